//! Where connections prove who is at their end: what NDL was told in a node's name bars the node itself for a time only, and ends no
//! link of it.

use super::*;

const HEARSAY: u64 = 9;

fn core() -> Core {
    Core::new(Settings { connections_prove: true, ..settings(LOW, 1) }, 7)
}

fn is_up(outputs: &[Output], incarnation: u64) -> bool {
    let incarnation = Incarnation(incarnation);
    outputs.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation }))
}

fn is_down(outputs: &[Output]) -> bool {
    outputs.iter().any(|output| matches!(output, Output::Fact(LinkFact::LinkBroken { .. })))
}

// spec: GNCL-7
#[test]
fn a_life_that_never_connects_gives_way_after_five_seconds_to_one_that_does() {
    for real in [5, 12] {
        let mut core = core();
        core.handle(millis(0), found(HEARSAY));
        let (_, at_once) = greet(&mut core, millis(4_999), hello_from(HIGH, real, 1));
        assert!(refusal(&at_once).is_some(), "it may still be on its way: {at_once:?}");
        let (_, later) = greet(&mut core, millis(5_000), hello_from(HIGH, real, 2));
        assert!(is_up(&later, real), "{later:?}");
    }
}

// spec: GNCL-7
#[test]
fn what_is_told_of_a_life_that_never_connected_does_not_end_the_link_of_the_one_that_did() {
    let lost = Input::NodeLost { node: HIGH, incarnation: Incarnation(HEARSAY) };
    let disowned = Input::NodeDisowned { node: HIGH, incarnation: Incarnation(HEARSAY) };
    for news in [found(HEARSAY), lost, disowned] {
        let mut core = core();
        core.handle(millis(0), found(HEARSAY));
        greet(&mut core, millis(6_000), hello_from(HIGH, 5, 1));
        core.handle(millis(6_001), news.clone());
        let then = outputs(&mut core);
        assert!(!is_down(&then), "{news:?}: {then:?}");
        // Nor does it keep it from connecting again, when NDL has found it.
        core.handle(millis(6_002), found(5));
        let (_, again) = greet(&mut core, millis(6_003), hello_from(HIGH, 5, 2));
        assert!(is_up(&again, 5), "{news:?}: {again:?}");
    }
}

// spec: GNCL-7
#[test]
fn a_life_that_never_connected_and_was_lost_bars_no_earlier_one_from_being_found_or_from_connecting_again() {
    for is_found_first in [true, false] {
        // Given: somebody answered in the node's name, and does not any more
        let mut core = core();
        core.handle(millis(0), found(HEARSAY));
        core.handle(millis(1), Input::NodeLost { node: HIGH, incarnation: Incarnation(HEARSAY) });
        outputs(&mut core);
        // When: NDL finds the node itself, before or after it connects
        if is_found_first {
            core.handle(millis(6_000), found(5));
            let dial = outputs(&mut core);
            assert!(dial.iter().any(|output| matches!(output, Output::Dial { .. })), "{dial:?}");
        }
        let (link, up) = greet(&mut core, millis(6_001), hello_from(HIGH, 5, 1));
        assert!(is_up(&up, 5), "{up:?}");
        // Then: it connects again when its link is broken
        core.handle(millis(6_002), Input::Ended(link));
        outputs(&mut core);
        let (_, again) = greet(&mut core, millis(6_003), hello_from(HIGH, 5, 2));
        assert!(is_up(&again, 5), "found first: {is_found_first}: {again:?}");
    }
}

#[test]
fn a_life_that_was_linked_bars_earlier_ones_as_ever() {
    let mut core = core();
    core.handle(millis(0), found(5));
    greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    let (_, earlier) = greet(&mut core, millis(60_000), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
}

// spec: GNCL-7
#[test]
fn a_thief_whose_certificate_is_revoked_bars_the_node_itself_for_five_seconds_only() {
    let disproven = Input::Disproven { node: HIGH, incarnation: Incarnation(u64::MAX) };
    for hangs_up_first in [false, true] {
        // Given: the last of all lives is linked, with keys that were stolen, and NDL goes on to hear it
        let mut core = core();
        core.handle(millis(0), found(u64::MAX));
        let (link, up) = greet(&mut core, millis(1), hello_from(HIGH, u64::MAX, 1));
        assert!(is_up(&up, u64::MAX));
        // When
        let end = if hangs_up_first {
            Input::Ended(link)
        } else {
            Input::Violated(link, Decline::Security("it is revoked".to_owned()))
        };
        core.handle(millis(99), end);
        let then = outputs(&mut core);
        assert!(is_down(&then), "{then:?}");
        core.handle(millis(100), disproven.clone());
        // Then, also where the list is read once more
        let (_, at_once) = greet(&mut core, millis(5_099), hello_from(HIGH, 5, 1));
        assert_eq!(refusal(&at_once), Some("stale incarnation"));
        core.handle(millis(5_099), disproven.clone());
        core.handle(millis(5_099), found(u64::MAX));
        let (_, later) = greet(&mut core, millis(5_100), hello_from(HIGH, 5, 2));
        assert!(is_up(&later, 5), "{later:?}");
    }
}

// spec: GNCL-7
#[test]
fn a_life_bars_earlier_ones_though_the_certificate_of_another_one_of_its_node_is_revoked() {
    let mut core = core();
    core.handle(millis(0), found(5));
    greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    core.handle(millis(2), Input::Disproven { node: HIGH, incarnation: Incarnation(9) });
    let (_, earlier) = greet(&mut core, millis(60_000), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
}
