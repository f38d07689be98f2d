//! Sets of triggers, and the spans of nodes that know them.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

const SECOND: u64 = 1_000_000_000;
const KEEP: Duration = Duration::from_secs(30);
const AFTER: Duration = Duration::from_secs(2);
/// Times before and after a trigger, of nodes with different configurations.
const TIMES: [(Duration, Duration); 4] = [
    (KEEP, AFTER),
    (Duration::from_secs(3), Duration::from_millis(2_500)),
    (Duration::from_secs(1), Duration::from_secs(1)),
    (Duration::from_secs(60), Duration::from_secs(4)),
];

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

/// Returns the spans that a node has in the end, with their begins and ends.
fn kept(outputs: &[Output]) -> BTreeMap<TriggerId, (u64, u64)> {
    let mut kept = BTreeMap::new();
    for output in outputs {
        let Output::Freeze(order) = output else { continue };
        for id in &order.replaces {
            assert!(kept.remove(id).is_some(), "it was frozen");
        }
        let former = kept.insert(order.trigger.id, (order.begin_ns, order.end_ns));
        assert_eq!(former, None, "it is replaced");
    }
    kept
}

fn order(trigger: &Trigger, replaces: &[TriggerId]) -> SpanOrder {
    let (begin_ns, end_ns) = (trigger.begin_ns(), trigger.end_ns());
    let causes = trigger.cause.as_str().to_owned();
    SpanOrder { trigger: trigger.clone(), causes, begin_ns, end_ns, replaces: replaces.to_vec() }
}

