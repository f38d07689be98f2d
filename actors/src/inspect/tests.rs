//! What becomes of questions: answered within bounds, refused, or too many.

use std::{
    net::{Ipv4Addr, SocketAddrV4},
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{LocalRoute, Outlet as _},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload as _, decode, encode},
};

use super::{
    inspector::{Inbox, WAITING_MAX},
    reports::{
        AppReport, AppsReport, AskApps, AskNode, AskTree, BarrierReport, ForeignReport, IdleReport,
        KindReport, LostReport, Missing, NodeReport, PeerReport, RefusalReport, Report as _, SecurityReport,
        TroubleReport, WaitReport,
    },
};
use crate::{
    config::{Interface, NodeConfig},
    lncl::AppFact,
    ndl::{self, Part, Progress, Told, Trouble},
    secured::Secured,
    security::{
        TimePolicy,
        tests::ground::{self, Authority},
    },
    stores::{Stores, lock},
    sync::{ArriveAtBarrier, BarrierKind, Input, OnPartyLoss},
};

fn question() -> Message {
    Message::new(Header::new(Kind::PING, Tid::NONE, Tid::NONE), bytes::Bytes::new())
}

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
    }
}

/// A barrier of this node's at which the hip waits for the knee.
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
fn more_questions_than_may_wait_are_refused() {
    // Given: nobody answers
    let (put, _questions) = sync_channel(WAITING_MAX);
    let inbox = Inbox(put);
    (0..WAITING_MAX).for_each(|_| assert!(inbox.submit(question()).is_ok()));
    // When, then
    assert_eq!(inbox.submit(question()).expect_err("one too many").why, Rejection::QueueFull);
}

#[test]
fn the_thread_that_answers_does_not_keep_a_node_alive() {
    let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
    super::begin(&stores).expect("a thread");
    let weak = Arc::downgrade(&stores);
    drop(stores);
    assert!(weak.upgrade().is_none(), "nobody has asked, so that nobody has it in hand");
}

#[test]
fn what_has_no_room_in_an_answer_is_counted() {
    let mut apps = report(5);
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (2, 3));
    assert!(apps.halve() && apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (0, 5));
    assert!(!apps.halve());
    // What they handle goes before one of them does.
    let mut apps = report(5);
    let kind = KindReport { kind: Kind::PING, name: None };
    apps.apps[0].kinds = vec![kind.clone(), kind];
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (5, 0));
    assert_eq!((apps.apps[0].kinds.len(), apps.apps[0].kinds_left_out), (0, 2));
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (2, 3));
    // Of barriers and applications those go first that take more room, and in the end all of both.
    let mut apps = report(2);
    apps.barriers = (0..16).map(barrier).collect();
    assert!(apps.halve());
    assert_eq!((apps.barriers.len(), apps.barriers_left_out, apps.left_out), (8, 8, 0));
    while apps.halve() {}
    assert_eq!((apps.barriers.len(), apps.barriers_left_out), (0, 16));
    assert_eq!((apps.apps.len(), apps.left_out), (0, 2));
}

#[test]
fn an_answer_has_its_maximum_of_entries_and_not_one_more() {
    assert!(decode::<AppsReport>(&encode(&report(super::APPS_MAX as u32))).is_ok());
    assert!(decode::<AppsReport>(&encode(&report(super::APPS_MAX as u32 + 1))).is_err());
}

/// The watchdog of a test that waits.
const DEADLINE: Duration = Duration::from_secs(60);

struct Ledger(SyncSender<Outcome>);

impl ReceiptSink for Ledger {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        self.0.send(outcome).expect("the test waits");
    }
}

/// A node without layers, and an application of it that asks.
struct Bench {
    stores: Arc<Stores>,
    asker: Tid,
    replies: Receiver<Message>,
}

