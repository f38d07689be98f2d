//! Applications that no node has named.

use super::*;
use crate::why::facts::Unreported;

fn silent() -> Unreported {
    Unreported::Silent("no answer within 2s".to_owned())
}

/// Returns this step, for facts in which the knee has not named its drive.
fn step(unreported: Option<Unreported>, ping: Option<Result<u64, String>>, what: &str) -> Step {
    let mut facts = free();
    facts.ends[1].app = Some(App { unreported, ..App::default() });
    facts.pings[0] = ping;
    judge(&facts).into_iter().find(|step| step.what == what).expect("it is looked at")
}

fn fix(step: &Step) -> &str {
    step.fix.as_deref().expect("it has a fix")
}

#[test]
fn application_is_not_called_absent_without_a_full_report() {
    let what = "knee.drive takes messages";
    let cases = [
        (silent(), "did not report its applications: no answer within 2s", "--deadline-ms"),
        (Unreported::LeftOut(9), "9 further applications that had no room in its answer", "`payload_max`"),
    ];
    for (unreported, detail, fixed) in cases {
        let found = step(Some(unreported.clone()), None, what);
        assert!(found.state == State::Blocked && found.detail.contains(detail), "{found:?}");
        assert!(!found.detail.contains("no such application") && fix(&found).contains(fixed), "{found:?}");
        // It is present, because it confirmed a message.
        assert_eq!(step(Some(unreported), Some(Ok(300)), what).state, State::Note);
    }
    // Only a complete list proves that an application is absent.
    let found = step(None, None, what);
    assert!(found.detail.contains("no such application"), "{found:?}");
}

#[test]
fn unknown_name_lists_nodes_with_incomplete_reports() {
    let mut facts = free();
    facts.ends[1] = TrafficEnd { wanted: "ankle".to_owned(), ..TrafficEnd::default() };
    facts.unreported = vec![("knee".to_owned(), silent()), ("hip".to_owned(), Unreported::LeftOut(2))];
    let what = "ankle is there";
    let found = |facts: &Facts| judge(facts).into_iter().find(|step| step.what == what).expect("it is found");
    let both = found(&facts);
    assert!(both.state == State::Blocked && both.detail.contains("'ankle' is not known"), "{both:?}");
    assert!(both.detail.contains("node knee did not report its applications: no answer"), "{both:?}");
    assert!(both.detail.contains("; node hip has 2 further applications"), "{both:?}");
    assert!(fix(&both).starts_with("ask again") && fix(&both).contains("`sinew apps`"), "{both:?}");
    // A long list of nodes is abbreviated.
    facts.unreported = vec![("knee".to_owned(), silent()); 9];
    assert!(found(&facts).detail.ends_with("; and so it is with 5 more"), "{:?}", found(&facts));
}

#[test]
fn misspelt_name_is_reported_with_nearest_ones() {
    let mut facts = free();
    facts.ends[1] = TrafficEnd { wanted: "kneee".to_owned(), ..TrafficEnd::default() };
    facts.names = ["knee", "knee.drive", "camera"].map(str::to_owned).to_vec();
    let step = judge(&facts).into_iter().find(|step| step.what == "kneee is there").expect("it is found");
    assert!(step.detail.ends_with("; nearest: knee, knee.drive"), "{step:?}");
}

#[test]
fn misspelt_group_is_reported_with_the_nearest_group() {
    let mut facts = free();
    facts.ends[1] = TrafficEnd { wanted: "presure".to_owned(), ..TrafficEnd::default() };
    facts.groups.insert(AppAddress::group("pressure"), 1);
    let step = |facts: &Facts| judge(facts).into_iter().find(|step| step.what == "presure is there");
    for is_alone in [false, true] {
        if is_alone {
            hip(&mut facts).peers.clear();
        }
        let found = step(&facts).expect("it is found");
        assert!(
            found.state == State::Blocked && found.detail.ends_with("nearest group: pressure (1 member)"),
            "{found:?}"
        );
        assert!(
            fix(&found).starts_with("is 'presure' misspelt? The group pressure has 1 member"),
            "{found:?}"
        );
    }
    // A name that applications require is that of an application.
    let why = "not there".to_owned();
    facts.lacked = vec![Missing { name: "presure".to_owned(), why, since_us: None }];
    assert!(!step(&facts).expect("it is found").detail.contains("nearest group"));
}
