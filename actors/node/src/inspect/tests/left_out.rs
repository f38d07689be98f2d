//! Answers with more entries than fit: the further ones are left out and counted.

use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierKind, OnPartyLoss},
    config::NodeConfig,
    facts::AppFact,
};
use sinew_runtime::{
    lock,
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Kind, Payload as _, decode, encode},
};
use sinew_sync::Input;

use super::Bench;
use crate::inspect::{
    APPS_MAX,
    reports::{
        AppReport, AppsReport, AskApps, AskNode, BarrierReport, ForeignReport, IdleReport, KindReport,
        LostReport, Missing, NodeReport, PeerReport, RefusalReport, Report as _, TroubleReport, WaitReport,
    },
};

fn report(count: u32) -> AppsReport {
    let app = |number: u32| AppReport {
        tid: Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::new(0x1000 + number)),
        name: Some(format!("app{number}")),
        ready: true,
        waits_us: None,
        missing: Vec::new(),
        missing_left_out: 0,
        ended: None,
        kinds: Vec::new(),
        kinds_left_out: 0,
    };
    AppsReport {
        name: "knee".to_owned(),
        apps: (0..count).map(app).collect(),
        left_out: 0,
        barriers: Vec::new(),
        barriers_left_out: 0,
        groups: Vec::new(),
        groups_left_out: 0,
    }
}

/// A barrier of this node at which the hip waits for the knee.
fn barrier(number: u32) -> BarrierReport {
    let missing = Missing { name: "knee".to_owned(), why: "not there".to_owned(), since_us: None };
    BarrierReport {
        name: format!("round {number}"),
        parties: vec!["hip".to_owned(), "knee".to_owned()],
        is_phase: false,
        generation: 0,
        waiting: vec![WaitReport { name: "hip".to_owned(), waits_us: 1 }],
        waiting_left_out: 0,
        missing: vec![missing],
        missing_left_out: 0,
    }
}

#[test]
fn entries_left_out_of_an_answer_are_counted() {
    let mut apps = report(5);
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (2, 3));
    assert!(apps.halve() && apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (0, 5));
    assert!(!apps.halve());
    // Handled types are dropped before applications.
    let mut apps = report(5);
    let kind = KindReport { kind: Kind::PING, name: None };
    apps.apps[0].kinds = vec![kind.clone(), kind];
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (5, 0));
    assert_eq!((apps.apps[0].kinds.len(), apps.apps[0].kinds_left_out), (0, 2));
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (2, 3));
    // Of barriers and applications, the longer encoding is dropped first. In the end both are empty.
    let mut apps = report(2);
    apps.barriers = (0..16).map(barrier).collect();
    assert!(apps.halve());
    assert_eq!((apps.barriers.len(), apps.barriers_left_out, apps.left_out), (8, 8, 0));
    while apps.halve() {}
    assert_eq!((apps.barriers.len(), apps.barriers_left_out), (0, 16));
    assert_eq!((apps.apps.len(), apps.left_out), (0, 2));
}

#[test]
fn answer_with_one_entry_too_many_is_rejected() {
    assert!(decode::<AppsReport>(&encode(&report(APPS_MAX as u32))).is_ok());
    assert!(decode::<AppsReport>(&encode(&report(APPS_MAX as u32 + 1))).is_err());
}

#[test]
fn answer_is_bounded_by_the_maximum_payload() {
    let mut config = NodeConfig::new("knee");
    config.payload_max = 64;
    let bench = Bench::new(config);
    // Without peers, losses and refusals there is nothing to leave out.
    assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Rejected(Rejection::TooLong));
    assert_eq!(bench.outcome(AskApps::KIND, Flags::ASK), Outcome::Delivered);
    assert!(bench.reply().payload.len() <= 64);
}