impl Bench {
    fn new(config: NodeConfig) -> Self {
        let stores = Stores::for_test(config, Incarnation(1));
        super::begin(&stores).expect("a thread");
        let (put, replies) = sync_channel(8);
        let asker = Tid::new(stores.node, AppAddress::fixed(0).expect("the first one"));
        let route = LocalRoute { outlet: Arc::new(Inbox(put)), events: Arc::new([]) };
        stores.router.set_local(asker.app, route);
        Self { stores, asker, replies }
    }

    /// What becomes of a question of this kind.
    fn outcome(&self, kind: Kind, flags: Flags) -> Outcome {
        let (say, heard) = sync_channel(1);
        let to = Tid::new(self.stores.node, AppAddress::INSPECT);
        let mut message = Message::new(Header::new(kind, self.asker, to), bytes::Bytes::from_static(&[0x80]));
        message.header.flags = flags;
        message.header.correlation = 7;
        message.receipt = Some(Receipt::new(Arc::new(Ledger(say)), message.ticket()));
        self.stores.router.send(message).expect("there is room");
        heard.recv_timeout(DEADLINE).expect("every question ends")
    }

    fn reply(&self) -> Message {
        self.replies.recv_timeout(DEADLINE).expect("a reply")
    }

    fn node(&self) -> NodeReport {
        assert_eq!(self.outcome(AskNode::KIND, Flags::ASK), Outcome::Delivered);
        self.reply().decode().expect("a report")
    }
}

#[test]
fn a_question_is_answered_and_what_is_none_is_refused() {
    // Given
    let bench = Bench::new(NodeConfig::new("knee"));
    // When, then
    assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Delivered);
    let reply = bench.reply();
    let said: NodeReport = reply.decode().expect("a report");
    assert_eq!((said.name.as_str(), said.incarnation, said.peers.len()), ("knee", Incarnation(1), 0));
    assert!(reply.header.flags.has(Flags::REPLY) && reply.header.correlation == 7);
    let refused = Outcome::Rejected;
    assert_eq!(bench.outcome(AskNode::KIND, Flags::NONE), refused(Rejection::Unsupported));
    assert_eq!(bench.outcome(Kind::named("test.other"), Flags::ASK), refused(Rejection::UnknownKind));
    assert_eq!(bench.outcome(Kind::PING, Flags::NONE), Outcome::Delivered);
    // And: a question whose answer cannot be had does not cost the next one
    drop(bench.stores.posts.root.close());
    assert_eq!(bench.outcome(AskTree::KIND, Flags::ASK), refused(Rejection::Closed));
    assert_eq!(bench.outcome(AskApps::KIND, Flags::ASK), Outcome::Delivered);
}

