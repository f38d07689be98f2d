//! The queue of a real-time actor, beside that of actix: fed from its own CPU, under a backlog, and at its
//! stop.
//!
//! `cargo bench -p sinew-runtime --bench mailbox [-- WORD...]`. The reader runs under SCHED_FIFO 50 on one
//! CPU. On the same CPU an ordinary thread sends, as fast as it can or 10,000 a second. From another CPU a
//! third thread sends one message each 100 us, which is timed from its sending to its handling. In the cases
//! with `medium` a SCHED_FIFO 30 thread takes that CPU for 5 ms of each 20: the holder of a lock without
//! priority inheritance is kept from releasing it. One JSON line for each figure on the standard output, a
//! table on the standard error. Nothing here asserts a time.

#![expect(clippy::unwrap_used, reason = "a bench says what failed by failing")]

mod reader;
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use reader::{Queue, READER_CPU, Reader, Seen};
use sinew_figures::{Alone, Asked, Figures, head};
use sinew_runtime::{supervision::Place, time::Time};

/// Time of one case.
const RUN: Duration = Duration::from_secs(5);
/// Time between two timed messages.
const PROBE: Duration = Duration::from_micros(100);
/// Messages queued at the start of a backlog, and the cost of each.
const BACKLOG: (u64, Duration) = (20_000, Duration::from_micros(50));

/// The other load on the reader's CPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Load {
    Flood,
    TenThousand,
    FloodAndMedium,
}

fn main() {
    let loads = [Some(Load::Flood), Some(Load::TenThousand), Some(Load::FloodAndMedium), None];
    let cases = [Queue::Sinew, Queue::Actix].into_iter().flat_map(|queue| loads.map(|load| (queue, load)));
    let name = |(queue, load): &(Queue, Option<Load>)| {
        format!("{}_{}", queue.name(), load.map_or("backlog", Load::name))
    };
    let wanted = Asked::read(include_str!("main.rs"), &[]).wanted(cases, name);
    if std::thread::available_parallelism().map_or(1, usize::from) < 2 {
        eprintln!("this needs two CPUs");
        return;
    }
    head();
    for case in wanted {
        let name = name(&case);
        match case {
            (queue, Some(load)) => fed(&name, queue, load),
            (queue, None) => backlog(&name, queue),
        }
    }
}

impl Load {
    const fn name(self) -> &'static str {
        match self {
            Self::Flood => "flood",
            Self::TenThousand => "10000_per_s",
            Self::FloodAndMedium => "flood_and_medium",
        }
    }
}

fn fed(case: &str, queue: Queue, load: Load) {
    let reader = Reader::start(queue, Duration::ZERO);
    let stop = Arc::new(AtomicBool::new(false));
    let (ordinary_sent, probes_refused) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let mut threads =
        vec![ordinary(&reader, load, &stop, &ordinary_sent), probe(&reader, &stop, &probes_refused)];
    if load == Load::FloodAndMedium {
        threads.push(medium(&stop));
    }
    std::thread::sleep(RUN);
    stop.store(true, Ordering::Relaxed);
    for thread in threads {
        thread.join().unwrap();
    }
    let Seen { ages, over_10_ms, .. } = reader.finish();
    let counts = [
        ("over_10_ms", over_10_ms),
        ("ordinary_sent", ordinary_sent.load(Ordering::Relaxed)),
        ("refused", probes_refused.load(Ordering::Relaxed)),
    ];
    Alone { bench: "mailbox", case, figure: "from sending to handling", seen: &ages, counts: &counts }
        .report();
}

/// An ordinary thread on the reader's CPU.
fn ordinary(reader: &Reader, load: Load, stop: &Arc<AtomicBool>, sent: &Arc<AtomicU64>) -> JoinHandle<()> {
    let (send, stop, sent) = (reader.sender(), stop.clone(), sent.clone());
    std::thread::spawn(move || {
        Place::thread("ordinary").on_cpu(READER_CPU).prepare();
        let mut due = Time::now();
        while !stop.load(Ordering::Relaxed) {
            sent.fetch_add(u64::from(send(0)), Ordering::Relaxed);
            if load == Load::TenThousand {
                // Messages that it missed while it had no CPU are sent late.
                due = due + PROBE;
                std::thread::sleep(due.since(Time::now()));
            }
        }
    })
}

/// Sends the timed messages, from another CPU.
fn probe(reader: &Reader, stop: &Arc<AtomicBool>, refused: &Arc<AtomicU64>) -> JoinHandle<()> {
    let (send, stop, refused) = (reader.sender(), stop.clone(), refused.clone());
    std::thread::spawn(move || {
        Place::thread("probe").on_cpu(1 - READER_CPU).realtime(40).prepare();
        while !stop.load(Ordering::Relaxed) {
            refused.fetch_add(u64::from(!send(Time::now().as_nanos())), Ordering::Relaxed);
            std::thread::sleep(PROBE);
        }
    })
}

/// Takes the reader's CPU for 5 ms of each 20, below the reader and above the ordinary thread.
fn medium(stop: &Arc<AtomicBool>) -> JoinHandle<()> {
    let stop = stop.clone();
    std::thread::spawn(move || {
        Place::thread("medium").on_cpu(READER_CPU).realtime(30).prepare();
        while !stop.load(Ordering::Relaxed) {
            let until = Time::now() + Duration::from_millis(5);
            while Time::now() < until {
                std::hint::spin_loop();
            }
            std::thread::sleep(Duration::from_millis(15));
        }
    })
}

/// 20,000 messages are queued, each takes 50 us. Measures how late the periods of 1 ms are, and how long a
/// stop takes meanwhile.
fn backlog(case: &str, queue: Queue) {
    let (mut stopping, mut lateness) = (Figures::new(), None);
    for round in 0..5 {
        let mut reader = Reader::start(queue, BACKLOG.1);
        let send = reader.sender();
        reader.hold();
        let taken = (0..BACKLOG.0).filter(|_| send(0)).count() as u64;
        assert_eq!(taken, BACKLOG.0, "all of it waits");
        reader.go_on();
        if round == 0 {
            // Until all of it is handled, with a margin for delayed messages.
            std::thread::sleep(BACKLOG.1 * 20_000 * 2);
            let Seen { ticks, .. } = reader.finish();
            lateness = Some(ticks);
            continue;
        }
        std::thread::sleep(Duration::from_millis(100));
        stopping.record(reader.stop());
    }
    let bench = "mailbox";
    let lateness = lateness.unwrap();
    Alone { bench, case, figure: "lateness of a 1 ms period", seen: &lateness, counts: &[] }.report();
    Alone { bench, case, figure: "from the stop order to the end", seen: &stopping, counts: &[] }.report();
}
