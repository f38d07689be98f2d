//! Actors that hang: their detection and replacement, and the actors that are left alone.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, Instant},
};

use actix::{Actor, ActorContext, ActorFutureExt, AsyncContext, Handler, Running, fut::WrapFuture};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    outcome::Outcome,
    sender::{SendError, Sender},
    supervision::{Place, Reason},
    wire::Class,
};

use sinew_runtime_tests::{DEADLINE, Number, Stage};

/// Small, so that the tests are short; far above the time of a healthy turn on a loaded machine, starvation
/// aside.
const BUDGET: Duration = Duration::from_millis(150);

/// The reaction of an actor to the number 13.
#[derive(Clone)]
enum Evil {
    /// Blocks until it is released, then records the number, sends, and records the result of that.
    Block(Arc<std::sync::Mutex<Receiver<()>>>),
    /// Waits for a future that never completes.
    WaitForEver,
    /// Blocks its thread in a task that no actor owns.
    BlockOutside,
    /// Computes without end until it is released.
    Spin(Arc<std::sync::Mutex<Receiver<()>>>),
}

struct Scribe {
    written: SyncSender<String>,
    life: u64,
    evil: Evil,
}

impl Actor for Scribe {
    type Context = AppContext<Self>;
}

impl Scribe {
    fn write(&self, what: impl std::fmt::Display) {
        self.written.send(format!("{}: {what}", self.life)).unwrap();
    }
}

impl Handler<Delivery<Number>> for Scribe {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        if number.0 != 13 {
            return self.write(number.0);
        }
        match &self.evil {
            Evil::Block(gate) => {
                self.write("blocks");
                gate.lock().unwrap().recv_timeout(DEADLINE).expect("let go");
                self.write("back");
                let sent = context.send(context.tid(), &Number(14));
                self.write(match sent {
                    Err(SendError::Over) => "refused",
                    Err(_) => "another error",
                    Ok(()) => "sent",
                });
                context.after(Duration::ZERO, |this, _, _| this.write("a timer of a dead one"));
                context.spawn(async {}.into_actor(self));
            }
            Evil::WaitForEver => context.wait(std::future::pending::<()>().into_actor(self)),
            Evil::BlockOutside => {
                let written = self.written.clone();
                actix::spawn(async move {
                    written.send("outside".to_owned()).unwrap();
                    std::thread::sleep(BUDGET * 20); // the hang that is tested
                });
            }
            Evil::Spin(gate) => {
                let gate = gate.lock().unwrap();
                let until = Instant::now() + DEADLINE;
                while gate.try_recv().is_err() && Instant::now() < until {
                    std::hint::spin_loop();
                }
            }
        }
    }
}

fn scribe(name: &str, evil: Evil) -> (AppSpec<Scribe>, Receiver<String>) {
    let (written, read) = sync_channel(100);
    let lives = AtomicU64::new(0);
    let make = move || {
        let life = lives.fetch_add(1, Ordering::Relaxed) + 1;
        Scribe { written: written.clone(), life, evil: evil.clone() }
    };
    (AppSpec::new(name, make).handles::<Number>().progress_within(BUDGET), read)
}

fn gate() -> (SyncSender<()>, Arc<std::sync::Mutex<Receiver<()>>>) {
    let (open, gate) = sync_channel(1);
    (open, Arc::new(std::sync::Mutex::new(gate)))
}

fn next(read: &Receiver<String>) -> String {
    read.recv_timeout(DEADLINE).expect("something is written")
}

/// The outcome of a confirmed number, awaited on a thread of its own.
fn confirmed(sender: &Sender, number: u64) -> Receiver<Outcome> {
    let confirmation = sender.message(sender.tid(), &Number(number)).confirmed(DEADLINE).unwrap();
    let (say, heard) = sync_channel(1);
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        say.send(runtime.block_on(confirmation)).unwrap();
    });
    heard
}

fn hung(reason: Reason) -> String {
    let Reason::Hung(what) = reason else { panic!("{reason}") };
    what
}

