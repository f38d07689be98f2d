//! Panics in any place of an actor: always one failure with the message and the location, and a working
//! successor.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, ActorContext, AsyncContext, Handler, Running, StreamHandler, fut::WrapFuture};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    outcome::Outcome,
    supervision::{ActorRestart, Place, Reason, RestartObserver, observe_restarts},
    wire::Class,
};

use sinew_runtime_tests::{DEADLINE, Number, Stage};

/// The place where the first incarnation panics on order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Where {
    Nowhere,
    Making,
    Started,
    Handler,
    /// In the handler, and in `drop` during the cleanup.
    HandlerThenDrop,
    /// In the handler, with a payload that panics when it is dropped.
    HandlerWithBomb,
    /// In the handler, with a payload that never returns from its drop.
    HandlerWithTar,
    Timer,
    Silence,
    ActixTimer,
    Future,
    Stream,
    Stopping,
    Stopped,
    Drop,
    /// In a task that no actor owns.
    Task,
    /// No panic: it ends its own thread.
    EndThread,
}

struct Fragile {
    whereabouts: Where,
    written: SyncSender<String>,
    life: u64,
}

/// Panics when it is dropped.
struct Bomb;

impl Drop for Bomb {
    fn drop(&mut self) {
        panic!("a bomb");
    }
}

/// Reports the schedule under which it is dropped, and does not return from the drop.
struct Tar(SyncSender<String>);

impl Drop for Tar {
    fn drop(&mut self) {
        self.0.send(format!("{:?}", thread_priority::thread_schedule_policy().unwrap())).unwrap();
        loop {
            std::thread::park();
        }
    }
}

impl Fragile {
    fn is(&self, whereabouts: Where) -> bool {
        self.life == 1 && self.whereabouts == whereabouts
    }
}

impl Actor for Fragile {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        assert!(!self.is(Where::Started), "in started");
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        assert!(!self.is(Where::Stopping), "in stopping");
        Running::Stop
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        assert!(!self.is(Where::Stopped), "in stopped");
    }
}

impl Drop for Fragile {
    fn drop(&mut self) {
        assert!(!self.is(Where::Drop) && !self.is(Where::HandlerThenDrop), "in drop");
    }
}

impl StreamHandler<u64> for Fragile {
    fn handle(&mut self, _: u64, _: &mut Self::Context) {
        panic!("in a stream");
    }
}

impl Handler<Delivery<Number>> for Fragile {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        let now = Duration::ZERO;
        if number.0 != 13 || self.life > 1 {
            return self.written.send(format!("{}: {}", self.life, number.0)).unwrap();
        }
        match self.whereabouts {
            Where::Nowhere | Where::Making | Where::Started => {}
            Where::Handler | Where::HandlerThenDrop => panic!("in the handler"),
            Where::HandlerWithBomb => std::panic::panic_any(Bomb),
            Where::HandlerWithTar => std::panic::panic_any(Tar(self.written.clone())),
            Where::Timer => {
                context.after(now, |_, _, _| panic!("in a timer"));
            }
            Where::Silence => {
                context.watch_input::<Number>(None, now, |_, _, _| panic!("in a silence"));
            }
            Where::ActixTimer => {
                context.run_later(now, |_, _| panic!("in a timer of actix's"));
            }
            Where::Future => {
                context.spawn(async { panic!("in a future") }.into_actor(self));
            }
            Where::Stream => {
                context.add_stream(futures_util::stream::iter([1]));
            }
            Where::Stopping | Where::Stopped | Where::Drop => context.stop(),
            Where::Task => {
                let written = self.written.clone();
                actix::spawn(async move {
                    written.send("a task".to_owned()).unwrap();
                    panic!("in nobody's task");
                });
            }
            Where::EndThread => {
                actix_rt::Arbiter::current().stop();
            }
        }
    }
}

fn fragile(name: &str, whereabouts: Where) -> (AppSpec<Fragile>, Receiver<String>) {
    let (written, read) = sync_channel(100);
    let lives = AtomicU64::new(0);
    let make = move || {
        let life = lives.fetch_add(1, Ordering::Relaxed) + 1;
        assert!(whereabouts != Where::Making || life != 1, "in its making");
        Fragile { whereabouts, written: written.clone(), life }
    };
    (AppSpec::new(name, make).handles::<Number>(), read)
}

/// Returns how the first incarnation ends when it is ordered to panic. Its successor works afterwards.
fn end_of(whereabouts: Where) -> Reason {
    let (spec, read) = fragile("fragile", whereabouts);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    if !matches!(whereabouts, Where::Making | Where::Started) {
        stage.wait_ready(0);
        stage.send(0, 13);
    }
    let reason = stage.wait_failed(0);
    stage.wait_ready(0);
    stage.send(0, 1);
    assert_eq!(read.recv_timeout(DEADLINE).expect("the successor works"), "2: 1");
    assert_eq!(stage.most_abandoned(), 0, "{reason}");
    assert_eq!(stage.stop(), Reason::Shutdown);
    reason
}

fn assert_panicked(whereabouts: Where, said: &str) {
    let end = end_of(whereabouts);
    let Reason::Panic(words) = end else { panic!("no panic in {whereabouts:?}: {end}") };
    let (seen, place) = words.rsplit_once(" at ").unwrap_or_else(|| panic!("no place: {words}"));
    assert_eq!(seen, said);
    assert!(place.starts_with("tests/runtime/tests/applications/panics.rs:"), "{place}");
}

#[test]
fn panic_in_factory_is_a_failed_start_and_retried() {
    assert_panicked(Where::Making, "in its making");
}

#[test]
fn panic_in_started_is_a_failure() {
    assert_panicked(Where::Started, "in started");
}

