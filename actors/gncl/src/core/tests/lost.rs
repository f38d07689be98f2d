//! Incarnations that NDL has lost: none of them is linked before NDL finds it again.

use super::*;

const LATER: u64 = 6;

fn lost(incarnation: u64) -> Input {
    Input::NodeLost { node: HIGH, incarnation: Incarnation(incarnation) }
}

fn is_up(outputs: &[Output], incarnation: u64) -> bool {
    let incarnation = Incarnation(incarnation);
    outputs.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation }))
}

/// Creates a core that was linked with the peer's incarnation 5, and has lost it.
fn having_lost() -> Core {
    let mut core = core();
    core.handle(millis(0), found(5));
    greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    core.handle(millis(2), lost(5));
    outputs(&mut core);
    core
}

// spec: GNCL-7
#[test]
fn lost_incarnation_is_refused_until_ndl_finds_it_again() {
    let mut core = having_lost();
    for dial in 2..5 {
        let (_, again) = greet(&mut core, millis(dial), hello_from(HIGH, 5, dial));
        assert_eq!(refusal(&again), Some("contested"), "its dial grows, its life does not");
        assert!(!again.iter().any(|output| matches!(output, Output::Attach(_))), "{again:?}");
        let sentence = again.iter().find_map(|output| {
            let Output::Refuse(_, Refusal { sentence, .. }) = output else { return None };
            Some(sentence.as_str())
        });
        assert!(sentence.is_some_and(|sentence| sentence.contains("lost")), "{sentence:?}");
    }
    core.handle(millis(5), found(5));
    let dial = outputs(&mut core);
    assert!(dial.iter().any(|output| matches!(output, Output::Dial { .. })), "{dial:?}");
    let (_, welcome) = greet(&mut core, millis(6), hello_from(HIGH, 5, 6));
    assert!(is_up(&welcome, 5), "{welcome:?}");
}

#[test]
fn loss_bars_earlier_incarnations_but_not_later_ones() {
    let mut core = having_lost();
    let (_, earlier) = greet(&mut core, millis(3), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
    let (_, later) = greet(&mut core, millis(4), hello_from(HIGH, LATER, 1));
    assert!(is_up(&later, LATER), "{later:?}");
}

#[test]
fn loss_of_an_unknown_incarnation_counts_too() {
    // As NDL reports it after a restart of this layer.
    let mut core = core();
    core.handle(millis(0), lost(5));
    let (_, hello) = greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    assert_eq!(refusal(&hello), Some("contested"));
    let (_, earlier) = greet(&mut core, millis(2), hello_from(HIGH, 4, 1));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
}

#[test]
fn loss_of_a_former_incarnation_bars_no_present_one() {
    let mut core = having_lost();
    greet(&mut core, millis(3), hello_from(HIGH, LATER, 1));
    core.handle(millis(4), lost(5));
    assert_eq!(outputs(&mut core), []);
    let (_, again) = greet(&mut core, millis(5), hello_from(HIGH, LATER, 2));
    assert!(is_up(&again, LATER), "{again:?}");
}

#[test]
fn incarnation_not_lost_by_ndl_is_linked_again() {
    // It has sent GOODBYE, and dials to send the remaining messages. spec: GNCL-10
    let mut leaving = core();
    leaving.handle(millis(0), found(5));
    leaving.handle(millis(1), Input::NodeLeaves { node: HIGH, incarnation: Incarnation(5) });
    // It was known by its own connection only, and its link was gone for long.
    let mut forgotten = core();
    let (link, _) = greet(&mut forgotten, millis(0), hello_from(HIGH, 5, 1));
    forgotten.handle(millis(1), Input::Ended(link));
    silence(&mut forgotten, Time::MAX);
    for mut core in [leaving, forgotten] {
        outputs(&mut core);
        let (_, again) = greet(&mut core, millis(9_000), hello_from(HIGH, 5, 2));
        assert!(is_up(&again, 5), "{again:?}");
    }
}

#[test]
fn full_table_evicts_lost_incarnations_last() {
    let node = |number: u32| NodeAddress::new(HIGH.bits() + number);
    let mut core = Core::new(Settings { peers_max: 3, ..settings(LOW, 1) }, 7);
    for (number, at) in [(0, 20), (1, 10)] {
        core.handle(millis(at), Input::NodeLost { node: node(number), incarnation: Incarnation(5) });
    }
    let (link, _) = greet(&mut core, millis(30), hello_from(node(2), 5, 1));
    core.handle(millis(31), Input::Ended(link));
    silence(&mut core, Time::MAX);
    for (newcomer, given_up) in [(3, 2), (4, 1), (5, 0)] {
        let found = Input::NodeFound {
            node: node(newcomer),
            incarnation: Incarnation(1),
            addresses: vec![address()],
        };
        core.handle(millis(9_000), found);
        assert!(outputs(&mut core).contains(&Output::Forget(node(given_up))), "for {newcomer}");
        assert!(core.peers.len() <= 3);
    }
}
