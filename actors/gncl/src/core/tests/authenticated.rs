//! Authenticated connections: a false report to NDL in a node's name bars the node itself for a limited time, and ends
//! no link of it.

use super::*;

const HEARSAY: u64 = 9;

fn core() -> Core {
    Core::new(Settings { connections_authenticate: true, ..settings(LOW, 1) }, 7)
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
fn unconnected_incarnation_yields_after_five_seconds() {
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
fn reports_of_an_unconnected_incarnation_end_no_link() {
    let lost = Input::NodeLost { node: HIGH, incarnation: Incarnation(HEARSAY) };
    let disowned = Input::NodeDisowned { node: HIGH, incarnation: Incarnation(HEARSAY) };
    for news in [found(HEARSAY), lost, disowned] {
        let mut core = core();
        core.handle(millis(0), found(HEARSAY));
        greet(&mut core, millis(6_000), hello_from(HIGH, 5, 1));
        core.handle(millis(6_001), news.clone());
        let then = outputs(&mut core);
        assert!(!is_down(&then), "{news:?}: {then:?}");
        // Nor do they keep it from connecting again, after NDL has found it.
        core.handle(millis(6_002), found(5));
        let (_, again) = greet(&mut core, millis(6_003), hello_from(HIGH, 5, 2));
        assert!(is_up(&again, 5), "{news:?}: {again:?}");
    }
}

// spec: GNCL-7
#[test]
fn lost_unconnected_incarnation_bars_no_earlier_one() {
    for is_found_first in [true, false] {
        // Given: a process answered in the node's name, and does not any more
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
        // Then: it connects again after a break of its link
        core.handle(millis(6_002), Input::Ended(link));
        outputs(&mut core);
        let (_, again) = greet(&mut core, millis(6_003), hello_from(HIGH, 5, 2));
        assert!(is_up(&again, 5), "found first: {is_found_first}: {again:?}");
    }
}

#[test]
fn linked_incarnation_bars_earlier_ones() {
    let mut core = core();
    core.handle(millis(0), found(5));
    greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    let (_, earlier) = greet(&mut core, millis(60_000), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
}

// spec: GNCL-7
#[test]
fn revoked_thief_bars_the_node_for_five_seconds_only() {
    let credentials_revoked = Input::CredentialsRevoked { node: HIGH, incarnation: Incarnation(u64::MAX) };
    for hangs_up_first in [false, true] {
        // Given: the last of all incarnations is linked, with stolen keys, and NDL continues to receive its answers
        let mut core = core();
        core.handle(millis(0), found(u64::MAX));
        let (link, up) = greet(&mut core, millis(1), hello_from(HIGH, u64::MAX, 1));
        assert!(is_up(&up, u64::MAX));
        // When
        let end = if hangs_up_first {
            Input::Ended(link)
        } else {
            Input::Violated(link, RefusalError::Security("it is revoked".to_owned()))
        };
        core.handle(millis(99), end);
        let then = outputs(&mut core);
        assert!(is_down(&then), "{then:?}");
        core.handle(millis(100), credentials_revoked.clone());
        // Then: this holds also where the list is read once more
        let (_, at_once) = greet(&mut core, millis(5_099), hello_from(HIGH, 5, 1));
        assert_eq!(refusal(&at_once), Some("stale incarnation"));
        core.handle(millis(5_099), credentials_revoked.clone());
        core.handle(millis(5_099), found(u64::MAX));
        let (_, later) = greet(&mut core, millis(5_100), hello_from(HIGH, 5, 2));
        assert!(is_up(&later, 5), "{later:?}");
    }
}

// spec: GNCL-7
#[test]
fn incarnation_still_bars_earlier_ones_after_another_revocation() {
    let mut core = core();
    core.handle(millis(0), found(5));
    greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    core.handle(millis(2), Input::CredentialsRevoked { node: HIGH, incarnation: Incarnation(9) });
    let (_, earlier) = greet(&mut core, millis(60_000), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
}
