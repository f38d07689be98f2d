//! Late members on two nodes, with a network that a test delivers step by step.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
    time::Duration,
};

use super::*;
use crate::{
    clock::Clock,
    router::LocalRoute,
    wire::{Kind, encode},
};

const SENDING: NodeAddress = NodeAddress::new(0x7f00_0001);
const RECEIVING: NodeAddress = NodeAddress::new(0x7f00_0002);
const MODES: AppAddress = AppAddress::group("modes");
const KIND: Kind = Kind::named("test.mode");
const SENDER: AppAddress = AppAddress::new(0x1000);

/// The sequence of a value, and whether it was handed over.
type Seen = (u64, bool);

/// A member, or the queue to another node.
#[derive(Default)]
struct Sink {
    messages: Mutex<VecDeque<Message>>,
    is_full: Mutex<bool>,
    /// Whether it takes removals only.
    is_short: Mutex<bool>,
}

impl Sink {
    fn take(&self) -> Vec<Message> {
        lock(&self.messages).drain(..).collect()
    }

    fn seen(&self) -> Vec<Seen> {
        let seen = |message: Message| (message.header.sequence, message.header.flags.has(Flags::RETAINED));
        self.take().into_iter().map(seen).collect()
    }
}

impl MessageSink for Sink {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        if *lock(&self.is_full) {
            return Err(SubmitError::new(message, Rejection::QueueFull));
        }
        if *lock(&self.is_short) && !message.payload.is_empty() {
            return Err(SubmitError::new(message, Rejection::TooLong));
        }
        lock(&self.messages).push_back(message);
        Ok(())
    }
}

/// A sending and a receiving node.
struct Nodes {
    sending: Router,
    receiving: Router,
    /// The queue from the sending node to the receiving one.
    wire: Arc<Sink>,
    sequence: u64,
}

impl Nodes {
    fn new() -> Self {
        let (sending, wire) = (Router::new(SENDING), Arc::<Sink>::default());
        sending.set_peer(RECEIVING, wire.clone());
        Self::register(&sending, SENDER);
        let receiving = Router::new(RECEIVING);
        receiving.set_peer(SENDING, Arc::new(Sink::default()));
        Self { sending, receiving, wire, sequence: 0 }
    }

    fn header() -> Header {
        let mut header = Header::new(KIND, Tid::new(SENDING, SENDER), Tid::new(NodeAddress::ALL, MODES));
        header.flags = Flags::KEEP;
        header
    }

    fn send(&mut self) -> u64 {
        self.sequence += 1;
        let mut header = Self::header();
        (header.sequence, header.sent) = (self.sequence, Clock::WALL.now());
        let result = self.sending.send(Message::new(header, encode(&self.sequence)));
        assert!(matches!(result, Ok(()) | Err(Rejection::QueueFull | Rejection::TooLong)), "{result:?}");
        self.sequence
    }

    fn clear(&self) {
        assert_eq!(self.sending.send(Message::new(Self::header(), Bytes::new())), Ok(()));
    }

    /// Delivers the messages of the queue.
    fn deliver(&self) {
        for message in self.wire.take() {
            self.receiving.deliver(message).expect("a member takes it, if there is one");
        }
    }

    fn register(router: &Router, app: AppAddress) -> Arc<Sink> {
        let sink = Arc::<Sink>::default();
        router.set_local(app, LocalRoute { sink: sink.clone(), events: Arc::new([]) });
        sink
    }

    fn member(router: &Router, number: u32) -> (AppAddress, Arc<Sink>) {
        let app = AppAddress::new(0x2000 + number);
        (app, Self::register(router, app))
    }

    /// Publishes the groups of the receiving node to the sending one.
    fn publish(&self) {
        let groups = self.receiving.groups();
        self.receiving.groups_listed(SENDING, &groups);
        self.sending.set_remote_groups(RECEIVING, &groups);
    }

    fn join(&self, number: u32) -> Arc<Sink> {
        let (app, sink) = Self::member(&self.receiving, number);
        assert!(self.receiving.set_member(MODES, app, true));
        sink
    }
}

