//! Types that two applications have in different versions.

use sinew::inspect::{MismatchReport, TypeUser};

use super::*;

const WHAT: &str = "knee.drive has the demo.gains of gait";

/// The gait on the hip sends gains that the drive of the knee has in another version.
fn differing(treatment: &str) -> Facts {
    let mut facts = free();
    let sender = Tid::new(node(1), AppAddress::new(0x1001));
    facts.ends[0].wanted = "gait".to_owned();
    let mut gait = app("gait");
    gait.report.as_mut().expect("it is listed").tid = sender;
    facts.ends[0].app = Some(gait);
    let receiver = drive(&mut facts).report.as_ref().expect("it is listed").tid;
    facts.mismatches = vec![MismatchReport {
        source: TypeUser { tid: sender, name: "gait".to_owned() },
        target: TypeUser { tid: receiver, name: "knee.drive".to_owned() },
        kind: sinew::message::Kind::named("demo.gains"),
        name: Some("demo.gains".to_owned()),
        policy: "accept-additions".to_owned(),
        treatment: treatment.to_owned(),
        differences: vec!["field `kd` is missing at the sender".to_owned()],
        seen: 3,
    }];
    facts
}

fn step(facts: &Facts) -> Step {
    judge(facts).into_iter().find(|step| step.what == WHAT).expect("it is judged")
}

#[test]
fn refused_type_blocks_and_says_what_differs() {
    let blocked = step(&differing("refused"));
    assert_eq!(blocked.state, State::Blocked, "{blocked:?}");
    for part in ["field `kd` is missing at the sender", "accept-additions", "3 messages so far"] {
        assert!(blocked.detail.contains(part), "{blocked:?}");
    }
    assert!(blocked.fix.is_some_and(|fix| fix.contains("`sinew schema demo.gains`")));
}

#[test]
fn accepted_type_is_a_note() {
    for treatment in ["accepted", "warned"] {
        assert_eq!(step(&differing(treatment)).state, State::Note, "{treatment}");
    }
}

#[test]
fn refused_type_of_the_way_back_is_a_note() {
    let mut facts = differing("refused");
    facts.ends.swap(0, 1);
    assert_eq!(step(&facts).state, State::Note);
}
