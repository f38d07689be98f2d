//! A node in another language, written from `docs/protocol` alone, beside one of Sinew.

use std::{
    process::{Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use sinew::prelude::*;
use sinew_testkit::{
    DEADLINE, Loopback, NodeProcess, all_run,
    scripted::{Order, Script, Seen, Value, sender_app, wait},
};

const NODE: &str = include_str!("other_language/node.py");
/// Messages in each direction.
const COUNT: u64 = 40;
/// The value that the node in Python sends.
const VALUE: u64 = 1_000_000;

/// The node in Python; `None` on a machine without Python 3, which is reported.
fn python(loopback: &Loopback, more: &[&str]) -> Option<NodeProcess> {
    let is_there = Command::new("python3").arg("--version").stdout(Stdio::null()).status();
    if !is_there.is_ok_and(|status| status.success()) {
        println!("skipped: there is no python3 on this machine");
        return None;
    }
    let mut python = Command::new("python3");
    python.args(["-c", NODE, "sinew", "127.0.0.9", &loopback.group.to_string(), "python.arm", "drive"]);
    python.args([Order::NAME, &COUNT.to_string()]).args(more);
    Some(NodeProcess::start("node.py", python))
}

#[test]
fn python_node_is_found_and_exchanges_messages() {
    let loopback = Loopback::new();
    let Some(mut python) = python(&loopback, &[]) else { return };
    let ((drive, log), (sender_app, key)) = (Script::new().app("drive"), sender_app("sender"));
    let (waiter, events) = Script::new().app("waiter");
    let waiter = waiter.requires(["python.arm"]).handles::<NodeEvent>();
    let node = loopback.node("rust").app(drive).app(sender_app).app(waiter).start().expect("a node");
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
    assert_eq!(python.wait_for_exit(), Some(0));

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
fn python_node_uses_class_connections_and_datagrams() {
    let loopback = Loopback::new();
    let Some(mut python) = python(&loopback, &[Value::NAME, &VALUE.to_string()]) else { return };
    let ((drive, log), (sender_app, key)) = (Script::new().app("drive"), sender_app("sender"));
    let waiter = Script::new().app("waiter").0.requires(["python.arm"]);
    let node = loopback.node("rust").app(drive).app(sender_app).app(waiter).start().expect("a node");
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
                // At the end the other node leaves.
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
    assert_eq!(python.wait_for_exit(), Some(0));
    let got = log.all().into_iter().filter(|seen| matches!(seen, Seen::Got(_, VALUE)));
    assert_eq!(got.count(), 1, "however often it was sent");
}
