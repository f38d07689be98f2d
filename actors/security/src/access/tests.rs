//! Verdicts of a list on messages and on clients, and faults of a list that cannot be read.

mod properties;
mod roles;

use std::{collections::BTreeMap, sync::Arc};

use sinew_model::{
    config::NodeConfig,
    refusals::{BY_LIST, Refusals},
};
use sinew_runtime::{
    outcome::Rejection,
    router::guard::Guard as _,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::{Class, Flags, Header, Kind},
};

use super::{
    Access, Applicant, Question, ReportedNames,
    client::ClientAccessError,
    file::parse,
    rule::{Names, Verdict},
};

const HERE: NodeAddress = NodeAddress::new(0x0a00_0002);
const THERE: NodeAddress = NodeAddress::new(0x0a00_0004);

/// The address and the refusals of a node.
struct Place {
    node: NodeAddress,
    refusals: Arc<Refusals>,
}

impl Place {
    fn of(config: &NodeConfig) -> Self {
        Self { node: config.node_address(), refusals: Arc::default() }
    }

    fn access(&self, text: &str) -> Arc<Access> {
        Access::in_test(self.node, &self.refusals, text)
    }
}

fn app(node: NodeAddress, number: u32) -> Tid {
    Tid::new(node, AppAddress::new(number))
}

fn asked(source: Tid, target: Tid) -> Question {
    Question { source, target, group: None, class: Class::Control }
}

fn named<'a>(source: &'a str, target: &'a str) -> Names<'a> {
    Names { source: Some(source), target: Some(target) }
}

fn verdict(text: &str, asked: Question, names: Names<'_>) -> Verdict {
    parse(text).unwrap_or_else(|faults| panic!("{faults}")).decide(HERE, asked, names)
}

#[test]
fn message_without_matching_rule_is_refused() {
    let message = asked(app(THERE, 0x1001), app(HERE, 0x1002));
    assert_eq!(verdict("", message, Names::default()), Verdict::Refused(None));
    let others = "[[rule]]\nfrom = ['gait']\nto = ['drive']\n";
    assert_eq!(verdict(others, message, named("gait", "log")), Verdict::Refused(None));
    assert_eq!(verdict(others, message, named("gait", "drive")), Verdict::Allowed(0));
    assert_eq!(
        verdict(others, message, Names::default()),
        Verdict::Refused(None),
        "nobody knows their names"
    );
}

#[test]
fn first_matching_rule_decides() {
    let text =
        "[[rule]]\nfrom = ['guest.*']\nto = ['*']\naction = 'refuse'\n[[rule]]\nfrom = ['*']\nto = ['*']\n";
    let message = asked(app(THERE, 0x1001), app(HERE, 0x1002));
    assert_eq!(verdict(text, message, named("guest.1", "drive")), Verdict::Refused(Some(0)));
    assert_eq!(verdict(text, message, named("gait", "drive")), Verdict::Allowed(1));
}

#[test]
fn selectors_match_by_node_address_range_and_pattern() {
    let covers = |from: &str, source: Tid, name: Option<&str>| {
        let text = format!("[[rule]]\nfrom = ['{from}']\nto = ['*']\n");
        let names = Names { source: name, target: None };
        verdict(&text, asked(source, app(HERE, 0x1002)), names) == Verdict::Allowed(0)
    };
    let (there, here) = (app(THERE, 0x1001), app(HERE, 0x1001));
    let cases = [
        ("*", true, true),
        ("10.0.0.4", true, false),
        ("here", false, true),
        ("10.0.0.4/1001", true, false),
        ("10.0.0.4/1002", false, false),
        ("*/1001", true, true),
        ("here/1000-1001", false, true),
        ("*/1002-7fffffff", false, false),
        ("10.0.0.4/*", true, false),
        ("leg.*", true, true),
        ("leg.*@10.0.0.4", true, false),
        ("leg.*@here", false, true),
        ("arm.*", false, false),
    ];
    for (from, is_there, is_here) in cases {
        let found = (covers(from, there, Some("leg.left")), covers(from, here, Some("leg.left")));
        assert_eq!(found, (is_there, is_here), "{from}");
    }
    assert!(covers("a@b@*", there, Some("a@b")), "a name with an @ in it");
    assert!(covers("7@*", there, Some("7")), "a name of digits");
    assert!(!covers("*@10.0.0.4", there, None), "a pattern is about names");
}