#[test]
fn hung_handler_is_replaced_and_silent_when_it_returns() {
    let (open, gate) = gate();
    let (spec, read) = scribe("scribe", Evil::Block(gate));
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    let outcome = confirmed(&stage.senders[0], 13);
    stage.send(0, 1);
    assert_eq!(next(&read), "1: blocks");

    let what = hung(stage.wait_failed(0));
    assert!(what.contains("in its handler of `test.number`"), "{what}");
    stage.wait_ready(0);
    assert_eq!(next(&read), "2: 1", "the message behind it reaches its successor");
    assert_eq!(outcome.recv_timeout(DEADLINE), Ok(Outcome::Failed), "before it comes back");
    let tally = stage.mailboxes[0].tally(Class::Bulk);
    assert_eq!((tally.failed, tally.delivered + tally.open()), (1, 1));
    stage.wait_abandoned(1);

    open.send(()).unwrap();
    assert_eq!([next(&read), next(&read)], ["1: back", "1: refused"]);
    stage.wait_abandoned(0);
    stage.send(0, 2);
    assert_eq!(next(&read), "2: 2", "no timer of the dead one fired");
    let tally = stage.mailboxes[0].tally(Class::Bulk);
    assert_eq!(tally.failed, 1, "and its message is not counted twice");
    assert_eq!(stage.stop(), Reason::Shutdown);
}

#[test]
fn endless_computation_under_sched_fifo_is_replaced() {
    let (open, gate) = gate();
    let (spec, read) = scribe("scribe", Evil::Spin(gate));
    let stage = Stage::start(vec![spec.place(Place::thread("fifo").realtime(20)).into()]);
    stage.wait_ready(0);
    stage.send(0, 13);
    stage.send(0, 1);
    hung(stage.wait_failed(0));
    assert_eq!(next(&read), "2: 1");
    stage.wait_abandoned(1);
    open.send(()).unwrap();
    stage.wait_abandoned(0);
    stage.stop();
}

#[test]
fn neighbours_of_a_hung_actor_continue_on_another_thread() {
    let (open, gate) = gate();
    let shared = Place::thread("shared");
    let (evil, _read) = scribe("evil", Evil::Block(gate));
    let (good, read) = scribe("good", Evil::WaitForEver);
    let stage = Stage::start(vec![evil.place(shared.clone()).into(), good.place(shared).into()]);
    stage.wait_ready(1);
    stage.send(0, 13);
    stage.send(1, 1);
    hung(stage.wait_failed(0));
    assert_eq!(stage.wait_failed(1), Reason::ThreadEnded);
    stage.wait_ready(1);
    stage.send(1, 2);
    let told = [next(&read), next(&read)];
    assert!(["1: 1", "2: 1"].contains(&&*told[0]), "before the thread was lost, or after it: {told:?}");
    assert_eq!(told[1], "2: 2");
    open.send(()).unwrap();
    stage.wait_abandoned(0);
    stage.stop();
}

#[test]
fn endless_wait_with_queued_messages_is_restarted() {
    let (spec, read) = scribe("scribe", Evil::WaitForEver);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    stage.send(0, 13);
    stage.send(0, 1);
    let what = hung(stage.wait_failed(0));
    assert!(what.contains("waits on a future; 1 messages wait"), "{what}");
    assert_eq!(next(&read), "2: 1");
    assert_eq!(stage.most_abandoned(), 0);
    stage.stop();
}

#[test]
fn endless_wait_without_queued_messages_is_left_alone() {
    let (spec, read) = scribe("scribe", Evil::WaitForEver);
    let (other, other_read) = scribe("other", Evil::WaitForEver);
    let stage = Stage::start(vec![spec.own_thread().into(), other.own_thread().into()]);
    stage.wait_ready(1);
    stage.send(0, 13);
    // The time in which it is left alone is that of another actor's whole hang.
    stage.send(1, 13);
    stage.send(1, 1);
    assert!(hung(stage.wait_failed(1)).contains("messages wait"));
    assert_eq!(next(&other_read), "2: 1");
    stage.send(0, 1);
    assert!(hung(stage.wait_failed(0)).contains("1 messages wait"), "only now");
    assert_eq!(next(&read), "2: 1");
    stage.stop();
}

#[test]
fn thread_that_hangs_in_an_unowned_task_is_replaced() {
    let (spec, read) = scribe("scribe", Evil::BlockOutside);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    stage.send(0, 13);
    assert_eq!(next(&read), "outside");
    stage.send(0, 1);
    let what = hung(stage.wait_failed(0));
    assert!(what.contains("something that is no actor's"), "{what}");
    assert_eq!(next(&read), "2: 1");
    stage.stop();
}