#[test]
fn a_node_says_whether_it_is_open_to_whom_and_until_when_its_certificate_counts() {
    let said = |bench: &Bench| -> NodeReport {
        assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Delivered);
        bench.reply().decode().expect("a report")
    };
    // Given: one that others cannot reach, one that they can, and one with keys
    let alone = Bench::new(NodeConfig::new("knee"));
    let mut config = NodeConfig::new("knee");
    config.ndl.interface = Ipv4Addr::new(192, 0, 2, 7).into();
    config.security.times = TimePolicy::Strict;
    let (open, secured) = (Bench::new(config.clone()), Bench::new(config));
    let credentials = Authority::new("walker").credentials("knee", 7);
    let own = Secured::new(ground::tls(&credentials), &credentials, 8, Incarnation(1));
    assert!(secured.stores.secured.set(own).is_ok(), "it had none");
    // Then
    let of = |bench: &Bench| said(bench).security.expect("it says so");
    assert_eq!(of(&alone), SecurityReport { is_beyond_host: false, certificate: None });
    assert_eq!(of(&open), SecurityReport { is_beyond_host: true, certificate: None });
    let is_default = |bench| said(bench).is_interface_default;
    assert_eq!((is_default(&alone), is_default(&open)), (Some(true), Some(false)));
    let certificate = of(&secured).certificate.expect("it has one");
    let (from, until) = (ground::NOW - ground::DAY, ground::NOW + 365 * ground::DAY);
    assert_eq!((certificate.from_s, certificate.until_s), (from, until));
    assert_eq!(certificate.times, "strict");
    assert!(certificate.clock_s > 0, "by its own clock");
    // And: one that looks for others on its own host, and listens or is announced on a network besides
    let [mut further, mut forwarded] = [NodeConfig::new("knee"), NodeConfig::new("knee")];
    further.gncl.further = vec![Ipv4Addr::new(192, 0, 2, 7)];
    forwarded.gncl.announce = Some(SocketAddrV4::new(Ipv4Addr::new(192, 0, 2, 7), 7_000));
    for config in [further, forwarded] {
        assert!(of(&Bench::new(config)).is_beyond_host);
    }
    let mut beside = NodeConfig::new("knee");
    beside.gncl.further = vec![Ipv4Addr::new(127, 0, 0, 2)];
    assert!(!of(&Bench::new(beside)).is_beyond_host);
    // And: who says nothing of it is of an older version, which is not the same as open
    let mut bytes = encode(&said(&open)).to_vec();
    let key = b"security";
    let at = bytes.windows(key.len()).position(|window| window == key).expect("a field of the map");
    bytes[at] = b'x';
    let older: NodeReport = decode(&bytes).expect("unknown fields are skipped");
    assert_eq!(older.security, None);
}

#[test]
fn an_answer_is_no_longer_than_a_payload_may_be() {
    let mut config = NodeConfig::new("knee");
    config.payload_max = 64;
    let bench = Bench::new(config);
    // Without peers, losses and refusals there is nothing to leave out of it.
    assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Rejected(Rejection::TooLong));
    assert_eq!(bench.outcome(AskApps::KIND, Flags::ASK), Outcome::Delivered);
    assert!(bench.reply().payload.len() <= 64);
}

impl Bench {
    /// The application of this number and name is ready, and waits at a barrier of each of these names for itself and these others.
    fn waits(&self, (number, name): (u32, String), barriers: &[String], others: &[String]) {
        let app = AppAddress::fixed(number).expect("a low number");
        let mut sync = lock(&self.stores.sync);
        let mut hears = |input| sync.handle(Time::now(), input);
        let registered = AppFact::own_registered(app, Some(name.clone()), Vec::new());
        hears(Input::AppChanged(registered));
        hears(Input::AppChanged(AppFact::Ready { app }));
        for (correlation, barrier) in (1..).zip(barriers) {
            let asked = ArriveAtBarrier {
                kind: BarrierKind::Meeting,
                barrier: barrier.clone(),
                parties: [std::slice::from_ref(&name), others].concat(),
                within_ms: 60_000,
                on_loss: OnPartyLoss::Wait,
            };
            hears(Input::Arrived { app, correlation, asked });
        }
    }

    fn apps(&self) -> AppsReport {
        assert_eq!(self.outcome(AskApps::KIND, Flags::ASK), Outcome::Delivered);
        self.reply().decode().expect("a report")
    }
}

// spec: INSPECT-3
#[test]
fn barriers_that_have_no_room_in_an_answer_are_counted() {
    // Given: more than an answer names
    let bench = Bench::new(NodeConfig::new("knee"));
    for number in 0..5 {
        let barriers: Vec<_> = (0..14).map(|round| format!("round {number}.{round}")).collect();
        bench.waits((number, format!("knee.{number}")), &barriers, &["hip".to_owned()]);
    }
    // When, then
    let said = bench.apps();
    assert_eq!((said.barriers.len(), said.barriers_left_out, said.apps.len()), (64, 6, 5));
    // And: a version that counts none has left none out, as far as it says
    let mut bytes = encode(&said).to_vec();
    let key = b"barriers_left_out";
    let at = bytes.windows(key.len()).position(|window| window == key).expect("a field of the map");
    bytes[at] = b'x';
    let older: AppsReport = decode(&bytes).expect("unknown fields are skipped");
    assert_eq!((older.barriers.len(), older.barriers_left_out), (64, 0));
}

