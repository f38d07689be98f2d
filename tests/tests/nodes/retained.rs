//! The last value of a group for members that join later, on two nodes.

use std::{path::Path, sync::mpsc::SyncSender};

use sinew::{Endpoint, NodeApi, Registration, client::Received, prelude::*};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory, all_run, sees, until};

payload!("retained.mode", retained => #[derive(Debug, PartialEq)] struct Mode { number: u64 });
payload!("retained.marker" => struct Marker;);

const GROUP: &str = "modes";

/// A node with its client socket at `socket`.
fn node(loopback: &Loopback, name: &str, socket: &Path) -> NodeBuilder {
    let socket = socket.to_owned();
    loopback.node(name).configure(move |config| config.lncl.socket = Some(socket))
}

fn client(socket: &Path, registration: Registration) -> Endpoint {
    let api = NodeApi::connect(socket).expect("the socket is open");
    api.register_transport_address(registration).expect("an address")
}

fn member(socket: &Path) -> Endpoint {
    let mut member = client(socket, Registration::new());
    member.join(GROUP).expect("the node answers");
    member
}

fn next(endpoint: &mut Endpoint) -> Received {
    endpoint.receive(DEADLINE).expect("its connection stands").expect("a message comes")
}

/// The next mode, and whether it is a retained one.
fn next_mode(endpoint: &mut Endpoint) -> (u64, bool) {
    let received = next(endpoint);
    (received.decode::<Mode>().expect("a mode").number, received.is_retained())
}

fn send(endpoint: &mut Endpoint, number: u64) {
    endpoint.send(Tid::group(GROUP), &Mode { number }).expect("the node takes it");
}

/// Waits until the node of this endpoint has read its messages: it answers in their order.
fn has_read(endpoint: &mut Endpoint) {
    let _ = endpoint.resolve("sender", DEADLINE).expect("the node answers");
}

/// Two linked nodes, and the sockets of their clients.
struct Scene {
    sockets: [std::path::PathBuf; 2],
    _nodes: [Node; 2],
    _directory: TestDirectory,
}

impl Scene {
    fn new() -> Self {
        let (loopback, directory) = (Loopback::new(), TestDirectory::new());
        let sockets = ["hip", "knee"].map(|name| directory.join(&format!("{name}.sock")));
        let hip = node(&loopback, "hip", &sockets[0]).start().expect("a node");
        let knee = node(&loopback, "knee", &sockets[1]).start().expect("a node");
        sees(&hip.handle(), knee.handle().address());
        sees(&knee.handle(), hip.handle().address());
        Self { sockets, _nodes: [hip, knee], _directory: directory }
    }
}

#[test]
fn late_member_elsewhere_gets_newest_value_once_and_first() {
    // Given: a value that was sent before the first member joined
    let scene = Scene::new();
    let [hip, knee] = &scene.sockets;
    let mut sender = client(hip, Registration::new());
    send(&mut sender, 1);
    send(&mut sender, 2);
    has_read(&mut sender);
    // When: a first member joins. Then: it gets the newest one
    let mut first = member(knee);
    let received = next(&mut first);
    assert_eq!(
        (received.decode::<Mode>().expect("a mode"), received.is_retained()),
        (Mode { number: 2 }, true)
    );
    assert_eq!(received.source(), sender.tid());
    received.settle(Outcome::Delivered);
    send(&mut sender, 3);
    assert_eq!(next_mode(&mut first), (3, false));
    // And: a second one, and the first one again
    let mut second = member(knee);
    assert_eq!(next_mode(&mut second), (3, true));
    first.leave(GROUP).expect("the node answers");
    first.join(GROUP).expect("the node answers");
    assert_eq!(next_mode(&mut first), (3, true));
    // And: one of the sender's node
    let mut here = member(hip);
    assert_eq!(next_mode(&mut here), (3, true));
    send(&mut sender, 4);
    for endpoint in [&mut first, &mut second, &mut here] {
        assert_eq!(next_mode(endpoint), (4, false), "nothing came twice");
    }
}

#[test]
fn late_member_gets_no_cleared_or_ended_value() {
    for ends in [false, true] {
        // Given: a member on the other node that has a value
        let scene = Scene::new();
        let [hip, knee] = &scene.sockets;
        let mut sender = client(hip, Registration::new().name("sender"));
        let mut marking = client(hip, Registration::new());
        let mut first = member(knee);
        send(&mut sender, 1);
        assert_eq!(next_mode(&mut first).0, 1);
        // When
        if ends {
            drop(sender);
            until("its address is free", || {
                marking.resolve("sender", DEADLINE).expect("the node answers").is_none().then_some(())
            });
        } else {
            sender.clear_retained::<Mode>(GROUP).expect("the node takes it");
            has_read(&mut sender);
        }
        // The removal is before the marker.
        let mut mark = || marking.send(Tid::group(GROUP), &Marker).expect("the node takes it");
        mark();
        assert_eq!(next(&mut first).kind(), Marker::KIND, "a removal reaches no member");
        // Then
        let mut members = [member(hip), member(knee)];
        mark();
        for member in &mut members {
            assert_eq!(next(member).kind(), Marker::KIND);
        }
    }
}

/// Sends a mode when it starts.
struct Announcer;

impl Actor for Announcer {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.send(Tid::group(GROUP), &Mode { number: 7 }).expect("its node retains it");
    }
}

/// Joins when it starts, and reports each mode: its number, whether it is a retained one, and whether it has an age.
struct Listener(SyncSender<(u64, bool)>);

impl Actor for Listener {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.join(GROUP);
    }
}

impl Handler<Delivery<Mode>> for Listener {
    type Result = ();

    fn handle(&mut self, mode: Delivery<Mode>, _: &mut Self::Context) {
        let _ = self.0.send((mode.number, mode.is_retained()));
    }
}

#[test]
fn later_node_gets_the_value_of_an_actor() {
    let loopback = Loopback::new();
    let hip = loopback.node("hip").app(AppSpec::new("announcer", || Announcer)).start().expect("a node");
    all_run(&[&hip]);
    let (reports, reported) = std::sync::mpsc::sync_channel(8);
    let listener = AppSpec::new("listener", move || Listener(reports.clone())).handles::<Mode>();
    let _knee = loopback.node("knee").app(listener).start().expect("a node");
    assert_eq!(reported.recv_timeout(DEADLINE), Ok((7, true)));
}
