//! The processes of a test: a router, a node with the applications of `examples/robot.rs`, and the bridge.

use std::{
    net::TcpListener,
    path::PathBuf,
    process::Command,
    sync::mpsc::{Receiver, sync_channel},
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory};
use sinew_zenoh::{
    config::Tls,
    session::{Role, open},
};
use zenoh::{Session, Wait, sample::Sample};

const LEASE_MS: &str = "1000";
/// Samples that wait for a test.
const SAMPLES_MAX: usize = 10_000;

/// Rules that the tests share.
pub(crate) const RULES: &str = r#"
[[in]]
to = "knee.drive"
types = ["robot.move"]
encoding = "json"
get = "confirm"

[[in]]
to = "knee.drive"
types = ["robot.get_angle"]
encoding = "json"
put = false
get = "ask"
within_ms = 5000

[[out]]
group = "telemetry"
types = ["robot.angle"]
encoding = "json"
"#;

/// The processes. They end in the order of the fields.
pub(crate) struct Stage {
    pub(crate) bridge: NodeProcess,
    pub(crate) robot: NodeProcess,
    pub(crate) endpoint: String,
    pub(crate) project: String,
    pub(crate) directory: TestDirectory,
    _router: NodeProcess,
}

fn program(name: &str) -> PathBuf {
    let bridge = PathBuf::from(env!("CARGO_BIN_EXE_sinew-zenoh-bridge"));
    bridge.parent().expect("it is in a folder").join(name)
}

impl Stage {
    /// Starts all processes with these rules of the bridge, and these settings of the node.
    pub(crate) fn start(rules: &str, settings: &str) -> Option<Self> {
        let router = program("sinew-zenoh-router");
        if !router.exists() {
            println!("skipped: there is no {}: cargo build -p sinew-zenoh", router.display());
            return None;
        }
        let directory = TestDirectory::new();
        let endpoint = format!("tcp/127.0.0.1:{}", free_port());
        let mut command = Command::new(router);
        command.args([LEASE_MS, &endpoint]);
        let mut router = NodeProcess::start("router", command);
        router.wait_for(&["router"]);
        let project = format!("zenoh{}", sinew_testkit::unique());
        let robot = robot(&directory, &project, settings);
        let bridge = bridge(&directory, &project, &endpoint, rules);
        Some(Self { bridge, robot, endpoint, project, directory, _router: router })
    }

    /// Returns the session of a Zenoh program.
    pub(crate) fn session(&self) -> Session {
        let routers = [self.endpoint.clone()];
        let role = Role::Client { routers: &routers, tls: &Tls::default() };
        open(role, Duration::from_secs(1)).expect("the router accepts it")
    }

    /// Returns a key of the project.
    pub(crate) fn key(&self, rest: &str) -> String {
        format!("sinew/{}/{rest}", self.project)
    }

    /// Waits until a counter of the bridge has this value.
    pub(crate) fn wait_for_count(&mut self, label: &str, value: u64) {
        let wanted = format!("{label}\"}} {value}");
        let end = Instant::now() + DEADLINE;
        loop {
            self.bridge.signal(Signal::USR1);
            let line = self.bridge.wait_for(&[&format!("{label}\"")]);
            if line.ends_with(&wanted) {
                return;
            }
            assert!(Instant::now() < end, "{line} instead of {wanted}; {:#?}", self.bridge.output());
        }
    }
}

/// Starts the node, and waits until its knee is there.
pub(crate) fn robot(directory: &TestDirectory, project: &str, settings: &str) -> NodeProcess {
    let socket = directory.join("robot.sock");
    let text = format!(
        "[node]\nname = \"robot\"\nproject = \"{project}\"\naddress = \"127.0.0.1\"\n\
         [lncl]\nsocket = \"{}\"\n[ndl]\nmdns_port = false\nmulticast = false\n{settings}",
        socket.display()
    );
    let mut command = Command::new(program("examples/sinew-zenoh-bridge-robot"));
    command.arg(directory.write("robot.toml", &text));
    let robot = NodeProcess::start("robot", command);
    sinew_testkit::until("the node's socket", || sinew::NodeApi::connect(&socket).ok().map(drop));
    robot
}

fn bridge(directory: &TestDirectory, project: &str, endpoint: &str, rules: &str) -> NodeProcess {
    let socket = directory.join("robot.sock");
    let text = format!(
        "project = \"{project}\"\nsocket = \"{}\"\n[zenoh]\nconnect = [\"{endpoint}\"]\n{rules}",
        socket.display()
    );
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew-zenoh-bridge"));
    command.arg(directory.write("bridge.toml", &text));
    let mut bridge = NodeProcess::start("bridge", command);
    bridge.wait_for(&["up"]);
    bridge
}

fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("it has an address").port()
}

/// Subscribes to a key expression.
pub(crate) fn subscribe(session: &Session, key: &str) -> Receiver<Sample> {
    let (put, samples) = sync_channel(SAMPLES_MAX);
    let callback = move |sample: Sample| {
        // The test has seen enough.
        let _ = put.try_send(sample);
    };
    session.declare_subscriber(key.to_owned()).callback(callback).background().wait().expect("a key");
    samples
}

/// Returns the next sample.
pub(crate) fn next(samples: &Receiver<Sample>) -> Sample {
    samples.recv_timeout(DEADLINE).expect("a sample in time")
}

/// Returns the first reply to a query: the payload, or the error.
pub(crate) fn get(session: &Session, key: &str, payload: &str) -> Result<String, String> {
    let (put, replies) = sync_channel(16);
    let callback = move |reply: zenoh::query::Reply| {
        let text = match reply.result() {
            Ok(sample) => Ok(String::from_utf8_lossy(&sample.payload().to_bytes()).into_owned()),
            Err(error) => Err(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned()),
        };
        let _ = put.try_send(text);
    };
    let query = session.get(key.to_owned()).payload(payload.to_owned()).timeout(Duration::from_secs(10));
    query.callback(callback).wait().expect("a key");
    replies.recv_timeout(DEADLINE).unwrap_or_else(|why| panic!("no reply to {key}: {why}"))
}
