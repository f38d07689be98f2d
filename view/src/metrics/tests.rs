//! The samples of a whole system, and the snapshots that other tests use.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    address::Incarnation,
    audit::{Account, Entry, NodeAudit, Place},
    inspect::{
        AgesReport, AppReport, AppsReport, BarrierReport, DialReport, GuardReport, LinkReport, LostReport,
        Missing, NodeReport, PeerReport, RealTimeReport, RecordingReport, RetainedReport, StallReport,
        StreamReport, TreeLine, TreeReport, WaitReport,
    },
    message::Class,
    stop::StopState,
};

use super::{Format, METRICS, Shape, encode};
use crate::{
    foxglove::Counts,
    snapshot::{Answers, NodeAnswers, Snapshot},
};

const TAKEN: Time = Time::from_nanos(5_000_000_000);
const NOW: Time = Time::from_nanos(5_500_000_000);
/// All names of labels.
const LABELS: [&str; 7] = ["node", "peer", "class", "outcome", "why", "app", "quantile"];

fn node(last: u8) -> NodeAddress {
    NodeAddress::from([10, 0, 0, last])
}

/// Returns the report of a node about which nothing is to be said.
pub(crate) fn node_report(node: NodeAddress, name: &str) -> NodeReport {
    NodeReport {
        node,
        name: name.to_owned(),
        incarnation: Incarnation(1),
        up_us: 2_500_000,
        pid: 1,
        version: "0.1.0".to_owned(),
        stopping: false,
        refused: 0,
        project: "walker".to_owned(),
        security: None,
        interface: "10.0.0.0".to_owned(),
        is_interface_default: Some(false),
        udp: None,
        gncl: None,
        group: None,
        groups: Vec::new(),
        seeds: Vec::new(),
        sources: Vec::new(),
        lost: Vec::new(),
        lost_left_out: 0,
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
        peers: Vec::new(),
        own_stalls: None,
        troubled: 0,
        troubles: Vec::new(),
        idle_clients: 0,
        idle: Vec::new(),
        left_out: 0,
    }
}

/// Returns the report about a lost node.
pub(crate) fn lost(node: NodeAddress, name: &str, why: &str) -> LostReport {
    LostReport {
        node,
        name: name.to_owned(),
        incarnation: Incarnation(1),
        udp: "10.0.0.3:7400".to_owned(),
        lost_us: 1,
        why: why.to_owned(),
        silent_us: 1,
        bound_us: None,
        found_by: Vec::new(),
    }
}

/// Returns the snapshot of the hip and the knee, which both answer, and a lost ankle. Each metric has a sample.
pub(crate) fn snapshot() -> Snapshot {
    let mut hip = node_report(node(1), "hip");
    hip.lost = vec![lost(node(3), "ankle", "gave up: the address is in use")];
    hip.own_stalls = Some(StallReport { count: 2, longest_us: 300_000, last_us: Some(1) });
    hip.real_time = Some(real_time());
    hip.recording = Some(RecordingReport { seen: 900, dropped: 3, ..RecordingReport::default() });
    hip.retained = Some(RetainedReport { values: 3, bytes: 120, not_kept: 2, not_handed_over: 1 });
    hip.stop = Some(StopState::Stopped);
    hip.peers = vec![peer()];
    hip.guards = [None, Some("Silent")].map(guard).to_vec();
    let knee = node_report(node(2), "knee");
    let answers = |node: NodeReport| {
        let (apps, tree) = (apps(&node), tree(&node));
        let audit = audit(&node);
        let (address, name) = (node.node, node.name.clone());
        NodeAnswers {
            node: address,
            name,
            result: Ok(Box::new(Answers { node, apps, tree, audit, log: Vec::new() })),
        }
    };
    Snapshot {
        taken: TAKEN,
        took: Duration::from_millis(20),
        entry: Ok(hip.clone()),
        nodes: vec![answers(hip), answers(knee)],
        left_out: 0,
        own: BTreeSet::from([Tid::new(node(1), AppAddress::new(0x2000))]),
    }
}

/// Returns what the hip has measured after its start.
fn real_time() -> RealTimeReport {
    let (p50_ns, p99_ns, p999_ns, max_ns) = (4_000, 60_000, 90_000, 210_000);
    let memory = "locked".to_owned();
    RealTimeReport { granted: 60, memory, p50_ns, p99_ns, p999_ns, max_ns, ..RealTimeReport::default() }
}

