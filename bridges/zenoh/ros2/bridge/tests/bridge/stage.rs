//! A router, a node with a sensor and a drive, the bridge, and a peer.

use std::{
    net::TcpListener,
    process::Command,
    sync::{Mutex, mpsc},
    time::Duration,
};

use serde::{Deserialize, Serialize};
use sinew::{
    Tid,
    prelude::*,
    protection::{Cause, Guard, Protection, State},
};
use sinew_ros2_core::{Attachment, Catalog, Service, Value, decode, encode, topic_key, type_hash};
use sinew_testkit::{DEADLINE, Log, Loopback, NodeProcess, TestDirectory, all_run};
use sinew_zenoh::{
    config::Tls,
    session::{Role, open},
};
use zenoh::{Session, Wait as _, pubsub::Subscriber, query::QueryTarget};

/// The address that the bridge has at the node: the drive guards commands of it alone.
const BRIDGE: u32 = 0x2001;
const PERIOD: Duration = Duration::from_millis(20);
const LEASE: Duration = Duration::from_secs(2);

payload!("demo.angle", Stream => struct Angle { degrees: f32 });
payload!("demo.torque" => struct Torque { newton_metres: f32 });

#[derive(Serialize, Deserialize)]
struct Push {
    newtons: f32,
}

impl Payload for Push {
    const NAME: &'static str = "demo.push";
    const CLASS: Class = Class::Stream;
    // Generous, because the machine may be busy with other tests.
    const PROTECTION: Option<Protection> = Some(Protection {
        within: Duration::from_millis(2_000),
        age_max: Duration::from_millis(4_000),
        lost_max: 50,
        bad_max: 8,
        good_min: 2,
    });
}

params! {
    /// How the knee assists.
    struct Gains {
        /// Assistance, as a share.
        assistance: f64 = 0.25, unit "1", range 0.0..=1.0;
        /// Steps of a ramp.
        steps: i64 = 3, unit "1", range 0..=10;
        /// Whether it is damped.
        damped: bool = true;
    }
}

/// An act of the drive. Numbers are tenths.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Done {
    Torque(i32),
    Push(i32),
    Safe,
}

struct Sensor;

impl Actor for Sensor {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(5), |_, _, ctx| {
            // The next one comes soon.
            let _ = ctx.send("knee.drive", &Angle { degrees: 30.0 });
        });
    }
}

struct Drive {
    log: Log<Done>,
    guard: Option<Guard<()>>,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let (sender, log) = (Tid::new(NodeAddress::HERE, AppAddress::new(BRIDGE)), self.log.clone());
        let guard = ctx.guard::<Push, _>(sender, (), move |(), _cause| log.write(Done::Safe));
        self.guard = guard.map_err(|error| ctx.fail_start(error.to_string())).ok();
        ctx.every(PERIOD, |drive, _, _| {
            if let Some(guard) = &drive.guard
                && guard.state() == State::Safe(Cause::NotArmed)
            {
                // Refused until good commands have come.
                let _ = guard.arm();
            }
        });
    }
}

impl Handler<Delivery<Angle>> for Drive {
    type Result = ();

    fn handle(&mut self, _: Delivery<Angle>, _: &mut Self::Context) {}
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, torque: Delivery<Torque>, _: &mut Self::Context) {
        self.log.write(Done::Torque((torque.newton_metres * 10.0).round() as i32));
    }
}

impl Handler<Delivery<Push>> for Drive {
    type Result = ();

    fn handle(&mut self, push: Delivery<Push>, _: &mut Self::Context) {
        self.log.write(Done::Push((push.newtons * 10.0).round() as i32));
    }
}

/// The rules of the bridge.
const RULES: &str = r#"
domain = 7
node = "sinew"
watched = ["/exo"]
diagnostics = true
address = 0x2001

[[to_ros]]
topic = "/joint_states"
type = "sensor_msgs/msg/JointState"
rate_hz = 100
max_age_ms = 60000
set = { name = ["knee"], "header.frame_id" = "leg" }
[[to_ros.from]]
app = "knee.sensor"
sinew = "demo.angle"
fields = { "position[0]" = "degrees * 0.1" }

[[from_ros]]
topic = "/knee/torque"
type = "std_msgs/msg/Float64"
rate_hz = 1000
sinew = "demo.torque"
to = "knee.drive"
fields = { newton_metres = "data / 2" }

[[from_ros]]
topic = "/knee/bare_push"
type = "std_msgs/msg/Float64"
rate_hz = 1000
sinew = "demo.push"
to = "knee.drive"
fields = { newtons = "data" }

[[from_ros]]
topic = "/knee/push"
type = "std_msgs/msg/Float64"
rate_hz = 1000
sinew = "demo.push"
to = "knee.drive"
class = "stream"
protected = { within_ms = 2000, age_max_ms = 4000, lost_max = 50, bad_max = 8, good_min = 2 }
fields = { newtons = "data" }

[[parameters]]
app = "knee.drive"
node = "knee_drive"
writes = ["assistance", "steps"]

[stop]
service = "/exo/stop"
within_ms = 5000
"#;

pub(crate) struct Stage {
    pub(crate) bridge: NodeProcess,
    pub(crate) peer: Peer,
    pub(crate) log: Log<Done>,
    pub(crate) port: u16,
    _node: Node,
    _router: Session,
    _directory: TestDirectory,
}

