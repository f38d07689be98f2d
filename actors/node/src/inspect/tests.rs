//! Requests to the inspection: answered within bounds, refused, or too many.

mod contracts;
mod guards;
mod left_out;

use std::{
    net::{Ipv4Addr, SocketAddrV4},
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use sinew_model::{
    config::{Interface, NodeConfig},
    facts::Trouble,
    progress::{Part, Progress, TroubleCode},
};
use sinew_runtime::{
    lock,
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{LocalRoute, MessageSink as _},
    tid::{AppAddress, Incarnation, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload as _, decode, encode},
};
use sinew_security::{
    TimePolicy,
    node_security::NodeSecurity,
    testing::{self, Authority},
};

use super::{
    inspector::{Inbox, WAITING_MAX},
    reports::{AskApps, AskNode, AskTree, NodeReport, SecurityReport, TroubleReport},
};
use crate::NodeState;

fn question() -> Message {
    Message::new(Header::new(Kind::PING, Tid::NONE, Tid::NONE), bytes::Bytes::new())
}

#[test]
fn requests_beyond_the_queue_bound_are_refused() {
    // Given: no thread answers
    let (put, _questions) = sync_channel(WAITING_MAX);
    let inbox = Inbox(put);
    (0..WAITING_MAX).for_each(|_| assert!(inbox.submit(question()).is_ok()));
    // When, then
    assert_eq!(inbox.submit(question()).expect_err("one too many").why, Rejection::QueueFull);
}

#[test]
fn answering_thread_does_not_keep_a_node_alive() {
    let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
    super::begin(&state).expect("a thread");
    let weak = Arc::downgrade(&state);
    drop(state);
    assert!(weak.upgrade().is_none(), "no question was asked, so no thread holds it");
}

/// The watchdog of a test that waits.
const DEADLINE: Duration = Duration::from_secs(60);

struct Ledger(SyncSender<Outcome>);

impl ReceiptSink for Ledger {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        self.0.send(outcome).expect("the test waits");
    }
}

/// A node without layers, and an application of it that sends requests.
struct Bench {
    state: Arc<NodeState>,
    requester: Tid,
    replies: Receiver<Message>,
}

impl Bench {
    fn new(config: NodeConfig) -> Self {
        let state = NodeState::for_test(config, Incarnation(1));
        super::begin(&state).expect("a thread");
        let (put, replies) = sync_channel(8);
        let requester = Tid::new(state.ctx.node, AppAddress::fixed(0).expect("the first one"));
        let route = LocalRoute { sink: Arc::new(Inbox(put)), events: Arc::new([]) };
        state.ctx.router.set_local(requester.app, route);
        Self { state, requester, replies }
    }

