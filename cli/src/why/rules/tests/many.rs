//! Messages to several receivers: the members of a group, and the verdicts of their nodes' lists.

use super::*;
use crate::why::facts::{Many, Member, MembersOn};

const OPEN: &str = "rule 2 'setpoints' (line 5)";
const SHUT: &str = "no rule allows it";

/// The list's verdict on this member, the same for all classes.
fn member(name: &str, is_allowed: bool, rule: &str) -> Member {
    let why = format!("{rule}, for 'gait' at 10.0.0.1/1001 to '{name}' at 10.0.0.2/1001");
    let verdict = |class| AccessVerdict { class, is_allowed, why: why.clone() };
    let app = Tid::new(node(2), AppAddress::group(name));
    Member { label: name.to_owned(), app, verdicts: Class::ALL.map(verdict).to_vec() }
}

/// The gait on the hip, and the group of the drives with these members on the knee, which has a list.
fn to_drives(members: Vec<Member>) -> Facts {
    let mut facts = free();
    facts.ends[0].wanted = "gait".to_owned();
    facts.ends[0].app = Some(app("gait"));
    let node = TrafficEnd { wanted: "knee".to_owned(), app: None, ..facts.ends[1].clone() };
    facts.ends[1] = TrafficEnd { wanted: "drives".to_owned(), ..TrafficEnd::default() };
    (facts.pings, facts.streams) = Default::default();
    let on = MembersOn { node, is_given: true, members, left_out: 0 };
    facts.many = Some(Many {
        end: 1,
        tid: Tid::group("drives"),
        is_judged: true,
        is_sender_many: false,
        places: vec![on],
        unreported: Vec::new(),
    });
    facts
}

fn many(facts: &mut Facts) -> &mut Many {
    facts.many.as_mut().expect("one is many")
}

/// Returns the step with this name.
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
fn members_with_one_verdict_share_a_step() {
    let facts = to_drives(["a", "b", "c"].map(|name| member(name, true, OPEN)).to_vec());
    let members = step(&facts, "drives has members");
    assert_eq!(members.detail, format!("group {}: a, b, c on knee", Tid::group("drives")));
    let may = step(&facts, MAY);
    assert_eq!(may.state, State::Fine, "{may:?}");
    assert!(may.detail.contains(OPEN) && may.detail.ends_with("; the same for b, c"), "{may:?}");
    assert_eq!(step(&facts, "gait reaches nodes of members").detail, "connected to knee");
    assert!(judge(&facts).iter().all(|step| step.state == State::Fine), "{:#?}", judge(&facts));
}

#[test]
fn members_with_different_verdicts_have_a_step_each() {
    let facts = to_drives(vec![
        member("a", true, OPEN),
        member("b", false, "rule 1 'no guests' (line 1)"),
        member("c", true, OPEN),
    ]);
    let let_through = step(&facts, &format!("{MAY}: a, c"));
    assert!(let_through.state == State::Fine && let_through.detail.contains(OPEN), "{let_through:?}");
    let refused = step(&facts, &format!("{MAY}: b"));
    assert!(
        refused.state == State::Note && refused.detail.contains("refused: rule 1 'no guests'"),
        "{refused:?}"
    );
    let fix = refused.fix.expect("it has a fix");
    let lines = "[[rule]]\nfrom = [\"gait@10.0.0.1\"]\ngroups = [\"drives\"]";
    for words in [lines, "before any that refuses it", "`sinew reload` on the host of knee"] {
        assert!(fix.contains(words), "{words}: {fix}");
    }
    assert!(is_free(&facts), "others get it");
}

#[test]
fn list_blocks_unless_some_member_is_allowed() {
    let mut facts = to_drives(vec![member("a", false, SHUT), member("b", false, SHUT)]);
    let may = step(&facts, MAY);
    assert!(may.state == State::Blocked && may.detail.contains(SHUT), "{may:?}");
    // A group that was given as a number has an unknown name.
    facts.ends[1].wanted = Tid::group("drives").to_string();
    let what = format!("gait may send to {} on knee", Tid::group("drives"));
    assert!(step(&facts, &what).fix.is_some_and(|fix| fix.contains("THE GROUP'S NAME")));
    facts.ends[1].wanted = "drives".to_owned();
    // The hip has a member, too, and no list.
    let node = TrafficEnd { wanted: "hip".to_owned(), app: None, ..facts.ends[0].clone() };
    let own = Member { label: "hip.drive".to_owned(), app: Tid::NONE, verdicts: Vec::new() };
    many(&mut facts).places.push(MembersOn { node, is_given: false, members: vec![own], left_out: 0 });
    assert_eq!(step(&facts, MAY).state, State::Note);
    assert_eq!(step(&facts, "gait may send to drives on hip").detail, "node hip has no access list");
    assert!(is_free(&facts));
}

#[test]
fn refused_classes_are_a_note() {
    let mut stream_only = member("a", true, OPEN);
    stream_only.verdicts[0].is_allowed = false;
    let facts = to_drives(vec![stream_only]);
    let may = step(&facts, MAY);
    assert!(may.state == State::Note && may.detail.contains("Control refused"), "{may:?}");
}

