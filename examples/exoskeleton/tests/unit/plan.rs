//! Tests of `src/robot/launch/plan.rs`.

use super::*;

#[test]
fn every_process_starts_once_and_a_joint_starts_last() {
    for seed in 0..50 {
        let mut plan = Plan::shuffled(seed, Time::ZERO);
        assert_eq!(plan.take_due(Time::ZERO).map(|_| plan.starts.len()), Some(4));
        let mut rest: Vec<Role> = std::iter::from_fn(|| plan.take_due(Time::MAX)).collect();
        assert!(matches!(rest[3], Role::Node(Part::Joint(_))), "{rest:?}");
        rest.sort_unstable();
        rest.dedup();
        assert_eq!(rest.len(), 4);
    }
}