impl Bench {
    /// The application of this number and name is ready. It waits at a barrier of each of these names with these other
    /// parties.
    fn waits(&self, (number, name): (u32, String), barriers: &[String], others: &[String]) {
        let app = AppAddress::fixed(number).expect("a low number");
        let mut sync = lock(&self.state.sync.core);
        let mut handle = |input| sync.handle(Time::now(), input);
        let registered = AppFact::own_registered(app, Some(name.clone()), Vec::new());
        handle(Input::AppChanged(registered));
        handle(Input::AppChanged(AppFact::Ready { app }));
        for (correlation, barrier) in (1..).zip(barriers) {
            let asked = ArriveAtBarrier {
                kind: BarrierKind::Meeting,
                barrier: barrier.clone(),
                parties: [std::slice::from_ref(&name), others].concat(),
                within_ms: 60_000,
                on_loss: OnPartyLoss::Wait,
            };
            handle(Input::Arrived { app, correlation, asked });
        }
    }

    fn apps(&self) -> AppsReport {
        assert_eq!(self.outcome(AskApps::KIND, Flags::ASK), Outcome::Delivered);
        self.reply().decode().expect("a report")
    }
}

// spec: INSPECT-3
#[test]
fn barriers_left_out_of_an_answer_are_counted() {
    // Given: more barriers than an answer contains
    let bench = Bench::new(NodeConfig::new("knee"));
    for number in 0..5 {
        let barriers: Vec<_> = (0..14).map(|round| format!("round {number}.{round}")).collect();
        bench.waits((number, format!("knee.{number}")), &barriers, &["hip".to_owned()]);
    }
    // When, then
    let shown = bench.apps();
    assert_eq!((shown.barriers.len(), shown.barriers_left_out, shown.apps.len()), (64, 6, 5));
    // And: the report of a version without this count decodes as none left out
    let mut bytes = encode(&shown).to_vec();
    let key = b"barriers_left_out";
    let at = bytes.windows(key.len()).position(|window| window == key).expect("a field of the map");
    bytes[at] = b'x';
    let older: AppsReport = decode(&bytes).expect("unknown fields are skipped");
    assert_eq!((older.barriers.len(), older.barriers_left_out), (64, 0));
}

// spec: INSPECT-3
#[test]
fn missing_parties_beyond_the_bound_are_counted() {
    // Given: an application that waits at two phases, each for 40 others
    let bench = Bench::new(NodeConfig::new("knee"));
    let name = "knee.drive".to_owned();
    bench.waits((0, name.clone()), &[], &[]);
    let app = AppAddress::fixed(0).expect("a low number");
    for (correlation, barrier) in (1..).zip(["homed", "armed"]) {
        let others = (0..40).map(|number| format!("drive.{number}"));
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Phase,
            barrier: barrier.to_owned(),
            parties: std::iter::once(name.clone()).chain(others).collect(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Wait,
        };
        lock(&bench.state.sync.core).handle(Time::now(), Input::Arrived { app, correlation, asked });
    }
    // When, then: the requester can decode it
    let shown = bench.apps();
    assert_eq!((shown.apps[0].missing.len(), shown.apps[0].missing_left_out), (64, 16));
    assert!(shown.barriers.iter().all(|phase| (phase.missing.len(), phase.missing_left_out) == (40, 0)));
}

// spec: INSPECT-3
#[test]
fn barrier_larger_than_a_payload_leaves_applications_reported() {
    // Given: a barrier with many long names, none of which is present
    let mut config = NodeConfig::new("knee");
    config.payload_max = 4_096;
    let bench = Bench::new(config);
    let others: Vec<_> = (0..27).map(|number| format!("{number:02}.{}", "a".repeat(60))).collect();
    bench.waits((0, "knee.drive".to_owned()), &["calibrated".to_owned()], &others);
    assert_eq!(lock(&bench.state.sync.core).barriers(Time::now()).len(), 1, "it waits there");
    // When, then
    let shown = bench.apps();
    assert_eq!((shown.barriers.len(), shown.barriers_left_out), (0, 1));
    assert_eq!((shown.apps.len(), shown.left_out), (1, 0));
}

