//! Verdicts on a free path, and on each obstacle.

mod access;
mod address;
mod cases;
mod direct;
mod guards;
mod keys;
mod many;
mod silent;
mod stream;
mod unnamed;
mod versions;

use sinew::{
    AppAddress, Class, NodeAddress, Tid,
    address::Incarnation,
    inspect::{
        AccessReport, AccessVerdict, AppReport, DialReport, ForeignReport, LinkReport, LostEchoReport,
        LostReport, Missing, RefusalReport, StreamReport, TreeLine, TroubleReport, UnguardedReport,
        UnhandledReport,
    },
};

use super::*;

fn node(number: u8) -> NodeAddress {
    NodeAddress::from([10, 0, 0, number])
}

fn peer(number: u8) -> PeerReport {
    let link = |class: &str| LinkReport { class: class.to_owned(), is_up: true, waiting: 0, unconfirmed: 0 };
    PeerReport {
        node: node(number),
        name: None,
        incarnation: Incarnation(1),
        is_there: true,
        found_us: Some(5_000_000),
        found_by: vec!["multicast".to_owned()],
        silent_us: Some(120_000),
        missed: 0,
        asked_every_us: Some(500_000),
        bound_us: Some(2_000_000),
        troubled: 0,
        troubles: Vec::new(),
        idle_clients: 0,
        idle: Vec::new(),
        routes: Vec::new(),
        round_trip_ns: None,
        offset_ns: None,
        offset_bound_ns: None,
        drift_ppb: None,
        drift_bound_ppb: None,
        linked_us: Some(4_000_000),
        broken_us: None,
        dial: None,
        links: ["control", "stream", "bulk"].map(link).to_vec(),
        stream: Some(values(7)),
    }
}

/// Datagrams are agreed on, and this many values have arrived by datagram.
fn values(arrived: u64) -> StreamReport {
    StreamReport { is_on: true, is_agreed: true, sent: arrived, arrived, payload_max: None }
}

fn report(number: u8, name: &str, other: u8) -> NodeReport {
    NodeReport {
        node: node(number),
        name: name.to_owned(),
        incarnation: Incarnation(1),
        up_us: 9_000_000,
        pid: 7,
        version: "0".to_owned(),
        stopping: false,
        refused: 0,
        security: None,
        project: "leg".to_owned(),
        interface: node(number).to_string(),
        is_interface_default: Some(false),
        udp: Some(format!("{}:7000", node(number))),
        gncl: Some(format!("{}:7001", node(number))),
        group: Some("239.0.0.1:7000".to_owned()),
        groups: vec!["239.0.0.1:7000".to_owned()],
        seeds: Vec::new(),
        sources: Vec::new(),
        lost: Vec::new(),
        lost_left_out: 0,
        own_stalls: None,
        troubled: 0,
        troubles: Vec::new(),
        idle_clients: 0,
        idle: Vec::new(),
        foreign: Vec::new(),
        foreign_left_out: 0,
        refusals: Vec::new(),
        unhandled: Vec::new(),
        unguarded: Vec::new(),
        lost_echoes: Vec::new(),
        real_time: None,
        recording: None,
        retained: None,
        stop: None,
        guards: Vec::new(),
        guards_left_out: 0,
        refusals_left_out: 0,
        peers: vec![peer(other)],
        left_out: 0,
    }
}

fn app(name: &str) -> App {
    let tid = Tid::new(node(2), AppAddress::new(0x1001));
    let report = AppReport {
        tid,
        name: Some(name.to_owned()),
        ready: true,
        waits_us: None,
        missing: Vec::new(),
        missing_left_out: 0,
        ended: None,
        kinds: Vec::new(),
        kinds_left_out: 0,
    };
    let line = TreeLine {
        depth: 1,
        name: name.to_owned(),
        tid: Some(tid),
        state: "ready".to_owned(),
        since_us: 1,
        life: 1,
        restarts: 0,
        last_reason: None,
        place: None,
        waiting: Some(0),
        waiting_most: Some(3),
        oldest_us: None,
        ages: None,
        strategy: None,
    };
    App { report: Some(report), unreported: None, line: Some(line), refused: 0, direct: Vec::new() }
}

