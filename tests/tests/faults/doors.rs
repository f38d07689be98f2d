//! What a hung thread still holds of the node's doors: its socket file, its TCP port, its UDP port.

use sinew::{
    Endpoint, NodeApi, Registration, client::ApiError, fault::Fault, message::Sender, node::NodeEnd,
    prelude::*,
};
use sinew_tests::{
    DEADLINE, Ground, OwnDirectory, all_run,
    load::LAYERS,
    puppet::{Job, Stage, desk, lives, outcome_of_job, wait},
    ready_for, sees, unique, until,
};

/// Doors that can be used by one only: fixed ports at an interface of the scenario's own, and a socket file.
struct Doors {
    directory: OwnDirectory,
    interface: [u8; 4],
}

impl Doors {
    fn new() -> Self {
        let [_, a, b, c] = unique().to_be_bytes();
        // Below 1 and above 254 are addresses with a meaning of their own.
        Self { directory: OwnDirectory::new(), interface: [127, a.clamp(1, 254), b, c.clamp(1, 254)] }
    }

    fn node(&self, ground: &Ground) -> NodeBuilder {
        let (socket, interface) = (self.directory.join("there.sock"), self.interface.into());
        ground.node("there").configure(|config| {
            config.lncl.socket = Some(socket);
            (config.gncl.port, config.ndl.port, config.ndl.interface) = (7_401, 7_402, interface);
        })
    }

    /// An application of another process, which the test plays itself.
    fn client(&self, name: &str) -> Endpoint {
        let api = NodeApi::connect(self.directory.join("there.sock")).expect("somebody listens");
        api.register_transport_address(Registration::new().name(name)).expect("the name is free")
    }
}

/// Jobs of the other node reach the puppet.
fn is_linked(sender: &Sender) {
    until("a job gets through", || {
        let sent = sender.message("puppet", &Job { number: 1 }).confirmed(DEADLINE).ok()?;
        (wait(sent) == Outcome::Delivered).then_some(())
    });
}

fn hangs_for_ever(layer: &'static str) {
    // Given: two nodes and a client
    let (ground, doors) = (Ground::new(), Doors::new());
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let there = doors.node(&ground).app(puppet).start().expect("a node");
    let here = ground.node("home").app(desk).start().expect("a node");
    all_run(&[&there, &here]);
    let sender = key.sender();
    is_linked(&sender);
    let mut former = doors.client("former");
    // When
    let before = LAYERS.map(|layer| there.handle().lives(layer).expect("every node has it").readies);
    there.handle().inject(layer, Fault::hang_for_ever()).expect("every node has it");
    // Then: it and all layers after it are back behind the same doors, while it hangs
    let from = LAYERS.iter().position(|name| *name == layer).expect("it is one");
    for index in from..LAYERS.len() {
        ready_for(&there.handle(), LAYERS[index], before[index] + 1);
    }
    is_linked(&sender);
    sees(&there.handle(), here.address());
    let next = doors.client("next");
    until("it is known on the other node", || sender.resolve("next"));
    if layer == "LNCL" || layer == "GNCL" {
        // They share a thread. Who was connected to what hangs there is told.
        let told = former.receive(DEADLINE);
        assert!(matches!(told, Err(ApiError::Disconnected(_))), "{layer}: {told:?}");
    }
    assert_eq!(lives(&log), 1, "{layer}: the application was not restarted");
    // The next node finds the doors free, though the thread still hangs.
    drop((former, next));
    assert_eq!(there.stop(), NodeEnd::Stopped, "{layer}");
    if layer != "NDL" {
        let (puppet, _) = Stage::new().app("puppet");
        let there = doors.node(&ground).app(puppet).start().expect("its doors are free");
        all_run(&[&there]);
        assert_eq!(there.stop(), NodeEnd::Stopped, "{layer}");
    }
}

#[test]
fn an_lncl_that_hangs_for_ever_keeps_no_door_from_its_successor() {
    hangs_for_ever("LNCL");
}

#[test]
fn a_gncl_that_hangs_for_ever_keeps_no_door_from_its_successor() {
    hangs_for_ever("GNCL");
}

#[test]
fn an_ndl_that_hangs_for_ever_keeps_no_door_from_its_successor() {
    hangs_for_ever("NDL");
}

#[test]
fn an_application_that_hangs_on_the_thread_of_the_sockets_keeps_no_door_from_the_layers() {
    let (ground, doors) = (Ground::new(), Doors::new());
    let ((puppet, _), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let (neighbour, _) = Stage::new().app("neighbour");
    let neighbour = neighbour.on_io_thread().progress_within(Duration::from_millis(100));
    let there = doors.node(&ground).app(puppet).app(neighbour).start().expect("a node");
    let here = ground.node("home").app(desk).start().expect("a node");
    all_run(&[&there, &here]);
    let sender = key.sender();
    is_linked(&sender);
    for life in 2..=3 {
        there.handle().inject("neighbour", Fault::hang_for_ever()).expect("it is there");
        ready_for(&there.handle(), "neighbour", life);
        LAYERS.into_iter().for_each(|layer| ready_for(&there.handle(), layer, life));
        is_linked(&sender);
        drop(doors.client("client"));
    }
    assert_eq!(outcome_of_job(&sender, "neighbour", 1), Outcome::Delivered);
}
