//! Nodes in more than one life.

use super::*;

#[test]
fn a_node_that_was_back_in_an_earlier_life_and_is_lost_before_it_said_anything_is_told_as_lost() {
    // Given: its list in a later life; its host's clock began anew
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    bench.links(KNEE, NEXT_LIFE);
    let mut later = list(1, &[("drive", true, &[])]);
    later.incarnation = NEXT_LIFE;
    bench.list(KNEE, later);
    bench.links(KNEE, LIFE);
    // When
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    // Then
    bench.down(0);
    assert_eq!(bench.missing(), [("drive".to_owned(), "its node was lost")]);
}

// spec: SYNC-1
#[test]
fn the_newest_version_of_the_newest_life_wins() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(2, &[("drive", false, &[])]));
    assert_eq!(bench.list(KNEE, list(1, &[("drive", true, &[])])), [], "older");
    let mut other_life = list(9, &[("drive", true, &[])]);
    other_life.incarnation = NEXT_LIFE;
    let refused = bench.list(KNEE, other_life.clone());
    assert!(matches!(refused[..], [Output::Refused { cause: "directory", .. }]), "{refused:?}");
    bench.links(KNEE, NEXT_LIFE);
    assert_eq!(bench.list(KNEE, other_life), [release(0)]);
    assert_eq!(bench.breaks(KNEE), [], "news of the former life");
    assert!(bench.core.directory()[0].ready);
}

fn found(bench: &mut Bench, incarnation: Incarnation) -> Vec<Output> {
    let found = MembershipFact::NodeFound { node: KNEE, incarnation, gncl: Vec::new() };
    bench.hears(Input::MembershipChanged(found))
}

// spec: SYNC-3
#[test]
fn a_node_that_is_found_in_its_next_life_brings_nothing_of_its_former_one_back() {
    // Given: somebody hears of the directory, the knee's drive is ready and a member of a group
    let mut bench = Bench::new();
    bench.registers(9, "", &[]);
    bench.hears(Input::DirectoryWanted { app: app(9) });
    bench.registers(0, "gait", &["drive"]);
    bench.links(KNEE, LIFE);
    let groups = vec![AppAddress::group("legs")];
    bench.list(KNEE, List { groups: groups.clone(), ..list(1, &[("drive", true, &[])]) });
    bench.ready(0);
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    // When
    let outputs = found(&mut bench, NEXT_LIFE);
    // Then
    assert_eq!(outputs, [], "nobody hears that it is there, and no group has a member there");
    assert!(bench.core.called("drive").is_empty());
    assert!(bench.core.directory().iter().all(|entry| entry.tid.node == HERE));
    assert_eq!(
        in_words(bench.core.missing(bench.now, app(0))),
        [("drive".to_owned(), "its node has restarted, its directory has not come yet")]
    );
    bench.links(KNEE, NEXT_LIFE);
    let next = List { incarnation: NEXT_LIFE, groups, ..list(1, &[("drive", true, &[])]) };
    assert!(bench.list(KNEE, next).contains(&met(0, "drive")));
    assert_eq!(bench.core.called("drive").len(), 1);
}

// spec: SYNC-3
#[test]
fn a_double_that_is_found_while_the_node_itself_is_linked_takes_nothing_away_until_the_link_breaks() {
    for is_unmasked in [true, false] {
        // Given
        let mut bench = Bench::new();
        bench.registers(0, "gait", &["drive"]);
        bench.links(KNEE, LIFE);
        bench.list(KNEE, list(1, &[("drive", true, &[])]));
        bench.ready(0);
        // When
        let outputs = found(&mut bench, NEXT_LIFE);
        // Then
        assert_eq!(outputs, []);
        assert_eq!(bench.core.called("drive").len(), 1);
        // And once messages do not reach the node any more, who was found last is there, unless it was no more than a double
        if is_unmasked {
            bench.hears(Input::MembershipChanged(MembershipFact::NodeLost {
                node: KNEE,
                incarnation: NEXT_LIFE,
                why: LossReason::Duplicate,
            }));
        }
        bench.breaks(KNEE);
        assert_eq!(bench.core.called("drive").len(), usize::from(is_unmasked));
    }
}

// spec: SYNC-3
#[test]
fn a_life_that_was_lost_is_over_also_where_the_end_of_its_link_is_heard_after_the_next_life_was_found() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    bench.lost(KNEE, LossReason::Crashed);
    found(&mut bench, NEXT_LIFE);
    assert!(bench.core.called("drive").is_empty());
    bench.breaks(KNEE);
    assert!(bench.core.called("drive").is_empty());
}

// spec: SYNC-13
#[test]
fn who_does_not_wait_for_a_lost_party_is_told_of_the_loss_also_when_its_node_is_found_in_its_next_life() {
    // Given: a wait for somebody whose life is over
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    // When
    bench.passes(Duration::from_millis(49));
    found(&mut bench, NEXT_LIFE);
    let outputs = bench.passes(Duration::from_millis(1));
    // Then
    let lost = |output: &Output| {
        matches!(output, Output::AnswerBarrier { correlation: 7, answer: BarrierAnswer::Lost { .. }, .. })
    };
    assert!(outputs.iter().any(lost), "{outputs:?}");
}

#[test]
fn a_life_that_is_lost_and_found_again_is_what_was_known_of_it() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::LinkDown);
    assert!(bench.core.called("drive").is_empty());
    found(&mut bench, LIFE);
    assert_eq!(bench.core.called("drive"), [Tid::new(KNEE, app(0))]);
}
