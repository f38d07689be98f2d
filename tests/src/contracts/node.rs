//! The role of a node: `central` sends commands, the others obey them with a guarded output and a contract.

use std::{io::BufRead, net::SocketAddrV4, path::PathBuf, sync::Arc};

use sinew::{
    contracts::{AskContracts, Closure, Contract, ContractsReport},
    message::Sender,
    prelude::*,
    stop::{ReleaseStop, StopReport},
};
use sinew_testkit::{
    DEADLINE,
    scripted::{sender_app, wait},
};

use super::NODES;
use crate::careless::{Drive, Output, commander, drive};

/// Time from one command to the next.
pub const PERIOD: Duration = Duration::from_millis(PERIOD_MS);
const PERIOD_MS: u64 = 20;
/// Age of the newest command from which its sender is late: that of the oldest one that an output accepts.
const LATE: Duration = Duration::from_millis(160);
/// Time from the last command to a safe output: 160 ms of age, and 60 ms of silence. The contracts add the slack.
pub const WATCHDOG: Duration = Duration::from_millis(220);
/// How long a release waits for the other nodes.
const RELEASED_WITHIN_MS: u32 = 10_000;

/// `NUMBER GROUP PROJECT FOLDER SLACK_MS PLANT [ANNOUNCE]`. With the plant `missing` a drive declares no contract, with
/// `short` one of too short a time, with `none` a correct one. The last argument is the address for the other nodes.
pub(crate) fn run(arguments: &[String]) {
    let [number, group, project, folder, slack, plant, announce @ ..] = arguments else {
        panic!("six arguments and more, not {arguments:?}")
    };
    let number: u8 = number.parse().expect("the scenario counts");
    let group: SocketAddrV4 = group.parse().expect("the scenario's group");
    let announce: Option<SocketAddrV4> =
        announce.first().map(|address| address.parse().expect("an address of the scenario's network"));
    let name = NODES[usize::from(number)];
    let slack = Duration::from_millis(slack.parse().expect("milliseconds"));
    let project = format!("contracts-{project}");
    let socket = PathBuf::from(folder).join(format!("{name}.sock"));
    let builder = Node::builder(name).address([127, 0, 0, number + 1]).configure(move |config| {
        config.project.clone_from(&project);
        config.lncl.socket = Some(socket.clone());
        (config.ndl.multicast, config.ndl.mdns_port) = (Some(group), None);
        config.ndl.period = Duration::from_millis(100);
        config.rt.probe = Duration::ZERO;
        config.gncl.announce = announce;
        (config.contracts.dry_run, config.contracts.slack) = (true, slack);
    });
    let (operator, key) = sender_app(&format!("operator.{name}"));
    let output = Arc::<Output>::default();
    output.set_acknowledges(true);
    let builder = builder.app(operator);
    let builder = if number == 0 {
        let drives = NODES[1..].iter().map(|node| format!("drive.{node}"));
        builder.app(commander::<PERIOD_MS>(PERIOD, drives).own_thread())
    } else {
        builder.app(drive_with_contract(name, &output, WATCHDOG + slack, plant))
    };
    let node = builder.start().unwrap_or_else(|error| panic!("{error}"));
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    println!("up {}", node.handle().gncl_address().expect("its layers are ready"));
    execute_orders(&key.sender(), node.handle().address(), &output);
    node.stop();
}

fn drive_with_contract(
    name: &str,
    output: &Arc<Output>,
    within: Duration,
    plant: &str,
) -> AppSpec<Drive<PERIOD_MS>> {
    let drive = drive(format!("drive.{name}"), ([127, 0, 0, 1].into(), PERIOD), output).own_thread();
    let within = match plant {
        "missing" => None,
        "short" => Some(within - Duration::from_millis(1)),
        "none" => Some(within),
        other => panic!("{other:?} is no plant"),
    };
    let contract = |within| Contract::when_lost("control").or_late(LATE).or_stopped().goes_to("safe", within);
    match within {
        Some(within) => drive.contract(contract(within)),
        None => drive,
    }
}

/// Executes the orders of the scenario, and prints one line for each.
fn execute_orders(operator: &Sender, own: NodeAddress, output: &Output) {
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["output"] => println!("{} {}", u8::from(output.is_live()), output.safe_ns()),
            ["press", within_ms] => {
                let within = Duration::from_millis(within_ms.parse().expect("milliseconds"));
                let report = wait(operator.press_stop("the scenario", within).expect("there is room"));
                println!("pressed {}", report.map(|report| report.nodes.len()).unwrap_or_default());
            }
            ["release"] => {
                let stop = Tid::new(own, AppAddress::STOP);
                let order = ReleaseStop { within_ms: RELEASED_WITHIN_MS };
                let reply =
                    operator.message(stop, &order).ask::<StopReport>(DEADLINE).expect("there is room");
                let refused = wait(reply).unwrap_or_else(|error| panic!("no report: {error}")).refused;
                println!("released {}", refused.unwrap_or_default());
            }
            ["check"] => println!("{}", check(operator)),
            ["leave"] => return,
            _ => panic!("{line:?} is no order"),
        }
    }
}

/// Checks the contracts of all nodes: whether they close, the number of their rows, and the longest dry run in
/// microseconds, 0 for none.
fn check(operator: &Sender) -> String {
    let report = |number: u8| {
        let inspect = Tid::new([127, 0, 0, number + 1].into(), AppAddress::INSPECT);
        let asked = operator.message(inspect, &AskContracts {}).ask::<ContractsReport>(DEADLINE).ok()?;
        wait(asked).ok()
    };
    let reports: Vec<_> = (0..NODES.len() as u8).filter_map(report).collect();
    let closure = Closure::of(&reports);
    let closes = closure.closes() && reports.len() == NODES.len();
    let outputs = reports.iter().flat_map(|report| &report.outputs);
    let measured = outputs.filter_map(|output| output.measured_us).max().unwrap_or_default();
    format!("{} {} {measured}", u8::from(closes), closure.rows.len())
}