    /// Returns the outcome of a request of this kind.
    fn outcome(&self, kind: Kind, flags: Flags) -> Outcome {
        let (sender, receiver) = sync_channel(1);
        let to = Tid::new(self.state.ctx.node, AppAddress::INSPECT);
        let mut message =
            Message::new(Header::new(kind, self.requester, to), bytes::Bytes::from_static(&[0x80]));
        message.header.flags = flags;
        message.header.correlation = 7;
        message.receipt = Some(Receipt::new(Arc::new(Ledger(sender)), message.ticket()));
        self.state.ctx.router.send(message).expect("there is room");
        receiver.recv_timeout(DEADLINE).expect("every question ends")
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
fn requests_are_answered_and_other_messages_refused() {
    // Given
    let bench = Bench::new(NodeConfig::new("knee"));
    // When, then
    assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Delivered);
    let reply = bench.reply();
    let report: NodeReport = reply.decode().expect("a report");
    assert_eq!((report.name.as_str(), report.incarnation, report.peers.len()), ("knee", Incarnation(1), 0));
    assert!(reply.header.flags.has(Flags::REPLY) && reply.header.correlation == 7);
    let refused = Outcome::Rejected;
    assert_eq!(bench.outcome(AskNode::KIND, Flags::NONE), refused(Rejection::Unsupported));
    assert_eq!(bench.outcome(Kind::named("test.other"), Flags::ASK), refused(Rejection::UnknownKind));
    assert_eq!(bench.outcome(Kind::PING, Flags::NONE), Outcome::Delivered);
    // And: a request without an available answer does not affect the next one
    drop(bench.state.root.close());
    assert_eq!(bench.outcome(AskTree::KIND, Flags::ASK), refused(Rejection::Closed));
    assert_eq!(bench.outcome(AskApps::KIND, Flags::ASK), Outcome::Delivered);
}

#[test]
fn node_reports_exposure_and_certificate_expiry() {
    let report_of = |bench: &Bench| -> NodeReport {
        assert_eq!(bench.outcome(AskNode::KIND, Flags::ASK), Outcome::Delivered);
        bench.reply().decode().expect("a report")
    };
    // Given: a node that others cannot reach, an open one that others can reach, and one with keys
    let alone = Bench::new(NodeConfig::new("knee"));
    let mut config = NodeConfig::new("knee");
    config.ndl.interface = Ipv4Addr::new(192, 0, 2, 7).into();
    config.security.times = TimePolicy::Strict;
    let (open, secured) = (Bench::new(config.clone()), Bench::new(config));
    let credentials = Authority::new("walker").credentials("knee", 7);
    let own = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(1));
    assert!(secured.state.security.secured.set(own).is_ok(), "it had none");
    // Then
    let of = |bench: &Bench| report_of(bench).security.expect("it says so");
    assert_eq!(of(&alone), SecurityReport { is_beyond_host: false, certificate: None });
    assert_eq!(of(&open), SecurityReport { is_beyond_host: true, certificate: None });
    let is_default = |bench| report_of(bench).is_interface_default;
    assert_eq!((is_default(&alone), is_default(&open)), (Some(true), Some(false)));
    let certificate = of(&secured).certificate.expect("it has one");
    let (from, until) = (testing::NOW - testing::DAY, testing::NOW + 365 * testing::DAY);
    assert_eq!((certificate.from_s, certificate.until_s), (from, until));
    assert_eq!(certificate.times, "strict");
    assert!(certificate.clock_s > 0, "by its own clock");
    // And: a node that discovers others on its own host, but also listens or is announced on a network
    let [mut further, mut forwarded] = [NodeConfig::new("knee"), NodeConfig::new("knee")];
    further.gncl.further = vec![Ipv4Addr::new(192, 0, 2, 7)];
    forwarded.gncl.announce = Some(SocketAddrV4::new(Ipv4Addr::new(192, 0, 2, 7), 7_000));
    for config in [further, forwarded] {
        assert!(of(&Bench::new(config)).is_beyond_host);
    }
    let mut beside = NodeConfig::new("knee");
    beside.gncl.further = vec![Ipv4Addr::new(127, 0, 0, 2)];
    assert!(!of(&Bench::new(beside)).is_beyond_host);
    // And: a report without this field is from an older version, which does not mean that the node is open
    let mut bytes = encode(&report_of(&open)).to_vec();
    let key = b"security";
    let at = bytes.windows(key.len()).position(|window| window == key).expect("a field of the map");
    bytes[at] = b'x';
    let older: NodeReport = decode(&bytes).expect("unknown fields are skipped");
    assert_eq!(older.security, None);
}

#[test]
fn node_reports_its_own_troubles() {
    // Given
    let bench = Bench::new(NodeConfig::new("knee"));
    let part = |app: u32| {
        let (name, trouble) = (format!("drive.{app:x}"), TroubleCode(Trouble::Stalled));
        Part { app: AppAddress::new(app), name, trouble, since_ms: 300 }
    };
    let progress = Progress::of((0x1000..0x1005).map(part).collect());
    lock(&bench.state.ndl.core).handle(Time::now(), sinew_ndl::Input::ProgressSeen(progress));
    // When, then
    let report = bench.node();
    assert_eq!((report.troubled, report.troubles.len()), (5, 4));
    let app = Tid::new(bench.state.ctx.node, AppAddress::new(0x1000));
    let (name, trouble) = ("drive.1000".to_owned(), "stalled".to_owned());
    assert_eq!(report.troubles[0], TroubleReport { app, name, trouble, since_us: 300_000 });
    // And: the report of a version without this field decodes as no troubles
    let mut bytes = encode(&report).to_vec();
    for key in [&b"troubled"[..], b"troubles"] {
        let at = bytes.windows(key.len()).position(|window| window == key).expect("a field of the map");
        bytes[at] = b'x';
    }
    let older: NodeReport = decode(&bytes).expect("unknown fields are skipped");
    assert_eq!((older.troubled, older.troubles), (0, Vec::new()));
}

#[test]
fn node_reports_each_group_that_it_queries() {
    let report_of = |interface: &[&str], change: fn(&mut NodeConfig)| -> NodeReport {
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
        // ::1 has no groups.
        (&["lo"], as_it_is, &[ipv4]),
        (&["::1"], as_it_is, &[]),
        (&["lo", "eth0/ipv6"], as_it_is, &[ipv4, ipv6]),
        (&["eth0"], |config| config.ndl.multicast6 = None, &[ipv4]),
        (&["eth0"], |config| config.ndl.multicast = None, &[]),
    ] {
        let report = report_of(interface, change);
        assert_eq!(report.groups, groups, "{interface:?}");
        // A reader that knows only `group` gets the first.
        assert_eq!(report.group.as_deref(), groups.first().copied(), "{interface:?}");
    }
}

#[test]
fn ended_node_gives_no_answer() {
    let bench = Bench::new(NodeConfig::new("knee"));
    bench.state.close();
    let to = Tid::new(bench.state.ctx.node, AppAddress::INSPECT);
    let late = Message::new(Header::new(Kind::PING, bench.requester, to), bytes::Bytes::new());
    assert_eq!(bench.state.ctx.router.send(late), Err(Rejection::NoSuchApplication));
}
