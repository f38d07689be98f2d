//! Two hosts with a link of 10 Mbit/s between them: Control beside Bulk, and a bare TCP connection beside another one.

use std::{
    io::Write,
    net::{Ipv4Addr, TcpListener, TcpStream},
    thread,
    time::Duration,
};

use sinew_figures::{
    Alone, Pace, Rounds,
    process::{self, Process, say_there},
    stream,
};
use sinew_hosts::{Host, Hosts, Queue};

use crate::{beside, nodes::At};

/// What a link carries in a second.
const KBIT_PER_S: u32 = 10_000;
const PORT: u16 = 20_000;
/// Round trips without and with the flood.
const ROUNDS: u64 = 1_000;
/// Bytes of a question, and of a message of the flood.
const ASKED: usize = 64;
const FLOODED: usize = 1000;

/// Makes the hosts, and runs both on them; says why where that is not possible. Returns whether what ran went well.
pub(crate) fn measure(case: &str, queue: Queue) -> bool {
    let hosts = Hosts::new(2).and_then(|hosts| hosts.throttle(KBIT_PER_S, queue).map(|()| hosts));
    let hosts = match hosts {
        Ok(hosts) => hosts,
        Err(why) => {
            eprintln!("{case}: skipped: no slow link can be made here: {why}");
            return true;
        }
    };
    let [here, there] = [0, 1].map(|host| &hosts.all()[host]);
    let on = |host: &Host, role: &str| host.moved(&process::command(role));
    let at = At::loopback();
    let both = [
        (
            format!("beside_echo 0 {}", at.on(there.address)),
            format!("slow_nodes {case} {}", at.on(here.address)),
        ),
        (format!("slow_raw_echo {}", there.address), format!("slow_raw {case} {}", there.address)),
    ];
    both.iter().all(|(echo, measure)| {
        let _echo = Process::start_command(on(there, echo), echo);
        process::has_run(on(here, measure))
    })
}

/// The measuring node.
pub(crate) fn nodes(case: &str, at: At) {
    beside::measure(case, at, FLOODED, ROUNDS);
}

/// Echoes the first connection, takes what comes through the second.
pub(crate) fn raw_echo(address: Ipv4Addr) {
    let listener = TcpListener::bind((address, PORT)).expect("a free port");
    say_there();
    let (questions, _) = listener.accept().expect("the measuring end");
    questions.set_nodelay(true).expect("TCP has no delay");
    thread::spawn(move || {
        let (mut flood, _) = listener.accept().expect("the measuring end floods");
        // Ends with the connection.
        let _ = std::io::copy(&mut flood, &mut std::io::sink());
    });
    let (mut reader, mut writer) = (&questions, &questions);
    // Ends with the connection.
    let _ = std::io::copy(&mut reader, &mut writer);
}

/// Asks through one connection: alone, and beside a flood through another one.
pub(crate) fn raw(case: &str, address: Ipv4Addr) {
    let rounds = Rounds { bytes: ASKED, pace: Pace::EveryMillisecond, warm_up: 20, counted: ROUNDS as u32 };
    let connect = || {
        let connection = TcpStream::connect((address, PORT)).expect("the echo listens");
        connection.set_nodelay(true).expect("TCP has no delay");
        connection.set_write_timeout(Some(Duration::from_secs(60))).expect("a second is not zero");
        connection
    };
    let questions = connect();
    let alone = stream::round_trips(&questions, rounds);
    let mut flood = connect();
    // Ends with the process.
    thread::spawn(move || while flood.write_all(&[7; FLOODED]).is_ok() {});
    let beside = stream::round_trips(&questions, Rounds { counted: ROUNDS as u32 / 4, ..rounds });
    for (figure, seen) in [("raw TCP alone", &alone), ("raw TCP beside a flood", &beside)] {
        Alone { bench: "gncl", case, figure, seen, counts: &[] }.report();
    }
}
