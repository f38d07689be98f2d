//! A node that does not answer, and the cause as known to the node at the other end.

use super::*;

/// The knee does not answer.
fn silent() -> Facts {
    let mut facts = free();
    facts.ends[1].report = None;
    facts.ends[1].silence = Some("no answer within 2s".to_owned());
    facts.pings[0] = Some(Err("no answer within 2s".to_owned()));
    facts
}

fn first_blocked(facts: &Facts) -> Step {
    judge(facts).into_iter().find(|step| step.state == State::Blocked).expect("it blocks")
}

/// Returns the step of the silent node itself.
fn there(facts: &Facts) -> Step {
    judge(facts).into_iter().find(|step| step.what == "knee.drive is there").expect("it is judged")
}

#[test]
fn cause_known_elsewhere_is_the_first_fix() {
    let cases: [(fn(&mut Facts), _, _); 4] = [
        (
            |facts| {
                hip(facts).peers.clear();
                hip(facts).lost.push(lost("hung"));
            },
            "while its host did",
            "is it stopped (`kill -CONT`)",
        ),
        (
            |facts| {
                hip(facts).peers.clear();
                hip(facts).lost.push(lost("crashed"));
            },
            "its process has ended",
            "start it again",
        ),
        (|facts| hip(facts).peers[0].missed = 2, "missed its last 2 answers", "Is it stopped (`kill -CONT`)"),
        (
            |facts| {
                let (app, name, trouble) = (Tid::NONE, "inspect".to_owned(), "stalled".to_owned());
                hip(facts).peers[0].troubled = 2;
                hip(facts).peers[0].troubles =
                    vec![TroubleReport { app, name, trouble, since_us: 2_500_000 }];
            },
            "2 of its layers and applications do not get on: inspect stalled for 2.5 s",
            "its log says more",
        ),
    ];
    for (change, detail, fix) in cases {
        let mut facts = silent();
        change(&mut facts);
        let blocked = first_blocked(&facts);
        assert_eq!(blocked.what, "hip knows knee.drive", "{blocked:?}");
        let text = blocked.fix.unwrap_or_default();
        assert!(blocked.detail.contains(detail) && text.contains(fix), "{}: {text}", blocked.detail);
        let there = there(&facts);
        assert!(there.state == State::Note && there.fix.is_none(), "{there:?}");
        assert!(there.detail.contains("no answer within 2s; hip knows the cause"), "{there:?}");
    }
}

#[test]
fn silent_node_without_a_known_cause_blocks() {
    let blocked = first_blocked(&silent());
    assert_eq!((blocked.what.as_str(), blocked.state), ("knee.drive is there", State::Blocked));
    assert!(blocked.fix.is_some_and(|fix| fix.starts_with("is it running? Start it")));
}