#[test]
fn late_member_here_gets_the_newest_value_once() {
    let mut nodes = Nodes::new();
    nodes.send();
    let newest = nodes.send();
    let (app, sink) = Nodes::member(&nodes.sending, 1);
    assert!(nodes.sending.set_member(MODES, app, true));
    assert_eq!(sink.seen(), [(newest, true)]);
    assert!(!nodes.sending.set_member(MODES, app, true), "it is a member already");
    assert_eq!(sink.seen(), []);
    let newer = nodes.send();
    assert_eq!(sink.seen(), [(newer, false)]);
    // And: a second join gets it again, once
    assert!(nodes.sending.set_member(MODES, app, false) && nodes.sending.set_member(MODES, app, true));
    assert_eq!(sink.seen(), [(newer, true)]);
}

#[test]
fn sender_that_joins_gets_no_value_of_its_own() {
    let mut nodes = Nodes::new();
    let sink = Nodes::register(&nodes.sending, SENDER);
    nodes.send();
    assert!(nodes.sending.set_member(MODES, SENDER, true));
    assert_eq!(sink.seen(), []);
}

#[test]
fn late_member_elsewhere_gets_the_newest_value_once() {
    let mut nodes = Nodes::new();
    nodes.send();
    let newest = nodes.send();
    let first = nodes.join(1);
    nodes.publish();
    nodes.deliver();
    assert_eq!(first.seen(), [(newest, true)]);
    // And: a later one gets it from its own node
    let second = nodes.join(2);
    nodes.publish();
    nodes.deliver();
    assert_eq!((first.seen(), second.seen()), (vec![], vec![(newest, true)]));
    let newer = nodes.send();
    nodes.deliver();
    assert_eq!((first.seen(), second.seen()), (vec![(newer, false)], vec![(newer, false)]));
}

#[test]
fn value_has_its_send_time() {
    let mut nodes = Nodes::new();
    nodes.send();
    let sent =
        lock(&nodes.sending.retained).store.of_group(MODES, Time::ZERO).next().expect("it").header.sent;
    let member = nodes.join(1);
    nodes.publish();
    nodes.deliver();
    assert_eq!(member.take()[0].header.sent, sent);
}

#[test]
fn member_that_joins_again_gets_the_present_value() {
    let mut nodes = Nodes::new();
    let _first = nodes.join(1);
    nodes.publish();
    nodes.send();
    nodes.deliver();
    let leave = |nodes: &Nodes, number: u32| {
        assert!(nodes.receiving.set_member(MODES, AppAddress::new(0x2000 + number), false));
    };
    // When: the sending node does not learn of it
    leave(&nodes, 1);
    let newer = nodes.send();
    nodes.deliver();
    let again = nodes.join(1);
    nodes.publish();
    nodes.deliver();
    assert_eq!(again.seen(), [(newer, true)]);
    // When: it does
    leave(&nodes, 1);
    nodes.publish();
    let newest = nodes.send();
    nodes.deliver();
    assert_eq!(nodes.receiving.retained().values, 0);
    let third = nodes.join(1);
    nodes.publish();
    nodes.deliver();
    assert_eq!(third.seen(), [(newest, true)]);
}

#[test]
fn value_of_ended_or_clearing_sender_is_gone() {
    for ends in [true, false] {
        let mut nodes = Nodes::new();
        let first = nodes.join(1);
        nodes.publish();
        let only = nodes.send();
        if ends {
            nodes.sending.remove_local(SENDER);
        } else {
            nodes.clear();
        }
        nodes.deliver();
        assert_eq!(first.seen(), [(only, false)], "a removal reaches no member");
        let (app, here) = Nodes::member(&nodes.sending, 3);
        assert!(nodes.sending.set_member(MODES, app, true));
        assert_eq!((here.seen(), nodes.join(2).seen()), (vec![], vec![]));
        assert_eq!((nodes.sending.retained().values, nodes.receiving.retained().values), (0, 0));
    }
}

#[test]
fn values_of_lost_node_return_with_its_link() {
    let mut nodes = Nodes::new();
    let first = nodes.join(1);
    nodes.publish();
    let value = nodes.send();
    nodes.deliver();
    assert_eq!(first.seen(), [(value, false)]);
    nodes.receiving.remove_peer(SENDING);
    assert_eq!(nodes.join(2).seen(), []);
    // When
    nodes.receiving.set_peer(SENDING, Arc::new(Sink::default()));
    nodes.sending.linked_again(RECEIVING);
    nodes.deliver();
    assert_eq!(first.seen(), [(value, true)]);
    // And: a link that comes again without a loss brings nothing new
    nodes.sending.linked_again(RECEIVING);
    nodes.deliver();
    assert_eq!(first.seen(), []);
}

