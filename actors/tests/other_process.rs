//! A whole node and an application in a process of its own, which waits, works, and is killed.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

use std::{
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::Duration,
};

use sinew::{
    AppAddress, NodeApi, Registration,
    client::{ApiError, Transport},
    prelude::*,
};

const WATCHDOG: Duration = Duration::from_secs(60);
const SOCKET: &str = "SINEW_TEST_SOCKET";

payload!("test.angle" => struct Angle { degrees: f32 });
payload!("test.twice" => struct Twice { degrees: f32 });

/// The application in the node's process: requires the sensor, and reports its observations to the test.
struct Drive(SyncSender<String>);

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        self.0.send("started".to_owned()).unwrap();
    }
}

impl Handler<Delivery<Angle>> for Drive {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, context: &mut Self::Context) {
        context.reply(&angle, &Twice { degrees: 2.0 * angle.degrees }).unwrap();
        self.0.send(format!("angle {}", angle.degrees)).unwrap();
    }
}

impl Handler<Delivery<RequirementEvent>> for Drive {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        self.0.send(format!("{:?}", event.payload)).unwrap();
    }
}

fn start_node(socket: &Path) -> (Node, Receiver<String>) {
    let (sender, seen) = sync_channel(64);
    let drive = AppSpec::new("drive", move || Drive(sender.clone()))
        .requires(["sensor"])
        .handles::<Angle>()
        .handles::<RequirementEvent>();
    let node = Node::builder("knee")
        .configure(|config| {
            config.lncl.socket = Some(socket.to_owned());
            config.ndl.multicast = None;
            config.ndl.mdns_port = None;
            config.rt.probe = Duration::ZERO;
        })
        .app(drive)
        .start()
        .unwrap();
    (node, seen)
}

/// Sends to an unregistered name, and reports the text of the error.
struct Misspelt(SyncSender<String>);

impl Actor for Misspelt {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let error = context.send("sensro", &Angle { degrees: 1.0 }).unwrap_err();
        self.0.send(error.to_string()).unwrap();
    }
}

// spec: LNCL-19
#[test]
fn misspelt_name_suggests_nearest_ones() {
    let directory = Directory(std::env::temp_dir().join(format!("sinew-nearest-{}", std::process::id())));
    let socket = directory.0.join("knee.sock");
    let (say, seen) = sync_channel(64);
    let node = Node::builder("knee")
        .configure(|config| {
            config.lncl.socket = Some(socket.clone());
            config.ndl.multicast = None;
            config.ndl.mdns_port = None;
            config.rt.probe = Duration::ZERO;
        })
        .app(AppSpec::new("misspelt", move || Misspelt(say.clone())).requires(["sensor"]))
        .start()
        .unwrap();
    let api = NodeApi::connect(socket.to_str().unwrap()).unwrap();
    let _sensor = api.register_transport_address(Registration::new().name("sensor")).unwrap();
    let found = seen.recv_timeout(WATCHDOG).unwrap();
    assert!(found.starts_with("no application is called 'sensro' now; nearest: sensor; "), "{found}");

    let mut endpoint = api.register_transport_address(Registration::new().requires(["sensor"])).unwrap();
    let error = endpoint.send("sensro", &Angle { degrees: 1.0 }).unwrap_err();
    let text = error.to_string();
    let ApiError::UnknownName { name, nearest } = error else { panic!("{text}") };
    assert_eq!((&*name, nearest), ("sensro", vec!["sensor".to_owned()]));
    assert!(text.starts_with("no application is called 'sensro' now; nearest: sensor; "), "{text}");
    // A loop that keeps sending to this name makes the node compare names only once a second.
    let again = endpoint.send("sensro", &Angle { degrees: 1.0 });
    assert!(matches!(again, Err(ApiError::UnknownName { nearest, .. }) if nearest.is_empty()));
    node.stop();
}

/// Runs `role` below in a process of its own.
fn start_process(role: &str, socket: &Path) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", role, "--ignored", "--nocapture"])
        .env(SOCKET, socket)
        .spawn()
        .unwrap()
}

fn expect(seen: &Receiver<String>, what: &str) {
    let found = seen.recv_timeout(WATCHDOG).unwrap_or_else(|_| panic!("waited for {what:?}"));
    assert!(found.starts_with(what), "{found:?} instead of {what:?}");
}

