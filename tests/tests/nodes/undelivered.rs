//! Reports of undelivered unconfirmed messages to their senders: on one node, between two, from and to
//! endpoints.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use sinew::{
    NodeApi, Registration, inspect,
    message::{Kind, Rejection, Sender},
    prelude::*,
};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory, all_run, until};

payload!("undelivered.angle", Control => #[derive(Debug)] struct Angle { degrees: f32 });
payload!("undelivered.torque", Stream => #[derive(Debug)] struct Torque { newton_metres: f32 });

/// The same type name with another structure.
mod other {
    use super::*;
    payload!("undelivered.torque", Control => #[derive(Debug)] pub(super) struct Torque { text: String });
    pub(super) fn torque() -> Torque {
        Torque { text: "much".to_owned() }
    }
}

const ANGLE: Angle = Angle { degrees: 1.0 };

/// Handles reports, and passes on its sender.
struct Hip(SyncSender<Undelivered>, SyncSender<Sender>);

impl Actor for Hip {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.1.send(context.sender()).expect("the test listens");
    }
}

impl Handler<Delivery<Undelivered>> for Hip {
    type Result = ();

    fn handle(&mut self, undelivered: Delivery<Undelivered>, _: &mut Self::Context) {
        self.0.send(undelivered.payload).expect("the test listens");
    }
}

struct HipProbe {
    sender: Receiver<Sender>,
    reports: Receiver<Undelivered>,
}

impl HipProbe {
    fn sender(&self) -> Sender {
        self.sender.recv_timeout(DEADLINE).expect("hip starts")
    }

    fn next(&self) -> Undelivered {
        self.reports.recv_timeout(DEADLINE).expect("a report")
    }
}

fn hip() -> (AppSpec<Hip>, HipProbe) {
    let (report, reports) = sync_channel(1_000);
    let (lend, sender) = sync_channel(8);
    let spec = AppSpec::new("hip", move || Hip(report.clone(), lend.clone())).handles::<Undelivered>();
    (spec, HipProbe { sender, reports })
}

/// Lacks a handler for [`Angle`].
struct Knee;

impl Actor for Knee {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.join("legs");
    }
}

impl Handler<Delivery<Torque>> for Knee {
    type Result = ();

    fn handle(&mut self, _: Delivery<Torque>, _: &mut Self::Context) {}
}

fn knee() -> AppSpec<Knee> {
    AppSpec::new("knee", || Knee).handles::<Torque>()
}

/// Checks the report of a missing handler.
fn is_of_angle(report: &Undelivered, to: Tid) {
    assert_eq!((report.destination, report.name.as_deref()), (to, Some("knee")));
    assert_eq!((report.kind, report.class), (Some(Angle::KIND), Some(Class::Control)));
    assert_eq!((report.why, report.count), (Rejection::UnknownKind, 1));
    assert!(report.first_sequence.is_some() && report.first_sequence == report.last_sequence, "{report:?}");
}

#[test]
fn unhandled_type_is_reported_at_once_then_with_counts() {
    const MORE: u64 = 500;
    let (hip, probe) = hip();
    let node = Loopback::new().node("leg").app(hip).app(knee()).start().expect("a node");
    all_run(&[&node]);
    let sender = probe.sender();
    sender.send("knee", &ANGLE).expect("its mailbox takes it");
    is_of_angle(&probe.next(), sender.resolve("knee").expect("it runs"));
    for _ in 0..MORE {
        // A full mailbox refuses a message until its application has read some.
        until("room in its mailbox", || sender.send("knee", &ANGLE).ok());
    }
    let mut count = 0;
    while count < MORE {
        count += probe.next().count;
    }
    assert_eq!(count, MORE);
}

#[test]
fn remote_rejections_are_reported_to_an_actor() {
    let loopback = Loopback::new();
    let (hip, probe) = hip();
    let there = loopback.node("shank").app(knee()).start().expect("a node");
    let here = loopback.node("thigh").app(hip.requires(["knee"])).start().expect("a node");
    all_run(&[&here, &there]);
    let sender = probe.sender();
    let to = sender.resolve("knee").expect("it is required");
    sender.send(to, &ANGLE).expect("it is connected");
    is_of_angle(&probe.next(), to);
    sender.send(to, &other::torque()).expect("it is connected");
    let report = probe.next();
    assert_eq!((report.destination, report.kind, report.why), (to, Some(Torque::KIND), Rejection::Malformed));
    sender
        .send(Tid::new(to.node, AppAddress::fixed(9).expect("in the range")), &ANGLE)
        .expect("it is connected");
    assert_eq!(probe.next().why, Rejection::NoSuchApplication);
}

#[test]
fn group_member_without_handler_is_reported_once() {
    let loopback = Loopback::new();
    let (hip, probe) = hip();
    let there = loopback.node("shank").app(knee()).start().expect("a node");
    let here = loopback.node("thigh").app(hip.requires(["knee"])).start().expect("a node");
    all_run(&[&here, &there]);
    let sender = probe.sender();
    sender.send(Tid::new(NodeAddress::ALL, AppAddress::ALL), &ANGLE).expect("it is connected");
    // The message reaches no member until the group is known here.
    let report = until("a report", || {
        let _ = sender.send(Tid::group("legs"), &ANGLE);
        probe.reports.recv_timeout(Duration::from_millis(20)).ok()
    });
    assert_eq!(report.destination, Tid::group("legs"), "the broadcast came first: {report:?}");
    assert_eq!((report.kind, report.why), (Some(Angle::KIND), Rejection::UnknownKind));
}

#[test]
fn remote_rejections_are_reported_to_an_endpoint() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let socket = directory.join("thigh.sock");
    let there = loopback.node("shank").app(knee()).start().expect("a node");
    let path = socket.clone();
    let here = loopback.node("thigh").configure(move |config| config.lncl.socket = Some(path));
    let here = here.start().expect("a node");
    all_run(&[&here, &there]);
    let api = NodeApi::connect(&socket).expect("its socket");
    let wanted = Registration::new().name("gait").requires(["knee"]).deadline(DEADLINE);
    let mut gait = api.register_transport_address(wanted).expect("the knee is there");
    let to = gait.resolve("knee", DEADLINE).expect("the node answers").expect("it is required");
    gait.send(to, &ANGLE).expect("the node takes it");
    let report = until("a report", || {
        drop(gait.receive(Duration::from_millis(10)).expect("the node is up"));
        gait.take_undelivered()
    });
    is_of_angle(&report, to);
    // The node of the receiver shows it to `sinew why`.
    let inspect = Tid::new(to.node, AppAddress::INSPECT);
    let report: inspect::NodeReport =
        gait.message(inspect, &inspect::AskNode {}).ask(DEADLINE).expect("the node answers");
    let [unhandled] = &report.unhandled[..] else { panic!("{:?}", report.unhandled) };
    assert_eq!((unhandled.receiver, unhandled.sender, unhandled.count), (to, gait.tid(), 1));
    assert_eq!((unhandled.kind, unhandled.is_malformed), (Kind::named("undelivered.angle"), false));
    assert!(unhandled.remedy.contains(".handles::<Angle>()"), "{}", unhandled.remedy);
}

#[test]
fn departed_remote_endpoint_is_reported() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let socket = directory.join("shank.sock");
    let (hip, probe) = hip();
    let path = socket.clone();
    let there = loopback.node("shank").configure(move |config| config.lncl.socket = Some(path));
    let there = there.start().expect("a node");
    let api = NodeApi::connect(&socket).expect("its socket");
    let gait = api.register_transport_address(Registration::new().name("gait")).expect("a free name");
    let here = loopback.node("thigh").app(hip.requires(["gait"])).start().expect("a node");
    all_run(&[&here, &there]);
    let (sender, to) = (probe.sender(), gait.tid());
    drop(gait);
    until("it is gone", || sender.resolve("gait").is_none().then_some(()));
    sender.send(to, &ANGLE).expect("its node is connected");
    let report = probe.next();
    assert_eq!((report.destination, report.count), (to, 1));
    assert_eq!((report.kind, report.why), (Some(Angle::KIND), Rejection::NoSuchApplication));
}
