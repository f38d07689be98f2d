//! Sockets that a hung thread still holds: the node's socket file, its TCP port, its UDP port.

use sinew::{Endpoint, NodeApi, Registration, client::ApiError, fault::Fault, node::NodeEnd, prelude::*};
use sinew_testkit::{
    DEADLINE, Loopback, TestDirectory, all_run, ready_for,
    scripted::{Script, incarnations, outcome_of_job, sender_app},
    sees, unique, until,
};
use sinew_tests::load::LAYERS;

use super::gets_through;

/// Sockets that only one process can use: fixed ports at an interface of the scenario's own, and a socket
/// file.
struct Doors {
    directory: TestDirectory,
    interface: [u8; 4],
}

impl Doors {
    fn new() -> Self {
        let [_, a, b, c] = unique().to_be_bytes();
        // Addresses below 1 and above 254 have a meaning of their own.
        Self { directory: TestDirectory::new(), interface: [127, a.clamp(1, 254), b, c.clamp(1, 254)] }
    }

    fn node(&self, loopback: &Loopback) -> NodeBuilder {
        let (socket, interface) = (self.directory.join("there.sock"), self.interface.into());
        loopback.node("there").configure(|config| {
            config.lncl.socket = Some(socket);
            (config.gncl.port, config.ndl.port, config.ndl.interface) = (7_401, 7_402, interface);
        })
    }

    /// An application of another process, played by the test itself.
    fn client(&self, name: &str) -> Endpoint {
        let api = NodeApi::connect(self.directory.join("there.sock")).expect("somebody listens");
        api.register_transport_address(Registration::new().name(name)).expect("the name is free")
    }
}

fn hangs_forever(layer: &'static str) {
    // Given: two nodes and a client
    let (loopback, doors) = (Loopback::new(), Doors::new());
    let ((scripted, log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
    let there = doors.node(&loopback).app(scripted).start().expect("a node");
    let here = loopback.node("home").app(sender_app).start().expect("a node");
    all_run(&[&there, &here]);
    let sender = key.sender();
    gets_through(&sender, 1);
    let mut former = doors.client("former");
    // When
    let before = LAYERS.map(|layer| there.handle().lives(layer).expect("every node has it").readies);
    there.handle().inject(layer, Fault::hang_for_ever()).expect("every node has it");
    // Then: it and all layers after it are back on the same sockets while it hangs
    let from = LAYERS.iter().position(|name| *name == layer).expect("it is one");
    for index in from..LAYERS.len() {
        ready_for(&there.handle(), LAYERS[index], before[index] + 1);
    }
    gets_through(&sender, 1);
    sees(&there.handle(), here.address());
    let next = doors.client("next");
    until("it is known on the other node", || sender.resolve("next"));
    if layer == "LNCL" || layer == "GNCL" {
        // LNCL and the hung application share a thread: its connected clients are notified.
        let received = former.receive(DEADLINE);
        assert!(matches!(received, Err(ApiError::Disconnected(_))), "{layer}: {received:?}");
    }
    assert_eq!(incarnations(&log), 1, "{layer}: the application was not restarted");
    // The next node finds the sockets free, although the thread still hangs.
    drop((former, next));
    assert_eq!(there.stop(), NodeEnd::Stopped, "{layer}");
    if layer != "NDL" {
        let (scripted, _) = Script::new().app("scripted");
        let there = doors.node(&loopback).app(scripted).start().expect("its doors are free");
        all_run(&[&there]);
        assert_eq!(there.stop(), NodeEnd::Stopped, "{layer}");
    }
}

#[test]
fn hung_lncl_keeps_no_socket_from_its_successor() {
    hangs_forever("LNCL");
}

#[test]
fn hung_gncl_keeps_no_socket_from_its_successor() {
    hangs_forever("GNCL");
}

#[test]
fn hung_ndl_keeps_no_socket_from_its_successor() {
    hangs_forever("NDL");
}

#[test]
fn hung_app_on_io_thread_keeps_no_socket() {
    let (loopback, doors) = (Loopback::new(), Doors::new());
    let ((scripted, _), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
    let (neighbour, _) = Script::new().app("neighbour");
    let neighbour = neighbour.on_io_thread().progress_within(Duration::from_millis(100));
    let there = doors.node(&loopback).app(scripted).app(neighbour).start().expect("a node");
    let here = loopback.node("home").app(sender_app).start().expect("a node");
    all_run(&[&there, &here]);
    let sender = key.sender();
    gets_through(&sender, 1);
    for incarnation in 2..=3 {
        there.handle().inject("neighbour", Fault::hang_for_ever()).expect("it is there");
        ready_for(&there.handle(), "neighbour", incarnation);
        LAYERS.into_iter().for_each(|layer| ready_for(&there.handle(), layer, incarnation));
        gets_through(&sender, 1);
        drop(doors.client("client"));
    }
    assert_eq!(outcome_of_job(&sender, "neighbour", 1), Outcome::Delivered);
}
