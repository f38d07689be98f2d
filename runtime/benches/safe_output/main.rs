//! Time from the deadline of an output's watchdog to its safe state, after its commands have stopped.
//!
//! `cargo bench -p sinew-runtime --bench safe_output [-- WORD...]`: a command each millisecond, `within` 3
//! ms, 1,000 trials of each case. The time of a trial starts at the deadline of the watchdog, counted from
//! the handler of the last valid command. It ends at the call that makes the output safe. So it lacks the
//! time between the check of a command and its handler, some microseconds.
//!
//! Sender, receiver and watchdog run under SCHED_FIFO where that is granted, as on a robot. In the cases that
//! end in `_busy` as many threads as there are CPUs, and one more, compute at ordinary priority. Two JSON
//! lines for each case on the standard output, a table on the standard error. Nothing here asserts a time.
//!
//! In the same case an unrelated thread with the watchdog's priority sleeps for `within` again and again. Its
//! lateness is that of the machine for any such thread. Causes are a host that takes the CPU away, or a
//! kernel without preemption, which first finishes its work for an ordinary thread.

#![expect(clippy::unwrap_used, reason = "a bench says what failed by failing")]

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use actix::{Actor, Handler};
use serde::{Deserialize, Serialize};
use sinew_figures::{Alone, Asked, Figures, head};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    protection::{Cause, Guard, Protection},
    supervision::Place,
    tid::Tid,
    time::Time,
    wire::{Class, Payload},
};
use sinew_runtime_tests::{DEADLINE, Stage, tid};

const TRIALS: u64 = 1_000;
const PERIOD: Duration = Duration::from_millis(1);
const PROTECTION: Protection = Protection::of_period(PERIOD);
/// Permitted lateness of the watchdog: a target of the design.
const LATE: Duration = Duration::from_millis(1);

#[derive(Serialize, Deserialize)]
struct Torque {
    nm: f64,
}

impl Payload for Torque {
    const NAME: &'static str = "bench.torque";
    const CLASS: Class = Class::Stream;
    const PROTECTION: Option<Protection> = Some(PROTECTION);
}

/// The cause that stops the commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Fault {
    None,
    /// The sender stops sending.
    Silence,
    /// The receiver sleeps in its handler.
    Block,
    /// The receiver computes in its handler.
    Spin,
}

/// State that the bench and both applications share.
#[derive(Default)]
struct Shared {
    fault: AtomicU8,
    /// Time at which the last valid command was handled, in nanoseconds.
    good: AtomicU64,
}

impl Shared {
    fn has(&self, fault: Fault) -> bool {
        self.fault.load(Ordering::Acquire) == fault as u8
    }

    fn set(&self, fault: Fault) {
        self.fault.store(fault as u8, Ordering::Release);
    }
}

struct Central {
    drive: Tid,
    shared: Arc<Shared>,
}

impl Actor for Central {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |central, _, context| {
            if !central.shared.has(Fault::Silence) {
                context.send(central.drive, &Torque { nm: 12.5 }).unwrap();
            }
        });
    }
}

/// Events at the motor, with their times.
enum Seen {
    Moved,
    Safe(Time, Cause),
}

struct Drive {
    central: Tid,
    motor: SyncSender<Seen>,
    shared: Arc<Shared>,
    guard: Option<Guard<SyncSender<Seen>>>,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let safe = |motor: &mut SyncSender<Seen>, cause| motor.send(Seen::Safe(Time::now(), cause)).unwrap();
        self.guard = Some(context.guard::<Torque, _>(self.central, self.motor.clone(), safe).unwrap());
        context.every(PERIOD * 10, |drive, _, _| {
            // A quick operator: rejected until enough valid ones have arrived.
            let _ = drive.guard.as_ref().unwrap().arm();
        });
    }
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, torque: Delivery<Torque>, _: &mut Self::Context) {
        self.shared.good.store(Time::now().as_nanos(), Ordering::Release);
        let live = self.guard.as_ref().unwrap().apply(|motor| {
            assert!(torque.nm > 0.0);
            // A full queue: the bench has enough events that it moves.
            let _ = motor.try_send(Seen::Moved);
        });
        if live.is_err() {
            return;
        }
        while self.shared.has(Fault::Block) {
            thread::sleep(PERIOD);
        }
        while self.shared.has(Fault::Spin) {
            std::hint::spin_loop();
        }
    }
}