/// The hip at 10.0.0.1, and knee.drive on the knee at 10.0.0.2.
fn free() -> Facts {
    let end = |wanted: &str, report: NodeReport| TrafficEnd {
        wanted: wanted.to_owned(),
        node: Some(report.node),
        report: Some(report),
        ..TrafficEnd::default()
    };
    let mut facts = Facts {
        ends: [end("hip", report(1, "hip", 2)), end("knee.drive", report(2, "knee", 1))],
        pings: [Some(Ok(300)), Some(Ok(400))],
        streams: [Some(values(8)), None],
        ..Facts::default()
    };
    facts.ends[1].app = Some(app("knee.drive"));
    facts
}

fn hip(facts: &mut Facts) -> &mut NodeReport {
    facts.ends[0].report.as_mut().expect("it answers")
}

fn knee(facts: &mut Facts) -> &mut NodeReport {
    facts.ends[1].report.as_mut().expect("it answers")
}

fn drive(facts: &mut Facts) -> &mut App {
    facts.ends[1].app.as_mut().expect("an application is meant")
}

fn lost(why: &str) -> LostReport {
    LostReport {
        node: node(2),
        name: "knee".to_owned(),
        incarnation: Incarnation(1),
        udp: "10.0.0.2:7000".to_owned(),
        lost_us: 3_000_000,
        why: why.to_owned(),
        silent_us: 1_500_000,
        bound_us: Some(2_000_000),
        found_by: Vec::new(),
    }
}

/// Neither node has discovered the other.
fn strangers(facts: &mut Facts) {
    hip(facts).peers.clear();
    knee(facts).peers.clear();
}

/// The node queries these groups.
fn asks(report: &mut NodeReport, groups: &[&str]) {
    report.groups = groups.iter().map(|group| (*group).to_owned()).collect();
    report.group = report.groups.first().cloned();
}

fn never_answered(facts: &mut Facts) {
    facts.ends[1] =
        TrafficEnd { wanted: "10.0.0.2".to_owned(), node: Some(node(2)), ..TrafficEnd::default() };
    hip(facts).peers.clear();
}

fn waits(facts: &mut Facts, missing: &str) {
    let report = drive(facts).report.as_mut().expect("it is there");
    report.ready = false;
    report.waits_us = Some(2_000_000);
    report.missing = vec![Missing { name: missing.to_owned(), why: "not there".to_owned(), since_us: None }];
    facts.waits.insert("knee.drive".to_owned(), vec![missing.to_owned()]);
}

#[test]
fn free_path_needs_no_fix() {
    let steps = judge(&free());
    let not_fine: Vec<_> =
        steps.iter().filter(|step| step.state != State::Fine || step.fix.is_some()).collect();
    assert!(not_fine.is_empty(), "{not_fine:?}");
    // Each end, one project, both directions known, linked, for Stream and pinged, and the application.
    assert_eq!(steps.len(), 12, "{steps:?}");
}

