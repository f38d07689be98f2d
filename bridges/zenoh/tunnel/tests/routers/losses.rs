//! The barrier, order, classes of losses, and a hostile client.

use std::path::Path;

use rustix::process::Signal;
use sinew_testkit::NodeProcess;

use crate::site::{ROUTERS, Site};

/// Times that a router is killed while messages flow.
const KILLS: u64 = 6;

/// The number of a line that reports a count, and the one before it.
fn count_in(line: &str) -> Option<(u64, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["count", number, "from", _, "after", last] => Some((number.parse().ok()?, last.parse().ok()?)),
        _ => None,
    }
}

/// Requires that each count followed the one before it.
fn assert_in_order(node: &NodeProcess) {
    let counts: Vec<_> = node.output().iter().filter_map(|line| count_in(line)).collect();
    assert!(!counts.is_empty() && counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
}

/// Requires that the node saw no loss with this reason.
fn assert_no_loss(node: &NodeProcess, reason: &str) {
    let lost = |line: &&String| line.contains("NodeLost") && line.contains(reason);
    assert_eq!(node.output().iter().find(lost), None);
}

#[test]
fn barrier_and_messages_pass_while_routers_are_killed() {
    let Some(mut site) = Site::start(None) else { return };
    let mut central =
        site.node(0, &["--requires", "knee", "--requires", "ankle", "--sends-to", "ankle", "--logs"]);
    let mut knee = site.node(1, &[]);
    knee.wait_for(&["NodeFound", "central"]);
    assert!(central.output().iter().all(|line| !line.contains("started")), "the barrier holds");
    let mut ankle = site.node(2, &[]);
    central.wait_for(&["started"]);
    ankle.wait_for(&["count 50 from 10.99.0.1"]);
    for kill in 1..=KILLS {
        site.restart_router(usize::from(kill % 2 == 0));
        ankle.wait_for(&[&format!("count {} from 10.99.0.1", 50 + 100 * kill)]);
    }
    assert_in_order(&ankle);
    for node in [&central, &knee, &ankle] {
        assert_no_loss(node, "Crashed");
        assert_no_loss(node, "Hung");
    }
}

#[test]
fn losses_have_the_class_of_their_cause() {
    let Some(mut site) = Site::start(None) else { return };
    let mut central = site.node(0, &[]);
    let mut ankle = site.node(2, &[]);
    central.wait_for(&["NodeFound", "ankle"]);
    ankle.wait_for(&["NodeFound", "central"]);

    // Its process dies: its own kernel refuses the next connection.
    ankle.kill();
    central.wait_for(&["NodeLost", "ankle", "Crashed"]);
    let mut ankle = site.node(2, &[]);
    central.wait_for(&["Node", "ankle"]);
    ankle.wait_for(&["NodeFound", "central"]);

    // It is stopped: its kernel still accepts connections.
    ankle.pause();
    central.wait_for(&["NodeLost", "ankle", "Hung"]);
    ankle.signal(Signal::CONT);
    central.wait_for(&["NodeFound", "ankle"]);

    // Its host has no link.
    site.hosts.take_down(2, 2);
    central.wait_for(&["NodeLost", "ankle", "LinkDown"]);
    ankle.wait_for(&["NodeLost", "central", "LinkDown"]);
    site.hosts.bring_up(2, 2);
    central.wait_for(&["NodeFound", "ankle"]);
    ankle.wait_for(&["NodeFound", "central"]);

    // All routers are gone.
    site.routers.iter_mut().for_each(|router| assert!(router.kill()));
    central.wait_for(&["NodeLost", "ankle", "LinkDown"]);
    ankle.wait_for(&["NodeLost", "central", "LinkDown"]);
    site.routers = ROUTERS.iter().map(|router| site.router(*router)).collect();
    central.wait_for(&["NodeFound", "ankle"]);

    // The tunnel of a host is killed: its nodes run.
    assert!(site.tunnels[2].kill());
    central.wait_for(&["NodeLost", "ankle", "LinkDown"]);
    site.tunnels[2] = site.tunnel(2, None);
    central.wait_for(&["NodeFound", "ankle"]);
    assert_no_loss(&ankle, "Crashed");
}

#[test]
fn hostile_client_reads_nothing_and_changes_nothing() {
    let digits = "5e".repeat(32);
    let Some(site) = Site::start(Some(&digits)) else { return };
    let mut spy = site.hosts.all()[ROUTERS[0]].command(Path::new(env!("CARGO_BIN_EXE_sinew-zenoh-spy")));
    spy.args(["tcp/127.0.0.1:7447", "8", "central", "ankle", "scenario.count", "sinew"]);
    let mut spy = NodeProcess::start("spy", spy);
    let mut central = site.node(0, &["--requires", "ankle", "--sends-to", "ankle"]);
    let mut ankle = site.node(2, &[]);
    central.wait_for(&["started"]);
    ankle.wait_for(&["count 300 from 10.99.0.1"]);
    let line = spy.wait_for(&["puts"]);
    let words: Vec<_> = line.split(' ').collect();
    let ["puts", puts, "forged", forged, "found", found] = words[..] else { panic!("{line}") };
    assert_ne!(puts, "0", "it read puts: {line}");
    assert_ne!(forged, "0", "it forged puts: {line}");
    assert_eq!(found, "0", "it read a name or a type: {line}");
    assert_in_order(&ankle);
    assert_no_loss(&central, "ankle");
    assert_no_loss(&ankle, "central");
}