/// Returns an output of the drive of the hip.
fn guard(safe: Option<&str>) -> GuardReport {
    let receiver = Tid::new(node(1), AppAddress::new(0x1000));
    let (sender, kind_name) = (Tid::new(node(2), AppAddress::new(0x1000)), "leg.torque".to_owned());
    GuardReport { receiver, sender, kind_name, safe: safe.map(str::to_owned), is_safe_failed: false }
}

/// Returns the knee, as the hip reports it.
fn peer() -> PeerReport {
    let link = |class: &str| LinkReport { class: class.to_owned(), is_up: true, waiting: 3, unconfirmed: 1 };
    let dial = DialReport {
        address: "10.0.0.2:7400".to_owned(),
        error: "refused".to_owned(),
        fault: "refused".to_owned(),
        ago_us: 1,
        failed: 4,
    };
    PeerReport {
        name: Some("knee".to_owned()),
        is_there: true,
        silent_us: Some(50_000),
        bound_us: Some(400_000),
        missed: 1,
        round_trip_ns: Some(120_000),
        offset_ns: Some(-2_000),
        offset_bound_ns: Some(60_000),
        drift_ppb: Some(1_500),
        drift_bound_ppb: Some(200_000),
        dial: Some(dial),
        links: vec![link("Control"), link("Bulk")],
        stream: Some(StreamReport { is_on: true, is_agreed: true, sent: 9, arrived: 8, payload_max: None }),
        ..PeerReport::lost(node(2), Incarnation(1))
    }
}

fn apps(of: &NodeReport) -> AppsReport {
    let app = |address, name: Option<&str>| AppReport {
        tid: Tid::new(of.node, AppAddress::new(address)),
        name: name.map(str::to_owned),
        ready: true,
        waits_us: None,
        missing: Vec::new(),
        missing_left_out: 0,
        ended: None,
        kinds: Vec::new(),
        kinds_left_out: 0,
    };
    let missing = Missing { name: "toe".to_owned(), why: "not there".to_owned(), since_us: Some(31_000_000) };
    let waits = AppReport {
        ready: false,
        waits_us: Some(31_000_000),
        missing: vec![missing.clone()],
        ..app(0x1001, Some("gait"))
    };
    let barrier = BarrierReport {
        name: "calibrated".to_owned(),
        parties: vec!["drive".to_owned(), "toe".to_owned()],
        is_phase: false,
        generation: 0,
        waiting: vec![WaitReport { name: "drive".to_owned(), waits_us: 7_000_000 }],
        waiting_left_out: 0,
        missing: vec![missing],
        missing_left_out: 0,
    };
    AppsReport {
        name: of.name.clone(),
        apps: vec![app(0x1000, Some("drive")), waits, app(0x1002, None), app(0x2000, None)],
        left_out: 0,
        barriers: vec![barrier],
        barriers_left_out: 0,
        groups: Vec::new(),
        groups_left_out: 0,
    }
}

fn tree(of: &NodeReport) -> TreeReport {
    let line = TreeLine {
        depth: 1,
        name: "drive".to_owned(),
        tid: Some(Tid::new(of.node, AppAddress::new(0x1000))),
        state: "runs".to_owned(),
        since_us: 1,
        life: 3,
        restarts: 2,
        last_reason: None,
        place: None,
        waiting: Some(5),
        waiting_most: Some(17),
        oldest_us: Some(1_500),
        ages: Some(AgesReport { counts: [vec![0, 3], vec![0; 15], vec![1]].concat(), sum_us: 20_000_100 }),
        strategy: None,
    };
    TreeReport { name: of.name.clone(), lines: vec![line], left_out: 0 }
}

fn audit(of: &NodeReport) -> NodeAudit {
    let account =
        Account { taken: 10, delivered: 7, expired: 2, waiting: 1, refused: 4, ..Account::default() };
    let (app, name) = (AppAddress::new(0x1000), "drive".to_owned());
    let places = vec![
        Place::Mailbox { app, name: name.clone(), class: Class::Control },
        Place::Client { app, name: name.clone() },
        Place::DirectLink { from: app, from_name: String::new(), to: app, to_name: name },
        Place::ToNode { node: node(2), class: Some(Class::Stream) },
        Place::FromNode { node: node(2), class: None },
        Place::OtherMailboxes,
        Place::OtherClients,
        Place::OtherDirectLinks,
        Place::ToFormerNodes,
        Place::FromFormerNodes,
    ];
    NodeAudit {
        node: of.node,
        name: of.name.clone(),
        incarnation: of.incarnation,
        entries: places.into_iter().map(|place| Entry { place, account }).collect(),
        sessions: Vec::new(),
        refused: BTreeMap::from([("not taken: NoSuchApplication".to_owned(), 6)]),
    }
}

