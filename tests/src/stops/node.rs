//! The role of a node: a guarded output that is armed whenever that is possible, load, and an operator.

use std::{
    io::BufRead,
    net::{Ipv4Addr, SocketAddrV4},
    path::PathBuf,
    sync::Arc,
};

use serde_json::json;
use sinew::{
    message::{AskError, Sender},
    prelude::*,
    stop::{AskStop, ReleaseStop, StopReport, StopState},
};
use sinew_testkit::{
    DEADLINE,
    scripted::{sender_app, wait},
};

use super::NODES;
use crate::careless::{Output, commander, drive};

const PERIOD_MS: u64 = 20;
const PERIOD: Duration = Duration::from_millis(PERIOD_MS);
/// Bytes of a message of the load.
const FILLER: usize = 256;
/// How long a release waits for the other nodes.
const RELEASED_WITHIN_MS: u32 = 10_000;

payload!("stops.load", Bulk => #[derive(Debug)] struct Load {
    #[serde(with = "serde_bytes")]
    filler: Vec<u8>,
});

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
    let output = Arc::<Output>::default();
    let drive = drive::<PERIOD_MS>(format!("drive.{number}"), ([10, 77, 0, 1].into(), PERIOD), &output);
    let messages = load.parse().expect("a number of messages");
    let to = format!("load.{}", (number + 1) % NODES);
    let loader = AppSpec::new(format!("load.{number}"), move || Loader { to: to.clone(), messages });
    let (operator, key) = sender_app(&format!("operator.{number}"));
    let mut builder =
        builder.app(drive.own_thread()).app(loader.handles::<Load>().own_thread()).app(operator);
    if number == 0 {
        let drives = (0..NODES).map(|node| format!("drive.{node}"));
        builder = builder.app(commander::<PERIOD_MS>(PERIOD, drives).own_thread());
    }
    let node = builder.start().unwrap_or_else(|error| panic!("{error}"));
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    obey(&key.sender(), node.handle().address(), &output);
    node.stop();
}

/// Executes the orders of the scenario, and prints one line for each.
fn obey(operator: &Sender, own: NodeAddress, output: &Output) {
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["start"] => output.set_acknowledges(true),
            ["hold"] => output.set_acknowledges(false),
            ["output"] => {
                let (is_live, safe_ns, moved) = (output.is_live(), output.safe_ns(), output.moved());
                println!("{} {safe_ns} {moved}", u8::from(is_live));
            }
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
