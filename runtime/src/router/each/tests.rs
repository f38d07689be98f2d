//! Group sends between three nodes. At any moment members settle, reject, die or hang, and nodes are lost.

use std::{
    collections::{BTreeMap, VecDeque},
    task::{Context, Poll, Waker},
};

use bytes::Bytes;
use proptest::prelude::*;

use super::*;
use crate::{
    outcome::{MemberOutcome, Rejection},
    pending::{Pending, Settlement, Wait},
    router::{LocalRoute, MessageSink, Router, SubmitError},
    wire::{Flags, Header, Kind, Message},
};

const SENDER: Tid = Tid::new(node(1), AppAddress::new(0x2000));
const GROUP: Tid = Tid::group("legs");

const fn node(number: u32) -> NodeAddress {
    NodeAddress::new(number)
}

fn member(number: u32, app: u32) -> Tid {
    Tid::new(node(number), AppAddress::new(0x1000 + app))
}

/// Pseudorandom numbers of a seed.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % bound.max(1)
    }
}

/// A mailbox with messages that wait until the test decides their outcomes.
#[derive(Default)]
struct Mailbox(Mutex<VecDeque<Message>>);

impl MessageSink for Mailbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        lock(&self.0).push_back(message);
        Ok(())
    }
}

/// Frames between the first node and another one.
enum Frame {
    Copy(Message),
    Outcome(Ticket, Outcome),
    Members(Ticket, Vec<MemberReport>),
}

/// The link of the first node with another one.
struct Link {
    to: NodeAddress,
    there: VecDeque<Frame>,
    back: VecDeque<Frame>,
    /// Receipts of copies without an outcome so far.
    open: BTreeMap<u64, Receipt>,
    is_lost: bool,
}

#[derive(Clone)]
struct Wire(Arc<Mutex<Link>>);

impl MessageSink for Wire {
    fn submit(&self, mut message: Message) -> Result<(), SubmitError> {
        let mut link = lock(&self.0);
        let receipt = message.receipt.take().expect("each copy is confirmed");
        assert_eq!(receipt.ticket().destination, Tid::new(link.to, GROUP.app));
        link.open.insert(message.header.correlation, receipt);
        link.there.push_back(Frame::Copy(message));
        Ok(())
    }
}

impl ReceiptSink for Wire {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        lock(&self.0).back.push_back(Frame::Outcome(ticket, outcome));
    }

    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        lock(&self.0).back.push_back(Frame::Members(ticket, reports.to_vec()));
    }
}

struct Node {
    router: Router,
    mailboxes: Vec<(Tid, Arc<Mailbox>)>,
}

impl Node {
    fn new(number: u32, members: u32) -> Self {
        let router = Router::new(node(number));
        let mailboxes: Vec<_> = (0..members).map(|app| (member(number, app), Arc::default())).collect();
        for (tid, mailbox) in &mailboxes {
            router.set_local(tid.app, LocalRoute { sink: Arc::clone(mailbox) as _, events: Arc::new([]) });
            router.set_member(GROUP.app, tid.app, true);
        }
        Self { router, mailboxes }
    }
}

struct World {
    nodes: Vec<Node>,
    wires: Vec<Wire>,
    pending: Arc<Pending>,
    /// The decided outcome of each member.
    decided: BTreeMap<(u64, Tid), Outcome>,
    random: Random,
}

impl World {
    fn new(seed: u64, members: [u32; 3]) -> Self {
        let nodes: Vec<_> = (1..).zip(members).map(|(number, members)| Node::new(number, members)).collect();
        let mut wires = Vec::new();
        for number in [2, 3] {
            let (there, back, open) = (VecDeque::new(), VecDeque::new(), BTreeMap::new());
            let wire =
                Wire(Arc::new(Mutex::new(Link { to: node(number), there, back, open, is_lost: false })));
            nodes[0].router.set_peer(node(number), Arc::new(wire.clone()));
            if members[number as usize - 1] > 0 {
                nodes[0].router.set_remote_groups(node(number), &[GROUP.app]);
            }
            wires.push(wire);
        }
        Self { nodes, wires, pending: Pending::new(100), decided: BTreeMap::new(), random: Random(seed) }
    }

    fn send(&self) -> Result<Wait, Rejection> {
        let wait = self.pending.open_each(GROUP, node(1)).expect("there is room");
        let mut header = Header::new(Kind::named("test.word"), SENDER, GROUP);
        header.flags = Flags::CONFIRM;
        header.correlation = wait.correlation();
        let mut message = Message::new(header, Bytes::new());
        let ticket = Ticket { source: SENDER, destination: GROUP, correlation: wait.correlation() };
        message.receipt = Some(Receipt::new(self.pending.clone(), ticket));
        self.nodes[0].router.send(message)?;
        Ok(wait)
    }

