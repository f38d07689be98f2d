//! Messages that wait for room, in virtual time.

use std::{
    future::Future,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    task::{Wake, Waker},
};

use serde::{Deserialize, Serialize};

use super::*;
use crate::{
    clock::VirtualTime,
    mailbox::{Mailbox, MailboxReader},
    outcome::Outcome,
    pending::Pending,
    router::{LocalRoute, Router},
    sender::Directory,
    tid::{AppAddress, NodeAddress},
    wire::{Header, Payload},
};

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
const SENDER: AppAddress = AppAddress::new(0x1001);
const SINK: AppAddress = AppAddress::new(0x1002);
/// Messages that have room in the sink's mailbox.
const CAPACITY: usize = 4;
const SECOND: Duration = Duration::from_secs(1);

#[derive(Debug, Serialize, Deserialize)]
struct Block(u32);

impl Payload for Block {
    const NAME: &'static str = "test.room.block";
    const CLASS: Class = Class::Bulk;
}

struct NoNames;

impl Directory for NoNames {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

#[derive(Default)]
struct Task(AtomicUsize);

impl Wake for Task {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// A sender, a sink with a small mailbox, and the task that sends.
struct World {
    time: VirtualTime,
    router: Arc<Router>,
    sender: Sender,
    mailbox: Arc<Mailbox>,
    reader: MailboxReader,
    task: Arc<Task>,
    waker: Waker,
}

impl World {
    fn new() -> Self {
        let time = VirtualTime::starting_at(Time::from_nanos(1_000));
        let router = Arc::new(Router::new(NODE).on_clock(time.clock()));
        let mailbox = Mailbox::on_clock(time.clock(), CAPACITY);
        router.set_local(SINK, LocalRoute { sink: mailbox.clone(), events: Arc::new([]) });
        let tid = Tid::new(NODE, SENDER);
        let pending = Pending::on_clock(time.clock(), 1, 8);
        let sender = Sender::new(tid, router.clone(), Arc::new(NoNames), pending, 1_000);
        let (reader, task) = (mailbox.attach(), Arc::<Task>::default());
        let waker = task.clone().into();
        Self { time, router, sender, mailbox, reader, task, waker }
    }

    /// The same, with a full mailbox.
    fn full() -> Self {
        let world = Self::new();
        (0..CAPACITY as u32)
            .for_each(|number| world.sender.send(sink(), &Block(number)).expect("it has room"));
        world
    }

    fn poll<F: Future + Unpin>(&self, future: &mut F) -> Poll<F::Output> {
        Pin::new(future).poll(&mut Context::from_waker(&self.waker))
    }

    fn wakes(&self) -> usize {
        self.task.0.load(Ordering::Relaxed)
    }

