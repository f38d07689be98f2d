//! Other nodes' addresses that two processes have: a newcomer with a member's address is a restart of the
//! member, or a second process.

use std::{
    collections::{BTreeMap, VecDeque},
    fmt,
    net::SocketAddr,
    ops::Deref,
    time::Duration,
};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Member, Output, Place, grace_period::IN_A_ROW_MAX, incarnations::AcceptedAnswer, members::Members,
    paces::Pace,
};
use crate::datagram::Announcement;

/// Maximum time for a node to show that it is alive when another process claims its address.
const CHALLENGE_MAX: Duration = Duration::from_millis(100);
/// Number of queries to the node in that time, because a query or its answer may be lost.
const CHALLENGES: u32 = 3;
/// Minimum time between two reports that a node address is used twice.
const REPORT_PERIOD: Duration = Duration::from_secs(10);

/// A newcomer claims a member's address in a later incarnation. The member gets a time to show that it is
/// alive. If it does not, the newcomer gets the same time to show that it is still alive: a node that finds a
/// live process with its address gives the address up, and sends nothing afterwards.
#[derive(Debug)]
pub(super) struct Conflict {
    /// An answer of the member to a query sent at or after this time shows that there are two processes.
    since: Time,
    pub(super) tried: Party,
    tried_since: Time,
    /// Time at which the tried party is queried again, or at which its time is over.
    until: Time,
    /// Number of remaining queries in the party's time.
    pub(super) again: u32,
    /// Number of times that the party's time was restarted. The reason is that the local timer was late, that
    /// the member gave a sign of life, or that it is connected.
    pub(super) put_off: u32,
    /// The newcomer answered in its time. Signs of life of the member on its connection are evaluated at the
    /// end of that time.
    pub(super) has_answered: bool,
    /// The member is alive, but has not settled, and the newcomer has. If the newcomer is still alive, the
    /// address is the newcomer's.
    yields: bool,
    pub(super) newcomer: AcceptedAnswer,
}

/// The party that must show that it is alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Party {
    Member,
    Newcomer,
}

/// A process that has or claims a node address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Claimant {
    /// The node's name.
    pub name: String,
    /// Address at which the process answers.
    pub at: SocketAddr,
}

/// Two live processes with one node address. The newcomer is no member, or not any more.
#[derive(Clone, Debug)]
pub(super) struct Collision {
    pub(super) node: NodeAddress,
    pub(super) holder: Claimant,
    pub(super) newcomer: Claimant,
}

/// An order of a conflict.
#[derive(Debug)]
pub(super) enum Step {
    /// Request a liveness hint: if no datagrams reach the member, its connections may be idle.
    RequestLiveness { node: NodeAddress, incarnation: Incarnation },
    /// Query the member at these places.
    QueryMember(Vec<Place>),
    /// Query the newcomer. Other addresses may have replaced this one among the queried addresses.
    QueryNewcomer(Place),
    /// Both processes are alive, and the member keeps the address.
    Collide(Collision),
    /// The newcomer is alive and replaces the member.
    Replace(AcceptedAnswer),
    /// The newcomer is alive and precedes the member, which is alive, too.
    YieldAddress(AcceptedAnswer),
}

/// The open conflicts by their node addresses.
#[derive(Debug, Default)]
pub(super) struct AddressConflicts {
    open: BTreeMap<NodeAddress, Conflict>,
    steps: VecDeque<Step>,
    /// Times of the last reports.
    reported: BTreeMap<NodeAddress, Time>,
}

impl Conflict {
    /// Returns whether this answer shows that the newcomer is still alive after the member's time.
    fn is_won_by(&self, answer: &AcceptedAnswer) -> bool {
        self.tried == Party::Newcomer
            && answer.queried >= self.tried_since
            && self.newcomer.is_of(&answer.announcement)
    }

    /// Handles a further answer of a newcomer.
    fn newcomer_answers(&mut self, newcomer: AcceptedAnswer) {
        let wins = self.is_won_by(&newcomer);
        let is_newer = self.newcomer.is_of(&newcomer.announcement)
            && self.newcomer.from == newcomer.from
            && newcomer.queried >= self.newcomer.queried;
        self.has_answered |= wins;
        if wins || is_newer {
            self.newcomer = newcomer;
        }
    }

    /// Returns whether the member has given a sign of life on its connection. Data received before a
    /// connection ended may be from a process that has ended already.
    fn is_hinted_alive(&self, member: &Member) -> bool {
        let broke = member.link_broke.unwrap_or(Time::ZERO);
        let since = if member.is_linked() { self.since } else { self.tried_since.max(broke) };
        member.is_hinted_alive_since(since)
    }

    /// Returns whether the party's time is restarted.
    ///
    /// If this node was starved, it may not have read the answer yet. A sign of life may have been in flight
    /// when the member ended. Data lost on an established connection is retransmitted later. The party is
    /// queried again, a bounded number of times. spec: NDL-4.2
    fn is_put_off(&self, member: &Member, is_late: bool) -> bool {
        let is_open = match self.tried {
            Party::Member => is_late || self.is_hinted_alive(member) || member.is_linked(),
            // The newcomer's leave may be unread as well: a node that finds a live process with its address
            // withdraws its answer.
            Party::Newcomer => is_late,
        };
        is_open && self.put_off < IN_A_ROW_MAX
    }
}

