//! Two live processes with one node address: which of them has it, for this node and for itself.

use sinew_model::facts::LossReason;
use sinew_runtime::time::Time;

use super::{
    Core, Output,
    address_conflict::{Claimant, Collision, Step},
    incarnations::AcceptedAnswer,
    local_node::Ownership,
};

/// Number of datagrams that announce a yielded address. A datagram may be lost, and a receiver that misses it
/// rejects the rightful owner.
const YIELDS: usize = 3;

impl Core {
    /// Executes the decisions about an address conflict. Returns whether a member gave way to a newcomer.
    pub(super) fn execute_conflict_steps(&mut self, now: Time) -> bool {
        let mut gave_way = false;
        while let Some(step) = self.conflicts.poll() {
            match step {
                Step::RequestLiveness { node, incarnation } => {
                    self.outputs.push_back(Output::RequestLiveness { node, incarnation });
                }
                Step::QueryMember(places) => places.into_iter().for_each(|place| self.query(now, place)),
                Step::QueryNewcomer(place) => self.query_new(now, place),
                Step::Collide(collision) => self.collide(now, collision),
                Step::Replace(newcomer) => {
                    if !self.contradicts_connection(now, &newcomer) {
                        self.replace(now, newcomer);
                    }
                }
                Step::YieldAddress(newcomer) => gave_way |= self.newcomer_precedes(now, newcomer),
            }
        }
        gave_way
    }

    /// Ends the parts of the tried parties' times that are over.
    pub(super) fn decide_conflicts(&mut self, now: Time) {
        for node in self.conflicts.due(now) {
            self.conflicts.time_passed(now, node, &self.members, self.paces.rest());
            self.execute_conflict_steps(now);
        }
    }

    /// Queries a place where a node answered. Others may have replaced it among the queried ones.
    pub(super) fn query_new(&mut self, now: Time, place: super::Place) {
        self.contacts.answering(now, place);
        self.query(now, place);
    }

    /// Handles a newcomer that is alive, and that preceded a member which is alive, too. Returns whether the
    /// member gave way. It may have settled since.
    fn newcomer_precedes(&mut self, now: Time, newcomer: AcceptedAnswer) -> bool {
        if self.contradicts_connection(now, &newcomer) {
            return false;
        }
        let node = newcomer.announcement.node;
        let Some(member) = self.members.get(&node) else { return false };
        let precedes = newcomer.announcement.precedes(&member.announcement);
        if precedes {
            self.yield_address(now, newcomer);
        } else {
            let (holder, newcomer) = (member.into(), (&newcomer).into());
            self.collide(now, Collision { node, holder, newcomer });
        }
        precedes
    }

    /// Handles an answer of a process that precedes a member with the same address. // spec: NDL-5.6
    pub(super) fn preceding_answers(&mut self, now: Time, answer: AcceptedAnswer) {
        let claimed = &answer.announcement;
        let Some(member) = self.members.get(&claimed.node) else { return };
        if member.fence.is_some_and(|fence| claimed.incarnation <= fence) {
            self.refuse_stale(now, &answer, member.announcement.incarnation);
            return;
        }
        // The process was queried before the member joined. It may have ended since, to give way to the member.
        if answer.queried >= member.since {
            self.yield_address(now, answer);
        }
    }

    /// Replaces a live member by a live process that precedes it.
    fn yield_address(&mut self, now: Time, answer: AcceptedAnswer) {
        let node = answer.announcement.node;
        let Some(member) = self.members.get(&node) else { return };
        let (holder, newcomer) = ((&answer).into(), member.into());
        self.collide(now, Collision { node, holder, newcomer });
        self.conflicts.remove(node);
        self.lose(now, node, LossReason::Duplicate);
        self.arrive(now, answer);
    }

    /// Reports two live processes with one node address. // spec: NDL-5.4
    pub(super) fn collide(&mut self, now: Time, collision: Collision) {
        self.refusals.count(now, "NDL node address used twice", &collision);
        self.outputs.extend(self.conflicts.report(now, collision));
    }

    /// Handles a live process that has this node's own address. // spec: NDL-5.5
    pub(super) fn local_address_used(&mut self, now: Time, answer: &AcceptedAnswer) {
        let has_peers = || self.authenticated.is_any();
        let ownership = self.local_node.address_used(now, &answer.announcement, self.paces.rest(), has_peers);
        let node = answer.announcement.node;
        let (local, other) = (self.local_node.claimant(answer.from), Claimant::from(answer));
        match ownership {
            Ownership::Unclaimed => {}
            Ownership::Local => self.collide(now, Collision { node, holder: local, newcomer: other }),
            Ownership::Contested => self.collide(now, Collision { node, holder: other, newcomer: local }),
            Ownership::Lost => {
                self.collide(now, Collision { node, holder: other.clone(), newcomer: local });
                self.give_address_up(other);
            }
            Ownership::LostAtStart => self.give_address_up(other),
        }
    }

    fn give_address_up(&mut self, holder: Claimant) {
        self.local_node.give_up();
        for _ in 0..YIELDS {
            self.leave();
        }
        self.outputs.push_back(Output::AddressTaken { holder });
    }

    /// Returns whether an answer contradicts an established connection.
    pub(super) fn contradicts_connection(&self, now: Time, answer: &AcceptedAnswer) -> bool {
        self.authenticated.contradicts(now, answer, (&self.members, &self.contacts), &self.refusals)
    }
}