/// The same report of a node that knows four others, and has so many losses and refusals that these take most of the
/// space.
fn with_long_lists(shown: NodeReport) -> NodeReport {
    let (incarnation, udp) = (Incarnation(1), "10.0.0.7:6911".to_owned());
    let lost = |number: u32| LostReport {
        node: NodeAddress::new(number),
        name: format!("knee.{number}"),
        incarnation,
        udp: udp.clone(),
        lost_us: 1_000_000,
        why: "link down".to_owned(),
        silent_us: 1_500_000,
        bound_us: Some(2_000_000),
        found_by: vec!["multicast".to_owned()],
    };
    let foreign = |number: u32| ForeignReport {
        node: NodeAddress::new(number),
        name: "arm".to_owned(),
        project: "arm".to_owned(),
        udp: udp.clone(),
        ago_us: 1,
    };
    let refusal = |number: u64| RefusalReport {
        cause: format!("cause {number}"),
        count: 1,
        detail: "x".repeat(256),
        ago_us: number,
    };
    let (app, name, since_us) = (Tid::NONE, "drive".to_owned(), 1);
    let trouble = TroubleReport { app, name: name.clone(), trouble: "away".to_owned(), since_us };
    NodeReport {
        lost: (0..64).map(lost).collect(),
        foreign: (0..16).map(foreign).collect(),
        refusals: (0..64).map(refusal).collect(),
        unhandled: Vec::new(),
        unguarded: Vec::new(),
        lost_echoes: Vec::new(),
        guards: Vec::new(),
        guards_left_out: 0,
        peers: (0..4).map(|number| PeerReport::lost(NodeAddress::new(number), incarnation)).collect(),
        troubled: 7,
        troubles: vec![trouble; 4],
        idle_clients: 3,
        idle: vec![IdleReport { app, name, since_us }; 2],
        ..shown
    }
}

// spec: INSPECT-3
#[test]
fn longest_list_is_cut_first_and_counted() {
    // Given
    let mut shown = with_long_lists(Bench::new(NodeConfig::new("knee")).node());
    let payload_max = 8 * 1024;
    assert!(encode(&shown).len() > payload_max);
    // When
    while encode(&shown).len() > payload_max {
        assert!(shown.halve(), "the rest has room");
    }
    // Then: all of the few known nodes are reported, and some entries of the other lists
    assert_eq!((shown.peers.len(), shown.left_out), (4, 0));
    assert_eq!((shown.troubles.len(), shown.idle.len()), (4, 2));
    assert!(!shown.lost.is_empty() && !shown.refusals.is_empty() && !shown.foreign.is_empty());
    assert!(shown.lost_left_out > 0 && shown.refusals_left_out > 0);
    assert_eq!(shown.lost.len() as u64 + shown.lost_left_out, 64);
    assert_eq!(shown.refusals.len() as u64 + shown.refusals_left_out, 64);
    let left = shown.refusals.iter().map(|refusal| refusal.ago_us);
    assert!(left.eq(0..shown.refusals.len() as u64), "the oldest ones go first");
    // And: if nothing fits, all lists are empty
    while shown.halve() {}
    assert_eq!((shown.left_out, shown.lost_left_out), (4, 64));
    assert_eq!((shown.foreign_left_out, shown.refusals_left_out), (16, 64));
    assert_eq!((shown.troubled, shown.troubles.len(), shown.idle_clients, shown.idle.len()), (7, 0, 3, 0));
}

// spec: INSPECT-3
#[test]
fn answer_with_many_refusals_is_cut_to_fit() {
    // Given: more causes than an answer contains, with details so long that not all of them fit
    let mut config = NodeConfig::new("knee");
    config.payload_max = 16 * 1024;
    let bench = Bench::new(config);
    for number in 0..70 {
        let cause: &'static str = Box::leak(format!("cause {number}").into_boxed_str());
        bench.state.ctx.refusals.count(Time::now(), cause, &"x".repeat(300));
    }
    // When, then
    let shown = bench.node();
    assert_eq!((shown.refusals.len(), shown.refusals_left_out), (32, 38));
}
