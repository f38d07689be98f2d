//! Messages within a process cause no allocation: once the number in flight stops growing, a message
//! allocates no memory.

use std::{
    alloc::System,
    collections::BTreeSet,
    pin::pin,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    task::{Context, Poll, Waker},
};

use actix::{Actor, Handler};
use serde::{Deserialize, Serialize};
use serde_bytes::ByteArray;
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery, DynApp, Raw},
    mailbox::Mailbox,
    outcome::Outcome,
    pending::Pending,
    router::{LocalRoute, Router},
    sender::Sender,
    supervision::Place,
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Header, Kind, MessageBuffer, Payload},
};
use sinew_runtime_tests::{DEADLINE, Nobody, Stage};
use stats_alloc::{INSTRUMENTED_SYSTEM, StatsAlloc};

use super::alone;

/// Counts the allocations of all threads.
#[global_allocator]
static MEMORY: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Round trips after which queues and buffers have grown as far as they will.
const WARM_UP: u64 = 1_000;
/// Round trips that are measured together. The count covers the whole process, and its watchdog checks now
/// and then: most windows contain no check.
const WINDOW: u64 = 100;
/// Number of windows; the best one counts. An allocation for each message, or for each hundredth, is in all
/// of them.
const WINDOWS: u64 = 100;

/// The longest payload of this guarantee.
#[derive(Serialize, Deserialize)]
struct Block(ByteArray<4096>);

impl Payload for Block {
    const NAME: &'static str = "test.block";
}

#[derive(Serialize, Deserialize)]
struct Angles {
    joints: [f64; 6],
    at: u64,
}

impl Payload for Angles {
    const NAME: &'static str = "test.angles";
}

const RAW: Kind = Kind::named("test.raw");

/// The payload of the round trips.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    Block,
    Angles,
    Raw,
}

/// Sends each message back to the other player, and counts.
struct Player {
    what: What,
    rounds: u64,
    /// Allocated bytes of the process at the start of the window.
    before: usize,
    /// The smallest allocation of a window.
    least: usize,
    say: SyncSender<usize>,
}

impl Player {
    fn new(what: What, say: SyncSender<usize>) -> Self {
        Self { what, rounds: 0, before: 0, least: usize::MAX, say }
    }

    fn returns(&mut self, to: Tid, context: &AppContext<Self>) {
        self.rounds += 1;
        if self.rounds > WARM_UP && self.rounds.is_multiple_of(WINDOW) {
            let now = allocated();
            self.least = self.least.min(now - self.before);
        }
        if self.rounds == WARM_UP + WINDOW * WINDOWS {
            // For the second of the two players, the channel has no receiver any more.
            let _ = self.say.try_send(self.least);
            return;
        }
        if self.rounds.is_multiple_of(WINDOW) {
            self.before = allocated();
        }
        send(&context.sender(), to, self.what);
    }
}

fn allocated() -> usize {
    let stats = MEMORY.stats();
    stats.allocations + stats.reallocations
}

fn send(from: &Sender, to: Tid, what: What) {
    match what {
        What::Block => from.send(to, &Block(ByteArray::new([7; 4096]))),
        What::Angles => from.send(to, &Angles { joints: [0.5; 6], at: 9 }),
        What::Raw => {
            let mut buffer = from.create_message(to, RAW, 4096).unwrap();
            buffer.fill(7);
            from.loaned(buffer).send()
        }
    }
    .unwrap();
}

impl Actor for Player {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Block>> for Player {
    type Result = ();

    fn handle(&mut self, block: Delivery<Block>, context: &mut Self::Context) {
        assert_eq!(block.0[4095], 7);
        self.returns(block.source, context);
    }
}

impl Handler<Delivery<Angles>> for Player {
    type Result = ();

    fn handle(&mut self, angles: Delivery<Angles>, context: &mut Self::Context) {
        assert_eq!((angles.joints[5], angles.at), (0.5, 9));
        self.returns(angles.source, context);
    }
}

impl Handler<Delivery<Raw>> for Player {
    type Result = ();

