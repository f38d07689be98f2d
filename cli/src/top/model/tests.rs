//! The tables of two snapshots.

use std::{collections::BTreeSet, time::Duration};

use sinew::{
    Tid, Time,
    address::Incarnation,
    audit::Entry,
    inspect::{AppsReport, RealTimeReport, RetainedReport, StallReport, TreeLine, TreeReport},
};

use super::*;
use crate::security::tests::node_report;

const HIP: NodeAddress = NodeAddress::new(0xc0a8_0007);
const KNEE: NodeAddress = NodeAddress::new(0xc0a8_0008);
const DRIVE: AppAddress = AppAddress::new(0x1000);
const COMMAND: AppAddress = AppAddress::new(0x2000);

fn app(address: AppAddress, name: Option<&str>) -> AppReport {
    AppReport {
        tid: Tid::new(HIP, address),
        name: name.map(str::to_owned),
        ready: true,
        waits_us: None,
        missing: Vec::new(),
        missing_left_out: 0,
        ended: None,
        kinds: Vec::new(),
        kinds_left_out: 0,
    }
}

fn tree() -> TreeReport {
    let line = TreeLine {
        depth: 1,
        name: "drive".to_owned(),
        tid: Some(Tid::new(HIP, DRIVE)),
        state: "ready".to_owned(),
        since_us: 1,
        life: 2,
        restarts: 1,
        last_reason: None,
        place: None,
        waiting: Some(3),
        waiting_most: Some(9),
        oldest_us: Some(1_500),
        ages: None,
        strategy: None,
    };
    TreeReport { name: "hip".to_owned(), lines: vec![line], left_out: 0 }
}

/// The hip after so many seconds, in each of which it got 50 messages and sent 20 to the knee.
fn hip(seconds: u64) -> Answers {
    let mailbox = Place::Mailbox { app: DRIVE, name: "drive".to_owned(), class: Class::Stream };
    let count = |count: u64| Account { taken: count * seconds, expired: seconds, ..Account::default() };
    let [to, from] = [true, false].map(|is_sent| {
        let class = Some(Class::Control);
        if is_sent { Place::ToNode { node: KNEE, class } } else { Place::FromNode { node: KNEE, class } }
    });
    let sent = Account { taken: 21 * seconds, own: seconds, ..Account::default() };
    let accounts = [(mailbox, count(50)), (to, sent), (from, Account { taken: 7, ..Account::default() })];
    let entries = accounts.map(|(place, account)| Entry { place, account }).to_vec();
    let link = LinkReport { class: "Control".to_owned(), is_up: true, waiting: 4, unconfirmed: 2 };
    let peer = PeerReport {
        name: Some("knee".to_owned()),
        is_there: true,
        round_trip_ns: Some(250_000),
        links: vec![link],
        ..PeerReport::lost(KNEE, Incarnation(1))
    };
    let real_time =
        RealTimeReport { granted: 60, p99_ns: 60_000, max_ns: 210_000, ..RealTimeReport::default() };
    let node = NodeReport {
        node: HIP,
        up_us: seconds * 1_000_000,
        own_stalls: Some(StallReport { count: 2, longest_us: 300_000, last_us: Some(1) }),
        real_time: Some(real_time),
        peers: vec![peer],
        stop: Some(StopState::Released),
        retained: Some(RetainedReport { values: 4, bytes: 90, not_kept: 1, not_handed_over: 2 }),
        ..node_report("hip", 7, None)
    };
    let audit = NodeAudit {
        node: HIP,
        name: "hip".to_owned(),
        incarnation: node.incarnation,
        entries,
        sessions: Vec::new(),
        refused: BTreeMap::new(),
    };
    let apps = AppsReport {
        name: "hip".to_owned(),
        apps: vec![app(DRIVE, Some("drive")), app(COMMAND, None)],
        left_out: 0,
        barriers: Vec::new(),
        barriers_left_out: 0,
        groups: Vec::new(),
        groups_left_out: 0,
    };
    Answers { node, apps, tree: tree(), audit, log: Vec::new() }
}

fn snapshot(hip: Answers) -> Snapshot {
    let entry = hip.node.clone();
    let nodes = vec![
        NodeAnswers { node: HIP, name: "hip".to_owned(), result: Ok(Box::new(hip)) },
        NodeAnswers { node: KNEE, name: "knee".to_owned(), result: Err("no answer".to_owned()) },
    ];
    Snapshot {
        taken: Time::from_nanos(1),
        took: Duration::from_millis(2),
        entry: Ok(entry),
        nodes,
        left_out: 0,
        own: BTreeSet::from([Tid::new(HIP, COMMAND)]),
    }
}

fn rows(model: &Model, title: &str) -> Vec<Vec<String>> {
    let section = model.sections.iter().find(|section| section.title == title).expect("a section");
    section.rows.iter().map(Row::texts).collect()
}

