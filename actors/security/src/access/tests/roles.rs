//! Roles: operators may set parameters, observers may read them.

use sinew_runtime::{
    parameters::{
        AskParameters, ParameterTransaction, ParameterVote, Participant, SetParameters, TransactionId,
    },
    router::guard::Guard as _,
    wire::{Message, Payload},
};

use super::*;

/// Whether a message of this kind from `source` may reach the application at 1001.
fn may(access: &Access, kind: Kind, source: Tid) -> bool {
    let target = AppAddress::new(0x1001);
    access.allows(&Header::new(kind, source, Tid::new(HERE, target)), target)
}

fn may_set(access: &Access, source: Tid) -> bool {
    may(access, SetParameters::KIND, source)
}

fn may_read(access: &Access, source: Tid) -> bool {
    may(access, AskParameters::KIND, source)
}

fn place() -> Place {
    let mut config = NodeConfig::new("knee");
    config.address = Some(HERE);
    Place::of(&config)
}

#[test]
fn operators_set_parameters_without_a_rule() {
    let place = place();
    let access = place.access("[roles]\noperators = ['tuner@10.0.0.4', 'here']\n");
    let [tuner, gait] = [0x1005, 0x1006].map(|number| app(THERE, number));
    access.set_remote_names(None, reported_by(INCARNATION, &[(tuner, "tuner"), (gait, "gait")]));
    assert!(may_set(&access, tuner) && may_read(&access, tuner));
    assert!(may_set(&access, app(HERE, 0x1002)));
    assert!(!may_set(&access, gait) && !may_read(&access, gait));
    // Nothing else is allowed to an operator without a rule.
    assert!(!may(&access, Kind::named("test.other"), tuner));
}

#[test]
fn rule_alone_allows_to_read_and_not_to_set() {
    let place = place();
    let access = place.access("[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let source = app(THERE, 0x1005);
    assert!(may_read(&access, source) && !may_set(&access, source));
    assert!(may(&access, Kind::named("test.other"), source));
    assert_eq!(place.refusals.of(BY_LIST), 1);
}

#[test]
fn reply_sets_no_parameters_without_the_role() {
    let place = place();
    let access = place.access("");
    let (knee, asked) = (Tid::new(HERE, AppAddress::new(0x1001)), app(THERE, 0x1005));
    let may_reply = |kind, number| {
        let mut request = Header::new(Kind::named("test.question"), knee, asked);
        (request.correlation, request.flags) = (number, Flags::ASK);
        access.asks(&request);
        let mut reply = Header::new(kind, asked, knee);
        (reply.correlation, reply.flags) = (number, Flags::REPLY);
        access.allows(&reply, knee.app)
    };
    assert!(may_reply(Kind::named("test.answer"), 1));
    assert!(!may_reply(SetParameters::KIND, 2));
}

#[test]
fn participants_that_an_operator_names_need_no_rule() {
    let place = place();
    let access = place.access("[[rule]]\nfrom = ['*']\nto = ['*']\n[roles]\noperators = ['here']\n");
    let (knee, other) = (Tid::new(HERE, AppAddress::new(0x1001)), Tid::new(HERE, AppAddress::new(0x1002)));
    let guest = Tid::new(HERE, AppAddress::new(0x1006));
    access.add_guest(guest.app, rustix::process::geteuid().as_raw() + 7);
    let hip = app(THERE, 0x1005);
    let vote = |source, to: Tid| {
        access.allows(
            &Header::new(ParameterVote::KIND, source, to),
            if to.app.is_group() { knee.app } else { to.app },
        )
    };
    // Before the begin, and between others, not even a rule allows it.
    assert!(!vote(hip, knee));
    let named = |tid: Tid| Participant { tid: tid.bits(), app: String::new() };
    let transaction = ParameterTransaction {
        id: TransactionId { coordinator: other.bits(), began_ns: 1 },
        participants: [knee, hip, guest].map(named).to_vec(),
        values: Vec::new(),
        lead_ns: 1,
        applies_after_ns: 1,
    };
    access.sets(&Message::typed(other, knee, &SetParameters::Prepare(transaction)));
    assert!(vote(hip, knee) && vote(knee, knee));
    assert!(!vote(hip, other) && !vote(app(THERE, 0x1007), knee));
    assert!(!vote(guest, knee) && !vote(hip, Tid::group("drives")));
}

#[test]
fn observers_read_without_a_rule() {
    let place = place();
    let access = place.access("[roles]\nobservers = ['10.0.0.4']\n");
    assert!(may_read(&access, app(THERE, 0x1005)) && !may_set(&access, app(THERE, 0x1005)));
    assert!(!may_read(&access, app(HERE, 0x1005)));
}

#[test]
fn guests_of_the_node_are_no_operators() {
    let place = place();
    let access = place.access("[roles]\noperators = ['*']\n");
    let own = rustix::process::geteuid().as_raw();
    let [guest, former, mine] = [0x1005, 0x1006, 0x1007].map(AppAddress::new);
    access.add_guest(guest, own + 7);
    access.holds(former, own + 7, None);
    access.remove(former);
    access.holds(mine, own, None);
    let is_operator = |of| may_set(&access, Tid::new(HERE, of));
    assert!(!is_operator(guest) && !is_operator(former) && is_operator(mine));
}

#[test]
fn reload_changes_the_operators() {
    let place = place();
    let access = place.access("[roles]\noperators = ['here']\n");
    assert!(may_set(&access, app(HERE, 0x1002)));
    access.replace_in_test("");
    assert!(!may_set(&access, app(HERE, 0x1002)));
}

#[test]
fn unknown_role_is_a_fault_with_the_known_ones() {
    let faults = parse("[roles]\noperator = ['here']\n").expect_err("it is misspelt").to_string();
    assert!(
        faults.contains("roles.operator (line 2)") && faults.contains("operators, observers"),
        "{faults}"
    );
    let faults = parse("roles = ['here']\n").expect_err("it is a list").to_string();
    assert!(faults.contains("[roles]"), "{faults}");
}