#[test]
fn group_and_class_rules_allow_only_their_targets() {
    let text = "[[rule]]\nfrom = ['*']\ngroups = ['drives']\nclasses = ['stream', 'bulk']\n";
    let to = |group, class| {
        let message = asked(app(THERE, 0x1001), app(HERE, 0x1002));
        verdict(text, Question { group, class, ..message }, Names::default())
    };
    let drives = Some(AppAddress::group("drives"));
    assert_eq!(to(drives, Class::Stream), Verdict::Allowed(0));
    assert_eq!(to(drives, Class::Bulk), Verdict::Allowed(0));
    assert_eq!(to(drives, Class::Control), Verdict::Refused(None));
    assert_eq!(to(Some(AppAddress::group("others")), Class::Stream), Verdict::Refused(None));
    assert_eq!(to(None, Class::Stream), Verdict::Refused(None), "a member itself is not its group");
}

#[test]
fn all_faults_are_reported_with_line_and_remedy() {
    let text = "[[rule]]\nfrom = ['10.0.0.4/3']\nto = ['*/80000001']\n[[rule]]\nto = []\nclass = ['fast']\naction = 'deny'\n\
                [[rule]]\nfrom = ['*']\ngroups = ['d*']\nclasses = ['fast']\n[[client]]\nnames = [7]\n[[clients]]\nuid = 1\n";
    let faults = parse(text).expect_err("nothing of it is right").to_string();
    let expected = [
        ("rule.from (line 2)", "layers are not subject"),
        ("rule.to (line 3)", "given out anew"),
        ("rule.from (line 4)", "from whom"),
        ("rule.to (line 5)", "to = "),
        ("rule.class (line 6)", "does not exist"),
        ("rule.action (line 7)", "\"allow\" or \"refuse\""),
        ("rule.groups (line 10)", "name each group"),
        ("rule.classes (line 11)", "control, stream or bulk"),
        ("client.uid (line 12)", "whom it is about"),
        ("client.names (line 13)", "in quotes"),
        ("clients (line 14)", "[[client]]"),
    ];
    let lines: Vec<_> = faults.lines().collect();
    assert_eq!(lines.len(), expected.len(), "{faults}");
    for (line, (place, remedy)) in lines.iter().zip(expected) {
        assert!(line.starts_with(place) && line.contains(remedy), "{line}");
    }
    let many = "[[rule]]\nfrom = ['*']\nto = ['*']\n";
    assert!(parse(&many.repeat(256)).is_ok() && parse(&many.repeat(257)).is_err());
    let wide = format!("[[rule]]\nfrom = [{}]\nto = ['*']\n", "'a', ".repeat(63));
    assert!(parse(&wide.repeat(32)).is_ok());
    let why = parse(&wide.repeat(33)).expect_err("too many").to_string();
    assert!(why.contains("2112 of them") && why.contains("at most 2048"), "{why}");
}

#[test]
fn misspelt_address_is_not_parsed_as_a_name() {
    let is_legal = |who: &str| {
        let (from, to) = (
            format!("[[rule]]\nfrom = ['{who}']\nto = ['*']\n"),
            format!("[[rule]]\nfrom = ['*']\nto = ['{who}']\n"),
        );
        assert_eq!(parse(&from).is_ok(), parse(&to).is_ok(), "{who}");
        parse(&from).is_ok()
    };
    for who in [
        "10.0.0.400",
        "10.0.0.*",
        "gait@10.0.0.400",
        "10.0.0.4:1001",
        "gait@knee",
        " gait",
        "10.0.0.4 ",
        "gait ",
        "7",
        "gait@",
        "gait|hip",
        "2 of leg.*",
        "leg/sensor",
    ] {
        assert!(!is_legal(who), "{who}");
    }
    for who in
        ["gait", "leg.*", "gait@10.0.0.4", "leg 2", "*.7", "7@*", "gait@here", "v1.2:a", "leg/sensor@*"]
    {
        assert_eq!(is_legal(who), who != "*.7", "{who}");
    }
    assert!(parse("[[client]]\nuid = 1\nnames = ['guest ']\n").is_err());
}

const POLICY: &str = "[[client]]\nuid = 1001\nnames = ['guest.*']\naddresses = ['2000-20ff']\n[[client]]\ngid = 50\n\
                      [[client]]\nuid = 0\nnames = ['*']\naddresses = ['*']\n";

