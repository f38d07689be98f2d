//! Actors that do not come back: who is accused, what becomes of him, and who is left alone.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod stage;

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
use stage::{DEADLINE, Number, Stage};

/// Small, so that the tests are short; far above what a loaded machine needs for a healthy turn, starvation aside.
const BUDGET: Duration = Duration::from_millis(150);

/// What an actor does with the number 13.
#[derive(Clone)]
enum Evil {
    /// Blocks until it is let go, then writes the number down, sends, and writes down what became of that.
    Block(Arc<std::sync::Mutex<Receiver<()>>>),
    /// Waits for a future that never comes.
    WaitForEver,
    /// Blocks its thread in a task that no actor owns.
    BlockOutside,
    /// Computes without end until it is let go.
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
                    std::thread::sleep(BUDGET * 20); // what this test is about
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

/// The outcome of a confirmed number, waited for on a thread of its own.
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
fn a_hung_handler_is_reported_and_replaced_and_does_nothing_more_when_it_comes_back() {
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
fn one_that_computes_without_end_under_sched_fifo_is_replaced_too() {
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
fn neighbours_of_a_hung_one_go_on_on_another_thread() {
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
fn one_that_waits_for_ever_while_messages_wait_is_remade_and_no_thread_is_lost() {
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
fn one_that_waits_for_ever_and_is_wanted_by_nobody_is_left_alone() {
    let (spec, read) = scribe("scribe", Evil::WaitForEver);
    let (other, other_read) = scribe("other", Evil::WaitForEver);
    let stage = Stage::start(vec![spec.own_thread().into(), other.own_thread().into()]);
    stage.wait_ready(1);
    stage.send(0, 13);
    // The time in which it is left alone: that of another's whole hang.
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
fn a_thread_that_hangs_in_a_task_of_nobodys_is_replaced() {
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
fn one_that_hangs_again_and_again_brings_its_supervisor_to_give_up_before_threads_run_out() {
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
fn one_that_hangs_in_started_or_in_its_making_is_seen_before_its_start_is_over_time() {
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

/// Stops as it is told to, and does not come back from its `stopping`, or from its `stopped`.
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
fn one_that_hangs_in_stopping_is_said_to_hang_there_whatever_made_it_stop() {
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

/// Slow, and never too slow: each message takes a third of the budget.
struct Slow(SyncSender<u64>);

impl Actor for Slow {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Slow {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        std::thread::sleep(BUDGET / 3); // what this test is about
        self.0.send(number.0).unwrap();
    }
}

#[test]
fn a_slow_one_that_comes_back_each_time_is_not_accused_nor_is_its_neighbour() {
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
