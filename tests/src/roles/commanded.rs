//! A node with commands, and the program of a command.
//!
//! `command_node CONFIG.toml` is a node without applications but the commands of its file.
//!
//! `commanded [--dies-at-start CODE] [--never-registers] [--ready-when FILE]` is a program for such a file. It
//! registers the name of its command, and follows orders.

use std::{path::Path, process::ExitCode, time::Duration};

use rustix::process::Signal;
use sinew::{Endpoint, Node, NodeApi, NodeConfig, Outcome, Payload, Registration, client::Received};
use sinew_testkit::{DEADLINE, until};

use super::{
    Options,
    process_under_test::{signal_myself, start_a_sleeper},
};
use crate::orders::{Count, Me, Order, Who};

fn print_line(what: &str) {
    println!("{what}");
}

pub(super) fn run_node(arguments: &[String]) -> ExitCode {
    let config = NodeConfig::from_file(&arguments[0]).expect("a scenario's configuration");
    match Node::builder(config.name.clone()).config(config).heed_signals().start() {
        Ok(node) => {
            print_line("is up");
            node.run()
        }
        Err(error) => {
            print_line(&format!("refused {error}"));
            ExitCode::FAILURE
        }
    }
}

pub(super) fn run_program(arguments: &[String]) -> ExitCode {
    let options = Options(arguments);
    let variable = |name: &str| std::env::var(name).expect("the node sets it");
    let (socket, name) = (variable("SINEW_SOCKET"), variable("SINEW_NAME"));
    print_line(&format!("program {} of {name} started", std::process::id()));
    if let Some(code) = options.value("--dies-at-start") {
        std::process::exit(code.parse().expect("an exit code"));
    }
    while options.has("--never-registers") {
        std::thread::sleep(Duration::from_secs(60));
    }
    let api = NodeApi::connect(socket).expect("the node runs");
    let registration = Registration::new().name(name);
    let mut endpoint = api.register_transport_address(registration).expect("the name is its own");
    if let Some(file) = options.value("--ready-when") {
        until("the test to allow it", || Path::new(&file).exists().then_some(()));
        endpoint.ready().expect("the node runs");
    }
    let mut counts = Vec::new();
    loop {
        let received = endpoint.receive(DEADLINE).expect("the node runs");
        let Some(received) = received else { continue };
        match received.kind() {
            Count::KIND => counts.push(received.decode::<Count>().expect("it is one").number),
            Who::KIND => {
                let me = Me { pid: std::process::id(), counts: counts.clone() };
                endpoint.reply(&received, &me).expect("the node runs");
            }
            Order::KIND => {
                let order: Order = received.decode().expect("it is one");
                if matches!(order, Order::Stop) {
                    return stop(endpoint, received);
                }
                execute(&order);
            }
            _ => received.settle(Outcome::Failed),
        }
    }
}

/// Ends in order.
fn stop(endpoint: Endpoint, received: Received) -> ExitCode {
    received.settle(Outcome::Delivered);
    endpoint.unregister().expect("the node runs");
    ExitCode::SUCCESS
}

fn execute(order: &Order) {
    if let Order::Exit(code) = order {
        std::process::exit(*code);
    }
    if matches!(order, Order::Kill) {
        signal_myself(Signal::KILL);
    }
    if matches!(order, Order::Hang) {
        loop {
            std::thread::sleep(Duration::from_secs(60));
        }
    }
    if let Order::StartASleeper(in_own_group) = order {
        start_a_sleeper(*in_own_group);
    }
}