#[test]
fn user_gets_exactly_the_permissions_of_its_rule() {
    let list = parse(POLICY).unwrap();
    let may = |uid, gid, name, address: Option<u32>| {
        list.may_register(1000, Applicant { uid, gid }, name, address.map(AppAddress::new))
    };
    assert_eq!(
        may(1000, 1000, Some("gait"), Some(0x1000)),
        Ok(()),
        "the node's own user, which no rule is about"
    );
    assert_eq!(may(0, 0, Some("gait"), Some(0x1000)), Ok(()));
    assert_eq!(may(1001, 9, Some("guest.1"), Some(0x2001)), Ok(()));
    assert_eq!(may(1001, 9, None, None), Ok(()));
    let name = may(1001, 9, Some("gait"), None).expect_err("not its name");
    assert!(matches!(name, ClientAccessError::Name { .. }) && name.to_string().contains("line 1 "), "{name}");
    let address = may(1001, 9, Some("guest.1"), Some(0x1001)).expect_err("not its address");
    assert!(matches!(address, ClientAccessError::Address { .. }), "{address}");
    assert_eq!(may(1002, 50, None, None), Ok(()), "of the group");
    assert!(may(1002, 50, Some("guest.1"), None).is_err(), "the group has no names");
    assert_eq!(may(1002, 9, None, None), Err(ClientAccessError::NotAdmitted(1002, 1000)));
    // The name and address patterns of different rules do not combine for any client.
    assert!(may(1001, 50, None, Some(0x2001)).is_ok());
}

#[test]
fn user_joins_only_the_groups_of_its_rules() {
    let list = parse(
        "[[client]]\nuid = 1001\ngroups = ['telemetry']\n[[client]]\ngid = 50\ngroups = ['cameras', 'legs']\n\
         [[client]]\nuid = 1002\n[[client]]\nuid = 1003\ngroups = ['*']\n[[client]]\nuid = 0\nnames = ['*']\n",
    )
    .unwrap();
    let may = |uid, gid, group| list.may_join(1000, Applicant { uid, gid }, AppAddress::group(group));
    assert_eq!(may(1001, 9, "telemetry"), Ok(()));
    let why = may(1001, 9, "stop").expect_err("it is not among them");
    assert!(matches!(why, ClientAccessError::Group { .. }), "{why:?}");
    for word in ["user 1001", &AppAddress::group("stop").to_string(), "line 1 ", "`groups`"] {
        assert!(why.to_string().contains(word), "{why}");
    }
    assert_eq!(may(1001, 50, "legs"), Ok(()), "several rules add up");
    assert!(may(1002, 9, "telemetry").is_err(), "none where none is named");
    assert_eq!(may(1003, 9, "anything"), Ok(()));
    assert_eq!(may(1004, 9, "telemetry"), Err(ClientAccessError::NotAdmitted(1004, 1000)));
    assert_eq!((may(1000, 9, "stop"), may(0, 9, "stop")), (Ok(()), Ok(())), "no rule lists their groups");
    assert!(
        may(1000, 50, "stop").is_err() && may(0, 50, "legs").is_ok(),
        "the group's rule is about them, too"
    );
}

#[test]
fn client_rules_without_groups_are_known() {
    let without = |text| parse(text).unwrap().without_groups(1000).map(|lines| lines.to_string());
    assert_eq!(without("[[client]]\nuid = 1001\n[[client]]\ngid = 50\n").as_deref(), Some("line 1, 3"));
    assert_eq!(without("[[client]]\nuid = 1001\ngroups = ['*']\n"), None);
    assert_eq!(without("[[client]]\nuid = 1000\n[[client]]\nuid = 0\n"), None, "these join any all the same");
}

#[test]
fn group_pattern_is_a_fault_with_a_remedy() {
    for groups in ["['leg*']", "['']", "[7]", "[]", "'legs'"] {
        let faults =
            parse(&format!("[[client]]\nuid = 1\ngroups = {groups}\n")).expect_err(groups).to_string();
        assert!(faults.starts_with("client.groups (line 3)"), "{faults}");
    }
}

#[test]
fn documented_list_is_valid() {
    let text = include_str!("../../../../docs/book/src/reference/access.toml");
    let list = parse(text).unwrap_or_else(|faults| panic!("{faults}"));
    let may = |group| list.may_join(1000, Applicant { uid: 1001, gid: 9 }, AppAddress::group(group));
    assert!(may("telemetry").is_ok() && may("stop").is_err());
}

#[test]
fn memberships_are_checked_against_the_current_list() {
    let place = Place::of(&NodeConfig::new("knee"));
    let access = place.access("[[client]]\nuid = 1001\ngroups = ['telemetry']\n");
    let (who, guest) = (Applicant { uid: 1_001, gid: 9 }, AppAddress::new(0x8000_0001));
    let join = |group| access.join(1_000, (who, guest), AppAddress::group(group));
    access.add_guest(guest, 1_001);
    assert_eq!(join("telemetry"), Ok(()));
    assert!(access.guests().contains(&guest));
    let why = join("stop").expect_err("the list does not have it");
    assert_eq!(why.why(), Rejection::NotAllowed);
    access.replace_in_test("[[client]]\nuid = 1001\ngroups = ['stop']\n");
    assert!(join("stop").is_ok() && join("telemetry").is_err());
    access.remove(guest);
    assert!(access.guests().is_empty());
}

