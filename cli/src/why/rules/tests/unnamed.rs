//! Applications that no node has named.

use super::*;
use crate::why::facts::Unsaid;

fn silent() -> Unsaid {
    Unsaid::Silent("no answer within 2s".to_owned())
}

/// The step that looks at this, of facts in which the knee has not named its drive.
fn step(unsaid: Option<Unsaid>, ping: Option<Result<u64, String>>, what: &str) -> Step {
    let mut facts = free();
    facts.ends[1].app = Some(App { unsaid, ..App::default() });
    facts.pings[0] = ping;
    judge(&facts).into_iter().find(|step| step.what == what).expect("it is looked at")
}

fn mend(step: &Step) -> &str {
    step.mend.as_deref().expect("it can be mended")
}

#[test]
fn an_application_whose_node_did_not_say_which_it_has_is_not_said_to_be_absent() {
    let what = "knee.drive takes messages";
    let cases = [
        (silent(), "did not say which applications it has: no answer within 2s", "--deadline-ms"),
        (Unsaid::LeftOut(9), "9 further applications that had no room in its answer", "`payload_max`"),
    ];
    for (unsaid, seen, mended) in cases {
        let told = step(Some(unsaid.clone()), None, what);
        assert!(told.state == State::Blocked && told.seen.contains(seen), "{told:?}");
        assert!(!told.seen.contains("no such application") && mend(&told).contains(mended), "{told:?}");
        // It is there, as it has confirmed a message.
        assert_eq!(step(Some(unsaid), Some(Ok(300)), what).state, State::Note);
    }
    // Only who has named all that it has has none such.
    let told = step(None, None, what);
    assert!(told.seen.contains("no such application"), "{told:?}");
}

#[test]
fn a_name_is_not_said_to_be_nobodys_where_nodes_have_not_named_all_that_they_have() {
    let mut facts = free();
    facts.ends[1] = End { wanted: "ankle".to_owned(), ..End::default() };
    facts.unsaid = vec![("knee".to_owned(), silent()), ("hip".to_owned(), Unsaid::LeftOut(2))];
    let what = "ankle is there";
    let told = |facts: &Facts| judge(facts).into_iter().find(|step| step.what == what).expect("it is told");
    let both = told(&facts);
    assert!(both.state == State::Blocked && both.seen.contains("'ankle' is not known"), "{both:?}");
    assert!(both.seen.contains("node knee did not say which applications it has: no answer"), "{both:?}");
    assert!(both.seen.contains("; node hip has 2 further applications"), "{both:?}");
    assert!(mend(&both).starts_with("ask again") && mend(&both).contains("`sinew apps`"), "{both:?}");
    // Many are not all named.
    facts.unsaid = vec![("knee".to_owned(), silent()); 9];
    assert!(told(&facts).seen.ends_with("; and so it is with 5 more"), "{:?}", told(&facts));
}
