//! The period of a loop while its parameters are set each 10 ms, in turns with none.
//!
//! `cargo bench -p sinew --bench params [-- --short]`: a loop of 1 kHz on a thread of its own reads two parameters in
//! each turn, under SCHED_FIFO where that is granted. In every second turn of 10 s another application of its node sets
//! both each 10 ms; one of them has a slope. There are ten turns. Two JSON lines for each case on the standard output:
//! the time from one tick to the next, and the lateness of the ticks. A table is on the standard error. `applied` and
//! `refused` count the outcomes of the sets; a set without an outcome is refused. Nothing here asserts a time.

use std::{
    hint::black_box,
    process::ExitCode,
    sync::{
        Arc, Mutex, MutexGuard,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
};

use sinew::{
    parameters::{NamedValue, ParameterOutcome, SetParameters, Value},
    prelude::*,
};
use sinew_figures::{Alone, Asked, Figures, head};

const PERIOD: Duration = Duration::from_millis(1);
const SET_EACH: Duration = Duration::from_millis(10);
const TURN: Duration = Duration::from_secs(10);
/// With `--short`.
const SHORT_TURN: Duration = Duration::from_secs(1);
/// Half of them have sets.
const TURNS: u32 = 10;
const PRIORITY: u8 = 60;
const DEADLINE: Duration = Duration::from_secs(60);

params! {
    /// The gains that the loop reads.
    struct Gains {
        /// Stiffness.
        stiffness: f64 = 0.0, unit "1", range 0.0..=1.0;
        /// Damping.
        damping: f64 = 0.0, unit "1", range 0.0..=1.0, slope 10.0;
    }
}

/// The times of one case.
#[derive(Default)]
struct Seen {
    periods: Figures,
    lateness: Figures,
}

/// State that the bench and both applications share.
#[derive(Default)]
struct Shared {
    /// Whether parameters are set in this turn.
    is_set: AtomicBool,
    /// Without sets, and with them. Only the loop takes the lock during the turns.
    cases: [Mutex<Seen>; 2],
    applied: AtomicU64,
    refused: AtomicU64,
}

impl Shared {
    fn case(&self, is_set: bool) -> MutexGuard<'_, Seen> {
        self.cases[usize::from(is_set)].lock().expect("no thread panics with it")
    }
}

struct Loop {
    gains: Arc<Gains>,
    shared: Arc<Shared>,
    before: Option<Time>,
}

impl Actor for Loop {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(PERIOD, |this, tick, _| {
            black_box(this.gains.stiffness.get() + this.gains.damping.get());
            let now = tick.scheduled + tick.lateness;
            let mut seen = this.shared.case(this.shared.is_set.load(Ordering::Relaxed));
            seen.lateness.record(tick.lateness);
            if let Some(before) = this.before.replace(now) {
                seen.periods.record(now.since(before));
            }
        });
    }
}

struct Setter {
    shared: Arc<Shared>,
}

impl Setter {
    fn count(&self, is_applied: bool) {
        let count = if is_applied { &self.shared.applied } else { &self.shared.refused };
        count.fetch_add(1, Ordering::Relaxed);
    }
}

impl Actor for Setter {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(SET_EACH, |setter, tick, ctx| {
            if !setter.shared.is_set.load(Ordering::Relaxed) {
                return;
            }
            let value = Value::Number((tick.number % 2) as f64);
            let named = |name: &str| NamedValue { name: name.to_owned(), value };
            let set = SetParameters::Values(["stiffness", "damping"].map(named).to_vec());
            match ctx.message("loop", &set).ask::<ParameterOutcome>(Duration::from_secs(1)) {
                Ok(reply) => drop(ctx.spawn(reply.into_actor(setter).map(|reply, setter, _| {
                    setter.count(matches!(reply, Ok(ParameterOutcome::Applied { .. })));
                }))),
                Err(_) => setter.count(false),
            }
        });
    }
}

fn main() -> ExitCode {
    let asked = Asked::read(include_str!("main.rs"), &["--short"]);
    let turn = if asked.is_short() { SHORT_TURN } else { TURN };
    head();
    let (gains, shared) = (Gains::new(), Arc::<Shared>::default());
    let (own, of_loop, of_setter) = (gains.clone(), shared.clone(), shared.clone());
    let reading =
        AppSpec::new("loop", move || Loop { gains: own.clone(), shared: of_loop.clone(), before: None });
    let setting = AppSpec::new("setter", move || Setter { shared: of_setter.clone() }).requires(["loop"]);
    let builder = Node::builder("params").configure(|config| {
        config.project = "params-bench".to_owned();
        (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
        config.rt.probe = Duration::ZERO;
    });
    let reading = reading.params(&gains).place(Place::own_thread().realtime(PRIORITY));
    let node = match builder.app(reading).app(setting.own_thread()).start() {
        Ok(node) => node,
        Err(why) => {
            eprintln!("no node starts: {why}");
            return ExitCode::FAILURE;
        }
    };
    if let Err(why) = node.handle().wait_until_running(DEADLINE) {
        eprintln!("the applications do not start: {why}");
        return ExitCode::FAILURE;
    }
    for number in 0..TURNS {
        shared.is_set.store(number % 2 == 1, Ordering::Relaxed);
        thread::sleep(turn);
    }
    node.stop();
    report(&shared);
    ExitCode::SUCCESS
}

fn report(shared: &Shared) {
    let [applied, refused] = [&shared.applied, &shared.refused].map(|count| count.load(Ordering::Relaxed));
    for (case, is_set) in [("no_set", false), ("set_each_10_ms", true)] {
        let seen = shared.case(is_set);
        let counts: &[_] = if is_set { &[("applied", applied), ("refused", refused)] } else { &[] };
        for (figure, seen) in [("from one tick to the next", &seen.periods), ("late", &seen.lateness)] {
            Alone { bench: "params", case, figure, seen, counts }.report();
        }
    }
}