/// A change, and the text of the note that follows from it.
type Note = (fn(&mut Facts), &'static str);

#[test]
fn notes_do_not_block_the_path() {
    let notes: [Note; 5] = [
        (|facts| hip(facts).peers[0].missed = 2, "missed its last 2 answers"),
        (|facts| facts.pings[1] = None, "not tried from there: this command has no socket of knee"),
        (|facts| drive(facts).refused = 9, "9 messages were refused"),
        (
            |facts| {
                let missing =
                    Missing { name: "ankle".to_owned(), why: "its node is lost".to_owned(), since_us: None };
                drive(facts).report.as_mut().expect("it is there").missing.push(missing);
            },
            "it lost ankle",
        ),
        (
            |facts| {
                let tids = [2, 3, 4, 5, 6, 7].map(|number| Tid::new(node(number), AppAddress::new(0x1001)));
                let (seen_from, others) = ("hip".to_owned(), tids[1..].to_vec());
                facts.ends[1].namesakes = Some(Namesakes { tid: tids[0], seen_from, others });
            },
            "from node hip the name stands for 10.0.0.2/1001, not for 10.0.0.3/1001, 10.0.0.4/1001, 10.0.0.5/1001, 10.0.0.6/1001 and 1 more",
        ),
    ];
    for (change, detail) in notes {
        let mut facts = free();
        change(&mut facts);
        let steps = judge(&facts);
        assert!(steps.iter().all(|step| step.state != State::Blocked), "{steps:#?}");
        assert!(
            steps.iter().any(|step| step.state == State::Note && step.detail.contains(detail)),
            "{steps:#?}"
        );
    }
}

#[test]
fn untried_way_back_is_noted_with_a_command() {
    let mut facts = free();
    facts.pings[1] = None;
    let steps = judge(&facts);
    let back =
        steps.iter().find(|step| step.what == "a message goes from knee to hip").expect("it is a step");
    let fix = back.fix.as_deref().expect("it can be tried");
    assert!(fix.starts_with("`sinew why knee.drive hip` on the host of knee"), "{fix}");
    // An end that cannot be queried at all blocks the path, and is reported once.
    facts.ends[1].report = None;
    assert!(judge(&facts).iter().all(|step| step.what != "a message goes from knee.drive to hip"));
}

#[test]
fn waiting_application_explains_an_unanswered_ping() {
    // Given: no ping was sent to it, or a ping had no answer before its node reported that it waits
    for ping in [None, Some(Err("no answer within 2s: its thread is busy or hangs".to_owned()))] {
        let mut facts = free();
        waits(&mut facts, "ankle");
        facts.pings[0] = ping;
        // When
        let steps = judge(&facts);
        // Then: it blocks the path once, at the step for accepting messages
        let blocked: Vec<_> = steps.iter().filter(|step| step.state == State::Blocked).collect();
        assert!(blocked.len() == 1 && blocked[0].what == "knee.drive takes messages", "{blocked:#?}");
        let there = steps.iter().find(|step| step.what == "a message goes from hip to knee.drive");
        let there = there.expect("it is a step");
        let detail = "not tried: it is not ready: has waited 2.0 s for ankle (not there)";
        assert_eq!((there.state, there.detail.as_str(), &there.fix), (State::Note, detail, &None));
        // And: the way back has its own step
        let back = steps.iter().find(|step| step.what == "a message goes from knee to hip");
        assert_eq!(back.map(|step| step.state), Some(State::Fine));
    }
}

#[test]
fn duplicate_address_of_a_third_node_does_not_block() {
    let mut facts = free();
    let cause = "NDL node address used twice".to_owned();
    // The elder of the two is at a former place of the knee.
    let detail =
        "10.0.0.21 is at 10.0.0.2:7000; the process at 10.0.0.9:7000 claims the same node address".to_owned();
    hip(&mut facts).refusals.push(RefusalReport { cause, count: 4, detail, ago_us: 1_000_000 });
    assert!(judge(&facts).iter().all(|step| step.state == State::Fine));
}

#[test]
fn refusals_of_a_longer_address_do_not_match() {
    for (detail, is_of_it) in [
        ("node 10.0.0.1 says: your clock is odd", true),
        ("10.0.0.1:7001 proves nothing", true),
        ("no word of 10.0.0.1.", true),
        ("node 10.0.0.10 is not it, and 10.0.0.1 is", true),
        ("node 10.0.0.10 says: your clock is odd", false),
        ("110.0.0.1:7001 proves nothing", false),
    ] {
        let mut facts = free();
        knee(&mut facts).peers[0].links.clear();
        let (cause, detail) = ("violation".to_owned(), detail.to_owned());
        knee(&mut facts).refusals.push(RefusalReport { cause, count: 1, detail, ago_us: 1_000 });
        let steps = judge(&facts);
        let step = steps.iter().find(|step| step.what == "knee.drive is connected to hip");
        let step = step.expect("it is looked at");
        assert_eq!((step.state, step.detail.contains("refused: ")), (State::Blocked, is_of_it), "{step:?}");
    }
}

#[test]
fn applications_of_one_node_need_no_connection() {
    let mut facts = free();
    facts.ends[0] = TrafficEnd { app: Some(app("knee.sensor")), ..facts.ends[1].clone() };
    facts.ends[0].wanted = "knee.sensor".to_owned();
    knee(&mut facts).peers.clear();
    assert!(judge(&facts).iter().all(|step| step.state == State::Fine));
}