#[test]
fn repeated_hangs_end_the_supervisor_before_threads_run_out() {
    let (written, _read) = sync_channel(100);
    let (_open, gate) = gate();
    let make = move || Scribe { written: written.clone(), life: 0, evil: Evil::Block(gate.clone()) };
    let spec = AppSpec::new("scribe", make).handles::<Number>().progress_within(BUDGET).own_thread();
    let stage = Stage::start(vec![spec.into()]);
    for _ in 0..4 {
        stage.wait_ready(0);
        stage.send(0, 13);
    }
    let Reason::GaveUp(why) = stage.wait_end() else { panic!("it gives up") };
    assert!(why.contains("have not let go of their threads"), "{why}");
}

/// Never becomes ready: its first turn does not end.
struct Stuck(Arc<std::sync::Mutex<Receiver<()>>>);

impl Actor for Stuck {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        let gate = self.0.lock().unwrap();
        gate.recv_timeout(DEADLINE).ok();
    }
}

#[test]
fn hang_in_started_or_factory_is_seen_early() {
    let (open, gate) = gate();
    let spec = AppSpec::new("stuck", move || Stuck(gate.clone())).progress_within(BUDGET).own_thread();
    let (second, making) = sync_channel::<()>(1);
    let making = Arc::new(std::sync::Mutex::new(making));
    let unmade = AppSpec::new("unmade", move || {
        making.lock().unwrap().recv_timeout(DEADLINE).ok();
        Stuck(Arc::new(std::sync::Mutex::new(sync_channel(1).1)))
    });
    let stage = Stage::start(vec![spec.into(), unmade.progress_within(BUDGET).own_thread().into()]);
    for child in [0, 1] {
        let what = hung(stage.wait_failed(child));
        assert!(what.contains("in its `started`"), "{what}");
    }
    drop((open, second));
    stage.stop();
}

/// Stops when ordered, and never returns from its `stopping`, or from its `stopped`.
struct Clinging {
    gate: Arc<std::sync::Mutex<Receiver<()>>>,
    clings_to_the_last: bool,
}

impl Clinging {
    fn cling(&self) {
        self.gate.lock().unwrap().recv_timeout(DEADLINE).ok();
    }
}

impl Actor for Clinging {
    type Context = AppContext<Self>;

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        if !self.clings_to_the_last {
            self.cling();
        }
        Running::Stop
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        self.cling();
    }
}

impl Handler<Delivery<Number>> for Clinging {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        match number.0 {
            1 => context.stop(),
            2 => _ = context.after(Duration::ZERO, |_, _, context| context.stop()),
            3 => _ = context.spawn(async {}.into_actor(self).map(|(), _, context| context.stop())),
            4 => context.terminate(),
            _ => _ = context.spawn(async {}.into_actor(self).map(|(), _, context| context.terminate())),
        }
    }
}

#[test]
fn hang_in_stopping_is_reported_as_such() {
    for (how, clings_to_the_last) in
        [(1, false), (2, false), (3, false), (1, true), (2, true), (3, true), (4, true), (5, true)]
    {
        let (open, gate) = gate();
        let make = move || Clinging { gate: gate.clone(), clings_to_the_last };
        let spec = AppSpec::new("clinging", make).handles::<Number>();
        let stage = Stage::start(vec![spec.progress_within(BUDGET).own_thread().into()]);
        stage.wait_ready(0);
        stage.send(0, how);
        let what = hung(stage.wait_failed(0));
        assert!(what.contains("in its `stopping` or `stopped`"), "{how}: {what}");
        drop(open);
        stage.stop();
    }
}

/// Slow, but within its budget: each message takes a third of it.
struct Slow(SyncSender<u64>);

impl Actor for Slow {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Slow {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        std::thread::sleep(BUDGET / 3); // the slowness that is tested
        self.0.send(number.0).unwrap();
    }
}

#[test]
fn slow_actor_within_its_budget_is_not_accused() {
    let shared = Place::thread("shared");
    let (say, heard) = sync_channel(100);
    let slow = AppSpec::new("slow", move || Slow(say.clone())).handles::<Number>().progress_within(BUDGET);
    let (good, read) = scribe("good", Evil::WaitForEver);
    let stage = Stage::start(vec![slow.place(shared.clone()).into(), good.place(shared).into()]);
    stage.wait_ready(1);
    // Twelve turns one after the other: four budgets in which the neighbour's message may wait.
    for number in 0..12 {
        stage.send(0, number);
    }
    stage.send(1, 1);
    for number in 0..12 {
        assert_eq!(heard.recv_timeout(DEADLINE), Ok(number));
    }
    assert_eq!(next(&read), "1: 1", "the same life as before; {:?}", stage.facts_so_far());
    stage.stop();
}
