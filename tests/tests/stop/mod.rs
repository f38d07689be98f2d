//! The stop of the whole system: four nodes with guarded outputs, of which the first one commands all.

mod clients;

use std::sync::Arc;

use sinew::{
    message::{AskError, Rejection, Sender},
    prelude::*,
    protection::{ArmError, Cause, Guard, State},
    stop::{AskStop, PressStop, ReleaseStop, StopReport, StopState},
};
use sinew_testkit::{
    Loopback, TestDirectory, all_run,
    scripted::{SenderApp, sender_app, wait},
    until,
};
use sinew_tests::careless::{Output, commander, drive};

const PERIOD: Duration = Duration::from_millis(5);
/// The period of the limits of a command: no machine is too slow for it.
const PERIOD_MS: u64 = 5_000;
const WITHIN: Duration = Duration::from_secs(20);

/// A node with a drive, and an application that the test sends with.
struct Robot {
    node: Node,
    output: Arc<Output>,
    sender: Sender,
}

impl Robot {
    fn guard(&self) -> Guard<()> {
        until("the drive has its guard", || self.output.guard())
    }

    fn wait_until_it_moves(&self) {
        let before = self.output.moved();
        until("the output moves", || (self.output.moved() > before).then_some(()));
    }
}

fn build(builder: NodeBuilder, number: usize) -> Robot {
    let output = Arc::<Output>::default();
    let drive = drive::<PERIOD_MS>(format!("drive {number}"), ([127, 0, 0, 1].into(), PERIOD), &output);
    let (test, sender): (_, SenderApp) = sender_app(&format!("test {number}"));
    let builder = builder.configure(|config| config.ndl.period = Duration::from_millis(50));
    let mut builder = builder.app(drive).app(test);
    if number == 0 {
        let drives = (0..4).map(|number| format!("drive {number}"));
        builder = builder.app(commander::<PERIOD_MS>(PERIOD, drives));
    }
    let node = builder.start().expect("a node");
    all_run(&[&node]);
    Robot { node, output, sender: sender.sender() }
}

/// Four nodes, of which all drives move.
fn robots(network: &Loopback) -> Vec<Robot> {
    let robots: Vec<_> =
        (0..4).map(|number| build(network.node(&format!("node {number}")), number)).collect();
    robots.iter().for_each(Robot::wait_until_it_moves);
    // Each is to learn of all others.
    for robot in &robots {
        until("all nodes are known", || (status(robot).nodes.len() == 4).then_some(()));
    }
    robots
}

fn stop_of(robot: &Robot) -> Tid {
    Tid::new(robot.node.handle().address(), AppAddress::STOP)
}

fn status(robot: &Robot) -> StopReport {
    let asked = robot.sender.message(stop_of(robot), &AskStop {}).ask::<StopReport>(WITHIN);
    wait(asked.expect("there is room")).expect("an answer")
}

fn press(robot: &Robot, within: Duration) -> StopReport {
    wait(robot.sender.press_stop("a test", within).expect("there is room")).expect("an answer")
}

fn release(robot: &Robot) -> Result<StopReport, AskError> {
    let order = ReleaseStop { within_ms: 10_000 };
    wait(robot.sender.message(stop_of(robot), &order).ask::<StopReport>(WITHIN).expect("there is room"))
}

#[test]
fn all_nodes_confirm_and_a_release_moves_nothing() {
    let network = Loopback::new();
    let robots = robots(&network);
    // When: an application of the third node presses
    let report = press(&robots[2], WITHIN);
    // Then: all outputs are safe when the report is there
    assert!(report.is_confirmed() && report.nodes.len() == 4, "{report:?}");
    assert_eq!((report.presses.len(), report.presses[0].reason.as_str()), (1, "a test"));
    for robot in &robots {
        let guard = robot.guard();
        assert_eq!(guard.state(), State::Safe(Cause::Stopped));
        assert_eq!(guard.arm(), Err(ArmError::Stopped));
        assert_eq!(guard.acknowledge_stop(), Err(ArmError::Stopped), "it is in force");
    }
    // When: it is released at another node
    let report = release(&robots[1]).expect("an answer");
    assert_eq!((report.refused.clone(), report.presses.len()), (None, 0), "{report:?}");
    // Then: commands come again, and nothing moves
    for robot in &robots {
        let (guard, moved) = (robot.guard(), robot.output.moved());
        let good = guard.tally().good;
        until("twenty good commands have come", || (guard.tally().good > good + 20).then_some(()));
        assert_eq!((guard.state(), guard.arm()), (State::Safe(Cause::Stopped), Err(ArmError::Stopped)));
        assert_eq!(robot.output.moved(), moved);
    }
    // And: a person starts again
    for robot in &robots {
        robot.output.set_acknowledges(true);
        robot.wait_until_it_moves();
    }
}