struct Case {
    name: &'static str,
    fault: Fault,
    is_busy: bool,
}

const CASES: [Case; 6] = [
    Case { name: "sender_silent", fault: Fault::Silence, is_busy: false },
    Case { name: "receiver_blocks", fault: Fault::Block, is_busy: false },
    Case { name: "receiver_spins", fault: Fault::Spin, is_busy: false },
    Case { name: "sender_silent_busy", fault: Fault::Silence, is_busy: true },
    Case { name: "receiver_blocks_busy", fault: Fault::Block, is_busy: true },
    Case { name: "receiver_spins_busy", fault: Fault::Spin, is_busy: true },
];

fn main() {
    let wanted = Asked::read(include_str!("main.rs"), &[]).wanted(&CASES, |case| case.name.to_owned());
    head();
    wanted.into_iter().for_each(run);
}

fn run(case: &Case) {
    let shared = Arc::new(Shared::default());
    let (motor, seen) = sync_channel(1_000);
    let [central, drive] = [0, 1].map(tid);
    let (sends, hears) = (shared.clone(), shared.clone());
    let sender = AppSpec::new("central", move || Central { drive, shared: sends.clone() });
    let receiver = AppSpec::new("drive", move || {
        let (motor, shared) = (motor.clone(), hears.clone());
        Drive { central, motor, shared, guard: None }
    });
    let sender = sender.place(Place::thread("central").realtime(40));
    let receiver = receiver.handles::<Torque>().place(Place::thread("drive").realtime(40));
    let stage = Stage::start(vec![sender.into(), receiver.into()]);
    let ends = Arc::new(AtomicBool::new(false));
    let busy = if case.is_busy { thread::available_parallelism().unwrap().get() + 1 } else { 0 };
    let spinners: Vec<_> = (0..busy)
        .map(|_| {
            let ends = ends.clone();
            thread::spawn(move || {
                while !ends.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            })
        })
        .collect();
    let witness = {
        let ends = ends.clone();
        thread::spawn(move || bear_witness(&ends))
    };
    let (mut late, mut over, mut early) = (Figures::new(), 0, 0);
    for _ in 0..TRIALS {
        while !matches!(next(&seen), Seen::Moved) {}
        shared.set(case.fault);
        let at = loop {
            // A stalled machine may have made it safe before; this event is in the queue as well.
            if let Seen::Safe(at, Cause::Silent) = next(&seen) {
                break at;
            }
        };
        let due = Time::from_nanos(shared.good.load(Ordering::Acquire)) + PROTECTION.within;
        if at < due {
            early += 1;
        } else {
            over += u64::from(at.since(due) > LATE);
            late.record(at.since(due));
        }
        shared.set(Fault::None);
    }
    let counts = [("over_1_ms", over), ("by_the_machine", early)];
    let figure = "made safe past the watchdog's time";
    Alone { bench: "safe_output", case: case.name, figure, seen: &late, counts: &counts }.report();
    ends.store(true, Ordering::Relaxed);
    let (woken, over) = witness.join().unwrap();
    let (figure, counts) = ("a bare sleep of as long is late", [("over_1_ms", over)]);
    Alone { bench: "safe_output", case: case.name, figure, seen: &woken, counts: &counts }.report();
    for spinner in spinners {
        spinner.join().unwrap();
    }
    stage.stop();
}

/// Measures how late a thread wakes that only sleeps, and how often it is late by more than [`LATE`].
fn bear_witness(ends: &AtomicBool) -> (Figures, u64) {
    Place::layer("witness").realtime(90).prepare();
    let (mut late, mut over) = (Figures::new(), 0);
    while !ends.load(Ordering::Relaxed) {
        let due = Time::now() + PROTECTION.within;
        thread::park_timeout(PROTECTION.within);
        let now = Time::now();
        // After a spurious wake it has slept for less.
        if now >= due {
            late.record(now.since(due));
            over += u64::from(now.since(due) > LATE);
        }
    }
    (late, over)
}

fn next(seen: &Receiver<Seen>) -> Seen {
    seen.recv_timeout(DEADLINE).expect("something happens to the motor")
}