fn challenge(pace: &Pace) -> Duration {
    pace.period.min(CHALLENGE_MAX)
}

impl AddressConflicts {
    /// Returns the next step.
    pub(super) fn poll(&mut self) -> Option<Step> {
        self.steps.pop_front()
    }

    /// Returns when [`AddressConflicts::time_passed`] is due.
    pub(super) fn next_wake(&self) -> Option<Time> {
        self.open.values().map(|conflict| conflict.until).min()
    }

    /// Returns the nodes with an expired conflict.
    pub(super) fn due(&self, now: Time) -> Vec<NodeAddress> {
        self.open.iter().filter(|(_, conflict)| conflict.until <= now).map(|(node, _)| *node).collect()
    }

    /// Starts or continues a conflict with a newcomer that has a member's address: a restart of the member, or
    /// a second process.
    // spec: NDL-5.3
    pub(super) fn newcomer_answers(
        &mut self,
        now: Time,
        newcomer: AcceptedAnswer,
        members: &Members,
        pace: &Pace,
    ) {
        let node = newcomer.announcement.node;
        if let Some(conflict) = self.open.get_mut(&node) {
            conflict.newcomer_answers(newcomer);
            return;
        }
        let tried = Party::Member;
        let conflict = Conflict {
            since: now,
            tried,
            tried_since: now,
            until: now,
            again: 0,
            put_off: 0,
            has_answered: false,
            yields: false,
            newcomer,
        };
        self.open.insert(node, conflict);
        self.give_time(now, node, tried, (members, pace));
    }

    fn give_time(&mut self, now: Time, node: NodeAddress, tried: Party, (members, pace): (&Members, &Pace)) {
        let Some(conflict) = self.open.get_mut(&node) else { return };
        (conflict.tried, conflict.tried_since, conflict.has_answered) = (tried, now, false);
        (conflict.until, conflict.again) = (now + challenge(pace) / CHALLENGES, CHALLENGES - 1);
        if let Some(member) = members.get(&node) {
            let incarnation = member.announcement.incarnation;
            self.steps.push_back(Step::RequestLiveness { node, incarnation });
        }
        self.query_tried(node, members);
    }

    fn query_tried(&mut self, node: NodeAddress, members: &Members) {
        let Some(conflict) = self.open.get(&node) else { return };
        let step = match conflict.tried {
            Party::Member => Step::QueryMember(self.challenged_places(node, members)),
            Party::Newcomer => Step::QueryNewcomer(conflict.newcomer.from),
        };
        self.steps.push_back(step);
    }

    /// Returns the places at which a member shows that it is alive. An answer of the member from a newcomer's
    /// address proves nothing.
    pub(super) fn challenged_places(&self, node: NodeAddress, members: &Members) -> Vec<Place> {
        let newcomer = self.open.get(&node).map(|conflict| conflict.newcomer.from);
        let routes = members.get(&node).into_iter().flat_map(|member| member.routes.places());
        routes.filter(|place| Some(*place) != newcomer).collect()
    }

    /// Ends a part of the tried party's time: queries the party again, or decides the conflict after the last part.
    pub(super) fn time_passed(&mut self, now: Time, node: NodeAddress, members: &Members, pace: &Pace) {
        let Some(member) = members.get(&node) else { return self.remove(node) };
        let Some(conflict) = self.open.get_mut(&node) else { return };
        let is_late = now.since(conflict.until) > challenge(pace) / 2;
        if conflict.again > 0 && !is_late && !conflict.has_answered {
            conflict.again -= 1;
            conflict.until = now + challenge(pace) / CHALLENGES;
            return self.query_tried(node, members);
        }
        if conflict.is_put_off(member, is_late) {
            conflict.put_off += 1;
            let tried = conflict.tried;
            self.give_time(now, node, tried, (members, pace));
        } else if conflict.is_hinted_alive(member) && !conflict.yields {
            self.both_live(node, member);
        } else if conflict.tried == Party::Member {
            conflict.put_off = 0;
            self.give_time(now, node, Party::Newcomer, (members, pace));
        } else {
            self.end(node);
        }
    }

    /// Ends a conflict in which the member did not answer. If the newcomer is not alive, its next answer starts
    /// another conflict.
    fn end(&mut self, node: NodeAddress) {
        let conflict = self.open.remove(&node).filter(|conflict| conflict.has_answered);
        let Some(Conflict { newcomer, yields, .. }) = conflict else { return };
        self.steps.push_back(if yields { Step::YieldAddress(newcomer) } else { Step::Replace(newcomer) });
    }

