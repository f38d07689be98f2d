//! A node in another language, written from `docs/protocol` alone, beside one of ours.

use std::{
    process::{Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use sinew::prelude::*;
use sinew_tests::{
    DEADLINE, Ground, Program, all_run,
    puppet::{Order, Seen, Stage, Value, desk, wait},
};

const NODE: &str = include_str!("other_language/node.py");
/// Messages each way.
const COUNT: u64 = 40;
/// The value that the node in Python sends.
const VALUE: u64 = 1_000_000;

/// The node in Python, or `None`, which is said, on a machine without Python 3.
fn python(ground: &Ground, more: &[&str]) -> Option<Program> {
    let is_there = Command::new("python3").arg("--version").stdout(Stdio::null()).status();
    if !is_there.is_ok_and(|status| status.success()) {
        println!("skipped: there is no python3 on this machine");
        return None;
    }
    let mut python = Command::new("python3");
    python.args(["-c", NODE, "sinew", "127.0.0.9", &ground.group.to_string(), "python.arm", "drive"]);
    python.args([Order::NAME, &COUNT.to_string()]).args(more);
    Some(Program::start("node.py", python))
}

#[test]
fn a_node_in_python_is_found_sends_takes_confirms_and_leaves() {
    let ground = Ground::new();
    let Some(mut python) = python(&ground, &[]) else { return };
    let ((drive, log), (desk, key)) = (Stage::new().app("drive"), desk("desk"));
    let (waiter, events) = Stage::new().app("waiter");
    let waiter = waiter.requires(["python.arm"]).handles::<NodeEvent>();
    let node = ground.node("rust").app(drive).app(desk).app(waiter).start().expect("a node");
    all_run(&[&node]);

    let sender = key.sender();
    for number in 1..=COUNT {
        let sent = sender.message("python.arm", &Order { number }).confirmed(DEADLINE).expect("it has room");
        assert_eq!(wait(sent), Outcome::Delivered, "of {number}");
        python.wait_for(&[&format!("got {number}")]);
    }
    for number in 1..=COUNT {
        python.wait_for(&[&format!("outcome {number} 0")]);
    }
    python.wait_for(&["left"]);
    assert_eq!(python.wait_for_end(), Some(0));

    let got = log.all().into_iter().filter(|seen| matches!(seen, Seen::Got(..)));
    assert!(got.eq((1..=COUNT).map(|number| Seen::Got(1, number))), "once and in order");
    events.wait("the node in Python to have left", |seen| {
        let left = |seen: &Seen| {
            matches!(seen, Seen::Node(NodeEvent::NodeLost { why: sinew::events::LossReason::Left, .. }))
        };
        seen.iter().any(left).then_some(())
    });
}

#[test]
fn a_node_in_python_has_a_connection_for_each_class_and_sends_and_takes_values_by_datagram() {
    let ground = Ground::new();
    let Some(mut python) = python(&ground, &[Value::NAME, &VALUE.to_string()]) else { return };
    let ((drive, log), (desk, key)) = (Stage::new().app("drive"), desk("desk"));
    let waiter = Stage::new().app("waiter").0.requires(["python.arm"]);
    let node = ground.node("rust").app(drive).app(desk).app(waiter).start().expect("a node");
    all_run(&[&node]);

    let sender = key.sender();
    for lane in ["control", "stream", "bulk"] {
        python.wait_for(&["linked with rust for", lane]);
    }
    for number in 1..=COUNT {
        let sent = sender.message("python.arm", &Order { number }).confirmed(DEADLINE).expect("it has room");
        assert_eq!(wait(sent), Outcome::Delivered, "of {number}");
    }
    // The first ones may go by the connection: datagrams are used once one was answered.
    let has_come = Arc::new(AtomicBool::new(false));
    let giver = {
        let has_come = has_come.clone();
        std::thread::spawn(move || {
            for number in 1.. {
                if has_come.load(Ordering::Relaxed) {
                    return;
                }
                // At the end the other one leaves.
                let _ = sender.send("python.arm", &Value { number });
                std::thread::sleep(Duration::from_millis(5));
            }
        })
    };
    python.wait_for(&["value", "by datagram"]);
    has_come.store(true, Ordering::Relaxed);
    giver.join().expect("it only sends");
    python.wait_for(&["value acknowledged"]);
    log.wait_for(Seen::Got(1, VALUE));
    python.wait_for(&["left"]);
    assert_eq!(python.wait_for_end(), Some(0));
    let got = log.all().into_iter().filter(|seen| matches!(seen, Seen::Got(_, VALUE)));
    assert_eq!(got.count(), 1, "however often it was sent");
}
