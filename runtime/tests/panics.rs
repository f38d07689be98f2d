//! Panics in any place of an actor: always one failure with the words and the place, and a successor that works.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::{
    sync::{
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, ActorContext, AsyncContext, Handler, Running, StreamHandler, fut::WrapFuture};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    outcome::Outcome,
    supervision::{Place, Reason},
    wire::Class,
};
use stage::{DEADLINE, Number, Stage};

/// Where the first life panics when it is told to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Where {
    Nowhere,
    Making,
    Started,
    Handler,
    /// In the handler, and in `drop` while that is cleaned up.
    HandlerThenDrop,
    /// In the handler, with something that panics when it is dropped.
    HandlerWithBomb,
    /// In the handler, with something whose drop does not come back.
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
    /// No panic: it ends the thread that it lives on.
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

/// Says under which schedule it is dropped, and does not come back from that.
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

/// How the first life ends, when it is told to panic and its successor then works.
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
    assert!(place.starts_with("runtime/tests/panics.rs:"), "{place}");
}

#[test]
fn a_panic_while_it_is_made_is_a_failed_start_that_is_tried_again() {
    assert_panicked(Where::Making, "in its making");
}

#[test]
fn a_panic_in_started_is_a_failure() {
    assert_panicked(Where::Started, "in started");
}

#[test]
fn a_panic_in_a_handler_is_a_failure() {
    assert_panicked(Where::Handler, "in the handler");
}

#[test]
fn a_panic_in_a_timer_is_a_failure() {
    assert_panicked(Where::Timer, "in a timer");
    assert_panicked(Where::ActixTimer, "in a timer of actix's");
}

#[test]
fn a_panic_in_an_input_watchdog_is_a_failure() {
    assert_panicked(Where::Silence, "in a silence");
}

#[test]
fn a_panic_in_a_future_or_a_stream_of_its_own_is_a_failure() {
    assert_panicked(Where::Future, "in a future");
    assert_panicked(Where::Stream, "in a stream");
}

#[test]
fn a_panic_in_stopping_or_stopped_is_a_failure() {
    assert_panicked(Where::Stopping, "in stopping");
    assert_panicked(Where::Stopped, "in stopped");
}

#[test]
fn a_panic_in_drop_after_an_end_of_its_own_is_a_failure() {
    assert_panicked(Where::Drop, "in drop");
}

#[test]
fn a_second_panic_in_drop_is_caught_and_the_first_one_is_the_reason() {
    assert_panicked(Where::HandlerThenDrop, "in the handler");
}

#[test]
fn a_panic_that_carries_something_that_panics_when_it_is_dropped_is_caught() {
    let Reason::Panic(words) = end_of(Where::HandlerWithBomb) else { panic!("no panic") };
    assert!(words.starts_with("something that is not text"), "{words}");
}

#[test]
fn a_panic_that_carries_something_whose_drop_never_ends_is_told_and_that_is_dropped_elsewhere() {
    // Given one under a real-time priority, where the system grants it.
    let (spec, read) = fragile("fragile", Where::HandlerWithTar);
    let stage = Stage::start(vec![spec.place(Place::thread("fifo").realtime(20)).into()]);
    stage.wait_ready(0);
    // When it panics with that, and nobody sends it anything more.
    stage.send(0, 13);
    // Then its death is told, as what it was.
    let Reason::Panic(words) = stage.wait_failed(0) else { panic!("no panic") };
    assert!(words.starts_with("something that is not text at runtime/tests/panics.rs:"), "{words}");
    // And what it carried holds up neither its successor nor the CPU.
    let schedule = read.recv_timeout(DEADLINE).expect("it is dropped");
    assert_eq!(schedule, "Normal(Other)");
    stage.wait_ready(0);
    stage.send(0, 1);
    assert_eq!(read.recv_timeout(DEADLINE).expect("the successor works"), "2: 1");
    assert_eq!(stage.most_abandoned(), 0);
    assert_eq!(stage.stop(), Reason::Shutdown);
}

#[test]
fn a_panic_settles_the_confirmed_message_in_hand_and_no_other() {
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
    // The last message is counted when its reader comes for the next, or ends.
    stage.stop();
    let tally = mailbox.tally(Class::Bulk);
    assert_eq!((tally.failed, tally.open()), (1, 0));
}

#[test]
fn all_on_a_thread_that_ends_are_started_again_on_another_and_nobody_failed() {
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
fn a_panic_in_a_task_that_no_actor_owns_ends_that_task_and_no_actor() {
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
