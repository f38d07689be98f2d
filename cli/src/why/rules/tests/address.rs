//! A node address that two processes have, or had.

use super::*;

/// The hip refused a second process with the knee's address this long ago, in microseconds.
fn claimed(ago_us: u64) -> Facts {
    let mut facts = free();
    let cause = "NDL node address used twice".to_owned();
    let detail =
        "10.0.0.2 is that of knee at 10.0.0.2:7000; shank at 10.0.0.9:7000 claims the same node address";
    hip(&mut facts).refusals.push(RefusalReport { cause, count: 1, detail: detail.to_owned(), ago_us });
    facts
}

fn step(facts: &Facts) -> Option<Step> {
    judge(facts).into_iter().find(|step| step.what == "hip sees both addresses once")
}

#[test]
fn resolved_duplicate_address_is_a_note() {
    // Given: no process has claimed it for 20 s, all links are up, and messages are confirmed both ways
    let facts = claimed(20_000_000);
    // When
    let note = step(&facts).expect("it is told");
    // Then
    assert_eq!(note.state, State::Note, "{note:?}");
    assert!(note.detail.starts_with("seen once, 20.0 s ago; over since: 10.0.0.2 is that of"), "{note:?}");
    assert!(judge(&facts).iter().all(|step| step.state != State::Blocked));
    // And: of several claims the latest is reported, and claims of long ago are omitted
    let mut facts = claimed(20_000_000);
    hip(&mut facts).refusals[0].count = 9;
    assert!(step(&facts).expect("it is told").detail.starts_with("seen last 20.0 s ago; over since"));
    assert_eq!(step(&claimed(60_000_000)), None);
}

#[test]
fn recent_claim_blocks_although_messages_pass() {
    assert_eq!(step(&claimed(4_999_999)).map(|step| step.state), Some(State::Blocked));
    assert_eq!(step(&claimed(5_000_000)).map(|step| step.state), Some(State::Note));
    // A node that queries less often also refuses the claim less often.
    let mut facts = claimed(20_000_000);
    hip(&mut facts).peers[0].asked_every_us = Some(5_000_001);
    assert_eq!(step(&facts).map(|step| step.state), Some(State::Blocked));
}

#[test]
fn duplicate_address_blocks_while_messages_do_not_pass() {
    let changes: [fn(&mut Facts); 5] = [
        |facts| facts.pings[0] = Some(Err("no answer within 2s".to_owned())),
        |facts| facts.pings[1] = Some(Err("no answer within 2s".to_owned())),
        |facts| hip(facts).peers[0].links[1].is_up = false,
        |facts| knee(facts).peers[0].links.clear(),
        |facts| knee(facts).peers.clear(),
    ];
    for (number, change) in changes.into_iter().enumerate() {
        let mut facts = claimed(20_000_000);
        change(&mut facts);
        assert_eq!(step(&facts).map(|step| step.state), Some(State::Blocked), "case {number}");
    }
    // A ping that was not tried, or was refused only to this command, is no evidence against it.
    for ping in [None, Some(Err(Rejection::NotAllowed.to_string()))] {
        let mut facts = claimed(20_000_000);
        facts.pings[0] = ping;
        assert_eq!(step(&facts).map(|step| step.state), Some(State::Note));
    }
}