// spec: INSPECT-3
#[test]
fn what_an_application_lacks_beyond_what_an_answer_names_is_counted() {
    // Given: one that waits at two phases, each for 40 others
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
        lock(&bench.stores.sync).handle(Time::now(), Input::Arrived { app, correlation, asked });
    }
    // When, then: who asks can read it
    let said = bench.apps();
    assert_eq!((said.apps[0].missing.len(), said.apps[0].missing_left_out), (64, 16));
    assert!(said.barriers.iter().all(|phase| (phase.missing.len(), phase.missing_left_out) == (40, 0)));
}

// spec: INSPECT-3
#[test]
fn a_barrier_that_is_longer_than_a_payload_may_be_does_not_keep_the_applications_from_being_told() {
    // Given: a barrier of many long names, of which none is there
    let mut config = NodeConfig::new("knee");
    config.payload_max = 4_096;
    let bench = Bench::new(config);
    let others: Vec<_> = (0..27).map(|number| format!("{number:02}.{}", "a".repeat(60))).collect();
    bench.waits((0, "knee.drive".to_owned()), &["calibrated".to_owned()], &others);
    assert_eq!(lock(&bench.stores.sync).barriers(Time::now()).len(), 1, "it waits there");
    // When, then
    let said = bench.apps();
    assert_eq!((said.barriers.len(), said.barriers_left_out), (0, 1));
    assert_eq!((said.apps.len(), said.left_out), (1, 0));
}

#[test]
fn a_node_says_what_of_its_own_does_not_get_on() {
    // Given
    let bench = Bench::new(NodeConfig::new("knee"));
    let part = |app: u32| {
        let (name, trouble) = (format!("drive.{app:x}"), Told(Trouble::Stalled));
        Part { app: AppAddress::new(app), name, trouble, since_ms: 300 }
    };
    let progress = Progress::of((0x1000..0x1005).map(part).collect());
    lock(&bench.stores.ndl).handle(Time::now(), ndl::Input::ProgressSeen(progress));
    // When, then
    let said = bench.node();
    assert_eq!((said.troubled, said.troubles.len()), (5, 4));
    let app = Tid::new(bench.stores.node, AppAddress::new(0x1000));
    let (name, trouble) = ("drive.1000".to_owned(), "stalled".to_owned());
    assert_eq!(said.troubles[0], TroubleReport { app, name, trouble, since_us: 300_000 });
    // And: a version that does not say so has none, as far as it says
    let mut bytes = encode(&said).to_vec();
    for key in [&b"troubled"[..], b"troubles"] {
        let at = bytes.windows(key.len()).position(|window| window == key).expect("a field of the map");
        bytes[at] = b'x';
    }
    let older: NodeReport = decode(&bytes).expect("unknown fields are skipped");
    assert_eq!((older.troubled, older.troubles), (0, Vec::new()));
}

/// The same of a node that knows four others, and has lost and refused so many that this takes most room.
fn with_long_lists(said: NodeReport) -> NodeReport {
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
        peers: (0..4).map(|number| PeerReport::lost(NodeAddress::new(number), incarnation)).collect(),
        troubled: 7,
        troubles: vec![trouble; 4],
        idle_clients: 3,
        idle: vec![IdleReport { app, name, since_us }; 2],
        ..said
    }
}

