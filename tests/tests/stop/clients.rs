//! Outputs of clients: the stop reaches them by the end of their echoes, and each client acknowledges it.

use std::{path::Path, thread, time::Instant};

use rustix::{
    process::{Gid, Uid, geteuid},
    thread::{set_thread_gid, set_thread_uid},
};
use sinew::{
    Endpoint, NodeApi, Registration,
    client::ApiError,
    message::Rejection,
    prelude::*,
    protection::{Guard, Protection, State},
    stop::{AskStop, ReleaseStop, StopReport, StopState},
};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory, all_run};

const ROUND: Duration = Duration::from_millis(5);
/// Rounds without a good command after which one is not expected any more: more than twice the longest echo.
const ROUNDS: usize = 200;
/// The user of a guest, for which no account is needed.
const GUEST: u32 = 54_321;

#[derive(serde::Serialize, serde::Deserialize)]
struct Level {
    percent: f32,
}

impl Payload for Level {
    const NAME: &'static str = "test.stop.level";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(100)));
}

/// The two ends of a flow of commands, each a client.
struct Flow {
    control: Endpoint,
    drive: Endpoint,
    guard: Guard<()>,
}

impl Flow {
    fn new(api: &NodeApi) -> Self {
        let register = |name: &str| {
            api.register_transport_address(Registration::new().name(name)).expect("the node accepts it")
        };
        let (control, mut drive) = (register("control"), register("drive"));
        let guard = drive.guard::<Level, _>(control.tid(), (), |(), _| {}).expect("there is the thread");
        Self { control, drive, guard }
    }

    /// Sends a command, passes the echoes on, and arms the output if that is possible.
    fn round(&mut self) -> State {
        let to = self.drive.tid();
        self.control.send(to, &Level { percent: 5.0 }).expect("it is connected");
        while self.control.receive(Duration::ZERO).expect("it is connected").is_some() {}
        let _ = self.drive.receive(ROUND).expect("it is connected");
        let _ = self.guard.arm();
        self.guard.state()
    }

    fn until(&mut self, what: &str, is_so: impl Fn(State) -> bool) {
        let deadline = Instant::now() + DEADLINE;
        while !is_so(self.round()) {
            assert!(Instant::now() < deadline, "{what}: {:?}", self.guard.tally());
        }
    }
}

#[test]
fn stopped_client_moves_only_after_its_acknowledgement() {
    // Given: two clients, one of which moves an output of the other
    let (network, directory) = (Loopback::new(), TestDirectory::new());
    let socket = directory.join("knee.sock");
    let path = socket.clone();
    let node = network.node("knee").configure(move |config| config.lncl.socket = Some(path.clone()));
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let mut flow = Flow::new(&NodeApi::connect(&socket).expect("the node listens"));
    flow.until("it is armed", |state| state == State::Live);
    // When: one of them presses
    let report = flow.control.press_stop("a test", DEADLINE).expect("the node answers");
    assert!(report.is_confirmed(), "{report:?}");
    // Then: its commands become too old
    flow.until("it is safe", |state| state != State::Live);
    for round in 0..ROUNDS {
        assert_ne!(flow.round(), State::Live, "round {round} of the stop");
    }
    assert!(flow.drive.acknowledge_stop(DEADLINE).is_ok_and(|outcome| outcome != Outcome::Delivered));
    // When: it is released
    let stop = Tid::new(flow.control.tid().node, AppAddress::STOP);
    let order = ReleaseStop { within_ms: 1_000 };
    let released = flow.control.message(stop, &order).ask::<StopReport>(DEADLINE).expect("the node answers");
    assert!(released.refused.is_none() && released.presses.is_empty(), "{released:?}");
    // Then: nothing moves before it is acknowledged
    for round in 0..ROUNDS {
        assert_ne!(flow.round(), State::Live, "round {round} after the release");
    }
    assert_eq!(flow.drive.acknowledge_stop(DEADLINE).expect("the node answers"), Outcome::Delivered);
    flow.until("it is armed again", |state| state == State::Live);
}

/// Presses the stop and asks for its state, as a guest.
fn act_as_guest(socket: &Path) -> [Result<StopReport, ApiError>; 2] {
    let act = || {
        // Only this one thread changes its user.
        set_thread_gid(Gid::from_raw(GUEST)).expect("root may");
        set_thread_uid(Uid::from_raw(GUEST)).expect("root may");
        let node = NodeApi::connect(socket).expect("the list admits it");
        let mut guest = node.register_transport_address(Registration::new()).expect("the list admits it");
        let stop = Tid::new(guest.tid().node, AppAddress::STOP);
        let pressed = guest.press_stop("a guest", Duration::ZERO);
        [pressed, guest.message(stop, &AskStop {}).ask(DEADLINE)]
    };
    thread::scope(|scope| scope.spawn(act).join().expect("no panic"))
}

#[test]
fn guest_of_the_access_list_neither_presses_nor_reads() {
    if !geteuid().is_root() {
        println!("skipped: only root can act as another user");
        return;
    }
    // Given: a node that admits another user
    let (network, directory) = (Loopback::new(), TestDirectory::new());
    let list = format!("[[rule]]\nfrom = ['*']\nto = ['*']\n[[client]]\nuid = {GUEST}\n");
    let (socket, access) = (directory.join("knee.sock"), directory.write("access.toml", &list));
    let path = socket.clone();
    let node = network.node("knee").configure(move |config| {
        config.lncl.socket = Some(path.clone());
        config.security.access = Some(access.clone());
    });
    let node = node.start().expect("a node");
    all_run(&[&node]);
    // When, then
    for answer in act_as_guest(&socket) {
        let is_refused = matches!(answer, Err(ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed))));
        assert!(is_refused, "{answer:?}");
    }
    // And: nothing is stopped
    let mut own = NodeApi::connect(&socket)
        .and_then(|node| node.register_transport_address(Registration::new()))
        .expect("the node's own user may");
    let stop = Tid::new(own.tid().node, AppAddress::STOP);
    let report: StopReport = own.message(stop, &AskStop {}).ask(DEADLINE).expect("the node answers");
    assert!(report.state != StopState::Stopped && report.presses.is_empty(), "{report:?}");
}
