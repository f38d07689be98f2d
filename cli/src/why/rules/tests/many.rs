//! Messages to many: who is in a group, and what the lists of their nodes say of each.

use super::*;
use crate::why::facts::{Many, Member, MembersOn};

const OPEN: &str = "rule 2 'setpoints' (line 5)";
const SHUT: &str = "no rule allows it";

/// What a list says of this one, of all classes alike.
fn member(name: &str, is_allowed: bool, rule: &str) -> Member {
    let why = format!("{rule}, for 'gait' at 10.0.0.1/1001 to '{name}' at 10.0.0.2/1001");
    let verdict = |class| AccessVerdict { class, is_allowed, why: why.clone() };
    Member { label: name.to_owned(), verdicts: Class::ALL.map(verdict).to_vec() }
}

/// The gait on the hip, and the group of the drives with these members on the knee, which has a list.
fn to_drives(members: Vec<Member>) -> Facts {
    let mut facts = free();
    facts.ends[0].wanted = "gait".to_owned();
    facts.ends[0].app = Some(app("gait"));
    let node = End { wanted: "knee".to_owned(), app: None, ..facts.ends[1].clone() };
    facts.ends[1] = End { wanted: "drives".to_owned(), ..End::default() };
    (facts.pings, facts.streams) = Default::default();
    let on = MembersOn { node, is_given: true, members, left_out: 0 };
    facts.many = Some(Many {
        end: 1,
        tid: Tid::group("drives"),
        is_judged: true,
        is_sender_many: false,
        places: vec![on],
        unsaid: Vec::new(),
    });
    facts
}

fn many(facts: &mut Facts) -> &mut Many {
    facts.many.as_mut().expect("one is many")
}

/// The step that looks at this.
fn step(facts: &Facts, what: &str) -> Step {
    let steps = judge(facts);
    let found = steps.iter().find(|step| step.what == what).cloned();
    found.unwrap_or_else(|| panic!("no step '{what}': {steps:#?}"))
}

fn is_free(facts: &Facts) -> bool {
    judge(facts).iter().all(|step| step.state != State::Blocked)
}

const MAY: &str = "gait may send to drives on knee";

#[test]
fn members_of_whom_a_list_says_the_same_are_one_step_with_the_rule_and_the_node() {
    let facts = to_drives(["a", "b", "c"].map(|name| member(name, true, OPEN)).to_vec());
    let members = step(&facts, "drives has members");
    assert_eq!(members.seen, format!("group {}: a, b, c on knee", Tid::group("drives")));
    let may = step(&facts, MAY);
    assert_eq!(may.state, State::Fine, "{may:?}");
    assert!(may.seen.contains(OPEN) && may.seen.ends_with("; the same for b, c"), "{may:?}");
    assert_eq!(step(&facts, "gait reaches nodes of members").seen, "connected to knee");
    assert!(judge(&facts).iter().all(|step| step.state == State::Fine), "{:#?}", judge(&facts));
}

#[test]
fn members_of_whom_a_list_says_otherwise_have_a_step_each_and_what_lets_it_through() {
    let facts = to_drives(vec![
        member("a", true, OPEN),
        member("b", false, "rule 1 'no guests' (line 1)"),
        member("c", true, OPEN),
    ]);
    let let_through = step(&facts, &format!("{MAY}: a, c"));
    assert!(let_through.state == State::Fine && let_through.seen.contains(OPEN), "{let_through:?}");
    let refused = step(&facts, &format!("{MAY}: b"));
    assert!(
        refused.state == State::Note && refused.seen.contains("refused: rule 1 'no guests'"),
        "{refused:?}"
    );
    let mend = refused.mend.expect("it can be mended");
    for words in ["groups = [\"drives\"]", "before any that refuses it", "`sinew reload` on the host of knee"]
    {
        assert!(mend.contains(words), "{words}: {mend}");
    }
    assert!(is_free(&facts), "others get it");
}