/// Counters of a server for Foxglove.
const FOXGLOVE: Counts = Counts { clients: 2, queued: 30, dropped: 4, missed: 5 };

fn text(snapshot: &Snapshot) -> String {
    encode(snapshot, Some(FOXGLOVE), NOW, Format::OpenMetrics).expect("it is written to memory")
}

/// Returns the sample of this line up to its value, or fails.
fn value(text: &str, sample: &str) -> f64 {
    let found = text.lines().find_map(|line| line.strip_prefix(sample)?.strip_prefix(' '));
    let found = found.unwrap_or_else(|| panic!("no sample {sample} in:\n{text}"));
    found.parse().expect("a sample has a number")
}

#[test]
fn each_metric_has_its_own_labels_in_both_formats() {
    for format in [Format::OpenMetrics, Format::PlainText] {
        let text = encode(&snapshot(), Some(FOXGLOVE), NOW, format).expect("it is written to memory");
        for metric in METRICS {
            let suffix = if metric.shape == Shape::Histogram { "_bucket" } else { "" };
            let name = metric.full_name() + suffix;
            let line = text.lines().find(|line| line.split(['{', ' ']).next() == Some(&name));
            let line = line.unwrap_or_else(|| panic!("no sample of {name} in:\n{text}"));
            for label in LABELS {
                let has = line.contains(&format!("{label}=\""));
                assert_eq!(has, metric.labels.contains(&label), "{label} of {line}");
            }
            assert!(text.contains(metric.help), "{text}");
        }
        assert_eq!(text.ends_with("# EOF\n"), format == Format::OpenMetrics);
    }
}

#[test]
fn names_and_labels_follow_the_conventions() {
    let mut names = BTreeSet::new();
    for metric in METRICS {
        assert!(names.insert(metric.name), "{} is there twice", metric.name);
        assert!(!metric.name.ends_with("_total") && !metric.name.ends_with("_seconds"), "{}", metric.name);
        assert!(metric.labels.iter().all(|label| LABELS.contains(label)), "{}", metric.name);
        assert!(metric.help.ends_with('.') && !metric.help.contains(['\n', '|']), "{}", metric.name);
        assert!(metric.shape != Shape::Counter || !metric.is_seconds, "{}", metric.name);
    }
}

#[test]
fn samples_have_base_units_and_the_names_of_nodes() {
    let text = text(&snapshot());
    for (sample, expected) in [
        ("sinew_entry_node_up", 1.0),
        ("sinew_snapshot_age_seconds", 0.5),
        ("sinew_node_up{node=\"hip\"}", 1.0),
        ("sinew_node_up{node=\"ankle\"}", 0.0),
        ("sinew_node_lost{node=\"ankle\",why=\"gave up\"}", 1.0),
        ("sinew_node_uptime_seconds{node=\"knee\"}", 2.5),
        ("sinew_peer_round_trip_seconds{node=\"hip\",peer=\"knee\"}", 0.000_12),
        ("sinew_peer_clock_offset_seconds{node=\"hip\",peer=\"knee\"}", -0.000_002),
        ("sinew_link_up{node=\"hip\",peer=\"knee\",class=\"control\"}", 1.0),
        ("sinew_restarts_total{node=\"hip\",app=\"drive\"}", 2.0),
        ("sinew_mailbox_oldest_seconds{node=\"hip\",app=\"drive\"}", 0.0015),
        ("sinew_app_message_age_seconds_bucket{le=\"1.048576\",node=\"hip\",app=\"drive\"}", 3.0),
        ("sinew_app_message_age_seconds_bucket{le=\"+Inf\",node=\"hip\",app=\"drive\"}", 4.0),
        ("sinew_app_message_age_seconds_count{node=\"hip\",app=\"drive\"}", 4.0),
        ("sinew_app_message_age_seconds_sum{node=\"hip\",app=\"drive\"}", 20.000_1),
        ("sinew_mailbox_depth_max{node=\"hip\",app=\"drive\"}", 17.0),
        ("sinew_barrier_wait_seconds{node=\"hip\",app=\"gait\"}", 31.0),
        ("sinew_barrier_wait_seconds{node=\"hip\",app=\"drive\"}", 7.0),
        ("sinew_barrier_blocked_seconds{node=\"hip\",app=\"toe\"}", 31.0),
        ("sinew_node_fifo_priority{node=\"hip\"}", 60.0),
        ("sinew_node_memory_locked{node=\"hip\"}", 1.0),
        ("sinew_node_stopped{node=\"hip\"}", 1.0),
        ("sinew_retained_values{node=\"hip\"}", 3.0),
        ("sinew_retained_bytes{node=\"hip\"}", 120.0),
        ("sinew_retained_dropped_total{node=\"hip\",why=\"bound\"}", 2.0),
        ("sinew_retained_dropped_total{node=\"hip\",why=\"member\"}", 1.0),
        ("sinew_node_wake_lateness_seconds{node=\"hip\",quantile=\"0.999\"}", 90e-6),
        ("sinew_guard_safe{node=\"hip\",app=\"drive\"}", 1.0),
        ("sinew_guard_safe_cause{node=\"hip\",app=\"drive\",why=\"Silent\"}", 1.0),
        ("sinew_guard_safe_failed{node=\"hip\",app=\"drive\"}", 0.0),
        ("sinew_foxglove_clients", 2.0),
        ("sinew_foxglove_messages_total", 30.0),
        ("sinew_foxglove_dropped_total{why=\"client\"}", 4.0),
        ("sinew_foxglove_dropped_total{why=\"journal\"}", 5.0),
        ("sinew_refused_total{node=\"hip\",why=\"not taken: NoSuchApplication\"}", 6.0),
    ] {
        let is = value(&text, sample);
        assert!((is - expected).abs() < 1e-12, "{sample}: {is}, not {expected}");
    }
}