#[test]
fn node_that_starts_during_a_stop_comes_up_stopped() {
    // Given: four nodes, one of which leaves
    let network = Loopback::new();
    let mut robots = robots(&network);
    let last = robots.pop().expect("there are four");
    let address = last.node.handle().address();
    last.node.stop();
    // When: the stop is pressed, and the node is started anew
    let report = press(&robots[0], WITHIN);
    assert!(report.is_confirmed(), "{report:?}");
    let again = build(network.node("node 3").address(address), 3);
    // Then
    until("it has learned of the stop", || (status(&again).state == StopState::Stopped).then_some(()));
    let guard = again.guard();
    assert_eq!(guard.arm(), Err(ArmError::Stopped));
    assert_eq!(again.output.moved(), 0);
    until("the others know that", || press_is_confirmed(&robots[0], 4));
    assert!(release(&robots[0]).expect("an answer").refused.is_none());
    assert!(guard.is_stopped() && guard.arm() == Err(ArmError::Stopped), "nothing moves by the release");
}

fn press_is_confirmed(robot: &Robot, nodes: usize) -> Option<()> {
    let report = status(robot);
    (report.is_confirmed() && report.nodes.len() == nodes).then_some(())
}

#[test]
fn stop_outlives_a_node_with_a_state_directory() {
    let (network, directory) = (Loopback::new(), TestDirectory::new());
    let state = directory.join("state");
    let start =
        |builder: NodeBuilder| build(builder.configure(|config| config.state = Some(state.clone())), 0);
    let robot = start(network.node("knee"));
    robot.wait_until_it_moves();
    let address = robot.node.handle().address();
    assert!(press(&robot, WITHIN).is_confirmed());
    until("it is written", || std::fs::read_dir(&state).ok()?.next().map(drop));
    robot.node.stop();
    let again = start(network.node("knee").address(address));
    assert_eq!(status(&again).state, StopState::Stopped);
    assert_eq!(again.guard().arm(), Err(ArmError::Stopped));
    assert!(release(&again).expect("an answer").refused.is_none());
    again.output.set_acknowledges(true);
    again.wait_until_it_moves();
}

#[test]
fn release_by_one_that_is_no_operator_is_refused() {
    let (network, directory) = (Loopback::new(), TestDirectory::new());
    let list = "[[rule]]\nfrom = ['*']\nto = ['*']\n";
    let path = directory.write("access.toml", list);
    let listed = network.node("knee").configure(|config| config.security.access = Some(path.clone()));
    let robot = build(listed, 0);
    robot.wait_until_it_moves();
    // Every application of the project may press
    assert!(press(&robot, WITHIN).is_confirmed());
    let report = release(&robot).expect("an answer");
    assert!(report.refused.is_some_and(|why| why.contains("[roles]")) && report.presses.len() == 1);
    assert_eq!(robot.guard().state(), State::Safe(Cause::Stopped));
    // When: the list names it
    let _ = directory.write("access.toml", &format!("{list}[roles]\noperators = ['test 0']\n"));
    robot.node.handle().reload_access().expect("it has no faults");
    let report = release(&robot).expect("an answer");
    assert!(report.refused.is_none() && report.presses.is_empty(), "{report:?}");
}

#[test]
fn press_that_asks_nothing_stops_too() {
    let network = Loopback::new();
    let robot = build(network.node("knee"), 0);
    let order = PressStop { reason: "a button".to_owned(), within_ms: 0 };
    let outcome = robot.sender.message(stop_of(&robot), &order).confirmed(WITHIN).expect("there is room");
    assert_eq!(wait(outcome), Outcome::Delivered);
    assert_eq!(status(&robot).state, StopState::Stopped);
}

#[test]
fn release_asked_from_another_node_is_refused() {
    let network = Loopback::new();
    let robots = robots(&network);
    assert!(press(&robots[0], WITHIN).is_confirmed());
    let (there, order) = (stop_of(&robots[0]), ReleaseStop { within_ms: 10 });
    let asked = robots[1].sender.message(there, &order).ask::<StopReport>(WITHIN).expect("there is room");
    let report = wait(asked).expect("an answer");
    assert!(report.refused.is_some() && report.state == StopState::Stopped, "{report:?}");
    let outcome = robots[1].sender.message(there, &AskStop {}).confirmed(WITHIN).expect("there is room");
    assert_eq!(wait(outcome), Outcome::Rejected(Rejection::Unsupported));
}
