//! What senders of unconfirmed messages are told that were not delivered: on one node, between two, from and to endpoints.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use sinew::{
    NodeApi, Registration, inspect,
    message::{Kind, Rejection, Sender},
    prelude::*,
};
use sinew_tests::{DEADLINE, Ground, OwnDirectory, all_run, until};

payload!("undelivered.angle", Control => #[derive(Debug)] struct Angle { degrees: f32 });
payload!("undelivered.torque", Stream => #[derive(Debug)] struct Torque { newton_metres: f32 });

/// The same type's name with another shape.
mod other {
    use super::*;
    payload!("undelivered.torque", Control => #[derive(Debug)] pub(super) struct Torque { text: String });
    pub(super) fn torque() -> Torque {
        Torque { text: "much".to_owned() }
    }
}

const ANGLE: Angle = Angle { degrees: 1.0 };

/// Handles reports, and lends its sending side.
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

struct Told {
    sender: Receiver<Sender>,
    reports: Receiver<Undelivered>,
}

impl Told {
    fn sender(&self) -> Sender {
        self.sender.recv_timeout(DEADLINE).expect("hip starts")
    }

    fn next(&self) -> Undelivered {
        self.reports.recv_timeout(DEADLINE).expect("a report")
    }
}

fn hip() -> (AppSpec<Hip>, Told) {
    let (say, reports) = sync_channel(1_000);
    let (lend, sender) = sync_channel(8);
    let spec = AppSpec::new("hip", move || Hip(say.clone(), lend.clone())).handles::<Undelivered>();
    (spec, Told { sender, reports })
}

/// Forgets to handle [`Angle`].
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

/// What is said of a forgotten handler.
fn is_of_angle(said: &Undelivered, to: Tid) {
    assert_eq!((said.destination, said.name.as_deref()), (to, Some("knee")));
    assert_eq!((said.kind, said.class), (Some(Angle::KIND), Some(Class::Control)));
    assert_eq!((said.why, said.count), (Rejection::UnknownKind, 1));
    assert!(said.first_sequence.is_some() && said.first_sequence == said.last_sequence, "{said:?}");
}

#[test]
fn an_actor_is_told_at_once_that_a_type_is_not_handled_and_then_with_counts() {
    const MORE: u64 = 500;
    let (hip, told) = hip();
    let node = Ground::new().node("leg").app(hip).app(knee()).start().expect("a node");
    all_run(&[&node]);
    let sender = told.sender();
    sender.send("knee", &ANGLE).expect("its mailbox takes it");
    is_of_angle(&told.next(), sender.resolve("knee").expect("it runs"));
    for _ in 0..MORE {
        sender.send("knee", &ANGLE).expect("its mailbox takes it");
        // Its mailbox has room for all that it has not refused yet.
        std::thread::yield_now();
    }
    let mut count = 0;
    while count < MORE {
        count += told.next().count;
    }
    assert_eq!(count, MORE);
}

#[test]
fn an_actor_is_told_what_another_node_did_not_handle_or_could_not_read() {
    let ground = Ground::new();
    let (hip, told) = hip();
    let there = ground.node("shank").app(knee()).start().expect("a node");
    let here = ground.node("thigh").app(hip.requires(["knee"])).start().expect("a node");
    all_run(&[&here, &there]);
    let sender = told.sender();
    let to = sender.resolve("knee").expect("it is required");
    sender.send(to, &ANGLE).expect("it is connected");
    is_of_angle(&told.next(), to);
    sender.send(to, &other::torque()).expect("it is connected");
    let said = told.next();
    assert_eq!((said.destination, said.kind, said.why), (to, Some(Torque::KIND), Rejection::Malformed));
    sender
        .send(Tid::new(to.node, AppAddress::fixed(9).expect("in the range")), &ANGLE)
        .expect("it is connected");
    assert_eq!(told.next().why, Rejection::NoSuchApplication);
}

#[test]
fn a_member_of_a_group_that_does_not_handle_a_type_is_one_report_and_a_broadcast_is_none() {
    let ground = Ground::new();
    let (hip, told) = hip();
    let there = ground.node("shank").app(knee()).start().expect("a node");
    let here = ground.node("thigh").app(hip.requires(["knee"])).start().expect("a node");
    all_run(&[&here, &there]);
    let sender = told.sender();
    sender.send(Tid::new(NodeAddress::ALL, AppAddress::ALL), &ANGLE).expect("it is connected");
    // It reaches nobody until the group is known here.
    let said = until("a report", || {
        let _ = sender.send(Tid::group("legs"), &ANGLE);
        told.reports.recv_timeout(Duration::from_millis(20)).ok()
    });
    assert_eq!(said.destination, Tid::group("legs"), "the broadcast came first: {said:?}");
    assert_eq!((said.kind, said.why), (Some(Angle::KIND), Rejection::UnknownKind));
}

#[test]
fn an_endpoint_is_told_what_an_actor_of_another_node_does_not_handle() {
    let (ground, directory) = (Ground::new(), OwnDirectory::new());
    let socket = directory.join("thigh.sock");
    let there = ground.node("shank").app(knee()).start().expect("a node");
    let path = socket.clone();
    let here = ground.node("thigh").configure(move |config| config.lncl.socket = Some(path));
    let here = here.start().expect("a node");
    all_run(&[&here, &there]);
    let api = NodeApi::connect(&socket).expect("its socket");
    let wanted = Registration::new().name("gait").requires(["knee"]).deadline(DEADLINE);
    let mut gait = api.register_transport_address(wanted).expect("the knee is there");
    let to = gait.resolve("knee", DEADLINE).expect("the node answers").expect("it is required");
    gait.send(to, &ANGLE).expect("the node takes it");
    let said = until("a report", || {
        drop(gait.receive(Duration::from_millis(10)).expect("the node is up"));
        gait.take_undelivered()
    });
    is_of_angle(&said, to);
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
fn an_actor_is_told_that_an_endpoint_of_another_node_has_gone() {
    let (ground, directory) = (Ground::new(), OwnDirectory::new());
    let socket = directory.join("shank.sock");
    let (hip, told) = hip();
    let path = socket.clone();
    let there = ground.node("shank").configure(move |config| config.lncl.socket = Some(path));
    let there = there.start().expect("a node");
    let api = NodeApi::connect(&socket).expect("its socket");
    let gait = api.register_transport_address(Registration::new().name("gait")).expect("a free name");
    let here = ground.node("thigh").app(hip.requires(["gait"])).start().expect("a node");
    all_run(&[&here, &there]);
    let (sender, to) = (told.sender(), gait.tid());
    drop(gait);
    until("it is gone", || sender.resolve("gait").is_none().then_some(()));
    sender.send(to, &ANGLE).expect("its node is connected");
    let said = told.next();
    assert_eq!((said.destination, said.count), (to, 1));
    assert_eq!((said.kind, said.why), (Some(Angle::KIND), Rejection::NoSuchApplication));
}
