//! The decision which spans a node freezes: a pure function of all triggers that it knows.
//!
//! A cause at this node makes a trigger, which travels to all nodes. Each node decides by itself, so the decision must
//! not depend on the order in which triggers arrive:
//!
//! - The triggers are sorted by time. The first one and all within its `after` are one group, the first one behind
//!   them begins the next group, and so on.
//! - Of a group the trigger with the smallest ID decides: the span has its ID. The span begins with the earliest begin
//!   of all triggers of the group, and ends with their latest end.
//!
//! A cause within `after` of a known trigger makes no trigger. Its words are kept for the name of the span.
//!
//! A trigger that arrives after a group was frozen can change the group. Then the right span is frozen in place of the
//! former ones. All times are nanoseconds of this node's monotonic clock.

use std::{
    collections::{BTreeMap, VecDeque},
    fmt,
    time::Duration,
};

use sinew_model::leave_reason::LeaveReason;
use sinew_runtime::tid::{Incarnation, NodeAddress};

/// Time after the end of a span for late triggers, and for records on their way into the ring.
const GRACE_NS: u64 = 200_000_000;
/// Time after the end of a group for which it is known: later copies of its triggers change nothing.
const MEMORY_NS: u64 = 30_000_000_000;
/// Maximum distance of a trigger into the future of this clock, in addition to its error.
const FUTURE_NS: u64 = 1_000_000_000;
/// Maximum number of known triggers. Further ones are counted.
const TRIGGERS_MAX: usize = 256;
/// Maximum number of causes without a trigger of which the words are kept: enough for a flood of 30 s.
const COVERED_MAX: usize = 512;
/// Maximum number of these within `after` of one another. Further ones are counted: a flood must not take the room for
/// the words of a later span.
const COVERED_NEAR_MAX: usize = 16;
/// Maximum number of causes that the name of a span has. Further ones are counted in it.
const NAMED_MAX: usize = 8;
/// Limits of the times in a trigger: those of the configuration.
const SECONDS_MIN: u64 = 1;
const KEEP_SECONDS_MAX: u64 = 600;
const AFTER_SECONDS_MAX: u64 = 60;

/// The identity of a trigger: the node that made it, and its number there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct TriggerId {
    pub(crate) node: NodeAddress,
    pub(crate) incarnation: Incarnation,
    pub(crate) number: u32,
}

/// As in the names of files: `10.0.0.2-6431f2a9c0b1d-1`.
impl fmt::Display for TriggerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{:x}-{}", self.node, self.incarnation.0, self.number)
    }
}

/// A reason to freeze a span, at a time of this node's clock.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Trigger {
    pub(crate) id: TriggerId,
    pub(crate) at_ns: u64,
    /// Maximum error of the time; `u64::MAX`: unknown.
    pub(crate) bound_ns: u64,
    pub(crate) keep: Duration,
    pub(crate) after: Duration,
    /// 1 to 200 bytes.
    pub(crate) cause: LeaveReason,
}

impl Trigger {
    /// Returns the first nanosecond of the span.
    pub(crate) fn begin_ns(&self) -> u64 {
        self.at_ns.saturating_sub(nanos(self.keep))
    }

    /// Returns the last nanosecond of the span.
    pub(crate) fn end_ns(&self) -> u64 {
        self.at_ns.saturating_add(nanos(self.after))
    }

    /// Returns whether a cause at this time needs no trigger of its own.
    fn covers(&self, at_ns: u64) -> bool {
        at_ns.abs_diff(self.at_ns) <= nanos(self.after)
    }

    /// Returns whether its times are those of a configuration.
    fn is_legal(&self) -> bool {
        let least = Duration::from_secs(SECONDS_MIN);
        (least..=Duration::from_secs(KEEP_SECONDS_MAX)).contains(&self.keep)
            && (least..=Duration::from_secs(AFTER_SECONDS_MAX)).contains(&self.after)
            && self.after <= self.keep
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

/// An order to the caller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// Send the trigger to all other nodes, once: it is one of this node, or changes a span.
    Forward(Trigger),
    /// Freeze a span.
    Freeze(SpanOrder),
}

/// A span to freeze.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SpanOrder {
    /// The trigger that decides.
    pub(crate) trigger: Trigger,
    /// The causes that this node knows, in the order of their times: at most 8, and the number of the others.
    pub(crate) causes: String,
    /// The first nanosecond of the span.
    pub(crate) begin_ns: u64,
    /// The last one.
    pub(crate) end_ns: u64,
    /// The frozen spans that this one replaces. Its own ID may be among them.
    pub(crate) replaces: Vec<TriggerId>,
}

