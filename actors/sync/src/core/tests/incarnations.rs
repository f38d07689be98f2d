//! Nodes in more than one incarnation.

use super::*;

#[test]
fn lost_earlier_incarnation_without_a_list_is_reported_lost() {
    // Given: its list in a later incarnation; the clock of its host was reset
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    bench.links(KNEE, NEXT_INCARNATION);
    let mut later = list(1, &[("drive", true, &[])]);
    later.incarnation = NEXT_INCARNATION;
    bench.list(KNEE, later);
    bench.links(KNEE, INCARNATION);
    // When
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    // Then
    bench.down(0);
    assert_eq!(bench.missing(), [("drive".to_owned(), "its node was lost")]);
}

// spec: SYNC-1
#[test]
fn newest_version_of_the_newest_incarnation_wins() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(2, &[("drive", false, &[])]));
    assert_eq!(bench.list(KNEE, list(1, &[("drive", true, &[])])), [], "older");
    let mut other_list = list(9, &[("drive", true, &[])]);
    other_list.incarnation = NEXT_INCARNATION;
    let refused = bench.list(KNEE, other_list.clone());
    assert!(matches!(refused[..], [Output::Refused { cause: "directory", .. }]), "{refused:?}");
    bench.links(KNEE, NEXT_INCARNATION);
    assert_eq!(bench.list(KNEE, other_list), [release(0)]);
    assert_eq!(bench.breaks(KNEE), [], "it is about the former incarnation");
    assert!(bench.core.directory()[0].ready);
}

fn found(bench: &mut Bench, incarnation: Incarnation) -> Vec<Output> {
    let found = MembershipFact::NodeFound { node: KNEE, incarnation, gncl: Vec::new() };
    bench.handle(Input::MembershipChanged(found))
}

// spec: SYNC-3
#[test]
fn node_found_in_its_next_incarnation_starts_empty() {
    // Given: a subscriber of the directory, and a ready drive of the knee that is a member of a group
    let mut bench = Bench::new();
    bench.registers(9, "", &[]);
    bench.handle(Input::DirectoryWanted { app: app(9) });
    bench.registers(0, "gait", &["drive"]);
    bench.links(KNEE, INCARNATION);
    let groups = vec![AppAddress::group("legs")];
    bench.list(KNEE, List { groups: groups.clone(), ..list(1, &[("drive", true, &[])]) });
    bench.ready(0);
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    // When
    let outputs = found(&mut bench, NEXT_INCARNATION);
    // Then
    assert_eq!(outputs, [], "nothing is reported, and no group has a member there");
    assert!(bench.core.called("drive").is_empty());
    assert!(bench.core.directory().iter().all(|entry| entry.tid.node == HERE));
    assert_eq!(
        in_words(bench.core.missing(bench.now, app(0))),
        [("drive".to_owned(), "its node has restarted, its directory has not come yet")]
    );
    bench.links(KNEE, NEXT_INCARNATION);
    let next = List { incarnation: NEXT_INCARNATION, groups, ..list(1, &[("drive", true, &[])]) };
    assert!(bench.list(KNEE, next).contains(&met(0, "drive")));
    assert_eq!(bench.core.called("drive").len(), 1);
}

// spec: SYNC-3
#[test]
fn duplicate_removes_nothing_until_the_link_breaks() {
    for is_unmasked in [true, false] {
        // Given
        let mut bench = Bench::new();
        bench.registers(0, "gait", &["drive"]);
        bench.links(KNEE, INCARNATION);
        bench.list(KNEE, list(1, &[("drive", true, &[])]));
        bench.ready(0);
        // When
        let outputs = found(&mut bench, NEXT_INCARNATION);
        // Then
        assert_eq!(outputs, []);
        assert_eq!(bench.core.called("drive").len(), 1);
        // And: once messages do not reach the node any more, the incarnation found last is present, unless it was only
        // a duplicate
        if is_unmasked {
            bench.handle(Input::MembershipChanged(MembershipFact::NodeLost {
                node: KNEE,
                incarnation: NEXT_INCARNATION,
                why: LossReason::Duplicate,
            }));
        }
        bench.breaks(KNEE);
        assert_eq!(bench.core.called("drive").len(), usize::from(is_unmasked));
    }
}

// spec: SYNC-3
#[test]
fn lost_incarnation_is_over_despite_a_late_link_down() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    bench.lost(KNEE, LossReason::Crashed);
    found(&mut bench, NEXT_INCARNATION);
    assert!(bench.core.called("drive").is_empty());
    bench.breaks(KNEE);
    assert!(bench.core.called("drive").is_empty());
}

// spec: SYNC-3
#[test]
fn lost_incarnation_stays_lost_after_a_late_link() {
    for why in [LossReason::Left, LossReason::Crashed, LossReason::LinkDown] {
        let mut bench = Bench::new();
        bench.links(KNEE, INCARNATION);
        bench.list(KNEE, list(1, &[("drive", true, &[])]));
        bench.breaks(KNEE);
        bench.lost(KNEE, why.clone());
        bench.links(KNEE, INCARNATION);
        bench.breaks(KNEE);
        assert!(bench.core.called("drive").is_empty(), "{why:?}");
        found(&mut bench, INCARNATION);
        bench.links(KNEE, INCARNATION);
        bench.breaks(KNEE);
        assert_eq!(bench.core.called("drive"), [Tid::new(KNEE, app(0))], "{why:?}");
    }
}

// spec: SYNC-13
#[test]
fn fail_on_loss_wait_ends_when_the_party_restarted() {
    // Given: a wait for a party in an incarnation that is over
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    // When
    bench.passes(Duration::from_millis(49));
    found(&mut bench, NEXT_INCARNATION);
    let outputs = bench.passes(Duration::from_millis(1));
    // Then
    let lost = |output: &Output| {
        matches!(output, Output::AnswerBarrier { correlation: 7, answer: BarrierAnswer::Lost { .. }, .. })
    };
    assert!(outputs.iter().any(lost), "{outputs:?}");
}

#[test]
fn incarnation_lost_and_found_again_keeps_its_known_state() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::LinkDown);
    assert!(bench.core.called("drive").is_empty());
    found(&mut bench, INCARNATION);
    assert_eq!(bench.core.called("drive"), [Tid::new(KNEE, app(0))]);
}
