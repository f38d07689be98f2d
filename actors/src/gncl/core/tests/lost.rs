//! Lives that NDL has lost: nothing of them is linked before NDL finds them again.

use super::*;

const LATER: u64 = 6;

fn lost(incarnation: u64) -> Input {
    Input::NodeLost { node: HIGH, incarnation: Incarnation(incarnation) }
}

fn is_up(outputs: &[Output], incarnation: u64) -> bool {
    let incarnation = Incarnation(incarnation);
    outputs.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation }))
}

/// A core that was linked with the peer's life 5, and has lost it.
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
fn a_life_that_ndl_has_lost_is_refused_in_words_until_ndl_finds_it_again() {
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
fn an_earlier_life_than_the_lost_one_is_refused_and_a_later_one_is_linked() {
    let mut core = having_lost();
    let (_, earlier) = greet(&mut core, millis(3), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
    let (_, later) = greet(&mut core, millis(4), hello_from(HIGH, LATER, 1));
    assert!(is_up(&later, LATER), "{later:?}");
}

#[test]
fn the_loss_of_a_life_that_was_not_known_is_heeded_as_well() {
    // As this layer is told by NDL after a restart.
    let mut core = core();
    core.handle(millis(0), lost(5));
    let (_, hello) = greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    assert_eq!(refusal(&hello), Some("contested"));
    let (_, earlier) = greet(&mut core, millis(2), hello_from(HIGH, 4, 1));
    assert_eq!(refusal(&earlier), Some("stale incarnation"));
}

#[test]
fn what_ndl_says_of_a_former_life_does_not_bar_the_present_one() {
    let mut core = having_lost();
    greet(&mut core, millis(3), hello_from(HIGH, LATER, 1));
    core.handle(millis(4), lost(5));
    assert_eq!(outputs(&mut core), []);
    let (_, again) = greet(&mut core, millis(5), hello_from(HIGH, LATER, 2));
    assert!(is_up(&again, LATER), "{again:?}");
}

#[test]
fn a_life_that_leaves_or_was_forgotten_without_ndls_word_is_linked_again() {
    // It has said goodbye, and dials for what it has still to say. spec: GNCL-10
    let mut leaving = core();
    leaving.handle(millis(0), found(5));
    leaving.handle(millis(1), Input::NodeLeaves { node: HIGH, incarnation: Incarnation(5) });
    // Nobody but itself has told of it, and its link was gone for long.
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
fn a_full_table_gives_up_those_that_ndl_lost_after_all_others_and_first_the_one_that_was_lost_first() {
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