#[test]
fn value_without_room_follows_a_later_list() {
    let mut nodes = Nodes::new();
    let value = nodes.send();
    let member = nodes.join(1);
    *lock(&nodes.wire.is_full) = true;
    nodes.publish();
    *lock(&nodes.wire.is_full) = false;
    nodes.sending.groups_listed(RECEIVING, &[]);
    nodes.deliver();
    assert_eq!(member.seen(), [(value, true)]);
    *lock(&nodes.wire.is_full) = true;
    nodes.sending.forget_retained(SENDER);
    *lock(&nodes.wire.is_full) = false;
    nodes.sending.groups_listed(RECEIVING, &[]);
    nodes.deliver();
    assert_eq!((member.seen(), nodes.receiving.retained().values), (vec![], 0));
}

#[test]
fn value_without_room_replaces_the_former_one_later() {
    let mut nodes = Nodes::new();
    let member = nodes.join(1);
    nodes.publish();
    let former = nodes.send();
    nodes.deliver();
    *lock(&nodes.wire.is_full) = true;
    let newer = nodes.send();
    *lock(&nodes.wire.is_full) = false;
    nodes.sending.groups_listed(RECEIVING, &[]);
    nodes.deliver();
    assert_eq!(member.seen(), [(former, false), (newer, true)]);
    assert_eq!(nodes.join(2).seen(), [(newer, true)]);
    nodes.sending.groups_listed(RECEIVING, &[]);
    assert_eq!(nodes.wire.seen(), [], "it is sent once");
}

#[test]
fn value_too_long_there_leaves_no_former_one() {
    let mut nodes = Nodes::new();
    let member = nodes.join(1);
    nodes.publish();
    let former = nodes.send();
    nodes.deliver();
    *lock(&nodes.wire.is_short) = true;
    nodes.send();
    nodes.sending.groups_listed(RECEIVING, &[]);
    nodes.deliver();
    assert_eq!((member.seen(), nodes.join(2).seen()), (vec![(former, false)], vec![]));
    assert_eq!(nodes.sending.retained().not_handed_over, 1);
}

#[test]
fn next_incarnation_of_member_gets_the_value_again() {
    let mut nodes = Nodes::new();
    let value = nodes.send();
    let (app, sink) = Nodes::member(&nodes.sending, 1);
    assert!(nodes.sending.set_member(MODES, app, true));
    assert_eq!(sink.seen(), [(value, true)]);
    // When: its incarnation ends, and the next one joins
    nodes.sending.forget_retained(app);
    assert!(!nodes.sending.set_member(MODES, app, true), "it has been a member all the time");
    assert_eq!(sink.seen(), [(value, true)]);
    // Then: once
    assert!(!nodes.sending.set_member(MODES, app, true));
    assert_eq!(sink.seen(), []);
    // And: nothing remains of an application that is removed
    nodes.sending.forget_retained(app);
    nodes.sending.remove_local(app);
    assert!(lock(&nodes.sending.retained).rejoining.is_empty());
}

#[test]
fn removal_reaches_node_without_the_group() {
    let mut nodes = Nodes::new();
    let _first = nodes.join(1);
    nodes.publish();
    nodes.send();
    nodes.deliver();
    // Given: the list without the group, after which an application has joined it again
    nodes.sending.set_remote_groups(RECEIVING, &[]);
    // When
    nodes.clear();
    nodes.deliver();
    // Then
    assert_eq!(nodes.receiving.retained().values, 0);
    assert_eq!(nodes.join(2).seen(), []);
}

#[test]
fn late_message_of_lost_sender_is_not_retained() {
    let mut nodes = Nodes::new();
    let member = nodes.join(1);
    nodes.publish();
    let value = nodes.send();
    // When: its node is lost, and then the message is delivered
    nodes.receiving.remove_peer(SENDING);
    nodes.deliver();
    assert_eq!((member.seen(), nodes.receiving.retained().values), (vec![(value, false)], 0));
    // And: a thread of the sender sends after its end
    nodes.sending.remove_local(SENDER);
    nodes.wire.take();
    let late = nodes.send();
    assert_eq!((nodes.wire.seen(), nodes.sending.retained().values), (vec![(late, false)], 0));
}