    /// Carries one frame over a link.
    fn carry(&mut self) {
        let at = self.random.below(self.wires.len());
        let wire = self.wires[at].clone();
        let is_back = self.random.below(2) == 0;
        let frame = {
            let mut link = lock(&wire.0);
            if link.is_lost {
                None
            } else if is_back {
                link.back.pop_front()
            } else {
                link.there.pop_front()
            }
        };
        let here = &self.nodes[0].router;
        match frame {
            Some(Frame::Copy(mut message)) => {
                let Ticket { source, correlation, .. } = message.ticket();
                let destination = Tid::new(node(at as u32 + 2), GROUP.app);
                let ticket = Ticket { source, destination, correlation };
                message.receipt = Some(Receipt::new(Arc::new(wire), ticket));
                self.nodes[at + 1].router.deliver(message).expect("a group takes it");
            }
            Some(Frame::Outcome(ticket, outcome)) => {
                let receipt = lock(&wire.0).open.remove(&ticket.correlation);
                receipt.into_iter().for_each(|receipt| receipt.settle(outcome));
            }
            Some(Frame::Members(ticket, reports)) => {
                here.members_reported(node(at as u32 + 2), ticket, &reports)
            }
            None => {}
        }
    }

    /// Lets a member handle its next message.
    fn handle(&mut self) {
        let of = self.random.below(self.nodes.len());
        let boxes = self.nodes[of].mailboxes.len();
        if boxes == 0 {
            return;
        }
        let (tid, mailbox) = &self.nodes[of].mailboxes[self.random.below(boxes)];
        let Some(mut message) = lock(&mailbox.0).pop_front() else { return };
        let outcome = match self.random.below(3) {
            0 => Outcome::Delivered,
            1 => Outcome::Rejected(Rejection::UnknownKind),
            // It dies while it handles the message.
            _ => Outcome::Failed,
        };
        self.decided.insert((message.header.correlation, *tid), outcome);
        if outcome != Outcome::Failed {
            message.settle(outcome);
        }
    }

    /// Loses the node at the other end of a link.
    fn lose(&mut self) {
        let at = self.random.below(self.wires.len());
        let receipts = {
            let mut link = lock(&self.wires[at].0);
            link.is_lost = true;
            std::mem::take(&mut link.open)
        };
        receipts.into_values().for_each(|receipt| receipt.settle(Outcome::Unknown));
        self.nodes[0].router.remove_peer(node(at as u32 + 2));
    }

    fn is_lost(&self, node: NodeAddress) -> bool {
        self.wires.iter().map(|wire| lock(&wire.0)).any(|link| link.to == node && link.is_lost)
    }

    fn step(&mut self) {
        match self.random.below(40) {
            0 => self.lose(),
            1..20 => self.carry(),
            _ => self.handle(),
        }
    }
}

fn ended(wait: &Wait) -> Option<Outcome> {
    match wait.poll_settled(&Context::from_waker(Waker::noop())) {
        Poll::Ready(Settlement::Outcome(outcome)) => Some(outcome),
        Poll::Ready(Settlement::Reply(_)) | Poll::Pending => None,
    }
}

/// Checks that every entry has the outcome of its member. Each member has one entry, or its node has one for
/// all members that it did not name.
fn check(
    world: &World,
    correlation: u64,
    list: &[MemberOutcome],
    is_over: bool,
) -> Result<(), TestCaseError> {
    for MemberOutcome { tid, outcome } in list {
        let decided = world.decided.get(&(correlation, *tid));
        if world.is_lost(tid.node) {
            prop_assert!(*outcome == Outcome::Unknown || Some(outcome) == decided, "{tid}: {outcome:?}");
        } else if is_over {
            prop_assert_eq!(Some(outcome), decided, "{}", tid);
        } else {
            prop_assert!(*outcome == Outcome::Unknown || Some(outcome) == decided, "{tid}: {outcome:?}");
        }
    }
    for of in &world.nodes {
        let node = of.router.node();
        let named = list.iter().filter(|entry| entry.tid.node == node);
        let named: Vec<_> = named.map(|entry| entry.tid).collect();
        let members: Vec<_> = of.mailboxes.iter().map(|(tid, _)| *tid).collect();
        let by_node = vec![Tid::new(node, GROUP.app)];
        let is_unnamed = named == by_node && (world.is_lost(node) || !is_over);
        // A node that was lost before has no copy.
        prop_assert!(named == members || is_unnamed || named.is_empty() && world.is_lost(node), "{named:?}");
    }
    Ok(())
}

