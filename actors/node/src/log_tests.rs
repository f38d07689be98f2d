//! The standard error of a node in a program without a subscriber: the program is this one, started once
//! more.

use std::{process::Command, time::Duration};

use actix::{Actor, Handler};
use serde::{Deserialize, Serialize};
use sinew_model::config::{LogLevel, NodeConfig};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    log,
    supervision::Restart,
    wire::Payload,
};

use super::{Node, NodeBuilder};

/// Set in the started program, so that it runs the node.
const INNER: &str = "SINEW_TEST_INNER";

#[derive(Serialize, Deserialize)]
struct Gains {
    kp: f32,
}

impl Payload for Gains {
    const NAME: &'static str = "test.gains";
}

/// The same payload name in another version of the program.
#[derive(Serialize, Deserialize)]
struct OtherGains {
    kp: f64,
}

impl Payload for OtherGains {
    const NAME: &'static str = Gains::NAME;
}

struct Hip;

impl Actor for Hip {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Gains>> for Hip {
    type Result = ();

    fn handle(&mut self, gains: Delivery<Gains>, _: &mut Self::Context) {
        assert!(gains.kp.is_finite(), "a gain that no sender sent");
        panic!("kp is {}", gains.kp);
    }
}

/// Sends gains to the hip when it starts.
struct Pilot(&'static [f64]);

impl Actor for Pilot {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let hip = context.resolve("hip").expect("it is required");
        for kp in self.0 {
            context.send(hip, &OtherGains { kp: *kp }).expect("the mailbox has room");
        }
    }
}

fn node(gains: &'static [f64], address: [u8; 4]) -> NodeBuilder {
    let alone = |config: &mut NodeConfig| (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
    let hip = AppSpec::new("hip", || Hip).handles::<Gains>().restart(Restart::Temporary);
    let pilot = AppSpec::new("pilot", move || Pilot(gains)).requires(["hip"]);
    Node::builder("knee").address(address).configure(alone).app(hip).app(pilot)
}

/// Starts it, waits until its applications have run, and stops it.
fn run(node: NodeBuilder) {
    let node = node.start().expect("its layers start");
    node.handle().wait_until_running(Duration::from_secs(60)).expect("the applications start");
    node.stop();
    log::flush(Duration::from_secs(60));
}

/// The lines of the program that plays its part in this test.
fn lines(test: &str) -> Vec<String> {
    let mut inner = Command::new(std::env::current_exe().expect("this program"));
    let name = format!("{}::{test}", module_path!().trim_start_matches("sinew_node::"));
    inner.args([&*name, "--exact", "--nocapture"]).env(INNER, "1");
    for variable in ["RUST_LOG", "SINEW_LOG", "RUST_BACKTRACE"] {
        inner.env_remove(variable);
    }
    let output = inner.output().expect("it starts");
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stderr).expect("text");
    text.lines().map(str::to_owned).collect()
}

fn is_inner() -> bool {
    std::env::var_os(INNER).is_some()
}

#[test]
fn healthy_start_and_stop_logs_no_warning() {
    if is_inner() {
        return run(node(&[], [127, 0, 0, 121]));
    }
    let lines = lines("healthy_start_and_stop_logs_no_warning");
    assert!(lines.iter().all(|line| line.contains(" INFO sinew")), "{lines:#?}");
    assert!((2..=5).contains(&lines.len()), "{lines:#?}");
    let started = lines.iter().find(|line| line.contains("the node has started")).expect("it says so");
    for expected in ["node=\"knee\"", "address=127.0.0.121", "project=\"sinew\"", "interface="] {
        assert!(started.contains(expected), "{expected}: {started}");
    }
    assert!(lines.iter().any(|line| line.contains("the node stops")), "{lines:#?}");
}

#[test]
fn node_with_log_off_is_silent() {
    if is_inner() {
        return run(node(&[], [127, 0, 0, 122]).configure(|config| config.log.level = LogLevel::Off));
    }
    assert_eq!(lines("node_with_log_off_is_silent"), Vec::<String>::new());
}

#[test]
fn malformed_value_is_logged_once_with_its_field() {
    if is_inner() {
        return run(node(&[1e300; 20], [127, 0, 0, 123]));
    }
    let lines = lines("malformed_value_is_logged_once_with_its_field");
    let words = "a message was refused: this is not a test.gains: field `kp`: expected f32, found 1e300";
    let warned: Vec<_> = lines.iter().filter(|line| line.contains(words)).collect();
    assert_eq!(warned.len(), 1, "{lines:#?}");
    // And the warning from the sender's report.
    let of_sender = "test.gains that pilot (";
    let warnings: Vec<_> = lines.iter().filter(|line| line.contains(" WARN ")).collect();
    assert!(warnings.len() == 2 && warnings.iter().any(|line| line.contains(of_sender)), "{lines:#?}");
    for expected in [words, "application=\"hip\"", "tid=127.0.0.123/", "source=127.0.0.123/"] {
        assert!(warned[0].contains(expected), "{expected}: {warned:?}");
    }
}

#[test]
fn panic_is_logged_with_name_address_and_place() {
    if is_inner() {
        return run(node(&[2.5], [127, 0, 0, 124]));
    }
    let lines = lines("panic_is_logged_with_name_address_and_place");
    let logged: Vec<_> = lines.iter().filter(|line| line.contains("kp is 2.5")).collect();
    assert_eq!(logged.len(), 1, "{lines:#?}");
    assert!(
        logged[0].contains("ERROR sinew_runtime::supervision: the actor 'hip' (127.0.0.124/"),
        "{logged:?}"
    );
    assert!(
        lines.iter().any(|line| line.contains("a child failed") && line.contains("a panic at ")),
        "{lines:#?}"
    );
    assert!(
        !lines.iter().any(|line| line.starts_with("thread '")),
        "not the standard hook as well: {lines:#?}"
    );
}