    fn handle(&mut self, raw: Delivery<Raw>, context: &mut Self::Context) {
        assert_eq!(raw[4095], 7);
        self.returns(raw.source, context);
    }
}

fn player(name: &str, what: What, place: Place) -> (DynApp, Receiver<usize>) {
    let (say, said) = sync_channel(1);
    let spec = AppSpec::new(name, move || Player::new(what, say.clone()));
    (spec.handles::<Block>().handles::<Angles>().handles_raw(RAW).place(place).into(), said)
}

/// The smallest allocation of a window of round trips between two applications.
fn allocated_between(what: What, places: [Place; 2]) -> usize {
    let [here, there] = places;
    let ((ping, said), (pong, _)) = (player("ping", what, here), player("pong", what, there));
    let stage = Stage::start(vec![ping, pong]);
    send(&stage.senders[1], stage.senders[0].tid(), what);
    let allocated = said.recv_timeout(DEADLINE).expect("the rounds end");
    stage.stop();
    allocated
}

#[test]
fn message_on_one_thread_allocates_nothing() {
    alone("allocations::message_on_one_thread_allocates_nothing", || {
        for what in [What::Block, What::Angles, What::Raw] {
            assert_eq!(allocated_between(what, [Place::thread("one"), Place::thread("one")]), 0, "{what:?}");
        }
    });
}

#[test]
fn message_between_two_threads_allocates_nothing() {
    alone("allocations::message_between_two_threads_allocates_nothing", || {
        for what in [What::Block, What::Angles, What::Raw] {
            assert_eq!(allocated_between(what, [Place::thread("one"), Place::thread("two")]), 0, "{what:?}");
        }
    });
}

#[test]
fn group_message_is_written_once_and_allocates_nothing() {
    alone("allocations::group_message_is_written_once_and_allocates_nothing", || {
        // Given a group of three.
        let router = Router::new(NodeAddress::new(1));
        let (group, kind) = (AppAddress::group("all"), Kind::named("test.raw"));
        let mailboxes: Vec<_> = (0..3).map(|_| Mailbox::new(8)).collect();
        for (index, mailbox) in (0..).zip(&mailboxes) {
            let app = AppAddress::fixed(index).unwrap();
            router.set_local(app, LocalRoute { sink: mailbox.clone(), events: Arc::new([]) });
            router.set_member(group, app, true);
        }
        let mut readers: Vec<_> = mailboxes.iter().map(Mailbox::attach).collect();
        let mut take = || {
            let task = &mut Context::from_waker(Waker::noop());
            readers.iter_mut().for_each(|reader| reader.finish(Outcome::Delivered));
            readers.iter_mut().map(|reader| reader.poll_take(task)).collect::<Vec<_>>()
        };
        let mut least = usize::MAX;
        for _ in 0..WINDOWS {
            // When a message is sent to it.
            let header = Header::new(kind, Tid::NONE, Tid::new(NodeAddress::ALL, group));
            let before = allocated();
            router.send(MessageBuffer::new(header, 4096).freeze()).unwrap();
            least = least.min(allocated() - before);
            // Then all have the same bytes, at the same address.
            let taken = take();
            let places: BTreeSet<_> = taken
                .iter()
                .map(|taken| {
                    let Poll::Ready(Some(message)) = taken else { panic!("each has a message: {taken:?}") };
                    message.payload.as_ptr() as usize
                })
                .collect();
            assert_eq!((taken.len(), places.len()), (3, 1));
        }
        assert_eq!(least, 0);
    });
}

#[test]
fn confirmed_message_and_outcome_allocate_nothing() {
    alone("allocations::confirmed_message_and_outcome_allocate_nothing", || {
        // Given an application that receives its messages.
        let (node, app) = (NodeAddress::new(1), AppAddress::fixed(1).unwrap());
        let (router, mailbox) = (Arc::new(Router::new(node)), Mailbox::new(8));
        router.set_local(app, LocalRoute { sink: mailbox.clone(), events: Arc::new([]) });
        let mut reader = mailbox.attach();
        let pending = Pending::new(8);
        let sender = Sender::new(Tid::new(node, app), router, Arc::new(Nobody), pending, 4096);
        let task = &mut Context::from_waker(Waker::noop());
        let mut least = usize::MAX;
        for at in 0..WINDOWS {
            let before = allocated();
            // When it is sent a message with an awaited outcome.
            let angles = Angles { joints: [0.5; 6], at };
            let mut confirmation = pin!(sender.message(sender.tid(), &angles).confirmed(DEADLINE).unwrap());
            let Poll::Ready(Some(mut message)) = reader.poll_take(task) else { panic!("the message") };
            message.settle(Outcome::Delivered);
            reader.finish(Outcome::Delivered);
            // Then the outcome is known, and nothing was allocated for it.
            assert_eq!(confirmation.as_mut().poll(task), Poll::Ready(Outcome::Delivered));
            least = least.min(allocated() - before);
        }
        assert_eq!(least, 0);
    });
}