#[test]
fn empty_group_blocks_and_silent_nodes_are_reported() {
    let mut facts = to_drives(Vec::new());
    many(&mut facts).places.clear();
    let members = step(&facts, "drives has members");
    assert!(
        members.state == State::Blocked && members.detail.contains("no application of any node"),
        "{members:?}"
    );
    many(&mut facts).unreported.push(("ankle".to_owned(), "no answer within 2s".to_owned()));
    let unknown = step(&facts, "drives has members");
    assert!(
        unknown.state == State::Blocked && unknown.detail.contains("ankle did not report"),
        "{unknown:?}"
    );
    // If some members are known, silent nodes are a note.
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    many(&mut facts).unreported.push(("ankle".to_owned(), "no answer within 2s".to_owned()));
    let some = step(&facts, "drives has members");
    assert!(some.state == State::Note && some.detail.contains("a on knee; ankle did not report"), "{some:?}");
}

#[test]
fn member_on_an_unconnected_node_blocks() {
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    hip(&mut facts).peers[0].links[0].is_up = false;
    let down = step(&facts, "gait is connected to knee");
    assert!(down.state == State::Blocked && down.detail.contains("control down"), "{down:?}");
    // A member on the sender's own node needs no connection.
    facts.ends[0].node = Some(node(2));
    assert!(is_free(&facts), "{:#?}", judge(&facts));
}

#[test]
fn sender_to_a_group_is_one_application() {
    // The sender is a node, but rules apply to its applications.
    let mut facts = to_drives(vec![member("a", false, SHUT)]);
    facts.ends[0].app = None;
    many(&mut facts).is_judged = false;
    let open = step(&facts, "gait may send to drives");
    assert!(open.state == State::Note && open.detail.contains("is open"), "{open:?}");
    // Several senders.
    facts.ends[0] = TrafficEnd { wanted: "legs".to_owned(), ..TrafficEnd::default() };
    many(&mut facts).is_sender_many = true;
    assert_eq!(step(&facts, "legs sends").state, State::Blocked);
    // Reversed: a group that is named first is still the receiver.
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    facts.ends.swap(0, 1);
    many(&mut facts).end = 0;
    assert_eq!(step(&facts, MAY).state, State::Fine);
}

#[test]
fn groups_with_a_different_verdict_are_noted() {
    let mut facts = free();
    let group = |name: &str| Tid::group(name).to_string();
    facts.by_groups[0] = vec![member(&group("drives"), true, OPEN), member(&group("legs"), true, OPEN)];
    facts.by_groups[1] = vec![member(&group("telemetry"), false, SHUT)];
    let there =
        step(&facts, &format!("hip may send to knee.drive by group {}, {}", group("drives"), group("legs")));
    assert!(there.state == State::Fine && there.detail.contains(OPEN), "{there:?}");
    let back =
        judge(&facts).into_iter().find(|step| step.what.starts_with("knee.drive may send to hip by group"));
    assert!(back.is_none(), "nothing on the way to knee.drive needs it: {back:?}");
    assert!(is_free(&facts));
}

/// The member with this name did not handle messages of the gait, this long ago.
fn unhandled(facts: &mut Facts, name: &str, ago_us: u64) {
    let sender = facts.ends[0].app_tid().expect("it is listed");
    let on = &mut many(facts).places[0];
    let receiver = on.members.iter().find(|member| member.label == name).expect("a member").app;
    let kind = sinew::message::Kind::named("demo.angle");
    let (kind_name, remedy) = (Some("demo.angle".to_owned()), "add `.handles::<Angle>()`".to_owned());
    let report =
        UnhandledReport { receiver, sender, kind, kind_name, is_malformed: false, count: 7, ago_us, remedy };
    on.node.report.as_mut().expect("it answers").unhandled.push(report);
}

#[test]
fn unhandled_type_blocks_only_if_no_member_handles_it() {
    // Given: one of two members does not handle the type
    let mut facts = to_drives(vec![member("a", true, OPEN), member("b", true, OPEN)]);
    unhandled(&mut facts, "a", 1_000);
    let of_a = step(&facts, "a handles what it is sent");
    assert!(
        of_a.state == State::Note && of_a.detail.starts_with("demo.angle is not handled: 7 messages"),
        "{of_a:?}"
    );
    assert!(is_free(&facts), "b handles it");
    // When: the other member does not handle it, either
    unhandled(&mut facts, "b", 1_000);
    for what in ["a handles what it is sent", "b handles what it is sent"] {
        let blocked = step(&facts, what);
        assert!(blocked.state == State::Blocked && blocked.detail.ends_with("from gait"), "{blocked:?}");
        assert!(blocked.fix.is_some_and(|fix| fix.contains("handles::<Angle>")));
    }
    // Then: members that did not fit into the answer may handle it
    many(&mut facts).places[0].left_out = 1;
    assert!(is_free(&facts));
    // And: an unhandled message of long ago is a note
    let mut facts = to_drives(vec![member("a", true, OPEN)]);
    unhandled(&mut facts, "a", RECENT_US);
    assert!(is_free(&facts));
}
