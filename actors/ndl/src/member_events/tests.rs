use std::{cell::RefCell, collections::BTreeMap};

use futures_util::{FutureExt, StreamExt};
use proptest::prelude::*;
use sinew_model::facts::LossReason;
use sinew_runtime::event_queue::EventQueue;

use super::*;

const NODE: NodeAddress = NodeAddress::new(7);
const OTHER: NodeAddress = NodeAddress::new(8);

const fn fact(fact: MembershipFact) -> MemberEvent {
    MemberEvent::Fact { fact, is_fenced: false }
}

const fn found(node: NodeAddress, incarnation: u64) -> MemberEvent {
    let incarnation = Incarnation(incarnation);
    fact(MembershipFact::NodeFound { node, incarnation, gncl: Vec::new() })
}

const fn lost_by(node: NodeAddress, incarnation: u64, why: LossReason) -> MemberEvent {
    fact(MembershipFact::NodeLost { node, incarnation: Incarnation(incarnation), why })
}

const fn lost(node: NodeAddress, incarnation: u64) -> MemberEvent {
    lost_by(node, incarnation, LossReason::Hung)
}

const fn moved(incarnation: u64) -> MemberEvent {
    MemberEvent::Moved { node: NODE, incarnation: Incarnation(incarnation), gncl: Vec::new() }
}

fn backlog(nodes_max: usize) -> EventBacklog<Rules> {
    EventBacklog::new(Rules, nodes_max * PER_NODE_MAX)
}

fn delivered(backlog: &mut EventBacklog<Rules>) -> Vec<MemberEvent> {
    let mut delivered = Vec::new();
    assert!(backlog.offer(|event| {
        delivered.push(event.clone());
        true
    }));
    delivered
}

/// Returns the pending events of a reader that knows incarnation 1 of the node, after `events`.
fn kept(nodes_max: usize, events: impl IntoIterator<Item = MemberEvent>) -> Vec<MemberEvent> {
    let mut backlog = backlog(nodes_max);
    backlog.push(found(NODE, 1));
    delivered(&mut backlog);
    events.into_iter().for_each(|event| _ = backlog.push(event));
    delivered(&mut backlog)
}

#[test]
fn rejected_facts_are_retried_before_later_ones() {
    let mut backlog = backlog(1);
    backlog.push(found(NODE, 1));
    assert!(!backlog.offer(|_| false));
    backlog.push(found(OTHER, 1));
    assert_eq!(delivered(&mut backlog), [found(NODE, 1), found(OTHER, 1)]);
}

#[test]
fn loss_is_fenced_once_before_its_delivery_only() {
    // given: the queue of GNCL has room for one event
    let (events, event_queues) =
        (MemberEvents::new(4), EventQueues { gncl: EventQueue::new(1), ..EventQueues::default() });
    let incarnation = Incarnation(1);
    for node in [NODE, OTHER] {
        events.push(&Output::Fact(MembershipFact::NodeLost { node, incarnation, why: LossReason::Hung }));
    }
    events.set_fenced(NODE, incarnation);
    let fenced = RefCell::new(Vec::new());
    let fence = |fact: &MembershipFact| fenced.borrow_mut().push(fact.clone());
    // when
    let full = events.offer(&event_queues, fence);
    // then
    let of_other = MembershipFact::NodeLost { node: OTHER, incarnation, why: LossReason::Hung };
    assert_eq!(full, FullQueues { gncl: true, ..FullQueues::default() });
    assert_eq!(fenced.take(), [of_other.clone(), of_other], "once for each layer");
    // when
    assert!(event_queues.gncl.attach().next().now_or_never().is_some());
    let full = events.offer(&event_queues, fence);
    // then
    assert_eq!((full, fenced.take()), (FullQueues::default(), Vec::new()));
    assert_eq!((event_queues.gncl.len(), event_queues.sync.len()), (1, 2));
}

#[test]
fn last_reason_of_a_loss_wins() {
    let as_duplicate = || lost_by(NODE, 1, LossReason::Duplicate);
    let kept = kept(4, [lost(NODE, 1), found(NODE, 1), as_duplicate(), found(NODE, 3)]);
    assert_eq!(kept, [as_duplicate(), found(NODE, 3)]);
}

