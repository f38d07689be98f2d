//! A process of its own as a member of a user's supervisor: stopped and restarted with its siblings, also
//! when the supervisor gives up.

use rustix::process::Signal;
use sinew::{Outcome, Tid};
use sinew_testkit::DEADLINE;
use sinew_tests::orders::{Me, Order, Who};

use super::scenario::{Scenario, Watched, signal};

/// A node with `leader` in one of its threads and then `drive` in a process of its own, both under the
/// supervisor `leg`.
struct Leg {
    scenario: Scenario,
    leader: Tid,
}

impl Leg {
    fn start(tree: &str) -> Self {
        let mut scenario = Scenario::start(&["--tree", tree]);
        let leader = scenario.endpoint.resolve("leader", DEADLINE).expect("the node answers");
        Self { leader: leader.expect("it runs"), scenario }
    }

    fn leader_panics(&mut self) {
        let outcome = self.scenario.endpoint.message(self.leader, &Order::Panic).confirmed(DEADLINE);
        assert_eq!(outcome.expect("the node answers"), Outcome::Failed);
    }

    fn leader_is_back(&mut self) {
        let me: Me = self.scenario.endpoint.message(self.leader, &Who {}).ask(DEADLINE).expect("it answers");
        assert_eq!(me.pid, self.scenario.node.id());
    }

    /// Checks the order: the process with these last words ended before the next incarnation of the leader
    /// started, and the next process started after that.
    #[track_caller]
    fn ended_and_came_back_in_order(&self, first: u32, last_words: &str, second: u32) {
        let (lines, node) = (self.scenario.node.output(), self.scenario.node.id());
        let all = |what: String| {
            let is_it = move |(index, line): (usize, &String)| line.starts_with(&what).then_some(index);
            lines.iter().enumerate().filter_map(is_it).collect::<Vec<_>>()
        };
        let last = *all(format!("{first} {last_words}")).last().expect("it was printed");
        let leader = *all(format!("{node} started")).last().expect("it was started again");
        let next = *all(format!("{second} started")).last().expect("it was started");
        assert!(last < leader && leader < next, "{last}, {leader}, {next} of {lines:#?}");
    }
}

#[test]
fn process_is_restarted_in_order_behind_a_failed_sibling() {
    let mut leg = Leg::start("rest-for-one");
    let first = leg.scenario.who().pid;
    let process = Watched::new(first);
    leg.leader_panics();
    // Sent while it is asked to stop, has ended, or is not started yet: kept all the same.
    (1..=200).for_each(|number| leg.scenario.count(number));
    process.wait_for_end();
    let second = leg.scenario.who();
    assert_ne!(second.pid, first);
    assert_eq!(leg.scenario.count_confirmed(201), Outcome::Delivered);
    leg.leader_is_back();
    leg.scenario.node.wait_for(&[&format!("{first} stopping")]);
    leg.scenario.node.wait_for(&[&format!("{} started", second.pid)]);
    leg.ended_and_came_back_in_order(first, "stopping", second.pid);
}

#[test]
fn process_that_ignores_a_group_stop_is_killed() {
    let mut leg = Leg::start("rest-for-one");
    let first = leg.scenario.who().pid;
    let process = Watched::new(first);
    leg.scenario.order(Order::Hang);
    leg.leader_panics();
    process.wait_for_end();
    assert_ne!(leg.scenario.who().pid, first);
    leg.leader_is_back();
}

#[test]
fn process_ends_and_returns_with_its_supervisor() {
    let mut leg = Leg::start("escalation");
    let first = leg.scenario.who().pid;
    let process = Watched::new(first);
    leg.leader_panics();
    leg.leader_is_back();
    assert_eq!(leg.scenario.who().pid, first, "one for one: it is no business of its");
    // One more than its supervisor restarts.
    leg.leader_panics();
    process.wait_for_end();
    let second = leg.scenario.who().pid;
    assert_ne!(second, first);
    leg.leader_is_back();
    leg.scenario.node.wait_for(&[&format!("{first} stopping")]);
    assert_eq!(leg.scenario.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn process_killed_too_often_restarts_its_supervisor() {
    let mut leg = Leg::start("escalation");
    let node = leg.scenario.node.id();
    let mut pids = vec![leg.scenario.who().pid];
    for _ in 0..2 {
        let process = Watched::new(*pids.last().expect("there is one"));
        signal(*pids.last().expect("there is one"), Signal::KILL);
        process.wait_for_end();
        pids.push(leg.scenario.who().pid);
    }
    pids.dedup();
    assert_eq!(pids.len(), 3, "{pids:?}");
    leg.leader_is_back();
    // In order, although it did not fail itself.
    leg.scenario.node.wait_for(&[&format!("{node} stopping")]);
    leg.scenario.node.wait_for(&["more than 1 restarts"]);
}

#[test]
fn messages_for_a_process_survive_its_supervisors_restart() {
    let mut leg = Leg::start("escalation");
    let first = leg.scenario.who().pid;
    let process = Watched::new(first);
    leg.leader_panics();
    leg.leader_is_back();
    leg.leader_panics();
    for number in 1..=200 {
        assert_eq!(leg.scenario.count_confirmed(number), Outcome::Delivered, "{number}");
    }
    process.wait_for_end();
    assert_ne!(leg.scenario.who().pid, first);
}
