//! The decision which spans a node freezes: a pure function of all triggers that it knows.
//!
//! A cause at this node makes a trigger, which travels to all nodes. Each node decides by itself, so the decision must
//! not depend on the order in which triggers arrive:
//!
//! - The triggers are sorted by time. The first one and all within its `after` are one group, the first one behind
//!   them begins the next group, and so on.
//! - Of a group the trigger with the smallest ID decides. Its span is frozen, from its `keep` before it to its `after`
//!   behind it. `keep` is not less than `after`, so all triggers of the group are in the span.
//!
//! A trigger that arrives after a group was frozen can change the group. Then the right span is frozen too, and the
//! wrong one is discarded. All times are nanoseconds of this node's monotonic clock.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
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
    /// Send the trigger to all other nodes, once.
    Forward(Trigger),
    /// Freeze the span of the trigger.
    Freeze(Trigger),
    /// Discard the frozen span of this trigger: that of another one has replaced it.
    Discard(TriggerId),
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
    /// The known triggers of which the span was frozen.
    frozen: BTreeSet<TriggerId>,
    /// Triggers to forward: at most one for each known trigger.
    outbox: VecDeque<Trigger>,
    /// Triggers that were refused: there were too many, or their times are wrong.
    refused: u64,
}

/// Triggers that have one span.
struct Group<'a> {
    members: Vec<&'a Trigger>,
    /// The trigger that decides.
    winner: &'a Trigger,
    due_ns: u64,
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
            frozen: BTreeSet::new(),
            outbox: VecDeque::new(),
            refused: 0,
        }
    }

    /// Handles a cause at this node. Returns the trigger that stands for it: a new one, or that of a span that has the
    /// cause already. `None` if there are too many.
    pub(crate) fn happened(&mut self, now_ns: u64, at_ns: u64, cause: &str) -> Option<TriggerId> {
        self.prune(now_ns);
        let has = |group: &Group<'_>| {
            let first = group.members[0];
            at_ns.abs_diff(first.at_ns) <= nanos(first.after)
        };
        if let Some(group) = self.groups().iter().find(|group| has(group)) {
            return Some(group.winner.id);
        }
        let number = self.last.checked_add(1)?;
        let id = TriggerId { node: self.node, incarnation: self.incarnation, number };
        let (keep, after, cause) = (self.keep, self.after, LeaveReason::of(cause));
        if !self.add(Trigger { id, at_ns, bound_ns: 0, keep, after, cause }) {
            return None;
        }
        self.last = number;
        Some(id)
    }

    /// Handles the trigger of another node. Returns whether it is new here.
    pub(crate) fn received(&mut self, now_ns: u64, trigger: Trigger) -> bool {
        self.prune(now_ns);
        let is_own = (trigger.id.node, trigger.id.incarnation) == (self.node, self.incarnation);
        if is_own || self.known.contains_key(&trigger.id) {
            return false;
        }
        let latest = now_ns.saturating_add(trigger.bound_ns).saturating_add(FUTURE_NS);
        let is_in_time = trigger.at_ns <= latest && now_ns <= forgotten_ns(due_ns(&trigger));
        if !trigger.is_legal() || !is_in_time {
            self.refused += 1;
            return false;
        }
        self.add(trigger)
    }

    /// Returns the next order, if one is due.
    pub(crate) fn poll(&mut self, now_ns: u64) -> Option<Output> {
        if let Some(trigger) = self.outbox.pop_front() {
            return Some(Output::Forward(trigger));
        }
        let mut output = None;
        for group in self.groups() {
            let is_frozen = self.frozen.contains(&group.winner.id);
            if !is_frozen && group.due_ns <= now_ns {
                output = Some(Output::Freeze(group.winner.clone()));
            } else if is_frozen {
                let others = group.members.iter().filter(|member| member.id != group.winner.id);
                let wrong = others.map(|member| member.id).find(|id| self.frozen.contains(id));
                output = wrong.map(Output::Discard);
            }
            if output.is_some() {
                break;
            }
        }
        match &output {
            Some(Output::Freeze(trigger)) => _ = self.frozen.insert(trigger.id),
            Some(Output::Discard(id)) => _ = self.frozen.remove(id),
            Some(Output::Forward(_)) | None => {}
        }
        output
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

    fn add(&mut self, trigger: Trigger) -> bool {
        if self.known.len() >= TRIGGERS_MAX {
            self.refused += 1;
            return false;
        }
        self.outbox.push_back(trigger.clone());
        self.known.insert(trigger.id, trigger);
        true
    }

    /// Returns the groups, by time.
    fn groups(&self) -> Vec<Group<'_>> {
        let mut by_time: Vec<_> = self.known.values().collect();
        by_time.sort_by_key(|trigger| (trigger.at_ns, trigger.id));
        let mut groups: Vec<Group<'_>> = Vec::new();
        for trigger in by_time {
            match groups.last_mut() {
                Some(group) if trigger.at_ns <= group.members[0].end_ns() => {
                    group.members.push(trigger);
                    group.due_ns = group.due_ns.max(due_ns(trigger));
                    if trigger.id < group.winner.id {
                        group.winner = trigger;
                    }
                }
                Some(_) | None => {
                    groups.push(Group { members: vec![trigger], winner: trigger, due_ns: due_ns(trigger) });
                }
            }
        }
        groups
    }

    /// Forgets whole groups: a part of one could decide otherwise.
    fn prune(&mut self, now_ns: u64) {
        let old: Vec<_> = self
            .groups()
            .iter()
            .filter(|group| now_ns > forgotten_ns(group.due_ns))
            .flat_map(|group| group.members.iter().map(|member| member.id))
            .collect();
        for id in old {
            self.known.remove(&id);
            self.frozen.remove(&id);
        }
    }
}

