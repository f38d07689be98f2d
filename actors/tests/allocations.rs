//! Messages between nodes need no allocation, at either end, once the number of messages in flight no longer
//! grows.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

use std::{
    alloc::System,
    collections::VecDeque,
    marker::PhantomData,
    net::SocketAddrV4,
    pin::pin,
    process::Command,
    sync::mpsc::{SyncSender, sync_channel},
    task::{Context, Poll, Waker},
    time::Duration,
};

use actix::fut::wrap_future;
use serde::{Deserialize, Serialize};
use serde_bytes::ByteArray;
use sinew::{
    message::{Confirmation, Sender},
    prelude::*,
};
use stats_alloc::{INSTRUMENTED_SYSTEM, StatsAlloc};

/// Counts allocations of all threads, so that both ends are counted.
#[global_allocator]
static MEMORY: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Set in the process of a single test.
const ALONE: &str = "SINEW_TEST_ALONE";

/// No wait is longer.
const DEADLINE: Duration = Duration::from_secs(120);
/// Windows after which queues and buffers have grown as far as they will.
const WARM_UP: usize = 20;
/// Messages per measured window: more than are acknowledged at once. The count covers the whole process, and
/// its layers have occasional work of their own. Most windows contain none of it.
const WINDOW: usize = 200;
/// Windows that are counted.
const WINDOWS: usize = 30;
/// Messages per part of a window. On a busy machine a window lasts so long that most windows contain periodic
/// work of the layers. Most parts contain none.
const PART: usize = 20;
const PARTS: usize = WINDOW / PART;

/// A payload of `N` bytes in class Control.
#[derive(Serialize, Deserialize)]
struct Order<const N: usize>(ByteArray<N>);

impl<const N: usize> Payload for Order<N> {
    const NAME: &'static str = "test.order";
}

/// A payload of `N` bytes in class Bulk.
#[derive(Serialize, Deserialize)]
struct Load<const N: usize>(ByteArray<N>);

impl<const N: usize> Payload for Load<N> {
    const NAME: &'static str = "test.load";
    const CLASS: Class = Class::Bulk;
}

/// A payload of `N` bytes in class Stream, sent by datagram if it fits into one.
#[derive(Serialize, Deserialize)]
struct Setpoint<const N: usize>(ByteArray<N>);

impl<const N: usize> Payload for Setpoint<N> {
    const NAME: &'static str = "test.setpoint";
    const CLASS: Class = Class::Stream;
}

/// Made of bytes.
trait Filled: Payload {
    fn filled() -> Self;
}

impl<const N: usize> Filled for Order<N> {
    fn filled() -> Self {
        Self(ByteArray::new([7; N]))
    }
}

impl<const N: usize> Filled for Load<N> {
    fn filled() -> Self {
        Self(ByteArray::new([7; N]))
    }
}

impl<const N: usize> Filled for Setpoint<N> {
    fn filled() -> Self {
        Self(ByteArray::new([7; N]))
    }
}

/// Reports that a message was handled. Its echo shows that everything sent before on the same path has
/// arrived.
#[derive(Serialize, Deserialize)]
struct Word;

impl Payload for Word {
    const NAME: &'static str = "test.word";
}

/// How messages go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum How {
    /// This number of messages is in flight; the receiver sends each one back.
    ThereAndBack(usize),
    /// This number of messages is sent, and their outcomes are read when all of them are there.
    ConfirmedAndLookedAt(usize),
    /// This number of messages is in flight, and the outcome of each is awaited in turn.
    ConfirmedAndAwaited(usize),
}

fn allocated() -> usize {
    let stats = MEMORY.stats();
    stats.allocations + stats.reallocations
}

/// Allocations in each part of a window, without the warm-up.
struct Windows {
    messages: usize,
    before: usize,
    parts: Vec<usize>,
    done: SyncSender<Vec<usize>>,
}

impl Windows {
    const ALL: usize = (WARM_UP + WINDOWS) * PARTS;

    fn new(done: SyncSender<Vec<usize>>) -> Self {
        Self { messages: 0, before: 0, parts: Vec::with_capacity(Self::ALL), done }
    }

    /// Counts a message. Returns whether more are needed.
    fn count(&mut self) -> bool {
        self.messages += 1;
        if self.messages.is_multiple_of(PART) && self.parts.len() < Self::ALL {
            let now = allocated();
            self.parts.push(now - self.before);
            if self.parts.len() == Self::ALL {
                self.done.send(self.parts[WARM_UP * PARTS..].to_vec()).unwrap();
            }
            self.before = allocated();
        }
        self.parts.len() < Self::ALL
    }
}