#[test]
fn server_that_is_off_has_no_samples() {
    let text = encode(&snapshot(), None, NOW, Format::OpenMetrics).expect("it is written to memory");
    assert!(!text.contains("sinew_foxglove_clients ") && text.contains("sinew_entry_node_up 1"), "{text}");
}

#[test]
fn messages_are_counted_by_outcome_at_each_place() {
    let text = text(&snapshot());
    let app = |class: &str, outcome: &str| {
        format!(
            "sinew_app_messages_total{{node=\"hip\",app=\"drive\",class=\"{class}\",outcome=\"{outcome}\"}}"
        )
    };
    for (outcome, count) in [("delivered", 7.0), ("expired", 2.0), ("refused", 4.0), ("failed", 0.0)] {
        assert!((value(&text, &app("control", outcome)) - count).abs() < f64::EPSILON);
        assert!((value(&text, &app("all", outcome)) - count).abs() < f64::EPSILON);
    }
    // Other mailboxes and other clients together.
    let other = "sinew_app_messages_total{node=\"hip\",app=\"other\",class=\"all\",outcome=\"delivered\"}";
    assert!((value(&text, other) - 14.0).abs() < f64::EPSILON);
    let sent =
        "sinew_peer_messages_sent_total{node=\"hip\",peer=\"knee\",class=\"stream\",outcome=\"delivered\"}";
    assert!((value(&text, sent) - 7.0).abs() < f64::EPSILON);
}

#[test]
fn applications_of_this_program_are_not_counted() {
    assert!((value(&text(&snapshot()), "sinew_apps{node=\"hip\"}") - 3.0).abs() < f64::EPSILON);
    assert!((value(&text(&snapshot()), "sinew_apps{node=\"knee\"}") - 4.0).abs() < f64::EPSILON);
}

#[test]
fn silent_node_is_a_sample_and_no_error() {
    let mut snapshot = snapshot();
    snapshot.nodes[1].result = Err("no answer within 2s".to_owned());
    let text = text(&snapshot);
    assert!(value(&text, "sinew_node_up{node=\"knee\"}").abs() < f64::EPSILON);
    assert!(!text.contains("sinew_node_uptime_seconds{node=\"knee\"}"), "{text}");
    assert!((value(&text, "sinew_peer_up{node=\"hip\",peer=\"knee\"}") - 1.0).abs() < f64::EPSILON);
}

#[test]
fn absent_entry_node_is_a_sample_and_no_error() {
    let text = text(&Snapshot::without_entry(TAKEN, "no node".to_owned()));
    assert!(value(&text, "sinew_entry_node_up").abs() < f64::EPSILON);
}

#[test]
fn texts_of_other_nodes_forge_no_sample() {
    let mut snapshot = snapshot();
    let Ok(knee) = &mut snapshot.nodes[1].result else { panic!("it has answered") };
    knee.node.name = "a\"} 1\nsinew_node_up{node=\"hip".to_owned();
    let text = text(&snapshot);
    let forged = text.lines().filter(|line| line.starts_with("sinew_node_up{node=\"hip\"}"));
    assert_eq!(forged.count(), 1, "{text}");
    assert!(text.contains("sinew_node_up{node=\"a\\\"} 1\\nsinew_node_up{node=\\\"hip\"} 1"), "{text}");
}