/// Returns when the span of a trigger can be frozen.
fn due_ns(trigger: &Trigger) -> u64 {
    trigger.end_ns().saturating_add(GRACE_NS)
}

const fn forgotten_ns(due_ns: u64) -> u64 {
    due_ns.saturating_add(MEMORY_NS)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: u64 = 1_000_000_000;
    const KEEP: Duration = Duration::from_secs(30);
    const AFTER: Duration = Duration::from_secs(2);

    fn plan(node: u32) -> FreezePlan {
        FreezePlan::new((NodeAddress::new(node), Incarnation(1)), KEEP, AFTER)
    }

    fn trigger(node: u32, number: u32, at_ns: u64) -> Trigger {
        let id = TriggerId { node: NodeAddress::new(node), incarnation: Incarnation(1), number };
        Trigger { id, at_ns, bound_ns: 0, keep: KEEP, after: AFTER, cause: LeaveReason::of("test") }
    }

    fn drain(plan: &mut FreezePlan, now_ns: u64) -> Vec<Output> {
        std::iter::from_fn(|| plan.poll(now_ns)).collect()
    }

    /// Returns the spans that a node has in the end.
    fn kept(outputs: &[Output]) -> BTreeSet<TriggerId> {
        let mut kept = BTreeSet::new();
        for output in outputs {
            match output {
                Output::Forward(_) => {}
                Output::Freeze(trigger) => assert!(kept.insert(trigger.id), "it is frozen once"),
                Output::Discard(id) => assert!(kept.remove(id), "it was frozen"),
            }
        }
        kept
    }

    #[test]
    fn cause_is_forwarded_at_once_and_frozen_after_its_time() {
        let mut plan = plan(1);
        let id = plan.happened(100 * SECOND, 100 * SECOND, "a guard is shut").unwrap();
        assert_eq!(id.to_string(), "0.0.0.1-1-1");
        let Some(Output::Forward(forwarded)) = plan.poll(100 * SECOND) else { panic!("it travels") };
        assert_eq!((forwarded.begin_ns(), forwarded.end_ns()), (70 * SECOND, 102 * SECOND));
        assert_eq!(plan.poll(102 * SECOND + GRACE_NS - 1), None);
        assert_eq!(plan.poll(102 * SECOND + GRACE_NS), Some(Output::Freeze(forwarded)));
        assert_eq!(plan.poll(200 * SECOND), None);
    }

    #[test]
    fn flood_of_causes_has_one_trigger_per_span() {
        let mut plan = plan(1);
        let mut ids = BTreeSet::new();
        for at_ns in (100 * SECOND..106 * SECOND).step_by(1_000_000) {
            ids.insert(plan.happened(at_ns, at_ns, "late").unwrap());
        }
        assert_eq!(ids.len(), 3);
        assert_eq!(drain(&mut plan, 106 * SECOND).len(), 3 + 2, "three are forwarded, and two are due");
    }

    #[test]
    fn trigger_with_a_smaller_id_replaces_a_frozen_span() {
        let mut plan = plan(2);
        let id = plan.happened(100 * SECOND, 100 * SECOND, "late").unwrap();
        assert_eq!(kept(&drain(&mut plan, 103 * SECOND)), BTreeSet::from([id]));
        let other = trigger(1, 1, 101 * SECOND);
        assert!(plan.received(104 * SECOND, other.clone()) && !plan.received(104 * SECOND, other.clone()));
        let expected = [Output::Forward(other.clone()), Output::Freeze(other), Output::Discard(id)];
        assert_eq!(drain(&mut plan, 104 * SECOND), expected);
    }

    #[test]
    fn wrong_and_old_triggers_are_refused() {
        let mut plan = plan(2);
        let now = 1_000 * SECOND;
        let long = Trigger { keep: Duration::from_secs(601), ..trigger(1, 1, now) };
        let short = Trigger { keep: Duration::from_secs(1), ..trigger(1, 2, now) };
        for wrong in [long, short, trigger(1, 3, now + 2 * SECOND), trigger(1, 4, now - 60 * SECOND)] {
            assert!(!plan.received(now, wrong));
        }
        assert_eq!(plan.refused(), 4);
        assert!((1..=300).map(|number| plan.received(now, trigger(1, number, now))).any(|is_new| !is_new));
        assert!(
            plan.known.len() == TRIGGERS_MAX
                && plan.happened(now + 9 * SECOND, now + 9 * SECOND, "x").is_none()
        );
        assert!(
            plan.happened(now + 100 * SECOND, now + 100 * SECOND, "later").is_some(),
            "old ones are forgotten"
        );
    }

    proptest! {
        /// Nodes with clocks apart by up to a millisecond, which get the same triggers in any order and at any time,
        /// have the same spans. The triggers' distances are not within that error of `after`.
        #[test]
        fn any_order_of_triggers_gives_the_same_spans(
            slots in proptest::collection::vec((0_u64..40, 1_u32..6), 1..20),
            orders in proptest::collection::vec(any::<u64>(), 3),
        ) {
            // Slots of 300 ms: 2 s lie between two of them.
            let base = 100 * SECOND;
            let all: Vec<_> = slots
                .iter()
                .zip(1..)
                .map(|((slot, node), number)| trigger(*node, number, base + slot * 300_000_000))
                .collect();
            let results = orders.iter().map(|order| {
                let mut plan = plan(9);
                let (mut mixed, mut outputs) = (all.clone(), Vec::new());
                mixed.sort_by_key(|trigger| (u64::from(trigger.id.number) + 1).wrapping_mul(order | 1));
                for (trigger, step) in mixed.into_iter().zip(0_u64..) {
                    let now_ns = base + 15 * SECOND + step * (order % (SECOND / 2));
                    let at_ns = trigger.at_ns + order.rotate_left(trigger.id.number) % 1_000_000;
                    plan.received(now_ns, Trigger { at_ns, ..trigger });
                    outputs.extend(drain(&mut plan, now_ns));
                }
                outputs.extend(drain(&mut plan, base + 40 * SECOND));
                kept(&outputs)
            });
            let results: BTreeSet<_> = results.collect();
            prop_assert_eq!(results.len(), 1, "{:?}", results);
        }

        /// Three nodes see causes of their own, and forward their triggers with any delay below a second. All have the
        /// same spans in the end, and each cause is within one of them.
        #[test]
        fn nodes_that_forward_their_triggers_have_the_same_spans(
            causes in proptest::collection::vec((0_u64..750, 0_usize..3), 1..12),
            delays in proptest::collection::vec(1_u64..50, 64),
        ) {
            const STEP: u64 = 20_000_000;
            let base = 100 * SECOND;
            let mut plans = [1, 2, 3].map(plan);
            let mut outputs: [Vec<Output>; 3] = Default::default();
            let mut all = BTreeMap::new();
            let mut delays = delays.into_iter().cycle();
            // Triggers on their way: the time of arrival, a number, the receiver, and the trigger.
            let mut on_the_way: Vec<(u64, usize, Trigger)> = Vec::new();
            for step in 0..1_500 {
                let now_ns = base + step * STEP;
                for (_, node) in causes.iter().filter(|(at, _)| *at == step) {
                    prop_assert!(plans[*node].happened(now_ns, now_ns, "test").is_some());
                }
                let (arrived, others) = on_the_way.into_iter().partition(|(at, ..)| *at <= now_ns);
                on_the_way = others;
                let arrived: Vec<(u64, usize, Trigger)> = arrived;
                for (_, node, trigger) in arrived {
                    plans[node].received(now_ns, trigger);
                }
                for node in 0..3 {
                    for output in drain(&mut plans[node], now_ns) {
                        if let Output::Forward(trigger) = &output {
                            all.insert(trigger.id, trigger.clone());
                            for other in (0..3).filter(|other| *other != node) {
                                let delay = delays.next().expect("it has no end") * STEP;
                                on_the_way.push((now_ns + delay, other, trigger.clone()));
                            }
                        }
                        outputs[node].push(output);
                    }
                }
            }
            let spans = outputs.map(|outputs| kept(&outputs));
            prop_assert_eq!(&spans[0], &spans[1]);
            prop_assert_eq!(&spans[0], &spans[2]);
            for (at, _) in causes {
                let at_ns = base + at * STEP;
                let has = |id: &TriggerId| (all[id].begin_ns()..=all[id].end_ns()).contains(&at_ns);
                prop_assert!(spans[0].iter().any(has), "{at_ns}: {spans:?}");
            }
        }
    }
}