#[test]
fn panic_in_handler_is_a_failure() {
    assert_panicked(Where::Handler, "in the handler");
}

#[test]
fn panic_in_timer_is_a_failure() {
    assert_panicked(Where::Timer, "in a timer");
    assert_panicked(Where::ActixTimer, "in a timer of actix's");
}

#[test]
fn panic_in_input_watchdog_is_a_failure() {
    assert_panicked(Where::Silence, "in a silence");
}

#[test]
fn panic_in_own_future_or_stream_is_a_failure() {
    assert_panicked(Where::Future, "in a future");
    assert_panicked(Where::Stream, "in a stream");
}

#[test]
fn panic_in_stopping_or_stopped_is_a_failure() {
    assert_panicked(Where::Stopping, "in stopping");
    assert_panicked(Where::Stopped, "in stopped");
}

#[test]
fn panic_in_drop_after_own_end_is_a_failure() {
    assert_panicked(Where::Drop, "in drop");
}

#[test]
fn second_panic_in_drop_is_caught_and_first_reported() {
    assert_panicked(Where::HandlerThenDrop, "in the handler");
}

#[test]
fn panic_with_payload_that_panics_in_drop_is_caught() {
    let Reason::Panic(words) = end_of(Where::HandlerWithBomb) else { panic!("no panic") };
    assert!(words.starts_with("something that is not text"), "{words}");
}

#[test]
fn panic_payload_with_endless_drop_is_dropped_elsewhere() {
    // Given an actor with a real-time priority, where the system grants it.
    let (spec, read) = fragile("fragile", Where::HandlerWithTar);
    let stage = Stage::start(vec![spec.place(Place::thread("fifo").realtime(20)).into()]);
    stage.wait_ready(0);
    // When it panics with that payload, and no further message arrives.
    stage.send(0, 13);
    // Then its death is reported with its cause.
    let Reason::Panic(words) = stage.wait_failed(0) else { panic!("no panic") };
    assert!(
        words.starts_with("something that is not text at tests/runtime/tests/applications/panics.rs:"),
        "{words}"
    );
    // And the payload blocks neither its successor nor the CPU.
    let schedule = read.recv_timeout(DEADLINE).expect("it is dropped");
    assert_eq!(schedule, "Normal(Other)");
    stage.wait_ready(0);
    stage.send(0, 1);
    assert_eq!(read.recv_timeout(DEADLINE).expect("the successor works"), "2: 1");
    assert_eq!(stage.most_abandoned(), 0);
    assert_eq!(stage.stop(), Reason::Shutdown);
}

#[derive(Default)]
struct Restarts(Mutex<Vec<(u64, String)>>);

impl RestartObserver for Restarts {
    fn restarted(&self, restart: &ActorRestart<'_>) {
        // Other tests of this process restart actors, too.
        if restart.name == "fragile and observed" {
            assert_eq!(restart.supervisor, "test");
            self.0.lock().unwrap().push((restart.restarts, restart.why.to_owned()));
        }
    }
}

#[test]
fn restart_is_shown_with_the_last_end() {
    let restarts = Arc::new(Restarts::default());
    let observer: Arc<dyn RestartObserver> = restarts.clone();
    assert!(observe_restarts(&observer));
    let (spec, _read) = fragile("fragile and observed", Where::Handler);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    assert!(restarts.0.lock().unwrap().is_empty(), "the first start is no restart");
    stage.send(0, 13);
    stage.wait_failed(0);
    stage.wait_ready(0);
    stage.stop();
    let shown = restarts.0.lock().unwrap();
    let [(1, why)] = &shown[..] else { panic!("not one restart: {shown:?}") };
    assert!(why.starts_with("panicked: in the handler at "), "{why}");
}

#[test]
fn panic_settles_only_the_handled_message() {
    let (spec, read) = fragile("fragile", Where::Handler);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    let sender = &stage.senders[0];
    let [fatal, next] =
        [13, 2].map(|number| sender.message(sender.tid(), &Number(number)).confirmed(DEADLINE).unwrap());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    assert_eq!(runtime.block_on(fatal), Outcome::Failed);
    assert_eq!(runtime.block_on(next), Outcome::Delivered);
    assert_eq!(read.recv_timeout(DEADLINE).unwrap(), "2: 2");
    let mailbox = stage.mailboxes[0].clone();
    // The last message is counted when its reader asks for the next, or ends.
    stage.stop();
    let tally = mailbox.tally(Class::Bulk);
    assert_eq!((tally.failed, tally.open()), (1, 0));
}

#[test]
fn actors_of_an_ended_thread_restart_without_failure() {
    let shared = Place::thread("shared");
    let (evil, _) = fragile("evil", Where::EndThread);
    let (good, read) = fragile("good", Where::Nowhere);
    let stage = Stage::start(vec![evil.place(shared.clone()).into(), good.place(shared).into()]);
    stage.wait_ready(1);
    stage.send(0, 13);
    let mut lost = [stage.next_failed(), stage.next_failed()];
    lost.sort_by_key(|(child, _)| *child);
    assert_eq!(lost, [(0, Reason::ThreadEnded), (1, Reason::ThreadEnded)]);
    stage.send(1, 1);
    assert_eq!(read.recv_timeout(DEADLINE).expect("the neighbour works again"), "2: 1");
    stage.stop();
}

#[test]
fn panic_in_an_unowned_task_ends_only_that_task() {
    let (spec, read) = fragile("fragile", Where::Task);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    for number in [13, 2, 13, 3] {
        stage.send(0, number);
    }
    let mut said = [(); 4].map(|()| read.recv_timeout(DEADLINE).expect("each is written"));
    said.sort();
    assert_eq!(said, ["1: 2", "1: 3", "a task", "a task"], "it is the same life");
    assert_eq!(stage.stop(), Reason::Shutdown);
}