#[test]
fn newest_state_wins_after_each_end() {
    // A node that the layer knows was lost, returned and is lost again: it is lost.
    assert_eq!(kept(4, [lost(NODE, 1), found(NODE, 1), lost(NODE, 1)]), [lost(NODE, 1)]);
    assert_eq!(kept(4, [lost(NODE, 1), found(NODE, 1)]), [lost(NODE, 1), found(NODE, 1)]);
    // Of short-lived incarnations the last one is kept, after the one that the layer knows.
    let incarnations =
        [lost(NODE, 1), found(NODE, 2), lost(NODE, 2), found(NODE, 3), lost(NODE, 3), found(NODE, 4)];
    assert_eq!(kept(4, incarnations), [lost(NODE, 1), lost(NODE, 3), found(NODE, 4)]);
    assert_eq!(kept(4, [lost(NODE, 1), found(NODE, 2), moved(2)]), [lost(NODE, 1), moved(2)]);
    assert_eq!(kept(4, [moved(1), lost(NODE, 1)]), [lost(NODE, 1)]);
}

#[test]
fn backlog_is_bounded_and_always_keeps_known_losses() {
    let strangers = (100..200).map(NodeAddress::new).flat_map(|node| [found(node, 1), lost(node, 1)]);
    let kept = kept(1, std::iter::once(lost(NODE, 1)).chain(strangers));
    assert_eq!(kept.len(), PER_NODE_MAX);
    assert_eq!(kept[0], lost(NODE, 1));
    assert_eq!(kept[PER_NODE_MAX - 1], lost(NodeAddress::new(199), 1));
}

/// The present incarnation of each node, according to its reports.
#[derive(Debug, Default, PartialEq, Eq)]
struct Members(BTreeMap<NodeAddress, Incarnation>);

impl Members {
    fn handle(&mut self, event: &MemberEvent) {
        let node = Rules.subject(event);
        match Rules.role(event) {
            Role::Begins(incarnation) => _ = self.0.insert(node, incarnation),
            Role::Ends(incarnation) if self.0.get(&node) == Some(&incarnation) => _ = self.0.remove(&node),
            Role::Ends(_) | Role::Changes | Role::Standalone => {}
        }
    }
}

proptest! {
    /// Each step is a change of one of eight nodes, of which four are members at most: it is lost or found, by
    /// turns, in its incarnation or the next one, moves, or its bar is lifted. Then the reader takes so many events.
    #[test]
    fn reader_ends_with_the_true_members(
        steps in prop::collection::vec((0_u32..8, 0_u8..4, 0_usize..4), 0..128)
    ) {
        let mut backlog = backlog(4);
        let (mut truth, mut read) = (Members::default(), Members::default());
        let (mut happened, mut delivered) = (Vec::new(), Vec::new());
        let mut last = [1_u64; 8];
        for (node, kind, room) in steps {
            let (of, last) = (NodeAddress::new(node), &mut last[node as usize]);
            let event = match (truth.0.get(&of), kind) {
                (Some(_), 0) => {
                    MemberEvent::Moved { node: of, incarnation: Incarnation(*last), gncl: Vec::new() }
                }
                (Some(_), _) => lost(of, *last),
                (None, _) if kind == 0 || truth.0.len() == 4 => MemberEvent::Forgotten { node: of, incarnation: Incarnation(*last) },
                (None, 1) => found(of, *last),
                (None, _) => {
                    *last += 1;
                    found(of, *last)
                }
            };
            truth.handle(&event);
            happened.push(event.clone());
            backlog.push(event);
            prop_assert!(backlog.len() <= 4 * PER_NODE_MAX);
            let mut room = room;
            backlog.offer(|event| {
                let is_taken = room > 0;
                if is_taken {
                    delivered.push(event.clone());
                    room -= 1;
                }
                is_taken
            });
        }
        backlog.offer(|event| {
            delivered.push(event.clone());
            true
        });
        delivered.iter().for_each(|event| read.handle(event));
        prop_assert_eq!(read, truth);
        let mut later = happened.iter();
        prop_assert!(delivered.iter().all(|event| later.any(|happened| happened == event)));
    }
}
