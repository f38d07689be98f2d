//! A layer that panics beside an application in a process of its own: neither the process nor its messages
//! notice.

use std::{fs, time::Duration};

use sinew::{Outcome, client::ApiError};
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, until};
use sinew_tests::orders::{Me, Order, Who};

use super::scenario::Scenario;

/// More than a process is given at once, so the last ones wait in the mailbox.
const MESSAGES: u64 = 100;

/// The number of confirmed messages that were delivered so far.
fn delivered(node: &mut NodeProcess) -> usize {
    let lines = node.poll_output().iter();
    lines.filter(|line| line.contains(" sent ") && line.ends_with(": Delivered")).count()
}

/// Waits until the endpoint has registered a second time.
fn wait_for_reconnection(scenario: &mut Scenario) {
    until("the endpoint is registered again", || {
        match scenario.endpoint.receive(Duration::from_millis(20)) {
            // It reports the end of its connection once.
            Ok(None) | Err(ApiError::Disconnected(_)) => {}
            other => panic!("{other:?}"),
        }
        (scenario.endpoint.registrations() == 2).then_some(())
    });
}

#[test]
fn process_and_its_messages_survive_an_lncl_panic() {
    // Given: a process that handles a confirmed message of another application, with more behind it
    let directory = TestDirectory::new();
    let held = directory.write("held", "");
    let arguments = ["--tree", "rest-for-one", "--turns-within", "600000", "--layers-panic"];
    let mut scenario = Scenario::start(&arguments);
    let pid = scenario.who().pid;
    let leader = scenario.endpoint.resolve("leader", DEADLINE).expect("the node answers").expect("it runs");
    let hold = Box::new(Order::HoldWhile(held.display().to_string()));
    let sends = (1..=MESSAGES).map(|number| Order::Send("drive".to_owned(), number));
    for order in [Order::SendOrder("drive".to_owned(), hold)].into_iter().chain(sends) {
        scenario.endpoint.send(leader, &order).expect("the node takes it");
    }
    scenario.node.wait_for(&["holds"]);
    // The leader answers when it has sent all of them.
    let _: Me = scenario.endpoint.message(leader, &Who {}).ask(DEADLINE).expect("the leader answers");
    // When
    scenario.node.send_line("LNCL");
    scenario.node.wait_for(&["LNCL is ready again"]);
    assert_eq!(delivered(&mut scenario.node), 0, "the first message is still in hand");
    fs::remove_file(&held).expect("the test's own file");
    // Then: each message is delivered, the one in hand (0) first
    for number in 0..=MESSAGES {
        scenario.node.wait_for(&[&format!(" sent {number}: Delivered")]);
    }
    // And: the endpoint continues, with the same process, which has handled each message once and in order
    wait_for_reconnection(&mut scenario);
    assert_eq!(scenario.count_confirmed(MESSAGES + 1), Outcome::Delivered);
    assert_eq!(scenario.who(), Me { pid, counts: (1..=MESSAGES + 1).collect() });
    // And: no message has a second outcome
    assert_eq!(delivered(&mut scenario.node) as u64, MESSAGES + 1);
}