fn row<const N: usize>(cells: [&str; N]) -> Vec<String> {
    cells.map(str::to_owned).to_vec()
}

#[test]
fn tables_have_states_queues_and_rates() {
    let model = Model::of(Some(&snapshot(hip(10))), &snapshot(hip(12)));
    assert_eq!(
        rows(&model, "Nodes"),
        [
            row([
                "hip",
                "192.168.0.7",
                "up",
                "released",
                "12.0 s",
                "60",
                "60 us",
                "210 us",
                "2",
                "300.0 ms",
                "4",
                "3",
            ]),
            row(["knee", "192.168.0.8", "no answer", "-", "-", "-", "-", "-", "-", "-", "-", "-"]),
        ]
    );
    // This command itself is not shown.
    assert_eq!(
        rows(&model, "Applications"),
        [row(["drive", "hip", "ready", "50.0", "-", "3", "9", "1.5 ms", "1", "-"])]
    );
    assert_eq!(
        rows(&model, "Links"),
        [row(["hip", "knee", "control", "up", "250 us", "20.0", "0.0", "4", "2"])]
    );
    let stream = rows(&model, "Losses of messages")[1].clone();
    assert_eq!(stream, ["stream", "1.0", "0", "12", "0", "0", "0", "0"]);
    assert!(!model.is_fine(), "the knee does not answer");
}

#[test]
fn rates_need_two_snapshots_of_one_incarnation() {
    let mut restarted = hip(12);
    restarted.node.incarnation = Incarnation(u64::MAX);
    for model in [
        Model::of(None, &snapshot(hip(12))),
        Model::of(Some(&snapshot(hip(12))), &snapshot(hip(12))),
        Model::of(Some(&snapshot(hip(10))), &snapshot(restarted)),
    ] {
        assert_eq!(rows(&model, "Applications")[0][3], "-");
        assert_eq!(rows(&model, "Losses of messages")[1][1], "-");
    }
}

#[test]
fn worst_state_of_the_outputs_is_shown() {
    let of = |safe: Option<&str>, is_safe_failed| GuardReport {
        receiver: Tid::new(HIP, DRIVE),
        sender: Tid::new(KNEE, DRIVE),
        kind_name: "leg.torque".to_owned(),
        safe: safe.map(str::to_owned),
        is_safe_failed,
    };
    let drive = app(DRIVE, Some("drive"));
    let shown = |guards: &[GuardReport]| guard(guards, &drive);
    let text = |text: &str, is_fine| (Cell::Text(text.to_owned()), is_fine);
    assert_eq!(shown(&[]), (Cell::Unknown, true));
    assert_eq!(shown(&[of(None, false)]), text("live", true));
    assert_eq!(shown(&[of(None, false), of(Some("Silent"), false)]), text("safe: Silent", false));
    assert_eq!(shown(&[of(Some("Silent"), false), of(None, true)]), text("FAILED", false));
}

#[test]
fn node_is_fine_unless_it_is_stopped() {
    let of = |stop| {
        let mut hip = hip(12);
        hip.node.stop = stop;
        let node = NodeAnswers { node: HIP, name: "hip".to_owned(), result: Ok(Box::new(hip)) };
        let row = node_row(&node);
        (row.texts()[3].clone(), row.is_fine)
    };
    let shown = |word: &str, is_fine| (word.to_owned(), is_fine);
    assert_eq!(of(Some(StopState::Released)), shown("released", true));
    assert_eq!(of(Some(StopState::Stopped)), shown("stopped", false));
    assert_eq!(of(Some(StopState::Held)), shown("held", false));
    assert_eq!(of(None), shown("-", true));
}

#[test]
fn lost_nodes_have_the_class_of_their_loss() {
    let mut entry = hip(12);
    entry.node.lost = vec![LostReport {
        node: KNEE,
        name: "knee".to_owned(),
        incarnation: Incarnation(1),
        udp: String::new(),
        lost_us: 2_000_000,
        why: "gave up: the address is in use".to_owned(),
        silent_us: 1,
        bound_us: None,
        found_by: Vec::new(),
    }];
    let model = Model::of(None, &snapshot(entry));
    let cells = ["gave up", "knee", "192.168.0.8", "2.0 s", "gave up: the address is in use"];
    assert_eq!(rows(&model, "Lost nodes"), [cells]);
    assert_eq!(model.json()["lost_nodes"][0]["lost_us"], 2_000_000);
}

#[test]
fn silent_entry_node_is_a_finding() {
    let model = Model::of(None, &Snapshot::without_entry(Time::from_nanos(1), "it was stopped".to_owned()));
    assert_eq!((model.fault.as_deref(), model.is_fine()), (Some("it was stopped"), false));
    assert!(rows(&model, "Nodes").is_empty());
}