/// The triggers that a node knows, and the spans that it has frozen.
#[derive(Debug)]
pub(crate) struct FreezePlan {
    node: NodeAddress,
    incarnation: Incarnation,
    keep: Duration,
    after: Duration,
    /// The number of the last trigger of this node.
    last: u32,
    known: BTreeMap<TriggerId, Trigger>,
    /// Causes at this node that made no trigger.
    covered: Vec<CoveredCause>,
    /// The known triggers of which the span was frozen, with its begin and its end.
    frozen: BTreeMap<TriggerId, (u64, u64)>,
    /// Triggers to forward: at most one for each known trigger.
    outbox: VecDeque<Trigger>,
    /// Triggers that were refused: there were too many, or their times are wrong.
    refused: u64,
}

/// A cause within `after` of a known trigger.
#[derive(Debug)]
struct CoveredCause {
    at_ns: u64,
    cause: LeaveReason,
    /// Further causes of which there was no room for the words.
    further: u64,
}

/// Triggers that have one span.
struct Group<'a> {
    /// At least one. The first one is the earliest.
    members: Vec<&'a Trigger>,
    /// The trigger that decides.
    winner: &'a Trigger,
    begin_ns: u64,
    end_ns: u64,
}

impl<'a> Group<'a> {
    fn new(first: &'a Trigger) -> Self {
        Self { members: vec![first], winner: first, begin_ns: first.begin_ns(), end_ns: first.end_ns() }
    }

    fn add(&mut self, trigger: &'a Trigger) {
        self.members.push(trigger);
        self.begin_ns = self.begin_ns.min(trigger.begin_ns());
        self.end_ns = self.end_ns.max(trigger.end_ns());
        if trigger.id < self.winner.id {
            self.winner = trigger;
        }
    }

    const fn span(&self) -> (u64, u64) {
        (self.begin_ns, self.end_ns)
    }

    /// Returns the order to freeze its span, unless that is frozen and no other span of its triggers is.
    fn order(&self, plan: &FreezePlan) -> Option<SpanOrder> {
        let FreezePlan { frozen, covered, .. } = plan;
        let replaces: Vec<_> =
            self.members.iter().map(|member| member.id).filter(|id| frozen.contains_key(id)).collect();
        if replaces == [self.winner.id] && frozen.get(&self.winner.id) == Some(&self.span()) {
            return None;
        }
        let (trigger, (begin_ns, end_ns)) = (self.winner.clone(), self.span());
        Some(SpanOrder { trigger, causes: self.causes(covered), begin_ns, end_ns, replaces })
    }

    /// Returns the words of all causes, each text once, in the order of their times.
    fn causes(&self, covered: &[CoveredCause]) -> String {
        let has = |other: &&CoveredCause| self.members.iter().any(|member| member.covers(other.at_ns));
        let (mut further, mut all) = (0_u64, Vec::new());
        for CoveredCause { at_ns, cause, further: more } in covered.iter().filter(has) {
            further += more;
            all.push((*at_ns, cause.as_str()));
        }
        all.extend(self.members.iter().map(|member| (member.at_ns, member.cause.as_str())));
        all.sort_unstable();
        let mut named: Vec<&str> = Vec::new();
        for (_, cause) in all {
            if !named.contains(&cause) {
                named.push(cause);
            }
        }
        further += named.len().saturating_sub(NAMED_MAX) as u64;
        named.truncate(NAMED_MAX);
        let rest = if further == 0 { String::new() } else { format!("; and {further} more") };
        named.join("; ") + &rest
    }
}

impl FreezePlan {
    pub(crate) fn new(
        (node, incarnation): (NodeAddress, Incarnation),
        keep: Duration,
        after: Duration,
    ) -> Self {
        Self {
            node,
            incarnation,
            keep,
            after,
            last: 0,
            known: BTreeMap::new(),
            covered: Vec::new(),
            frozen: BTreeMap::new(),
            outbox: VecDeque::new(),
            refused: 0,
        }
    }

    /// Handles a cause at this node. Returns the trigger of the span that has the cause; a trigger that arrives later
    /// can change it. `None` if there are too many.
    pub(crate) fn happened(&mut self, now_ns: u64, at_ns: u64, cause: &str) -> Option<TriggerId> {
        self.prune(now_ns);
        let covers = |group: &&Group<'_>| group.members.iter().any(|member| member.covers(at_ns));
        let covering = self.groups().iter().find(covers).map(|group| group.winner.id);
        if let Some(id) = covering {
            self.cover(at_ns, cause);
            return Some(id);
        }
        let number = self.last.checked_add(1)?;
        let id = TriggerId { node: self.node, incarnation: self.incarnation, number };
        let (keep, after, cause) = (self.keep, self.after, LeaveReason::of(cause));
        let trigger = Trigger { id, at_ns, bound_ns: 0, keep, after, cause };
        if !self.add(&trigger) {
            return None;
        }
        self.outbox.push_back(trigger);
        self.last = number;
        let group =
            self.groups().into_iter().find(|group| group.members.iter().any(|member| member.id == id));
        Some(group.map_or(id, |group| group.winner.id))
    }