#[test]
fn cause_is_forwarded_immediately_and_frozen_after_its_time() {
    let mut plan = plan(1);
    let id = plan.happened(100 * SECOND, 100 * SECOND, "a guard is shut").unwrap();
    assert_eq!(id.to_string(), "0.0.0.1-1-1");
    let Some(Output::Forward(forwarded)) = plan.poll(100 * SECOND) else { panic!("it travels") };
    assert_eq!((forwarded.begin_ns(), forwarded.end_ns()), (70 * SECOND, 102 * SECOND));
    assert_eq!(plan.poll(102 * SECOND + GRACE_NS - 1), None);
    assert_eq!(plan.poll(102 * SECOND + GRACE_NS), Some(Output::Freeze(order(&forwarded, &[]))));
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
fn name_of_a_span_has_its_causes_in_order() {
    let mut plan = plan(1);
    plan.happened(100 * SECOND, 100 * SECOND, "a guard is shut").unwrap();
    // Given: causes that make no trigger, one of them reported late, and one twice
    for (at_ns, cause) in [(102, "the knee is lost"), (101, "late"), (101, "a guard is shut"), (102, "late")]
    {
        plan.happened(102 * SECOND, at_ns * SECOND, cause).unwrap();
    }
    assert!(plan.received(103 * SECOND, trigger(2, 1, 101 * SECOND + 1)));
    let name = |plan: &mut FreezePlan| {
        let mut orders = drain(plan, 110 * SECOND).into_iter().filter_map(|output| match output {
            Output::Freeze(order) => Some(order.causes),
            Output::Forward(_) => None,
        });
        orders.next().expect("it is due")
    };
    assert_eq!(name(&mut plan), "a guard is shut; late; test; the knee is lost");
    // And: a long list is counted
    let at_ns = 200 * SECOND;
    for number in 0..100 {
        plan.happened(at_ns, at_ns + number, &format!("fault {number}")).unwrap();
    }
    assert_eq!(plan.covered.len(), COVERED_NEAR_MAX);
    let later = plan.poll(at_ns).is_some().then(|| drain(&mut plan, at_ns + 10 * SECOND)).unwrap();
    let Some(Output::Freeze(order)) = later.last() else { panic!("it is due: {later:?}") };
    assert!(
        order.causes.starts_with("fault 0; fault 1; ") && order.causes.ends_with("; fault 7; and 92 more")
    );
}

#[test]
fn flood_leaves_room_for_the_words_of_later_causes() {
    let mut plan = plan(1);
    for number in 0..1_000 {
        let at_ns = 100 * SECOND + number * (SECOND / 100);
        plan.happened(at_ns, at_ns, &format!("fault {number}")).unwrap();
    }
    let at_ns = 115 * SECOND;
    for cause in ["a guard is shut", "the knee is lost"] {
        plan.happened(at_ns, at_ns, cause).unwrap();
    }
    assert!(plan.covered.len() <= COVERED_MAX);
    let outputs = drain(&mut plan, 120 * SECOND);
    let Some(Output::Freeze(order)) = outputs.last() else { panic!("it is due: {outputs:?}") };
    assert_eq!(order.causes, "a guard is shut; the knee is lost");
}

#[test]
fn trigger_with_a_smaller_id_replaces_a_frozen_span() {
    let mut plan = plan(2);
    let id = plan.happened(100 * SECOND, 100 * SECOND, "late").unwrap();
    let span = (70 * SECOND, 102 * SECOND);
    assert_eq!(kept(&drain(&mut plan, 103 * SECOND)), BTreeMap::from([(id, span)]));
    let other = trigger(1, 1, 101 * SECOND);
    assert!(plan.received(104 * SECOND, other.clone()) && !plan.received(104 * SECOND, other.clone()));
    let both = SpanOrder { begin_ns: span.0, causes: "late; test".to_owned(), ..order(&other, &[id]) };
    assert_eq!(drain(&mut plan, 104 * SECOND), [Output::Forward(other), Output::Freeze(both)]);
    assert_eq!(plan.poll(105 * SECOND), None);
}

#[test]
fn span_has_the_times_of_all_its_triggers() {
    let mut plan = plan(1);
    let id = plan.happened(100 * SECOND, 100 * SECOND, "late").unwrap();
    let (keep, after) = (Duration::from_secs(60), Duration::from_secs(9));
    let longer = Trigger { keep, after, ..trigger(2, 1, 101 * SECOND) };
    assert!(plan.received(101 * SECOND, longer));
    assert!(kept(&drain(&mut plan, 109 * SECOND)).is_empty(), "the other one is not over");
    let spans = kept(&drain(&mut plan, 111 * SECOND));
    assert_eq!(spans, BTreeMap::from([(id, (41 * SECOND, 110 * SECOND))]));
}

#[test]
fn trigger_without_effect_is_not_forwarded() {
    let mut plan = plan(1);
    plan.happened(100 * SECOND, 100 * SECOND, "late").unwrap();
    assert_eq!(drain(&mut plan, 100 * SECOND).len(), 1, "its own one");
    let within = |trigger: Trigger| Trigger { keep: AFTER, after: Duration::from_secs(1), ..trigger };
    assert!(plan.received(101 * SECOND, within(trigger(2, 1, 100 * SECOND + 1))));
    assert_eq!(drain(&mut plan, 101 * SECOND), [], "the span is the same with it");
    assert!(plan.received(101 * SECOND, trigger(3, 1, 99 * SECOND)));
    assert_eq!(drain(&mut plan, 101 * SECOND).len(), 1, "the span begins earlier");
    assert_eq!(plan.known().len(), 3);
}

#[test]
fn lost_node_costs_few_messages() {
    const NODES: u32 = 32;
    let mut plans: Vec<_> = (1..=NODES).map(plan).collect();
    let base = 100 * SECOND;
    let mut messages = 0;
    // Each node sees the loss, at another moment, and has the triggers of the others in an order of its own.
    let at_ns = |node: u32| base + u64::from(node.wrapping_mul(0x9e37_79b9) >> 12);
    for (plan, node) in plans.iter_mut().zip(1..) {
        plan.happened(base, at_ns(node), "the knee is lost").unwrap();
        for step in 1..NODES {
            let other = (node - 1 + step * 7) % NODES + 1;
            plan.received(base, trigger(other, 1, at_ns(other)));
        }
        messages += drain(plan, base).len() as u32 * (NODES - 1);
    }
    assert!(
        messages < NODES * NODES * 12,
        "{messages}, and each trigger from each node were {}",
        NODES.pow(3)
    );
    let spans: BTreeSet<_> = plans.iter_mut().map(|plan| kept(&drain(plan, base + 9 * SECOND))).collect();
    assert_eq!(spans.len(), 1);
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
        plan.known.len() == TRIGGERS_MAX && plan.happened(now + 9 * SECOND, now + 9 * SECOND, "x").is_none()
    );
    assert!(
        plan.happened(now + 100 * SECOND, now + 100 * SECOND, "later").is_some(),
        "old ones are forgotten"
    );
}

proptest! {
    /// Nodes with clocks apart by up to a millisecond, which get the same triggers in any order and at any time,
    /// have the same spans. The triggers' distances are not within that error of `after`, and not within it of 0.
    #[test]
    fn any_order_of_triggers_gives_the_same_spans(
        slots in proptest::collection::btree_map(0_u64..40, 1_u32..6, 1..20),
        orders in proptest::collection::vec(any::<u64>(), 3),
    ) {
        // Slots of 300 ms: each time after a trigger lies between two of them.
        let base = 100 * SECOND;
        let all: Vec<_> = slots
            .iter()
            .zip(1..)
            .map(|((slot, node), number)| {
                let (keep, after) = TIMES[number as usize % TIMES.len()];
                Trigger { keep, after, ..trigger(*node, number, base + slot * 300_000_000) }
            })
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
            kept(&outputs).into_keys().collect::<Vec<_>>()
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
        let mut plans = [1, 2, 3].map(|node| {
            let (keep, after) = TIMES[node as usize % TIMES.len()];
            FreezePlan::new((NodeAddress::new(node), Incarnation(1)), keep, after)
        });
        let mut outputs: [Vec<Output>; 3] = Default::default();
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
            let has = |(begin_ns, end_ns): &(u64, u64)| (*begin_ns..=*end_ns).contains(&at_ns);
            prop_assert!(spans[0].values().any(has), "{at_ns}: {spans:?}");
        }
    }
}
