//! Scenarios without free descriptors.

use super::*;

#[test]
fn half_of_the_strangers_are_closed_without_descriptors() {
    let mut core = core();
    let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 1));
    let strangers: Vec<_> = (0..3).map(|_| core.open()).collect();
    for stranger in &strangers {
        core.handle(millis(0), Input::Accepted(*stranger, SOMEWHERE));
    }
    for gone in [&strangers[..2], &strangers[2..], &[]] {
        core.handle(millis(1), Input::Starved);
        assert_eq!(
            outputs(&mut core),
            gone.iter().map(|stranger| Output::Close(*stranger)).collect::<Vec<_>>()
        );
    }
    assert!(core.linked(link).is_some(), "no link is touched");
}

#[test]
fn many_strangers_are_closed_a_few_per_millisecond() {
    let mut core = Core::new(Settings { strangers_max: 20, ..settings(LOW, 1) }, 7);
    let strangers: Vec<_> = (0..20).map(|_| core.open()).collect();
    for stranger in &strangers {
        core.handle(millis(0), Input::Accepted(*stranger, SOMEWHERE));
    }
    core.handle(millis(10), Input::Starved);
    let mut gone = Vec::new();
    for (at, count) in [(10, 4), (11, 4), (12, 4)] {
        let closed = outputs(&mut core);
        assert_eq!(closed.len(), count, "at {at} ms: {closed:?}");
        gone.extend(closed);
        // A repeated report closes none sooner, and of the 16 remaining ones 8 are closed in all.
        if at == 10 {
            core.handle(millis(at), Input::Starved);
            assert_eq!(outputs(&mut core), []);
        }
        if gone.len() < 12 {
            assert_eq!(core.next_wake(), Some(millis(at + 1)));
        }
        core.handle(millis(at + 1), Input::TimePassed);
    }
    assert_eq!(outputs(&mut core), []);
    let oldest = strangers[..12].iter().map(|stranger| Output::Close(*stranger));
    assert_eq!(gone, oldest.collect::<Vec<_>>());
}

#[test]
fn at_most_half_of_the_present_strangers_are_closed() {
    let mut core = Core::new(Settings { strangers_max: 40, ..settings(LOW, 1) }, 7);
    let strangers: Vec<_> = (0..40).map(|_| core.open()).collect();
    for stranger in &strangers {
        core.handle(millis(0), Input::Accepted(*stranger, SOMEWHERE));
    }
    core.handle(millis(10), Input::Starved);
    assert_eq!(outputs(&mut core).len(), 4);
    // All others hang up, and two new ones connect.
    for stranger in &strangers[4..] {
        core.handle(millis(10), Input::Ended(*stranger));
    }
    let newcomers = [core.open(), core.open()];
    for newcomer in newcomers {
        core.handle(millis(10), Input::Accepted(newcomer, SOMEWHERE));
    }
    outputs(&mut core);
    for at in 11..40 {
        core.handle(millis(at), Input::TimePassed);
    }
    assert_eq!(outputs(&mut core), [Output::Close(newcomers[0])], "half of the two, and it ends there");
}