    /// Keeps the words of a cause that makes no trigger.
    fn cover(&mut self, at_ns: u64, cause: &str) {
        let cause = LeaveReason::of(cause);
        let is_same = |known: &LeaveReason| *known == cause;
        let is_named = self.known.values().any(|trigger| trigger.covers(at_ns) && is_same(&trigger.cause));
        // A name has each text once. That of an earlier group counts for itself.
        let after_ns = nanos(self.after);
        let has_room = self.covered.len() < COVERED_MAX;
        let is_near = |other: &&mut CoveredCause| at_ns.abs_diff(other.at_ns) <= after_ns;
        let mut near: Vec<_> = self.covered.iter_mut().filter(is_near).collect();
        if is_named || near.iter().any(|other| is_same(&other.cause)) {
            return;
        }
        if near.len() < COVERED_NEAR_MAX && has_room {
            self.covered.push(CoveredCause { at_ns, cause, further: 0 });
        } else if let Some(last) = near.last_mut() {
            last.further += 1;
        }
    }

    /// Handles the trigger of another node. Returns whether it is new here.
    pub(crate) fn received(&mut self, now_ns: u64, trigger: Trigger) -> bool {
        self.prune(now_ns);
        let is_own = (trigger.id.node, trigger.id.incarnation) == (self.node, self.incarnation);
        if is_own || self.known.contains_key(&trigger.id) {
            return false;
        }
        let latest = now_ns.saturating_add(trigger.bound_ns).saturating_add(FUTURE_NS);
        let is_in_time = trigger.at_ns <= latest && now_ns <= forgotten_ns(due_ns(trigger.end_ns()));
        if !trigger.is_legal() || !is_in_time {
            self.refused += 1;
            return false;
        }
        let before = self.spans();
        if !self.add(&trigger) {
            return false;
        }
        // Else the others do without it. If a node is lost, each of the n others has a trigger of its own: n³ messages.
        if self.spans() != before {
            self.outbox.push_back(trigger);
        }
        true
    }

    /// Returns the next order, if one is due.
    pub(crate) fn poll(&mut self, now_ns: u64) -> Option<Output> {
        if let Some(trigger) = self.outbox.pop_front() {
            return Some(Output::Forward(trigger));
        }
        let is_due = |group: &&Group<'_>| due_ns(group.end_ns) <= now_ns;
        let order = self.groups().iter().filter(is_due).find_map(|group| group.order(self))?;
        for id in &order.replaces {
            self.frozen.remove(id);
        }
        self.frozen.insert(order.trigger.id, (order.begin_ns, order.end_ns));
        Some(Output::Freeze(order))
    }

    /// Returns how many triggers were refused.
    pub(crate) const fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the known triggers.
    #[cfg(test)]
    pub(crate) fn known(&self) -> Vec<Trigger> {
        self.known.values().cloned().collect()
    }

    fn add(&mut self, trigger: &Trigger) -> bool {
        if self.known.len() >= TRIGGERS_MAX {
            self.refused += 1;
            return false;
        }
        self.known.insert(trigger.id, trigger.clone());
        true
    }

    /// Returns the spans of all known triggers: the trigger that decides, the begin and the end.
    fn spans(&self) -> Vec<(TriggerId, (u64, u64))> {
        self.groups().iter().map(|group| (group.winner.id, group.span())).collect()
    }

    /// Returns the groups, by time. spec: BAG-7
    fn groups(&self) -> Vec<Group<'_>> {
        let mut by_time: Vec<_> = self.known.values().collect();
        by_time.sort_by_key(|trigger| (trigger.at_ns, trigger.id));
        let mut groups: Vec<Group<'_>> = Vec::new();
        for trigger in by_time {
            match groups.last_mut() {
                Some(group) if trigger.at_ns <= group.members[0].end_ns() => {
                    group.add(trigger);
                }
                Some(_) | None => groups.push(Group::new(trigger)),
            }
        }
        groups
    }

    /// Forgets whole groups: a part of one could decide otherwise.
    fn prune(&mut self, now_ns: u64) {
        let old: Vec<_> = self
            .groups()
            .iter()
            .filter(|group| now_ns > forgotten_ns(due_ns(group.end_ns)))
            .flat_map(|group| group.members.iter().map(|member| member.id))
            .collect();
        for id in old {
            self.known.remove(&id);
            self.frozen.remove(&id);
        }
        let Self { known, covered, .. } = self;
        covered.retain(|cause| known.values().any(|trigger| trigger.covers(cause.at_ns)));
    }
}

/// Returns when a span with this end can be frozen.
const fn due_ns(end_ns: u64) -> u64 {
    end_ns.saturating_add(GRACE_NS)
}

const fn forgotten_ns(due_ns: u64) -> u64 {
    due_ns.saturating_add(MEMORY_NS)
}

#[cfg(test)]
mod tests;