impl Stage {
    /// Starts a router, a node and the bridge between both.
    pub(crate) fn start() -> Self {
        let directory = TestDirectory::new();
        let (router, port) = router();
        let (log, gains, network) = (Log::default(), Gains::new(), Loopback::new());
        let (written, socket) = (log.clone(), directory.join("leg.sock"));
        let drive = AppSpec::new("knee.drive", move || Drive { log: written.clone(), guard: None })
            .handles::<Angle>()
            .handles::<Torque>()
            .handles::<Push>()
            .params(&gains);
        let sensor = AppSpec::new("knee.sensor", || Sensor).requires(["knee.drive"]);
        let node = network.node("leg").configure(|config| config.lncl.socket = Some(socket.clone()));
        let node = node.app(drive).app(sensor).start().expect("a node");
        all_run(&[&node]);
        let text = format!("socket = {socket:?}\nrouters = [\"tcp/127.0.0.1:{port}\"]\n{RULES}");
        let mut command = Command::new(env!("CARGO_BIN_EXE_sinew-ros2"));
        command.arg(directory.write("mapping.toml", &text));
        let mut bridge = NodeProcess::start("sinew-ros2", command);
        for words in ["reads the messages of node", "sends commands as ros2", " runs"] {
            bridge.wait_for(&[words]);
        }
        Self {
            bridge,
            peer: Peer::connect(port),
            log,
            port,
            _node: node,
            _router: router,
            _directory: directory,
        }
    }
}

/// Starts a router on a free port.
fn router() -> (Session, u16) {
    let free = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    let port = free.expect("a free port").port();
    let listen = [format!("tcp/127.0.0.1:{port}")];
    (open(Role::Router { listen: &listen, connect: &[] }, LEASE).expect("a router"), port)
}

/// A program of ROS 2.
pub(crate) struct Peer {
    pub(crate) session: Session,
    pub(crate) catalog: Catalog,
    sequence: Mutex<i64>,
}

impl Peer {
    fn connect(port: u16) -> Self {
        let routers = [format!("tcp/127.0.0.1:{port}")];
        let session = open(Role::Client { routers: &routers, tls: &Tls::default() }, LEASE);
        Self { session: session.expect("a session"), catalog: Catalog::shipped(), sequence: Mutex::new(0) }
    }

    fn key(&self, topic: &str, of: &str) -> String {
        let of = self.catalog.message(of).expect("a type");
        topic_key(7, topic, &of.name, &type_hash(&of))
    }

    #[expect(clippy::disallowed_methods, reason = "ROS 2 stamps messages with the wall clock")]
    fn attachment(&self) -> Attachment {
        let mut sequence = self.sequence.lock().expect("no panic");
        *sequence += 1;
        let time = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).expect("a time");
        let time_ns = i64::try_from(time.as_nanos()).expect("a time of this century");
        Attachment { sequence: *sequence, time_ns, gid: [9; 16] }
    }

    /// Subscribes to a topic.
    pub(crate) fn subscribe(
        &self,
        topic: &str,
        of: &str,
    ) -> (Subscriber<()>, mpsc::Receiver<(Value, Attachment)>) {
        let (put, taken) = mpsc::sync_channel(4_096);
        let message = self.catalog.message(of).expect("a type");
        let take = move |sample: zenoh::sample::Sample| {
            let value = decode(&message, &sample.payload().to_bytes()).expect("a message");
            let attachment = sample.attachment().expect("an attachment").to_bytes();
            // The test may have ended.
            let _ = put.try_send((value, Attachment::parse(&attachment).expect("an attachment")));
        };
        let declared = self.session.declare_subscriber(self.key(topic, of)).callback(take).wait();
        (declared.expect("a subscription"), taken)
    }

    /// Publishes one message.
    pub(crate) fn publish(&self, topic: &str, of: &str, value: &Value) {
        let message = self.catalog.message(of).expect("a type");
        self.put(self.key(topic, of), encode(&message, value).expect("bytes"));
    }

    /// Publishes a `Float64`.
    pub(crate) fn publish_number(&self, topic: &str, number: f64) {
        self.publish(topic, "std_msgs/msg/Float64", &Value::Message(vec![Value::Float(number)]));
    }

    pub(crate) fn put(&self, key: String, bytes: Vec<u8>) {
        let attachment = self.attachment().encode();
        self.session.put(key, bytes).attachment(&attachment[..]).wait().expect("a put");
    }

    /// Calls a service.
    pub(crate) fn call(&self, topic: &str, service: &Service, request: &Value) -> Result<Value, String> {
        let bytes = encode(&service.request, request).expect("bytes");
        self.call_with(topic, service, bytes)
    }

    pub(crate) fn call_with(
        &self,
        topic: &str,
        service: &Service,
        request: Vec<u8>,
    ) -> Result<Value, String> {
        let key = topic_key(7, topic, &service.name, &type_hash(&service.description));
        let attachment = self.attachment();
        let replies = self
            .session
            .get(key)
            .payload(request)
            .attachment(&attachment.encode()[..])
            .target(QueryTarget::AllComplete)
            .timeout(DEADLINE)
            .wait()
            .expect("a request");
        let reply = replies.recv().map_err(|_| "no server".to_owned())?;
        match reply.result() {
            Ok(sample) => {
                let answered = sample.attachment().expect("an attachment").to_bytes();
                let answered = Attachment::parse(&answered).expect("an attachment");
                assert_eq!((answered.sequence, answered.gid), (attachment.sequence, attachment.gid));
                Ok(decode(&service.response, &sample.payload().to_bytes()).expect("a response"))
            }
            Err(error) => Err(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned()),
        }
    }
}