#[test]
fn full_member_misses_its_value_and_this_is_counted() {
    let mut nodes = Nodes::new();
    nodes.send();
    let (app, sink) = Nodes::member(&nodes.sending, 1);
    *lock(&sink.is_full) = true;
    assert!(nodes.sending.set_member(MODES, app, true));
    assert_eq!(nodes.sending.retained().not_handed_over, 1);
    assert_eq!(nodes.sending.refused_because(), [(Rejection::QueueFull, 1)]);
}

#[test]
fn value_beyond_bound_is_delivered_and_predecessor_removed() {
    let mut nodes = Nodes::new();
    let first = nodes.join(1);
    nodes.publish();
    nodes.send();
    let mut header = Nodes::header();
    header.sequence = 2;
    let long = Bytes::from(vec![7; store::VALUE_BYTES_MAX + 1]);
    assert_eq!(nodes.sending.send(Message::new(header, long)), Ok(()));
    nodes.deliver();
    assert_eq!(first.seen(), [(1, false), (2, false)]);
    assert_eq!((nodes.sending.retained().values, nodes.receiving.retained().values), (0, 0));
    assert_eq!(nodes.sending.retained().not_kept, 1);
    assert_eq!(nodes.join(2).seen(), []);
}

#[test]
fn expired_value_is_not_handed_over() {
    let nodes = Nodes::new();
    let mut header = Nodes::header();
    header.sent = Clock::WALL.now();
    let _ = header.set_time_to_live(Duration::from_micros(1));
    assert_eq!(nodes.sending.send(Message::new(header, encode(&1))), Ok(()));
    while !header.is_expired(Clock::WALL.now()) {
        std::hint::spin_loop();
    }
    let (app, sink) = Nodes::member(&nodes.sending, 1);
    assert!(nodes.sending.set_member(MODES, app, true));
    assert_eq!(sink.seen(), []);
}

#[test]
fn message_without_keep_is_not_retained() {
    let nodes = Nodes::new();
    for (flags, class) in [(Flags::NONE, Class::Control), (Flags::KEEP, Class::Stream)] {
        let header = Header { flags, class, ..Nodes::header() };
        assert_eq!(nodes.sending.send(Message::new(header, encode(&1))), Ok(()));
        assert_eq!(nodes.sending.retained(), RetainedCounts::default());
    }
}

/// The values that one member got are newer from each to the next, and end with the newest one.
fn check(seed: u64, seen: &[Seen], newest: Option<u64>) {
    assert!(seen.windows(2).all(|pair| pair[0].0 < pair[1].0), "seed {seed}: {seen:?}");
    assert_eq!(seen.last().map(|(sequence, _)| *sequence), newest, "seed {seed}: {seen:?}");
}

#[test]
fn no_order_delivers_an_older_value_or_one_twice() {
    for seed in 0..500 {
        let (mut random, mut nodes) = (fastrand::Rng::with_seed(seed), Nodes::new());
        let mut members: Vec<(Arc<Sink>, Vec<Seen>)> = Vec::new();
        let mut newest = None;
        for _ in 0..random.u32(1..40) {
            match random.u32(0..6) {
                0 | 1 => newest = Some(nodes.send()),
                2 if members.len() < 8 => {
                    members.push((nodes.join(u32::try_from(members.len()).expect("few")), Vec::new()));
                }
                3 => nodes.publish(),
                4 => nodes.sending.linked_again(RECEIVING),
                _ => nodes.deliver(),
            }
        }
        nodes.publish();
        nodes.deliver();
        for (sink, seen) in &mut members {
            seen.extend(sink.seen());
            check(seed, seen, newest);
        }
    }
}

#[test]
fn member_joining_beside_sends_gets_values_in_order() {
    for seed in 0..50 {
        let router = Arc::new(Router::new(SENDING));
        Nodes::register(&router, SENDER);
        let (app, sink) = Nodes::member(&router, 1);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for sequence in 1..=100 {
                    let header = Header { sequence, ..Nodes::header() };
                    assert_eq!(router.send(Message::new(header, encode(&sequence))), Ok(()));
                }
            });
            assert!(router.set_member(MODES, app, true));
        });
        let seen = sink.seen();
        check(seed, &seen, Some(100));
        let first = seen[0].0;
        let expected: Vec<u64> = (first..=100).collect();
        assert_eq!(seen.iter().map(|(sequence, _)| *sequence).collect::<Vec<_>>(), expected);
        assert!(seen.iter().skip(1).all(|(_, is_retained)| !is_retained), "{seen:?}");
    }
}
