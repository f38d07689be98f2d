//! The role of a node: a guarded output that is armed whenever that is possible, load, and an operator.

use std::{
    io::BufRead,
    net::{Ipv4Addr, SocketAddrV4},
    path::PathBuf,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use serde_json::json;
use sinew::{
    message::{AskError, Sender},
    prelude::*,
    protection::{Guard, Protection, State},
    stop::{AskStop, ReleaseStop, StopReport, StopState},
};
use sinew_testkit::{
    DEADLINE,
    scripted::{sender_app, wait},
};

use super::NODES;

const PERIOD: Duration = Duration::from_millis(20);
const CONTROL: AppAddress = AppAddress::new(0x1001);
/// Bytes of a message of the load.
const FILLER: usize = 256;
/// How long a release waits for the other nodes.
const RELEASED_WITHIN_MS: u32 = 10_000;

/// A protected command.
#[derive(serde::Serialize, serde::Deserialize)]
struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "stops.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(PERIOD));
}

payload!("stops.load", Bulk => #[derive(Debug)] struct Load {
    #[serde(with = "serde_bytes")]
    filler: Vec<u8>,
});

/// Commands the outputs of all nodes.
struct Control;

impl Actor for Control {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |_, _, context| {
            for node in 0..NODES {
                // A drive that is not there gets none.
                let _ = context.send(&*format!("drive.{node}"), &Torque { newton_metres: 1.0 });
            }
        });
    }
}

/// The output, as the orders of the scenario see it.
#[derive(Default)]
struct View {
    guard: Mutex<Option<Guard<()>>>,
    safe_ns: AtomicU64,
    moved: AtomicU64,
    /// The person starts again: a released stop is acknowledged.
    starts: AtomicBool,
}

impl View {
    fn line(&self) -> String {
        let guard = self.guard.lock().unwrap_or_else(PoisonError::into_inner);
        let is_live = guard.as_ref().is_some_and(|guard| guard.state() == State::Live);
        let [safe_ns, moved] = [&self.safe_ns, &self.moved].map(|number| number.load(Ordering::SeqCst));
        format!("{} {safe_ns} {moved}", u8::from(is_live))
    }
}

struct Drive {
    control: Tid,
    view: Arc<View>,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let view = self.view.clone();
        let make_safe = move |(): &mut (), _| view.safe_ns.store(Time::now().as_nanos(), Ordering::SeqCst);
        let guard = context.guard::<Torque, _>(self.control, (), make_safe).expect("there is the thread");
        *self.view.guard.lock().unwrap_or_else(PoisonError::into_inner) = Some(guard.clone());
        context.every(PERIOD, move |drive, _, _| {
            if drive.view.starts.load(Ordering::SeqCst) {
                let _ = guard.acknowledge_stop();
            }
            // A careless application: it arms whenever that is possible.
            let _ = guard.arm();
        });
    }
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, _: Delivery<Torque>, _: &mut Self::Context) {
        let view = self.view.clone();
        let guard = view.guard.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(guard) = guard {
            let _ = guard.apply(|()| view.moved.fetch_add(1, Ordering::SeqCst));
        }
    }
}

/// Sends load to the next node, and takes that of the former one.
struct Loader {
    to: String,
    messages: u32,
}

impl Actor for Loader {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |loader, _, context| {
            for _ in 0..loader.messages {
                // A queue that is full takes no more: it is load.
                let _ = context.send(&*loader.to, &Load { filler: vec![7; FILLER] });
            }
        });
    }
}

impl Handler<Delivery<Load>> for Loader {
    type Result = ();

    fn handle(&mut self, _: Delivery<Load>, _: &mut Self::Context) {}
}