    /// Takes the next message at the sink, and returns its number and header.
    fn take(&mut self) -> (u32, Header) {
        let Poll::Ready(Some(mut message)) = self.reader.poll_take(&mut Context::from_waker(Waker::noop()))
        else {
            panic!("no message waits")
        };
        self.reader.finish(Outcome::Delivered);
        message.settle(Outcome::Delivered);
        (message.decode::<Block>().expect("a block").0, message.header)
    }
}

fn sink() -> Tid {
    Tid::new(NODE, SINK)
}

#[test]
fn message_with_room_is_sent_at_its_first_poll() {
    let mut world = World::new();
    let mut sent = world.sender.message(sink(), &Block(7)).room_within(SECOND).send();
    assert_eq!(world.mailbox.depth(), 0, "nothing is sent before that");
    assert_eq!(world.poll(&mut sent), Poll::Ready(Ok(())));
    assert_eq!((world.take().0, world.wakes()), (7, 0));
    assert_eq!(world.time.next_wake(), None, "it has no timer");
}

#[test]
fn message_without_room_waits_for_half_of_the_queue() {
    let mut world = World::full();
    let sender = world.sender.clone();
    let mut sent = sender.message(sink(), &Block(7)).room_within(SECOND).send();
    assert!(world.poll(&mut sent).is_pending());
    world.time.advance_to(Time::from_nanos(500_000));
    world.take();
    assert_eq!(world.wakes(), 0, "half of the queue is not free yet");
    world.take();
    assert_eq!(world.wakes(), 1);
    assert_eq!(world.poll(&mut sent), Poll::Ready(Ok(())));
    let taken: Vec<_> = (0..3).map(|_| world.take()).collect();
    assert_eq!(taken.iter().map(|(number, _)| *number).collect::<Vec<_>>(), [2, 3, 7]);
    assert_eq!(taken[2].1.sent, Time::from_nanos(1_000), "its age counts from the first attempt");
    assert_eq!((world.wakes(), world.router.refused()), (1, 0), "a message that waits is not refused");
}

#[test]
fn deadline_names_the_queue_that_had_no_room() {
    let world = World::full();
    let mut sent = world.sender.message(sink(), &Block(7)).room_within(SECOND).send();
    assert!(world.poll(&mut sent).is_pending());
    world.time.advance_to(world.time.now() + SECOND);
    assert_eq!(world.wakes(), 1);
    let stalled = StalledError { destination: sink(), waited: SECOND, queue: StalledQueue::Application };
    assert_eq!(world.poll(&mut sent), Poll::Ready(Err(stalled.into())));
    assert_eq!(world.router.refused_because(), [(Rejection::QueueFull, 1)]);
    assert_eq!(world.mailbox.tally(Class::Bulk).refused, 1, "the queue has refused it once");
    assert!(stalled.to_string().contains("no room within 1s"), "{stalled}");
}

#[test]
fn deadline_names_the_first_queue_of_each_path() {
    let time = VirtualTime::starting_at(Time::from_nanos(1_000));
    let far = Tid::new(NodeAddress::new(0x7f00_0002), SINK);
    for queue in [StalledQueue::Peer, StalledQueue::OwnNode] {
        let mailbox = Mailbox::on_clock(time.clock(), 1);
        let router = match queue {
            StalledQueue::OwnNode => Router::through(NODE, mailbox),
            StalledQueue::Peer | StalledQueue::Application => {
                let router = Router::new(NODE);
                router.set_peer(far.node, mailbox);
                router
            }
        };
        let pending = Pending::on_clock(time.clock(), 1, 8);
        let router = Arc::new(router.on_clock(time.clock()));
        let sender = Sender::new(Tid::new(NODE, SENDER), router, Arc::new(NoNames), pending, 1_000);
        sender.send(far, &Block(0)).expect("it has room");
        let mut sent = sender.message(far, &Block(1)).room_within(Duration::ZERO).send();
        let stalled = StalledError { destination: far, waited: Duration::ZERO, queue };
        let ended = Pin::new(&mut sent).poll(&mut Context::from_waker(Waker::noop()));
        assert_eq!(ended, Poll::Ready(Err(stalled.into())));
    }
}

#[test]
fn zero_time_waits_for_nothing() {
    let world = World::full();
    let mut sent = world.sender.message(sink(), &Block(7)).room_within(Duration::ZERO).send();
    assert!(matches!(world.poll(&mut sent), Poll::Ready(Err(SendError::Stalled(_)))));
}

#[test]
fn message_waits_no_longer_than_its_time_to_live() {
    let world = World::full();
    let lives = Duration::from_millis(20);
    let mut sent = world.sender.message(sink(), &Block(7)).expires_after(lives).room_within(SECOND).send();
    assert!(world.poll(&mut sent).is_pending());
    world.time.advance_to(world.time.now() + lives);
    let ended = world.poll(&mut sent);
    assert!(
        matches!(ended, Poll::Ready(Err(SendError::Stalled(error))) if error.waited == lives),
        "{ended:?}"
    );
}

#[test]
fn closed_queue_ends_the_wait() {
    let world = World::full();
    let mut sent = world.sender.message(sink(), &Block(7)).room_within(SECOND).send();
    assert!(world.poll(&mut sent).is_pending());
    world.mailbox.close();
    assert_eq!(world.wakes(), 1);
    assert_eq!(world.poll(&mut sent), Poll::Ready(Err(Rejection::Closed.into())));
}

#[test]
fn confirmed_message_has_its_outcome_after_its_wait() {
    let mut world = World::full();
    let sender = world.sender.clone();
    let mut sent = sender.message(sink(), &Block(7)).room_within(SECOND).confirmed(2 * SECOND);
    assert!(world.poll(&mut sent).is_pending());
    for number in 0..CAPACITY as u32 {
        assert_eq!(world.take().0, number);
    }
    let Poll::Ready(Ok(mut confirmation)) = world.poll(&mut sent) else { panic!("it has room") };
    assert!(world.poll(&mut confirmation).is_pending());
    assert_eq!(world.take().0, 7);
    assert_eq!(world.poll(&mut confirmation), Poll::Ready(Outcome::Delivered));
}

#[test]
fn dropped_wait_sends_nothing_and_leaves_no_timer() {
    let mut world = World::full();
    let mut sent = Box::new(world.sender.message(sink(), &Block(7)).room_within(SECOND).send());
    assert!(world.poll(&mut sent).is_pending());
    drop(sent);
    assert_eq!(world.time.next_wake(), None);
    (0..CAPACITY as u32).for_each(|number| assert_eq!(world.take().0, number));
    assert_eq!(world.mailbox.depth(), 0);
}

#[test]
fn message_to_many_or_of_stream_never_waits() {
    let world = World::full();
    let unsupported = SendError::from(Rejection::Unsupported);
    let mut to_group = world.sender.message(Tid::group("sinks"), &Block(7)).room_within(SECOND).send();
    assert_eq!(world.poll(&mut to_group), Poll::Ready(Err(unsupported.clone())));
    assert!(world.poll(&mut to_group).is_pending(), "it has ended");
    let mut value =
        world.sender.message(sink(), &Block(7)).class(Class::Stream).room_within(SECOND).confirmed(SECOND);
    assert!(matches!(world.poll(&mut value), Poll::Ready(Err(error)) if error == unsupported));
}