// spec: INSPECT-3
#[test]
fn of_what_a_node_says_the_longest_list_yields_first_and_what_has_no_room_is_counted() {
    // Given
    let mut said = with_long_lists(Bench::new(NodeConfig::new("knee")).node());
    let payload_max = 8 * 1024;
    assert!(encode(&said).len() > payload_max);
    // When
    while encode(&said).len() > payload_max {
        assert!(said.halve(), "the rest has room");
    }
    // Then: the few nodes that it knows are all told, and of the others some
    assert_eq!((said.peers.len(), said.left_out), (4, 0));
    assert_eq!((said.troubles.len(), said.idle.len()), (4, 2));
    assert!(!said.lost.is_empty() && !said.refusals.is_empty() && !said.foreign.is_empty());
    assert!(said.lost_left_out > 0 && said.refusals_left_out > 0);
    assert_eq!(said.lost.len() as u64 + said.lost_left_out, 64);
    assert_eq!(said.refusals.len() as u64 + said.refusals_left_out, 64);
    let left = said.refusals.iter().map(|refusal| refusal.ago_us);
    assert!(left.eq(0..said.refusals.len() as u64), "the oldest ones go first");
    // And: where there is room for nothing all of them go
    while said.halve() {}
    assert_eq!((said.left_out, said.lost_left_out), (4, 64));
    assert_eq!((said.foreign_left_out, said.refusals_left_out), (16, 64));
    assert_eq!((said.troubled, said.troubles.len(), said.idle_clients, said.idle.len()), (7, 0, 3, 0));
}

// spec: INSPECT-3
#[test]
fn a_node_that_has_refused_much_answers_though_little_has_room() {
    // Given: more causes than an answer names, with details of which so many have no room
    let mut config = NodeConfig::new("knee");
    config.payload_max = 16 * 1024;
    let bench = Bench::new(config);
    for number in 0..70 {
        let cause: &'static str = Box::leak(format!("cause {number}").into_boxed_str());
        bench.stores.refusals.count(Time::now(), cause, &"x".repeat(300));
    }
    // When, then
    let said = bench.node();
    assert_eq!((said.refusals.len(), said.refusals_left_out), (32, 38));
}

#[test]
fn a_node_says_each_group_that_it_asks() {
    let said = |interface: &[&str], change: fn(&mut NodeConfig)| -> NodeReport {
        let mut config = NodeConfig::new("knee");
        let chosen = interface.iter().map(|text| text.parse::<Interface>().expect("an interface"));
        config.ndl.interface = chosen.collect::<Vec<_>>().into();
        change(&mut config);
        let bench = Bench::new(config);
        assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Delivered);
        bench.reply().decode().expect("a report")
    };
    let (ipv4, ipv6) = ("239.255.83.119:6910", "[ff12::8000:5377]:6910");
    let as_it_is: fn(&mut NodeConfig) = |_| {};
    for (interface, change, groups) in [
        (&["eth0"][..], as_it_is, &[ipv4, ipv6][..]),
        (&["eth0/ipv4"], as_it_is, &[ipv4]),
        (&["eth0/ipv6"], as_it_is, &[ipv6]),
        (&["10.0.0.7", "fe80::7%eth0"], as_it_is, &[ipv4, ipv6]),
        // There are no groups at ::1.
        (&["lo"], as_it_is, &[ipv4]),
        (&["::1"], as_it_is, &[]),
        (&["lo", "eth0/ipv6"], as_it_is, &[ipv4, ipv6]),
        (&["eth0"], |config| config.ndl.multicast6 = None, &[ipv4]),
        (&["eth0"], |config| config.ndl.multicast = None, &[]),
    ] {
        let report = said(interface, change);
        assert_eq!(report.groups, groups, "{interface:?}");
        // Who knows `group` alone is told the first.
        assert_eq!(report.group.as_deref(), groups.first().copied(), "{interface:?}");
    }
}

#[test]
fn nobody_answers_for_a_node_that_has_ended() {
    let bench = Bench::new(NodeConfig::new("knee"));
    bench.stores.close();
    let to = Tid::new(bench.stores.node, AppAddress::INSPECT);
    let late = Message::new(Header::new(Kind::PING, bench.asker, to), bytes::Bytes::new());
    assert_eq!(bench.stores.router.send(late), Err(Rejection::NoSuchApplication));
}