struct Directory(PathBuf);

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[test]
fn requirement_is_awaited_lost_and_met_again() {
    let directory = Directory(std::env::temp_dir().join(format!("sinew-process-{}", std::process::id())));
    let socket = directory.0.join("knee.sock");
    let (node, seen) = start_node(&socket);
    assert!(seen.try_recv().is_err(), "the drive does not start before the sensor is there");

    let mut sensor = start_process("process_of_the_sensor", &socket);
    expect(&seen, "started");
    expect(&seen, "angle 12.5");

    // `kill` is SIGKILL: the process sends nothing more.
    sensor.kill().unwrap();
    sensor.wait().unwrap();
    expect(&seen, "Lost { name: \"sensor\" }");

    let mut sensor = start_process("process_of_the_sensor", &socket);
    // One report comes from the sync manager and the other from the sensor, in any order.
    let mut both = [seen.recv_timeout(WATCHDOG).unwrap(), seen.recv_timeout(WATCHDOG).unwrap()];
    both.sort();
    assert_eq!(both, ["Met { name: \"sensor\" }", "angle 12.5"]);
    sensor.kill().unwrap();
    sensor.wait().unwrap();
    node.stop();
    assert!(!socket.exists());
}

#[test]
fn process_application_waits_for_its_requirement() {
    let directory = Directory(std::env::temp_dir().join(format!("sinew-waits-{}", std::process::id())));
    let socket = directory.0.join("knee.sock");
    let (node, seen) = start_node(&socket);
    let api = NodeApi::connect(&socket).unwrap();
    // Given: the required application waits itself, for a sensor that does not exist.
    let hip = Registration::new().name("hip").requires(["drive"]);
    // Long enough for the node to report the missing requirement.
    let early = api.register_transport_address(hip.clone().deadline(Duration::from_secs(1)));
    assert!(early.unwrap_err().to_string().contains("drive"));
    // When: the sensor registers.
    let _sensor = api.register_transport_address(Registration::new().name("sensor")).unwrap();
    expect(&seen, "started");
    // Then
    api.register_transport_address(hip.deadline(WATCHDOG)).unwrap();
    node.stop();
}

/// Repeats `look` until it returns a value.
fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = std::time::Instant::now() + WATCHDOG;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(std::time::Instant::now() < deadline, "waited for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn comes_back_to_a_killed_node(transport: Transport) {
    // Given: a node in a process of its own, and an endpoint here
    let name = format!("sinew-returns-{transport:?}-{}", std::process::id());
    let directory = Directory(std::env::temp_dir().join(name));
    let socket = directory.0.join("knee.sock");
    let mut node = start_process("process_of_a_lone_node", &socket);
    let api = until("the node", || NodeApi::connect(&socket).ok());
    let registration = Registration::new().name("drive").transport(transport);
    let mut endpoint = api.register_transport_address(registration).unwrap();
    let tid = endpoint.tid();
    // When
    node.kill().unwrap();
    node.wait().unwrap();
    // Then: `receive` reports it once, and so does each send
    let told = until("word of the node's end", || endpoint.receive(Duration::from_millis(5)).err());
    assert!(matches!(told, ApiError::Disconnected(_)), "{told}");
    let told = endpoint.send(tid, &Angle { degrees: 1.0 }).unwrap_err();
    assert!(matches!(told, ApiError::Disconnected(_)), "{told}");
    assert!(endpoint.receive(Duration::from_millis(5)).unwrap().is_none(), "it waits for the node's return");
    assert_eq!(endpoint.registrations(), 1);
    // When
    let mut node = start_process("process_of_a_lone_node", &socket);
    // Then: it has reconnected with its name and address, and any sender reaches it
    until("the endpoint's return", || {
        endpoint.receive(Duration::from_millis(50)).unwrap();
        (endpoint.registrations() == 2).then_some(())
    });
    assert_eq!(endpoint.tid(), tid);
    assert_eq!(endpoint.resolve("drive", WATCHDOG).unwrap(), Some(tid));
    let mut other = api.register_transport_address(Registration::new().transport(transport)).unwrap();
    other.send(tid, &Angle { degrees: 2.0 }).unwrap();
    assert_eq!(
        endpoint.receive(WATCHDOG).unwrap().expect("a message").decode::<Angle>().unwrap().degrees,
        2.0
    );
    node.kill().unwrap();
    node.wait().unwrap();
}

