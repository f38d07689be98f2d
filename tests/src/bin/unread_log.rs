//! A node for the scenarios in which nobody reads what a node logs.
//!
//! `unread_log CONFIG.toml [--subscriber] [--place process]`
//!
//! At each line of its standard input its application `hip` panics. What follows is said on the standard output, with the time
//! in microseconds: `panics`, `will`, `down`, `started`. Without a subscriber the standard library's panic hook speaks alone.

use std::process::ExitCode;

use sinew::prelude::*;
use sinew_tests::{
    orders::Count,
    puppet::{Job, desk},
};

fn say(what: &str) {
    println!("{what} {}", Time::now().as_nanos() / 1_000);
}

struct Hip;

impl Actor for Hip {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        say("started");
    }
}

impl Handler<Delivery<Job>> for Hip {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {
        say("panics");
        panic!("this is what nobody reads");
    }
}

/// Gets the hip's will, and hears of its end.
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
        say("watching");
    }
}

impl Handler<Delivery<Count>> for Heir {
    type Result = ();

    fn handle(&mut self, _: Delivery<Count>, _: &mut Self::Context) {
        say("will");
    }
}

impl Handler<Delivery<Down>> for Heir {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, context: &mut Self::Context) {
        say(&format!("down {:?}", down.class));
        Self::watch(context);
    }
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let is_set = |flag: &str| arguments.iter().any(|argument| argument == flag);
    if is_set("--subscriber") {
        tracing_subscriber::fmt().with_writer(std::io::stderr).init();
    }
    let config = NodeConfig::from_file(&arguments[0]).expect("a scenario's configuration");
    let mut hip = AppSpec::new("hip", || Hip).handles::<Job>().last_will("heir", &Count { number: 1 });
    hip = if is_set("--place") { hip.own_process() } else { hip.own_thread() };
    let heir = AppSpec::new("heir", || Heir).handles::<Count>().handles::<Down>().requires(["hip"]);
    let (desk, key) = desk("desk");
    let node = Node::builder(config.name.clone()).config(config).app(hip).app(heir.own_thread()).app(desk);
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