#[test]
fn without_client_rules_only_own_user_and_root_enter() {
    let list = parse("").unwrap();
    let admits = |uid| list.admit(1000, Applicant { uid, gid: 1 }).is_ok();
    assert!(admits(1000) && admits(0) && !admits(1001));
}

const INCARNATION: Incarnation = Incarnation(7);

/// Names of these applications as reported by their nodes, in one incarnation.
fn reported<'a>(names: &[(Tid, &'a str)]) -> impl Iterator<Item = ReportedNames<'a>> {
    reported_by(INCARNATION, names)
}

fn reported_by<'a>(
    incarnation: Incarnation,
    names: &[(Tid, &'a str)],
) -> impl Iterator<Item = ReportedNames<'a>> {
    let mut nodes = BTreeMap::<_, Vec<_>>::new();
    for (tid, name) in names {
        nodes.entry(tid.node).or_default().push((tid.app, *name));
    }
    nodes.into_iter().map(move |(node, names)| ReportedNames { node, incarnation, names })
}

#[test]
fn only_own_user_and_root_may_reload_the_list() {
    let place = Place::of(&NodeConfig::new("knee"));
    let access = place.access("");
    let [own, guest, root] = [0x1001, 0x1002, 0x1003].map(AppAddress::new);
    for (app, uid) in [(own, 1_000), (guest, 1_001), (root, 0)] {
        access.holds(app, uid, None);
    }
    assert!(access.is_of(own, 1_000) && access.is_of(root, 1_000));
    assert!(!access.is_of(guest, 1_000) && !access.is_of(AppAddress::new(0x1004), 1_000));
}

#[test]
fn reconnecting_user_does_not_evict_present_holders() {
    let place = Place::of(&NodeConfig::new("knee"));
    let access = place.access("");
    let held = AppAddress::new(0x1001);
    access.holds(held, 1_000, None);
    for number in 0..5_000 {
        let app = AppAddress::new(0x8000_0000 + number);
        access.holds(app, 1_001, None);
        access.remove(app);
    }
    assert!(access.is_of(held, 1_000));
}

fn header(source: Tid, target: Tid) -> Header {
    Header::new(Kind::named("test"), source, target)
}

#[test]
fn quotas_keep_replies_to_guests_and_own_applications() {
    // Given: a list that allows nothing, one of the robot's own applications, and five guest users, all in one shard
    let place = Place::of(&NodeConfig::new("knee"));
    let access = place.access("");
    let (here, there) = (place.node, app(THERE, 0x1001));
    let own = app(here, 0x2000);
    let guests = [1, 2, 3, 4, 5].map(|uid| (app(here, 0x2000 + 16 * uid), uid));
    access.add_own(own.app);
    guests.iter().for_each(|(guest, uid)| access.add_guest(guest.app, *uid));
    let asks = |source: Tid, number| {
        let mut question = header(source, there);
        (question.correlation, question.flags) = (number, Flags::ASK);
        access.asks(&question);
    };
    let is_answered = |target: Tid, number| {
        let mut reply = header(there, target);
        (reply.correlation, reply.flags) = (number, Flags::REPLY);
        access.allows(&reply, target.app)
    };
    // When: guests send as many requests as they can after a request of the robot's own application
    asks(own, 1);
    guests.iter().for_each(|(guest, _)| (1..=2_000).for_each(|number| asks(*guest, number)));
    asks(own, 2);
    // Then
    assert!(is_answered(own, 1) && is_answered(own, 2) && !is_answered(own, 2), "each once");
    // When: the robot's own applications do the same after a request of a guest
    let (first, _) = guests[0];
    asks(first, 3_000);
    (1..=5).for_each(|robots| {
        (1..=2_000).for_each(|number| asks(app(here, 0x3000 + 16 * robots), number));
    });
    // Then
    assert!(is_answered(first, 3_000));
    // And: after a guest has ended, the next holder of its address receives none of its replies
    asks(first, 3_001);
    access.remove(first.app);
    access.add_own(first.app);
    assert!(!is_answered(first, 3_001));
}