#[test]
fn a_list_is_in_the_way_where_it_lets_nothing_through_to_any_member_and_not_where_another_node_does() {
    let mut facts = to_drives(vec![member("a", false, SHUT), member("b", false, SHUT)]);
    let may = step(&facts, MAY);
    assert!(may.state == State::Blocked && may.seen.contains(SHUT), "{may:?}");
    // What was asked for as a number has a name that nobody knows.
    facts.ends[1].wanted = Tid::group("drives").to_string();
    let what = format!("gait may send to {} on knee", Tid::group("drives"));
    assert!(step(&facts, &what).mend.is_some_and(|mend| mend.contains("THE GROUP'S NAME")));
    facts.ends[1].wanted = "drives".to_owned();
    // The hip has a member, too, and no list.
    let node = End { wanted: "hip".to_owned(), app: None, ..facts.ends[0].clone() };
    let own = Member { label: "hip.drive".to_owned(), verdicts: Vec::new() };
    many(&mut facts).places.push(MembersOn { node, is_given: false, members: vec![own], left_out: 0 });
    assert_eq!(step(&facts, MAY).state, State::Note);
    assert_eq!(step(&facts, "gait may send to drives on hip").seen, "node hip has no access list");
    assert!(is_free(&facts));
}

#[test]
fn classes_that_a_list_refuses_are_told_and_in_nobodys_way() {
    let mut stream_only = member("a", true, OPEN);
    stream_only.verdicts[0].is_allowed = false;
    let facts = to_drives(vec![stream_only]);
    let may = step(&facts, MAY);
    assert!(may.state == State::Note && may.seen.contains("Control refused"), "{may:?}");
}

#[test]
fn a_group_without_members_is_in_the_way_and_nodes_that_do_not_say_are_told() {
    let mut facts = to_drives(Vec::new());
    many(&mut facts).places.clear();
    let nobody = step(&facts, "drives has members");
    assert!(
        nobody.state == State::Blocked && nobody.seen.contains("no application of any node"),
        "{nobody:?}"
    );
    many(&mut facts).unsaid.push(("ankle".to_owned(), "no answer within 2s".to_owned()));
    let unknown = step(&facts, "drives has members");
    assert!(unknown.state == State::Blocked && unknown.seen.contains("ankle did not say"), "{unknown:?}");
    // Where some are known the others are a note.
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    many(&mut facts).unsaid.push(("ankle".to_owned(), "no answer within 2s".to_owned()));
    let some = step(&facts, "drives has members");
    assert!(some.state == State::Note && some.seen.contains("a on knee; ankle did not say"), "{some:?}");
}

#[test]
fn a_member_whose_node_is_not_connected_is_told_as_between_two() {
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    hip(&mut facts).peers[0].links[0].is_up = false;
    let down = step(&facts, "gait is connected to knee");
    assert!(down.state == State::Blocked && down.seen.contains("control down"), "{down:?}");
    // One on the sender's own node needs no connection.
    facts.ends[0].node = Some(node(2));
    assert!(is_free(&facts), "{:#?}", judge(&facts));
}

#[test]
fn whoever_sends_to_many_is_one_application() {
    // A node: rules are about its applications.
    let mut facts = to_drives(vec![member("a", false, SHUT)]);
    facts.ends[0].app = None;
    many(&mut facts).is_judged = false;
    let open = step(&facts, "gait may send to drives");
    assert!(open.state == State::Note && open.seen.contains("is open"), "{open:?}");
    // Many.
    facts.ends[0] = End { wanted: "legs".to_owned(), ..End::default() };
    many(&mut facts).is_sender_many = true;
    assert_eq!(step(&facts, "legs sends").state, State::Blocked);
    // The other way round: a group that was named first is sent to all the same.
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    facts.ends.swap(0, 1);
    many(&mut facts).end = 0;
    assert_eq!(step(&facts, MAY).state, State::Fine);
}

#[test]
fn groups_by_which_a_list_says_something_else_of_two_applications_are_told_and_not_in_the_way() {
    let mut facts = free();
    let group = |name: &str| Tid::group(name).to_string();
    facts.by_groups[0] = vec![member(&group("drives"), true, OPEN), member(&group("legs"), true, OPEN)];
    facts.by_groups[1] = vec![member(&group("telemetry"), false, SHUT)];
    let there =
        step(&facts, &format!("hip may send to knee.drive by group {}, {}", group("drives"), group("legs")));
    assert!(there.state == State::Fine && there.seen.contains(OPEN), "{there:?}");
    let back = step(&facts, &format!("knee.drive may send to hip by group {}", group("telemetry")));
    assert!(back.state == State::Note && back.seen.contains(SHUT), "{back:?}");
    assert!(back.mend.is_some_and(|mend| mend.contains("on the host of hip")));
    assert!(is_free(&facts));
}