    /// Handles a member that gives signs of life on its connection but answers no datagram. // spec: NDL-5.4
    fn both_live(&mut self, node: NodeAddress, member: &Member) {
        let Some(conflict) = self.open.remove(&node) else { return };
        // Without an established connection, the member may have ended: data that it sent before arrives late as well.
        if member.is_linked() && member.is_hinted_alive_since(conflict.tried_since) {
            let newcomer = (&conflict.newcomer).into();
            self.steps.push_back(Step::Collide(Collision { node, holder: member.into(), newcomer }));
        }
    }

    /// Returns whether the announcement is of a newcomer in a conflict, received from its place or from a
    /// place that it announces.
    pub(super) fn is_newcomer(&self, from: Place, announcement: &Announcement) -> bool {
        self.open.get(&announcement.node).is_some_and(|Conflict { newcomer, .. }| {
            let is_from_there = newcomer.from == from || newcomer.announcement.has_ndl_at(from.there);
            newcomer.is_of(announcement) && is_from_there
        })
    }

    /// Handles an answer of the member. If it answers a query sent after the newcomer arrived, there are two
    /// processes. `is_contradicted` tells whether an established connection contradicts the newcomer.
    pub(super) fn member_answers(
        &mut self,
        now: Time,
        answer: &AcceptedAnswer,
        (members, pace): (&Members, &Pace),
        is_contradicted: impl FnOnce(&AcceptedAnswer) -> bool,
    ) {
        let node = answer.announcement.node;
        let is_later =
            |conflict: &Conflict| answer.queried >= conflict.since && answer.from != conflict.newcomer.from;
        if !self.open.get(&node).is_some_and(is_later) {
            return;
        }
        let Some(mut conflict) = self.open.remove(&node) else { return };
        // The member may have authenticated itself since the newcomer arrived.
        if !conflict.newcomer.announcement.precedes(&answer.announcement)
            || is_contradicted(&conflict.newcomer)
        {
            let newcomer = (&conflict.newcomer).into();
            self.steps.push_back(Step::Collide(Collision { node, holder: answer.into(), newcomer }));
            return;
        }
        if now.since(conflict.newcomer.queried) <= challenge(pace) / CHALLENGES {
            self.steps.push_back(Step::YieldAddress(conflict.newcomer));
            return;
        }
        // The newcomer may have ended since, and the member would then be lost without a successor.
        let is_tried = std::mem::replace(&mut conflict.yields, true);
        if !is_tried {
            conflict.put_off = 0;
        }
        self.open.insert(node, conflict);
        if !is_tried {
            self.give_time(now, node, Party::Newcomer, (members, pace));
        }
    }

    /// Ends the conflict of a node without a decision, and returns its newcomer.
    pub(super) fn take_newcomer(&mut self, node: NodeAddress) -> Option<AcceptedAnswer> {
        self.open.remove(&node).map(|conflict| conflict.newcomer)
    }

    /// Ends the conflict of a node without a decision.
    pub(super) fn remove(&mut self, node: NodeAddress) {
        self.open.remove(&node);
    }

    /// Ends all conflicts without a decision.
    pub(super) fn clear(&mut self) {
        self.open.clear();
    }

    /// Ends the conflicts with newcomers at places from local addresses that are not in use any more.
    pub(super) fn use_paths(&mut self, paths: &[SocketAddr]) {
        self.open.retain(|_, conflict| paths.contains(&conflict.newcomer.from.here));
    }

    /// Ends the conflict with a newcomer if another node answers from its place.
    pub(super) fn confirmed(&mut self, from: Place, claimed: &Announcement) {
        self.open.retain(|_, conflict| conflict.newcomer.from != from || conflict.newcomer.is_of(claimed));
    }

    /// Returns the report of a collision, if none was made about its node address recently.
    pub(super) fn report(&mut self, now: Time, collision: Collision) -> Option<Output> {
        let Collision { node, holder, newcomer } = collision;
        self.reported.retain(|_, last| now.since(*last) < REPORT_PERIOD);
        if self.reported.contains_key(&node) {
            return None;
        }
        self.reported.insert(node, now);
        Some(Output::Collision { node, holder, newcomer })
    }
}

impl Deref for AddressConflicts {
    type Target = BTreeMap<NodeAddress, Conflict>;

    fn deref(&self) -> &Self::Target {
        &self.open
    }
}

#[cfg(test)]
impl AddressConflicts {
    pub(super) fn get_mut(&mut self, node: NodeAddress) -> Option<&mut Conflict> {
        self.open.get_mut(&node)
    }

    /// Returns the number of reports that are not repeated yet.
    pub(super) fn reports(&self) -> usize {
        self.reported.len()
    }
}

impl fmt::Display for Collision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { node, holder, newcomer } = self;
        write!(f, "{node} is that of {holder}; {newcomer} claims the same node address")
    }
}

impl From<&AcceptedAnswer> for Claimant {
    fn from(answer: &AcceptedAnswer) -> Self {
        Self { name: answer.announcement.name.clone(), at: answer.from.there }
    }
}

impl From<&Member> for Claimant {
    fn from(member: &Member) -> Self {
        Self { name: member.announcement.name.clone(), at: member.routes.best().there }
    }
}

impl fmt::Display for Claimant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the node '{}' at {}", self.name, self.at)
    }
}