/// The sending application, which counts.
struct Here<P> {
    how: How,
    windows: Windows,
    /// Sent messages with unread outcomes.
    under_way: Vec<Confirmation>,
    /// Words received since then.
    words: usize,
    payload: PhantomData<fn() -> P>,
}

impl<P: Filled> Here<P> {
    fn new(how: How, done: SyncSender<Vec<usize>>) -> Self {
        Self { how, windows: Windows::new(done), under_way: Vec::new(), words: 0, payload: PhantomData }
    }

    /// Sends `count` messages; the receiver answers each with a word when it is handled.
    fn send_confirmed(&mut self, there: Tid, count: usize, sender: &Sender) {
        self.words = 0;
        let sent = (0..count).map(|_| sender.message(there, &P::filled()).confirmed(DEADLINE).unwrap());
        self.under_way.extend(sent);
    }

    /// Sends messages with `count` in flight, and awaits the oldest outcome each time.
    async fn send_and_await(sender: Sender, there: Tid, count: usize, mut windows: Windows) {
        let send = || sender.message(there, &P::filled()).confirmed(DEADLINE).unwrap();
        let mut under_way: VecDeque<_> = (0..count).map(|_| send()).collect();
        while let Some(first) = under_way.pop_front() {
            assert_eq!(first.await, Outcome::Delivered);
            if windows.count() {
                under_way.push_back(send());
            }
        }
    }
}

impl<P: Filled> Actor for Here<P> {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (there, sender) = (context.resolve("there").unwrap(), context.sender());
        match self.how {
            How::ThereAndBack(count) => (0..count).for_each(|_| sender.send(there, &P::filled()).unwrap()),
            How::ConfirmedAndLookedAt(count) => self.send_confirmed(there, count, &sender),
            How::ConfirmedAndAwaited(count) => {
                let nobody = Windows::new(sync_channel(1).0);
                let windows = std::mem::replace(&mut self.windows, nobody);
                context.spawn(wrap_future(Self::send_and_await(sender, there, count, windows)));
            }
        }
    }
}

impl<P: Filled> Handler<Delivery<P>> for Here<P> {
    type Result = ();

    fn handle(&mut self, message: Delivery<P>, context: &mut Self::Context) {
        // There and back are two.
        self.windows.count();
        if self.windows.count() {
            context.send(message.source, &P::filled()).unwrap();
        }
    }
}

impl<P: Filled> Handler<Delivery<Word>> for Here<P> {
    type Result = ();

    fn handle(&mut self, word: Delivery<Word>, context: &mut Self::Context) {
        self.windows.count();
        self.words += 1;
        let count = self.under_way.len();
        if self.words < count {
            return;
        }
        // Outcomes are delivered after all messages of the same read. A word requested now arrives behind
        // them.
        if self.words < count + 2 {
            return context.send(word.source, &Word).unwrap();
        }
        let task = &mut Context::from_waker(Waker::noop());
        for confirmation in self.under_way.drain(..) {
            assert_eq!(pin!(confirmation).poll(task), Poll::Ready(Outcome::Delivered));
        }
        // Allocations for confirmations are counted, too.
        if (0..count).all(|_| self.windows.count()) {
            self.send_confirmed(word.source, count, &context.sender());
        }
    }
}

/// The receiving application at the other node, which also answers.
struct There {
    how: How,
}

impl Actor for There {
    type Context = AppContext<Self>;
}

impl<P: Filled> Handler<Delivery<P>> for There {
    type Result = ();

    fn handle(&mut self, message: Delivery<P>, context: &mut Self::Context) {
        // After the last count the other node stops, and receives nothing more.
        let _ = match self.how {
            How::ThereAndBack(_) => context.send(message.source, &P::filled()),
            How::ConfirmedAndLookedAt(_) => context.send(message.source, &Word),
            How::ConfirmedAndAwaited(_) => Ok(()),
        };
    }
}

impl Handler<Delivery<Word>> for There {
    type Result = ();

    fn handle(&mut self, word: Delivery<Word>, context: &mut Self::Context) {
        context.send(word.source, &Word).unwrap();
    }
}

/// A node on the loopback interface, in a group that only this process has.
fn node(name: &str, host: u8) -> NodeBuilder {
    let id = std::process::id();
    let group = SocketAddrV4::new([239, 255, 86, (id % 200 + 1) as u8].into(), 20_000 + (id % 20_000) as u16);
    Node::builder(name).address([127, 0, 0, host]).configure(|config| {
        config.ndl.multicast = Some(group);
        config.ndl.mdns_port = None;
        config.rt.probe = Duration::ZERO;
    })
}

