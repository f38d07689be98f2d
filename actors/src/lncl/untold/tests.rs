use super::*;

const APP: AppAddress = AppAddress::new(0x1000);
const OTHER: AppAddress = AppAddress::new(0x1001);

fn registered(app: AppAddress, name: &str) -> AppFact {
    AppFact::own_registered(app, Some(name.to_owned()), Vec::new())
}

const fn ready(app: AppAddress) -> AppFact {
    AppFact::Ready { app }
}

const fn down(app: AppAddress) -> AppFact {
    AppFact::Down { app }
}

const fn gone(app: AppAddress) -> AppFact {
    AppFact::Unregistered { app }
}

/// These happen so many times, one after the other.
fn again_and_again(facts: &[AppFact], times: usize) -> Vec<AppFact> {
    (0..times).flat_map(|_| facts.to_vec()).collect()
}

fn told(facts: &mut Facts) -> Vec<AppFact> {
    let mut told = Vec::new();
    assert!(facts.offer(|fact| {
        told.push(fact.clone());
        true
    }));
    assert!(facts.of.is_empty(), "nothing is kept of what was told");
    told
}

/// What a reader that knows of `known` is told when it reads on, after all that has happened meanwhile.
fn kept(reader: Reader, known: &[AppFact], happened: &[AppFact]) -> Vec<AppFact> {
    let mut facts = Facts::new(reader);
    known.iter().for_each(|fact| facts.note(fact.clone()));
    told(&mut facts);
    for fact in happened {
        facts.note(fact.clone());
        assert!(!facts.offer(|_| false) || facts.facts.is_empty());
    }
    told(&mut facts)
}

#[test]
fn what_is_not_taken_is_told_before_what_came_later() {
    let happened = [registered(APP, "drive"), registered(OTHER, "gait"), ready(APP), ready(OTHER)];
    assert_eq!(kept(Reader::Sync, &[], &happened), happened);
}

#[test]
fn that_a_life_has_ended_is_told_however_often_it_did_and_then_what_is_so_now() {
    let known = [registered(APP, "drive"), ready(APP)];
    let fails = [down(APP), ready(APP)];
    assert_eq!(kept(Reader::Sync, &known, &again_and_again(&fails, 9)), [down(APP), ready(APP)]);
    assert_eq!(kept(Reader::Ndl, &known[1..], &again_and_again(&fails, 9)), [down(APP), ready(APP)]);
    let stopped = AppFact::Stopped { app: APP };
    assert_eq!(kept(Reader::Sync, &known, &[down(APP), ready(APP), stopped.clone()]), [stopped]);
    let comes_again = [gone(APP), registered(APP, "drive"), ready(APP)];
    assert_eq!(kept(Reader::Sync, &known, &again_and_again(&comes_again, 9)), comes_again);
    assert_eq!(kept(Reader::Sync, &known, &again_and_again(&comes_again[..2], 2)), comes_again[..2]);
}

#[test]
fn of_who_came_and_went_nothing_is_told_and_that_another_is_gone_always() {
    let (came, went) = ([registered(OTHER, "gait"), ready(OTHER)], [down(OTHER), gone(OTHER)]);
    let happened = [&came[..], &[gone(APP)], &went[..]].concat();
    assert_eq!(kept(Reader::Sync, &[registered(APP, "drive")], &happened), [gone(APP)]);
    assert_eq!(kept(Reader::Ndl, &[ready(APP)], &happened), [gone(APP)]);
    assert_eq!(kept(Reader::Ndl, &[], &[down(APP), gone(APP)]), []);
}

#[test]
fn whoever_has_a_name_now_is_told_behind_the_end_of_who_had_it_before() {
    let known = [registered(APP, "drive")];
    // The later end of the same address does not go behind the newcomer.
    let happened =
        [gone(APP), registered(OTHER, "drive"), registered(APP, "gait"), gone(APP), registered(APP, "knee")];
    let last = [gone(APP), registered(OTHER, "drive"), registered(APP, "knee")];
    assert_eq!(kept(Reader::Sync, &known, &happened), last);
}

#[test]
fn what_an_application_handles_is_kept_once_and_ends_with_it() {
    use sinew_runtime::wire::Kind;
    let handles = |kind| AppFact::Handles { app: APP, kinds: vec![Kind::named(kind)] };
    let known = [registered(APP, "drive")];
    let happened = [handles("a"), ready(APP), handles("b")];
    assert_eq!(kept(Reader::Sync, &known, &happened), [ready(APP), handles("b")]);
    assert_eq!(kept(Reader::Sync, &known, &[handles("a"), gone(APP)]), [gone(APP)]);
    assert_eq!(kept(Reader::Sync, &[], &[AppFact::GroupsChanged, AppFact::GroupsChanged]).len(), 1);
}