#[test]
fn refusals_are_counted_with_rule_and_both_ends() {
    let mut config = NodeConfig::new("knee");
    config.address = Some(HERE);
    let place = Place::of(&config);
    let access = place.access("[[rule]]\nname = 'no guests'\nfrom = ['*']\nto = ['*']\naction = 'refuse'\n");
    access.named(AppAddress::new(0x1002), Some("drive"));
    let (source, target) = (app(THERE, 0x1001), app(HERE, 0x1002));
    (0..3).for_each(|_| assert!(!access.allows(&header(source, target), target.app)));
    assert_eq!(place.refusals.of(BY_LIST), 3);
    let detail = &place.refusals.reports()[0].detail;
    for word in ["rule 1 'no guests' (line 1)", "10.0.0.4/1001", "'drive'", "Control"] {
        assert!(detail.contains(word), "{detail}");
    }
    // The rules do not apply to messages of this node's layers to its applications. The layers of another node have no
    // such privilege.
    assert!(access.allows(&header(Tid::new(HERE, AppAddress::SYNC), target), target.app));
    assert!(!access.allows(&header(Tid::new(THERE, AppAddress::SYNC), target), target.app));
}

#[test]
fn name_is_valid_only_while_it_is_registered() {
    let mut config = NodeConfig::new("knee");
    config.address = Some(HERE);
    let place = Place::of(&config);
    let access = place.access("[[rule]]\nfrom = ['gait']\nto = ['drive']\n");
    let (source, target) = (app(THERE, 0x1001), app(HERE, 0x1002));
    let is_open = || access.allows(&header(source, target), target.app);
    assert!(!is_open());
    access.named(target.app, Some("drive"));
    assert!(!is_open());
    access.set_remote_names(Some(THERE), reported(&[(source, "gait")]));
    assert!(is_open());
    // A node cannot name the applications of another node, or those of this node.
    let other = NodeAddress::new(9);
    access.set_remote_names(Some(other), reported(&[(source, "log"), (target, "log")]));
    assert!(is_open());
    access.set_remote_names(None, [].into_iter());
    assert!(!is_open());
    access.set_remote_names(None, reported(&[(source, "gait")]));
    assert!(is_open());
    access.remove(target.app);
    assert!(!is_open());
}

#[test]
fn names_of_an_incarnation_end_with_it() {
    // Given: a node on which an allowed application has the first dynamic address
    let place = Place::of(&NodeConfig::new("knee"));
    let access = place.access("[[rule]]\nfrom = ['gait']\nto = ['*']\n");
    let (source, target) = (app(THERE, 0x8000_0000), app(place.node, 0x1002));
    let is_open = || access.allows(&header(source, target), target.app);
    let next = Incarnation(8);
    access.on_connected(THERE, INCARNATION);
    access.set_remote_names(Some(THERE), reported(&[(source, "gait")]));
    access.on_connected(THERE, INCARNATION);
    assert!(is_open(), "another connection to the same incarnation");
    assert!(access.guard_for(THERE, INCARNATION).is_none());
    // When: this node connects to a new incarnation of that node
    access.on_connected(THERE, next);
    // Then: no application there has that name, even if another node repeats the report of the previous incarnation
    assert!(!is_open());
    access.set_remote_names(None, reported(&[(source, "gait")]));
    assert!(!is_open());
    let allows = |incarnation| {
        access.guard_for(THERE, incarnation).unwrap().allows(&header(source, target), target.app)
    };
    assert!(allows(INCARNATION), "its last wills are its own");
    assert!(!allows(Incarnation(6)), "of that one nothing is known");
    access.set_remote_names(None, reported_by(next, &[(source, "gait")]));
    assert!(is_open());
}

#[test]
fn refused_name_also_refuses_applications_without_known_names() {
    let place = Place::of(&NodeConfig::new("knee"));
    let rules = "[[rule]]\nfrom = ['guest.*', 'log@10.0.0.9']\nto = ['*']\naction = 'refuse'\n[[rule]]\nfrom = ['*']\nto = ['*']\n";
    let access = place.access(rules);
    let (source, target) = (app(THERE, 0x8000_0000), app(place.node, 0x1002));
    let is_open = |from| access.allows(&header(from, target), target.app);
    assert!(is_open(app(place.node, 0x8000_0000)), "those of this node are known");
    assert!(!is_open(source));
    access.on_connected(THERE, INCARNATION);
    assert!(!is_open(source));
    access.set_remote_names(Some(THERE), reported(&[(source, "gait")]));
    assert!(is_open(source) && is_open(app(THERE, 0x1001)), "one that has no name");
    access.replace_in_test(&rules.replace("'guest.*', ", ""));
    assert!(is_open(source) && is_open(app(NodeAddress::new(8), 0x1001)), "it is about another node");
    assert!(!is_open(app(NodeAddress::new(0x0a00_0009), 0x1001)));
}
