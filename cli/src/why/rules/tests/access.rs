//! Verdicts of an access list on a path.

use super::*;

/// The knee's list has this verdict on each class, and the hip has no list.
fn listed(facts: &mut Facts, allowed: [bool; 3]) {
    let verdict =
        |(class, is_allowed)| AccessVerdict { class, is_allowed, why: "rule 1 (line 4)".to_owned() };
    let verdicts = Class::ALL.into_iter().zip(allowed).map(verdict).collect();
    let none = AccessReport { is_given: false, verdicts: Vec::new(), path: None };
    let path = Some("/etc/knee/access.toml".to_owned());
    facts.access = [Some(AccessReport { is_given: true, verdicts, path }), Some(none)];
}

#[test]
fn list_blocks_only_if_it_refuses_all_classes() {
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
        assert!(there.detail.contains("rule 1 (line 4)"), "{there:?}");
        assert_eq!(step(&facts, "knee.drive may send to hip").state, State::Fine);
    }
    // No reply is required, so refused replies do not block the path.
    facts.access.swap(0, 1);
    let back = step(&facts, "knee.drive may send to hip");
    assert!(
        back.state == State::Fine && back.fix.is_none() && back.detail.starts_with("not needed"),
        "{back:?}"
    );
    // A refusal of the command's own ping does not block other senders.
    facts.pings[0] = Some(Err(Rejection::NotAllowed.to_string()));
    assert!(judge(&facts).iter().all(|step| step.state != State::Blocked));
}

#[test]
fn refusal_without_a_judged_sender_blocks_with_a_command() {
    // Given: one end is a node, so that the list was not evaluated for a sender
    let mut facts = free();
    facts.access = [None, None];
    facts.pings[0] = Some(Err(Rejection::NotAllowed.to_string()));
    // When, then
    let told: Vec<_> = judge(&facts).into_iter().filter(|step| step.state == State::Blocked).collect();
    let [step] = &told[..] else { panic!("{told:#?}") };
    let fix = step.fix.as_deref().unwrap_or_default();
    assert!(step.detail.contains("access list") && fix.contains("`sinew why SENDER knee.drive`"), "{step:?}");
}

/// The gait on the hip, with its messages refused by the knee's list for this reason.
fn refused(why: &str) -> Facts {
    let mut facts = free();
    listed(&mut facts, [false; 3]);
    facts.ends[0].wanted = "gait".to_owned();
    facts.ends[0].app = Some(app("gait"));
    let report = facts.access[0].as_mut().expect("there is a list");
    report.verdicts.iter_mut().for_each(|verdict| verdict.why = why.to_owned());
    facts
}

fn fix(facts: &Facts, what: &str) -> String {
    let steps = judge(facts);
    steps.into_iter().find(|step| step.what == what).and_then(|step| step.fix).expect("it has a fix")
}

#[test]
fn fix_of_a_refusal_names_rule_and_file() {
    let may = "gait may send to knee.drive";
    assert_eq!(
        fix(&refused("no rule allows it, for 'gait'"), may),
        "put these lines into the list /etc/knee/access.toml, then `sinew reload` on its host:\n\
         [[rule]]\nfrom = [\"gait@10.0.0.1\"]\nto = [\"knee.drive\"]"
    );
    // A refusing rule takes effect first as long as it is above.
    let by_rule = fix(&refused("rule 1 'no guests' (line 1)"), may);
    assert!(by_rule.contains("access.toml, before the rule that refuses, then"), "{by_rule}");
    // An older node does not report the path. An application without a name is shown by its address.
    let mut facts = refused("no rule allows it");
    facts.access[0].as_mut().expect("there is a list").path = None;
    for app in facts.ends.iter_mut().filter_map(|end| end.app.as_mut()) {
        app.report.as_mut().expect("it is listed").name = None;
    }
    let unnamed = fix(&facts, may);
    assert!(unnamed.starts_with("put these lines into that list, then"), "{unnamed}");
    assert!(unnamed.ends_with("from = [\"10.0.0.2/1001\"]\nto = [\"10.0.0.2/1001\"]"), "{unnamed}");
}

#[test]
fn refused_way_back_matters_only_for_echoes() {
    let mut facts = refused("no rule allows it");
    facts.access.swap(0, 1);
    let back = "knee.drive may send to gait";
    let state = |facts: &Facts| judge(facts).iter().find(|step| step.what == back).map(|step| step.state);
    assert_eq!(state(&facts), Some(State::Fine));
    // Given: the list of the hip refuses the echoes of the drive, which guards the gait
    let gait = facts.ends[0].app_tid().expect("it is listed");
    let receiver = drive(&mut facts).report.as_ref().expect("it is listed").tid;
    let mut echo = LostEchoReport {
        receiver,
        guarded: gait,
        why: "NoSuchApplication".to_owned(),
        count: 1,
        ago_us: 1_000,
    };
    knee(&mut facts).lost_echoes.push(echo.clone());
    assert_eq!(state(&facts), Some(State::Fine), "it was not refused by a list");
    echo.why = "NotAllowed".to_owned();
    knee(&mut facts).lost_echoes.push(echo);
    // Then
    assert_eq!(state(&facts), Some(State::Note));
    let lines = fix(&facts, back);
    assert!(
        lines.ends_with("from = [\"knee.drive@10.0.0.2\"]\nto = [\"gait\"]\nclasses = [\"stream\"]"),
        "{lines}"
    );
    assert!(judge(&facts).iter().all(|step| step.state != State::Blocked));
}

#[test]
fn refused_message_of_the_command_blocks_nothing() {
    let mut facts = free();
    facts.pings[1] = Some(Err(Rejection::NotAllowed.to_string()));
    let steps = judge(&facts);
    let back =
        steps.iter().find(|step| step.what == "a message goes from knee to hip").expect("it is a step");
    assert!(back.state == State::Note && back.fix.is_none(), "{back:?}");
    assert!(steps.iter().all(|step| step.state != State::Blocked), "{steps:#?}");
}
