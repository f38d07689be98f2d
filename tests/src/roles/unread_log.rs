//! A node for the scenarios in which the log of a node is not read.
//!
//! `unread_log CONFIG.toml [--subscriber] [--place process]`
//!
//! At each line of its standard input its application `hip` panics. The program prints the following events
//! to standard output, with the time in microseconds: `panics`, `will`, `down`, `started`. Without a
//! subscriber only the panic hook of the standard library prints messages.

use std::process::ExitCode;

use super::Options;
use crate::orders::Count;
use sinew::prelude::*;
use sinew_testkit::scripted::{Job, sender_app};

fn print_line(what: &str) {
    println!("{what} {}", Time::now().as_nanos() / 1_000);
}

struct Hip;

impl Actor for Hip {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        print_line("started");
    }
}

impl Handler<Delivery<Job>> for Hip {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {
        print_line("panics");
        panic!("this is not read");
    }
}

/// Receives the last will of `hip`, and the notification of its end.
struct Heir;

impl Heir {
    fn watch(context: &AppContext<Self>) {
        let hip = context.resolve("hip").expect("it is required");
        context.monitor(hip).expect("there is room for one");
    }
}

impl Actor for Heir {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        Self::watch(context);
        print_line("watching");
    }
}

impl Handler<Delivery<Count>> for Heir {
    type Result = ();

    fn handle(&mut self, _: Delivery<Count>, _: &mut Self::Context) {
        print_line("will");
    }
}

impl Handler<Delivery<Down>> for Heir {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, context: &mut Self::Context) {
        print_line(&format!("down {:?}", down.class));
        Self::watch(context);
    }
}

pub(super) fn run(arguments: &[String]) -> ExitCode {
    let options = Options(arguments);
    if options.has("--subscriber") {
        tracing_subscriber::fmt().with_writer(std::io::stderr).init();
    }
    let config = NodeConfig::from_file(&arguments[0]).expect("a scenario's configuration");
    let mut hip = AppSpec::new("hip", || Hip).handles::<Job>().last_will("heir", &Count { number: 1 });
    hip = if options.has("--place") { hip.own_process() } else { hip.own_thread() };
    let heir = AppSpec::new("heir", || Heir).handles::<Count>().handles::<Down>().requires(["hip"]);
    let (sender_app, key) = sender_app("sender");
    let node =
        Node::builder(config.name.clone()).config(config).app(hip).app(heir.own_thread()).app(sender_app);
    let node = node.heed_signals().start().expect("a node");
    std::thread::spawn(move || {
        let sender = key.sender();
        for _ in std::io::stdin().lines().map_while(Result::ok) {
            let hip = sender.resolve("hip").expect("it is there");
            sender.send(hip, &Job { number: 1 }).expect("its mailbox has room");
        }
    });
    node.run()
}