/// Allocations in each part of the windows of messages between two nodes.
fn parts<P: Filled>(how: How) -> Vec<usize> {
    let (done, parts) = sync_channel(1);
    let there = AppSpec::new("there", move || There { how }).handles::<P>().handles::<Word>().own_thread();
    let here = AppSpec::new("home", move || Here::<P>::new(how, done.clone()));
    let here = here.handles::<P>().handles::<Word>().requires(["there"]).own_thread();
    let there = node("there", 2).app(there).start().unwrap();
    let here = node("home", 1).app(here).start().unwrap();
    let parts = parts.recv_timeout(DEADLINE).expect("all windows are counted");
    assert_goes_by_datagram::<P>(&here);
    here.stop();
    there.stop();
    parts
}

/// Asserts that values of class Stream went by datagram, except those before the datagram path was
/// established. Otherwise the test would have measured the connection, where the session counts sent
/// messages.
fn assert_goes_by_datagram<P: Payload>(here: &Node) {
    if P::CLASS == Class::Stream {
        let sessions = here.handle().audit_here().sessions;
        let by_connection: u64 = sessions
            .iter()
            .filter(|session| session.class == Some(P::CLASS))
            .map(|session| session.sending.next)
            .sum();
        let sent = (WARM_UP + WINDOWS) * WINDOW / 2;
        assert!(by_connection < sent as u64 / 2, "{sessions:?}");
    }
}

/// Asserts that the best window allocates at most `bound`, and that a quarter of the parts allocate little
/// more. So most messages reuse memory, not just some. `--nocapture` displays the other windows, including
/// the layers' own work.
fn assert_at_most<P: Filled>(bound: usize, length: usize, how: How) {
    let mut parts = parts::<P>(how);
    let mut windows: Vec<usize> = parts.chunks(PARTS).map(|window| window.iter().sum()).collect();
    windows.sort_unstable();
    parts.sort_unstable();
    let [least, median, most] = [0, WINDOWS / 2, WINDOWS - 1].map(|at| windows[at]);
    let quartile = parts[parts.len() / 4];
    let class = P::CLASS;
    println!(
        "{class:?}, {length} bytes, {how:?}: in {WINDOW} messages {least}, {median} (median), {most}; {quartile} in {PART}"
    );
    assert!(least <= bound, "{class:?}, {length} bytes, {how:?}: {windows:?}");
    // At rest half of the windows have 2 more at most.
    assert!(quartile <= bound.div_ceil(PARTS) + PART / 2, "{class:?}, {length} bytes, {how:?}: {parts:?}");
}

/// The same for each class, and the least and the greatest length: nothing is decided between them.
fn assert_all_at_most(bound: usize, how: How) {
    assert_at_most::<Order<64>>(bound, 64, how);
    assert_at_most::<Order<4096>>(bound, 4096, how);
    assert_at_most::<Load<64>>(bound, 64, how);
    assert_at_most::<Load<4096>>(bound, 4096, how);
}

/// Runs the body in a process of its own, as the count covers the whole process. `test` is the name of the calling
/// test.
fn alone(test: &str, body: impl FnOnce()) {
    if std::env::var_os(ALONE).is_some() {
        return body();
    }
    let mut program = Command::new(std::env::current_exe().unwrap());
    let output = program.args([test, "--exact", "--nocapture"]).env(ALONE, "1").output().unwrap();
    let report = String::from_utf8_lossy(&output.stdout);
    println!("{report}");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(report.contains("1 passed"), "there is no test {test}: {report}");
}

#[test]
fn unconfirmed_message_between_nodes_allocates_nothing() {
    alone("unconfirmed_message_between_nodes_allocates_nothing", || {
        assert_all_at_most(0, How::ThereAndBack(1));
        assert_all_at_most(0, How::ThereAndBack(16));
    });
}

#[test]
fn stream_value_by_datagram_allocates_nothing() {
    alone("stream_value_by_datagram_allocates_nothing", || {
        // Two values of a flow in flight are one: the newer value replaces the older.
        assert_at_most::<Setpoint<64>>(0, 64, How::ThereAndBack(1));
        assert_at_most::<Setpoint<1000>>(0, 1000, How::ThereAndBack(1));
    });
}

#[test]
fn confirmed_message_and_outcome_allocate_nothing() {
    alone("confirmed_message_and_outcome_allocate_nothing", || {
        assert_all_at_most(0, How::ConfirmedAndLookedAt(1));
        assert_all_at_most(0, How::ConfirmedAndLookedAt(16));
    });
}

#[test]
fn awaited_outcome_allocates_only_its_timer() {
    alone("awaited_outcome_allocates_only_its_timer", || {
        // The first message of a window may find the previous timer still in use.
        let of_the_edge = 2;
        assert_all_at_most(WINDOW + of_the_edge, How::ConfirmedAndAwaited(1));
    });
}