#[test]
fn ring_endpoint_reconnects_to_restarted_node() {
    comes_back_to_a_killed_node(Transport::Ring);
}

#[test]
fn socket_endpoint_reconnects_to_restarted_node() {
    comes_back_to_a_killed_node(Transport::Socket);
}

#[test]
fn task_endpoint_reconnects_to_restarted_node() {
    for transport in [Transport::Ring, Transport::Socket] {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(a_task_comes_back(transport));
    }
}

async fn a_task_comes_back(transport: Transport) {
    // Given
    let name = format!("sinew-task-returns-{transport:?}-{}", std::process::id());
    let directory = Directory(std::env::temp_dir().join(name));
    let socket = directory.0.join("knee.sock");
    let mut node = start_process("process_of_a_lone_node", &socket);
    let api = until("the node", || NodeApi::connect(&socket).ok());
    let registration = Registration::new().name("drive").transport(transport);
    let mut endpoint = api.register_transport_address_async(registration.clone()).await.unwrap();
    endpoint.join("drives").await.unwrap();
    let tid = endpoint.tid();
    // When
    node.kill().unwrap();
    node.wait().unwrap();
    // Then: the pending receive fails at once, and so does each send
    let told =
        tokio::time::timeout(WATCHDOG, endpoint.receive()).await.expect("word of the end").unwrap_err();
    assert!(matches!(told, ApiError::Disconnected(_)), "{told}");
    let told = endpoint.send(tid, &Angle { degrees: 1.0 }).await.unwrap_err();
    assert!(matches!(told, ApiError::Disconnected(_)), "{told}");
    // When: the node returns while the endpoint waits
    let mut node = start_process("process_of_a_lone_node", &socket);
    // A fixed address is of another range: the first dynamic registration gets the former dynamic one.
    let fixed = Registration::new().fixed_address(AppAddress::fixed(9).unwrap());
    let other = tokio::task::spawn_blocking(move || {
        let mut other = until("the door", || api.register_transport_address(fixed.clone()).ok());
        until("the name", || other.resolve("drive", WATCHDOG).unwrap());
        // Group membership is announced after the registration: the sender repeats until a member receives
        // it.
        move || other.send(Tid::group("drives"), &Angle { degrees: 2.0 }).unwrap()
    });
    let mut send = tokio::time::timeout(WATCHDOG, async {
        tokio::select! {
            other = other => other.unwrap(),
            received = endpoint.receive() => panic!("{received:?} before anything was sent"),
        }
    })
    .await
    .expect("it comes back while it waits");
    // Then: it has its former name and address
    let received = tokio::time::timeout(WATCHDOG, async {
        loop {
            send();
            let soon = tokio::time::timeout(Duration::from_millis(20), endpoint.receive()).await;
            if let Ok(received) = soon {
                break received.unwrap();
            }
        }
    })
    .await
    .expect("a message to the group");
    assert_eq!(received.decode::<Angle>().unwrap().degrees, 2.0);
    assert_eq!((endpoint.tid(), endpoint.registrations()), (tid, 2));
    node.kill().unwrap();
    node.wait().unwrap();
}

#[test]
#[ignore = "a process of the tests above, not a test"]
fn process_of_a_lone_node() {
    let Some(socket) = std::env::var_os(SOCKET) else { return };
    let _node = Node::builder("knee")
        .configure(|config| {
            config.lncl.socket = Some(socket.into());
            config.ndl.multicast = None;
            config.ndl.mdns_port = None;
            config.rt.probe = Duration::ZERO;
        })
        .start()
        .unwrap();
    // Until it is killed; not forever if the test is.
    std::thread::sleep(2 * WATCHDOG);
}

#[test]
#[ignore = "a process of the test above, not a test"]
fn process_of_the_sensor() {
    let Some(socket) = std::env::var_os(SOCKET) else { return };
    let api = NodeApi::connect(socket).unwrap();
    let mut sensor = api.register_transport_address(Registration::new().name("sensor")).unwrap();
    let drive = sensor.resolve("drive", WATCHDOG).unwrap().expect("the drive is registered");
    let twice: Twice = sensor.message(drive, &Angle { degrees: 12.5 }).ask(WATCHDOG).unwrap();
    assert_eq!(twice.degrees, 25.0);
    // Until it is killed; the end of the node ends it, too.
    while sensor.receive(WATCHDOG).is_ok() {}
}
