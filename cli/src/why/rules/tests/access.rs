//! What an access list says of a way.

use super::*;

/// What the knee's list says of each class, and the hip has none.
fn listed(facts: &mut Facts, allowed: [bool; 3]) {
    let verdict =
        |(class, is_allowed)| AccessVerdict { class, is_allowed, why: "rule 1 (line 4)".to_owned() };
    let verdicts = Class::ALL.into_iter().zip(allowed).map(verdict).collect();
    let none = AccessReport { is_given: false, verdicts: Vec::new() };
    facts.access = [Some(AccessReport { is_given: true, verdicts }), Some(none)];
}

#[test]
fn a_list_is_in_the_way_where_it_lets_nothing_through_and_is_told_of_where_it_lets_something() {
    let mut facts = free();
    let step = |facts: &Facts, what: &str| {
        judge(facts).into_iter().find(|step| step.what == what).expect("it is judged")
    };
    for (allowed, state) in
        [([true; 3], State::Fine), ([true, false, true], State::Note), ([false; 3], State::Blocked)]
    {
        listed(&mut facts, allowed);
        let there = step(&facts, "hip may send to knee.drive");
        assert_eq!(there.state, state, "{there:?}");
        assert!(there.seen.contains("rule 1 (line 4)"), "{there:?}");
        assert_eq!(step(&facts, "knee.drive may send to hip").state, State::Fine);
    }
    // Nothing goes back, and nobody has asked for that.
    facts.access.swap(0, 1);
    assert_eq!(step(&facts, "knee.drive may send to hip").state, State::Note);
    // That the command itself may not send there is not in the way of others.
    facts.pings[0] = Some(Err(Rejection::NotAllowed.to_string()));
    assert!(judge(&facts).iter().all(|step| step.state != State::Blocked));
}

#[test]
fn where_nobody_asked_what_the_list_says_of_the_two_a_refusal_is_in_the_way_and_says_how_to_ask() {
    // Given: one end is a node, so that the list was not asked about a sender
    let mut facts = free();
    facts.access = [None, None];
    facts.pings[0] = Some(Err(Rejection::NotAllowed.to_string()));
    // When, then
    let told: Vec<_> = judge(&facts).into_iter().filter(|step| step.state == State::Blocked).collect();
    let [step] = &told[..] else { panic!("{told:#?}") };
    let mend = step.mend.as_deref().unwrap_or_default();
    assert!(step.seen.contains("access list") && mend.contains("`sinew why SENDER knee.drive`"), "{step:?}");
}