proptest! {
    #[test]
    fn each_member_has_one_outcome_and_nothing_leaks(
        seed in any::<u64>(),
        members in [0..3_u32, 0..3_u32, 0..3_u32],
        steps in 0..400_usize,
    ) {
        // Given
        let mut world = World::new(seed, members);
        let mut waits = Vec::new();
        // When: some messages are sent, and this many steps happen
        for step in 0..steps {
            if step % 50 == 0 {
                waits.push(world.send().expect("a group takes it"));
            }
            world.step();
        }
        // Then: each send has ended with all outcomes, or has those that are known at its deadline
        for wait in waits {
            let last = ended(&wait);
            check(&world, wait.correlation(), &wait.members(last), last.is_some())?;
        }
        // And: when hung members are gone, too, nothing is left
        world.nodes.iter().flat_map(|node| &node.mailboxes).for_each(|(_, mailbox)| {
            let dropped = std::mem::take(&mut *lock(&mailbox.0));
            drop(dropped);
        });
        for wire in &world.wires {
            let receipts = std::mem::take(&mut lock(&wire.0).open);
            drop(receipts);
        }
        prop_assert_eq!(world.nodes[0].router.open_group_sends(), 0);
    }
}

#[test]
fn empty_group_ends_at_once_with_an_empty_list() {
    let world = World::new(0, [0, 0, 0]);
    let wait = world.send().expect("it is no error");
    let last = ended(&wait);
    assert_eq!(last, Some(Outcome::Delivered));
    assert_eq!(wait.members(last), []);
}

#[test]
fn send_to_too_many_members_is_rejected() {
    let world = World::new(0, [MEMBERS_HERE_MAX as u32 + 1, 0, 0]);
    assert_eq!(world.send().err(), Some(Rejection::TooManyMembers));
    let (_, mailbox) = &world.nodes[0].mailboxes[0];
    assert!(lock(&mailbox.0).is_empty(), "nobody has a copy");
}

#[test]
fn open_sends_to_other_nodes_are_limited() {
    let world = World::new(0, [0, 1, 0]);
    let waits: Vec<_> = (0..OPEN_OF_ONE_MAX).map(|_| world.send().expect("there is room")).collect();
    assert_eq!(world.send().err(), Some(Rejection::TooManyMembers));
    // Its node is lost: there is room again.
    let receipts = std::mem::take(&mut lock(&world.wires[0].0).open);
    receipts.into_values().for_each(|receipt| receipt.settle(Outcome::PeerLost));
    assert!(waits.iter().all(|wait| ended(wait) == Some(Outcome::Delivered)));
    assert!(world.send().is_ok());
}

#[test]
fn expired_send_takes_no_room_from_later_ones() {
    let (open, sink) = (Arc::new(OpenSends::default()), Pending::new(1));
    let receipt = |correlation| {
        let ticket = Ticket { source: SENDER, destination: GROUP, correlation };
        Receipt::new(sink.clone(), ticket)
    };
    let (now, until) = (Time::from_nanos(1), Time::from_nanos(2));
    let nodes = || (node(1), vec![node(2)]);
    let hung: Vec<_> = (0..OPEN_OF_ONE_MAX as u64)
        .map(|correlation| open.open(nodes(), receipt(correlation), (now, until)).expect("there is room"))
        .collect();
    assert!(open.open(nodes(), receipt(100), (now, until)).is_err());
    let later = Time::from_nanos(3);
    let next = open.open(nodes(), receipt(100), (later, later)).expect("theirs is over");
    drop(hung);
    assert_eq!(open.len(), 1, "those that end late leave the later one");
    drop(next);
    assert_eq!(open.len(), 0);
}

#[test]
fn node_reports_only_its_own_members() {
    let world = World::new(0, [0, 1, 0]);
    let wait = world.send().expect("there is room");
    let ticket = Ticket { source: SENDER, destination: GROUP, correlation: wait.correlation() };
    let delivered = |tid| MemberReport::of_member(tid, MemberState::Settled(Outcome::Delivered));
    let router = &world.nodes[0].router;
    router.members_reported(node(3), ticket, &[delivered(member(3, 0))]);
    router.members_reported(node(2), ticket, &[delivered(member(1, 0)), delivered(member(3, 0))]);
    router.members_reported(
        node(2),
        ticket,
        &[MemberReport::of_node(node(2), MemberState::Settled(Outcome::Failed))],
    );
    let unnamed = MemberOutcome { tid: Tid::new(node(2), GROUP.app), outcome: Outcome::Unknown };
    assert_eq!(wait.members(None), [unnamed]);
}
