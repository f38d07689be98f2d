//! Time from a hang to its detection and to a ready successor, and the same after a panic.
//!
//! `cargo bench -p sinew-runtime --bench hangs [-- WORD...]`: 200 hangs of each sort, each in a new
//! incarnation, and 1,000 panics. A hang's time is that past its budget. The supervisor and its victim run
//! under SCHED_FIFO where that is granted, as on a robot. One JSON line for each figure on the standard
//! output, a table on the standard error. Nothing here asserts a time.

#![expect(clippy::unwrap_used, reason = "a bench says what failed by failing")]

use std::{
    sync::{
        Arc, Mutex,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, AsyncContext, Handler, fut::WrapFuture};
use sinew_figures::{Alone, Asked, Figures, head};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::{ChildId, Place, Reason, SupervisorFact},
    time::Time,
};
use sinew_runtime_tests::{Number, Patience, Stage};

const HANGS: u64 = 200;
const PANICS: u64 = 1_000;
const BUDGET: Duration = Duration::from_millis(50);

/// The fault at a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// Blocks in the handler.
    Block,
    /// Computes in the handler.
    Spin,
    /// Blocks in a spawned future; its start is not recorded.
    BlockInFuture,
    /// Waits for a future while messages are queued.
    WaitForEver,
    Panic,
}

struct Victim {
    fault: Fault,
    /// When the fault began.
    began: SyncSender<Time>,
    /// Closed when the fault may return.
    gate: Arc<Mutex<Receiver<()>>>,
}

impl Actor for Victim {
    type Context = AppContext<Self>;
}

fn block(gate: &Mutex<Receiver<()>>) {
    // Either the fault is released, or the bench is over.
    let _ = gate.lock().unwrap().recv();
}

impl Handler<Delivery<Number>> for Victim {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        if number.0 == 0 {
            return;
        }
        let (began, gate) = (self.began.clone(), self.gate.clone());
        match self.fault {
            Fault::Block => {
                began.send(Time::now()).unwrap();
                block(&gate);
            }
            Fault::Spin => {
                began.send(Time::now()).unwrap();
                let gate = gate.lock().unwrap();
                while gate.try_recv().is_err() {
                    std::hint::spin_loop();
                }
            }
            Fault::BlockInFuture => {
                let blocks = async move {
                    began.send(Time::now()).unwrap();
                    block(&gate);
                };
                context.spawn(blocks.into_actor(self));
            }
            Fault::WaitForEver => {
                began.send(Time::now()).unwrap();
                context.send(context.tid(), &Number(0)).unwrap();
                context.wait(std::future::pending::<()>().into_actor(self));
            }
            Fault::Panic => {
                began.send(Time::now()).unwrap();
                panic!("on purpose");
            }
        }
    }
}

struct Case {
    name: &'static str,
    fault: Fault,
    trials: u64,
}

const CASES: [Case; 5] = [
    Case { name: "blocks_in_handler", fault: Fault::Block, trials: HANGS },
    Case { name: "spins_in_handler", fault: Fault::Spin, trials: HANGS },
    Case { name: "blocks_in_future", fault: Fault::BlockInFuture, trials: HANGS },
    Case { name: "waits_for_ever", fault: Fault::WaitForEver, trials: HANGS },
    Case { name: "panics_in_handler", fault: Fault::Panic, trials: PANICS },
];

fn main() {
    let wanted = Asked::read(include_str!("main.rs"), &[]).wanted(&CASES, |case| case.name.to_owned());
    // Suppresses a thousand panic messages on the terminal.
    std::panic::set_hook(Box::new(|_| {}));
    head();
    wanted.into_iter().for_each(run);
}

fn run(case: &Case) {
    let (began, begins) = sync_channel(1);
    let (open, gate) = sync_channel(1);
    let (gate, fault) = (Arc::new(Mutex::new(gate)), case.fault);
    let make = move || Victim { fault, began: began.clone(), gate: gate.clone() };
    let place = Place::thread("victim").realtime(40);
    let spec = AppSpec::new("victim", make).handles::<Number>().progress_within(BUDGET).place(place);
    let stage = Stage::start_with(vec![spec.into()], Patience::Endless);
    stage.wait_ready(0);
    let (mut noticed, mut ready, mut late) = (Figures::new(), Figures::new(), 0);
    for _ in 0..case.trials {
        stage.send(0, 1);
        let began: Time = begins.recv().unwrap();
        let (told, is_hang) = next_failure(&stage);
        let budget = if is_hang { BUDGET } else { Duration::ZERO };
        let past = told.since(began + budget);
        noticed.record(past);
        late += u64::from(past > Duration::from_millis(10));
        ready.record(next_ready(&stage).since(told));
        if fault != Fault::Panic && fault != Fault::WaitForEver {
            open.send(()).unwrap();
            stage.wait_abandoned(0);
        }
    }
    let noticing =
        if fault == Fault::Panic { "from the panic to its report" } else { "report past the budget" };
    let bench = "hangs";
    Alone { bench, case: case.name, figure: noticing, seen: &noticed, counts: &[("over_10_ms", late)] }
        .report();
    Alone { bench, case: case.name, figure: "from the report to Ready", seen: &ready, counts: &[] }.report();
    stage.stop();
}

fn next_failure(stage: &Stage) -> (Time, bool) {
    loop {
        if let (at, SupervisorFact::Failed(ChildId(0), reason)) = stage.next_fact_at() {
            return (at, matches!(reason, Reason::Hung(_)));
        }
    }
}

fn next_ready(stage: &Stage) -> Time {
    loop {
        if let (at, SupervisorFact::Ready(ChildId(0))) = stage.next_fact_at() {
            return at;
        }
    }
}
