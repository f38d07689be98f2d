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
