//! A process of its own as a member of a supervisor of the user's: stopped, restarted and given up with its siblings.

use rustix::process::Signal;
use sinew::{Outcome, Tid};
use sinew_tests::{
    DEADLINE,
    orders::{Me, Order, Who},
};

use crate::scenario::{Scenario, Watched, signal};

/// A node with `leader` in a thread of it and then `drive` in a process of its own, both under the supervisor `leg`.
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
        let told = self.scenario.endpoint.message(self.leader, &Order::Panic).confirmed(DEADLINE);
        assert_eq!(told.expect("the node answers"), Outcome::Failed);
    }

    fn leader_is_back(&mut self) {
        let me: Me = self.scenario.endpoint.message(self.leader, &Who {}).ask(DEADLINE).expect("it answers");
        assert_eq!(me.pid, self.scenario.node.id());
    }

    /// The process that says this ended before the next life of the leader began, and the next process began behind that.
    #[track_caller]
    fn ended_and_came_back_in_order(&self, first: u32, last_words: &str, second: u32) {
        let (said, node) = (self.scenario.node.said(), self.scenario.node.id());
        let all = |what: String| {
            let is_it = move |(index, line): (usize, &String)| line.starts_with(&what).then_some(index);
            said.iter().enumerate().filter_map(is_it).collect::<Vec<_>>()
        };
        let last = *all(format!("{first} {last_words}")).last().expect("it said so");
        let leader = *all(format!("{node} started")).last().expect("it was started again");
        let next = *all(format!("{second} started")).last().expect("it was started");
        assert!(last < leader && leader < next, "{last}, {leader}, {next} of {said:#?}");
    }
}

#[test]
fn a_process_is_stopped_in_order_and_started_again_behind_the_one_before_it_that_failed() {
    let mut leg = Leg::start("rest-for-one");
    let first = leg.scenario.who().pid;
    let process = Watched::new(first);
    leg.leader_panics();
    // Sent to one that is told to stop, has ended, or is not started yet: kept all the same.
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
fn a_process_that_does_not_stop_with_its_group_is_killed_and_the_group_comes_back() {
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
fn a_process_goes_with_its_supervisor_that_gives_up_and_comes_back_with_it() {
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
fn a_process_that_is_killed_too_often_takes_its_supervisor_and_its_siblings_along_and_all_come_back() {
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
    // In order, although it was not its own failure.
    leg.scenario.node.wait_for(&[&format!("{node} stopping")]);
    leg.scenario.node.wait_for(&["more than 1 restarts"]);
}

#[test]
fn no_message_for_a_process_fails_while_its_supervisor_gives_up_and_comes_back() {
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