/// `NODE ADDRESS GROUP PROJECT LOAD ACCESS STATE`
pub(crate) fn run(arguments: &[String]) {
    let [number, address, group, project, load, access, state] = arguments else {
        panic!("seven arguments, not {arguments:?}")
    };
    let number: usize = number.parse().expect("the scenario counts");
    let address: Ipv4Addr = address.parse().expect("the scenario's address");
    let group: SocketAddrV4 = group.parse().expect("the scenario's group");
    let (access, state) = (PathBuf::from(access), PathBuf::from(state));
    let project = format!("stops-{project}");
    let builder =
        Node::builder(format!("node-{number}")).address(address.octets()).configure(move |config| {
            config.project.clone_from(&project);
            config.ndl.interface = address.into();
            (config.ndl.multicast, config.ndl.mdns_port) = (Some(group), None);
            config.ndl.period = Duration::from_millis(100);
            config.rt.probe = Duration::ZERO;
            config.security.access = Some(access.clone());
            config.state = Some(state.clone());
        });
    let view = Arc::new(View::default());
    let (shared, control) = (view.clone(), Tid::new([10, 77, 0, 1].into(), CONTROL));
    let drive = AppSpec::new(format!("drive.{number}"), move || Drive { control, view: shared.clone() });
    let messages = load.parse().expect("a number of messages");
    let to = format!("load.{}", (number + 1) % NODES);
    let loader = AppSpec::new(format!("load.{number}"), move || Loader { to: to.clone(), messages });
    let (operator, key) = sender_app(&format!("operator.{number}"));
    let mut builder = builder
        .app(drive.handles::<Torque>().own_thread())
        .app(loader.handles::<Load>().own_thread())
        .app(operator);
    if number == 0 {
        builder = builder.app(AppSpec::new("control", || Control).address(CONTROL).own_thread());
    }
    let node = builder.start().unwrap_or_else(|error| panic!("{error}"));
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    obey(&key.sender(), node.handle().address(), &view);
    node.stop();
}

/// Executes the orders of the scenario, and prints one line for each.
fn obey(operator: &Sender, own: NodeAddress, view: &View) {
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["start"] => view.starts.store(true, Ordering::SeqCst),
            ["hold"] => view.starts.store(false, Ordering::SeqCst),
            ["output"] => println!("{}", view.line()),
            ["press", within_ms] => {
                let within = Duration::from_millis(within_ms.parse().expect("milliseconds"));
                let pressed = Time::now();
                let reply = operator.press_stop("the scenario", within).expect("there is room");
                print(pressed, wait(reply));
            }
            ["status"] => ask(operator, own, &AskStop {}),
            ["release"] => ask(operator, own, &ReleaseStop { within_ms: RELEASED_WITHIN_MS }),
            _ => panic!("{line:?} is no order"),
        }
        if matches!(words[..], ["start" | "hold"]) {
            println!("done");
        }
    }
}

fn ask<P: Payload>(operator: &Sender, own: NodeAddress, question: &P) {
    let now = Time::now();
    let stop = Tid::new(own, AppAddress::STOP);
    let reply = operator.message(stop, question).ask::<StopReport>(DEADLINE).expect("there is room");
    print(now, wait(reply));
}

fn print(pressed: Time, report: Result<StopReport, AskError>) {
    let report = report.unwrap_or_else(|error| panic!("no report: {error}"));
    let word = |state: Option<StopState>| match state {
        None => "unknown",
        Some(StopState::Released) => "released",
        Some(StopState::Held) => "held",
        Some(StopState::Stopped) => "stopped",
    };
    let row = |node: &sinew::stop::StopNode| {
        json!({
            "node": node.node.to_string(), "state": word(node.state),
            "confirmed_us": node.confirmed_us, "bound_us": node.bound_us,
        })
    };
    let json = json!({
        "pressed_ns": pressed.as_nanos(), "state": word(Some(report.state)),
        "is_confirmed": report.is_confirmed(), "refused": report.refused,
        "nodes": report.nodes.iter().map(row).collect::<Vec<_>>(),
    });
    println!("{json}");
}
