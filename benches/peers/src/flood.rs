//! A flood: one-way packets of 1000 bytes as fast as possible, until the last one has arrived.

use std::{
    process::Stdio,
    sync::atomic::{AtomicU64, Ordering},
    time::{Duration, Instant},
};

use sinew_figures::{
    Alone, Figures, Pinning,
    process::{Process, await_end, command, print_ready},
    results::{self, CaseResult, Recorder},
};
use zenoh::Wait;

use crate::{
    nodes::At,
    one_way::{self, Carrier},
    ping::DEADLINE,
    zenoh as peer,
};

/// Bytes of a packet.
const PACKET: usize = 1000;
/// The first byte of a counted packet; other packets only announce their sender.
const COUNTS: u8 = 7;
/// Runs of each case.
const RUNS: usize = 5;

/// zenoh's name: reliable, batching as it likes.
const ZENOH: &str = "zenoh";

/// The carriers: TCP with a length before each packet; zenoh; Sinew between applications on their own
/// threads, with each packet confirmed, or none.
const CARRIERS: [&str; 5] = [
    Carrier::Tcp.name(),
    Carrier::TcpTogether.name(),
    ZENOH,
    Carrier::Confirmed.name(),
    Carrier::Unconfirmed.name(),
];

/// Runs every case that has every one of these words in its name.
pub(crate) fn run(is_short: bool, words: &[String], recorder: &mut Recorder) {
    let packets = if is_short { 100_000 } else { 1_000_000 };
    sinew_figures::head();
    for pinning in [Pinning::Anywhere, Pinning::OneCpuEach] {
        for carrier in CARRIERS {
            let name = format!("flood-{carrier}-{}", pinning.name());
            if words.iter().all(|word| name.contains(word.as_str())) {
                let Some((figures, rates)) = rates(&name, carrier, pinning, packets) else { continue };
                report(&name, packets, &figures, &rates);
                recorder.add(result(carrier, pinning, packets, &rates));
            }
        }
    }
}

/// Returns the time for each packet, and the messages a second, sorted, of all runs that succeed.
fn rates(name: &str, carrier: &str, pinning: Pinning, packets: u64) -> Option<(Figures, Vec<u64>)> {
    let (mut figures, mut rates) = (Figures::new(), Vec::new());
    for _ in 0..RUNS {
        let role = format!("flood {carrier} {} {packets}", pinning.name());
        let output = command(&role).stdin(Stdio::null()).output().expect("this program starts itself");
        let line = String::from_utf8(output.stdout).ok();
        let Some(nanos) = line.and_then(|line| line.trim().parse::<u64>().ok()) else {
            eprintln!("{name} failed: {}", String::from_utf8_lossy(&output.stderr));
            continue;
        };
        figures.record(Duration::from_nanos(nanos / packets));
        rates.push(packets * 1_000_000_000 / nanos.max(1));
    }
    rates.sort_unstable();
    (!rates.is_empty()).then_some((figures, rates))
}

fn report(name: &str, packets: u64, seen: &Figures, rates: &[u64]) {
    let counts = [
        ("messages_per_second", rates[rates.len() / 2]),
        ("least", rates[0]),
        ("most", rates[rates.len() - 1]),
        ("packets", packets),
    ];
    Alone { bench: "peers", case: name, figure: "time for each packet", seen, counts: &counts }.report();
}

fn result(carrier: &str, pinning: Pinning, packets: u64, rates: &[u64]) -> CaseResult {
    CaseResult {
        case: carrier.to_owned(),
        pace: results::FLOOD.to_owned(),
        cpus: pinning.name().to_owned(),
        bytes: PACKET,
        runs: rates.len(),
        rounds: Some(packets),
        per_second: Some(rates[rates.len() / 2]),
        least_per_second: rates.first().copied(),
        most_per_second: rates.last().copied(),
        ..CaseResult::default()
    }
}

/// Sends them, and prints the total time.
pub(crate) fn measure(carrier: &str, packets: usize, pinning: Pinning) {
    let role = |at: &str| format!("sink {carrier} {} {packets} {at}", pinning.name());
    let took = if carrier == ZENOH {
        zenoh(packets, role)
    } else {
        let at = At::loopback();
        one_way::run(Carrier::named(carrier), packets, at, &role(&at.host(2).to_string())).took
    };
    println!("{}", took.as_nanos());
}

/// Receives the packets, and answers when the last one has arrived.
pub(crate) fn sink(carrier: &str, packets: usize, at: &str) {
    if carrier == ZENOH {
        zenoh_sink(packets, at);
    } else {
        one_way::sink(Carrier::named(carrier), packets, At::read(at));
    }
}

fn zenoh(packets: usize, role: impl Fn(&str) -> String) -> Duration {
    let at = peer::free_address();
    let _sink = Process::start(&role(&at));
    let session = peer::session(false, &at);
    let (answer, answers) = peer::answers();
    let _subscriber = peer::subscriber(&session, false, move |sample| drop(answer.send(sample)));
    let publisher = peer::publisher(&session, true, false);
    peer::meet(&publisher, &answers, &[0; PACKET]);
    let packet = vec![COUNTS; PACKET];
    let start = Instant::now();
    for _ in 0..packets {
        publisher.put(packet.as_slice()).wait().expect("a session");
    }
    answers.recv_timeout(DEADLINE).expect("the sink answers");
    start.elapsed()
}

fn zenoh_sink(packets: usize, at: &str) {
    let session = peer::session(true, at);
    let (back, taken) = (peer::publisher(&session, false, true), AtomicU64::new(0));
    let _subscriber = peer::subscriber(&session, true, move |sample| {
        let counts = sample.payload().to_bytes().first() == Some(&COUNTS);
        if !counts || taken.fetch_add(1, Ordering::Relaxed) + 1 == packets as u64 {
            back.put([1]).wait().expect("a session");
        }
    });
    print_ready();
    await_end();
}
