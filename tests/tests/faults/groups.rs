//! Groups under supervisors of their own, and children that come and go, while other things fail.

use sinew::{fault::Fault, prelude::*};
use sinew_tests::{
    Ground, Log, all_run,
    puppet::{Job, Puppet, Seen, Stage, desk, lives, outcome_of_job, send_jobs, wait_for_numbers},
    ready_for, until,
};

use crate::node_with_a_puppet_that_fails_at_each_job;

/// Three puppets under one supervisor, and what they write down.
fn leg(strategy: Strategy) -> (SupervisorSpec, [Log<Seen>; 3]) {
    let [a, b, c] = ["a", "b", "c"].map(member);
    let leg = SupervisorSpec::new("leg").strategy(strategy).app(a.0).app(b.0).app(c.0);
    (leg, [a.1, b.1, c.1])
}

fn member(name: &str) -> (AppSpec<Puppet>, Log<Seen>) {
    Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen")).app(name)
}

#[test]
fn messages_for_every_member_of_a_group_outlive_the_restart_of_all() {
    let (leg, logs) = leg(Strategy::OneForAll);
    let (desk, key) = desk("desk");
    let node = Ground::new().node("node").supervisor(leg).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let tids = ["a", "b", "c"].map(|name| sender.resolve(name).expect("it is there"));
    for number in [1, 13, 2, 3] {
        send_jobs(&sender, "b", [number]);
    }
    for number in 1..=20 {
        for name in ["a", "c"] {
            send_jobs(&sender, name, [number]);
        }
    }
    for log in [&logs[0], &logs[2]] {
        assert_eq!(wait_for_numbers(log, 20), (1..=20).collect::<Vec<_>>());
    }
    assert_eq!(wait_for_numbers(&logs[1], 4), [1, 13, 2, 3]);
    logs.iter().for_each(|log| log.wait_for(Seen::Started(2)));
    assert_eq!(["a", "b", "c"].map(|name| sender.resolve(name)), tids.map(Some), "behind the same addresses");
}

#[test]
fn a_group_is_complete_again_when_a_layer_died_in_the_middle_of_its_restart() {
    for layer in ["LNCL", "sync", "GNCL", "NDL"] {
        let (leg, logs) = leg(Strategy::OneForAll);
        let (desk, key) = desk("desk");
        let node = Ground::new().node("node").supervisor(leg).app(desk).start().expect("a node");
        all_run(&[&node]);
        let sender = key.sender();
        send_jobs(&sender, "b", [13]);
        node.handle().inject(layer, Fault::panic()).expect("every node has it");
        logs.iter().for_each(|log| log.wait_for(Seen::Started(2)));
        for name in ["a", "b", "c"] {
            assert_eq!(outcome_of_job(&sender, name, 1), Outcome::Delivered, "{name} after {layer}");
        }
        ready_for(&node.handle(), layer, 2);
    }
}

#[test]
fn a_second_fault_while_a_group_is_restarted_is_one_more_fault_and_no_lost_member() {
    let (leg, logs) = leg(Strategy::RestForOne);
    let (desk, key) = desk("desk");
    // Both fail again on their way back.
    let node =
        Ground::new().node("node").supervisor(leg).app(desk).fault("b:panic@start(2), c:panic@start(2)");
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "a", 13), Outcome::Failed);
    for name in ["a", "b", "c"] {
        assert_eq!(outcome_of_job(&sender, name, 1), Outcome::Delivered, "{name}");
    }
    let starts = |name: &str| node.handle().lives(name).map(|lives| lives.starts);
    assert_eq!((starts("a"), starts("b"), starts("c")), (Some(2), Some(3), Some(3)));
    assert_eq!(logs.each_ref().map(lives), [2, 2, 2]);
}

#[test]
fn an_application_that_is_added_while_the_layers_die_comes_up_and_is_found() {
    let (desk, key) = desk("desk");
    let node = Ground::new().node("node").app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for (number, layer) in ["sync", "LNCL", "NDL", "GNCL"].into_iter().enumerate() {
        let handle = node.handle();
        // With the news of it in its hand, where the layer is told at all.
        handle.inject(layer, Fault::panic().at_event(1)).expect("every node has it");
        let (name, (app, log)) = (format!("late {number}"), Stage::new().app(&format!("late {number}")));
        handle.add_app(app, None).expect("its name is free");
        handle.inject(layer, Fault::panic()).expect("every node has it");
        log.wait_for(Seen::Started(1));
        until("it is found", || sender.resolve(&name));
        assert_eq!(outcome_of_job(&sender, &name, 1), Outcome::Delivered, "{layer}");
        until("it is known as ready", || {
            handle.directory().iter().any(|entry| entry.name == name && entry.ready).then_some(())
        });
        assert_eq!(lives(&log), 1);
    }
}

#[test]
fn an_application_that_is_removed_while_it_fails_is_gone_and_its_name_is_free() {
    let (node, log, sender) = node_with_a_puppet_that_fails_at_each_job();
    send_jobs(&sender, "puppet", 0..100);
    log.wait_for(Seen::Started(2));
    node.handle().stop_app("puppet").expect("it is there");
    node.handle().remove_app("puppet").expect("it is stopped");
    until("its name is free", || sender.resolve("puppet").is_none().then_some(()));
    let (next, at_next) = Stage::new().app("puppet");
    node.handle().add_app(next, None).expect("its name is free");
    at_next.wait_for(Seen::Started(1));
    assert_eq!(outcome_of_job(&sender, "puppet", 1), Outcome::Delivered);
    let count = |what: fn(&Seen) -> bool| log.all().iter().filter(|seen| what(seen)).count();
    assert_eq!(count(|seen| matches!(seen, Seen::Made(_))), count(|seen| matches!(seen, Seen::Dropped(_))));
}

#[test]
fn a_supervisor_that_gives_up_keeps_the_messages_of_its_members_for_their_next_lives() {
    let (a, at_a) = member("a");
    let (b, at_b) = member("b");
    let (desk, key) = desk("desk");
    let leg = SupervisorSpec::new("leg").intensity(0, Duration::from_secs(10)).app(a).app(b);
    let node = Ground::new().node("node").supervisor(leg).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    send_jobs(&sender, "a", [13, 1, 2]);
    for number in 1..=10 {
        sender.send("b", &Job { number }).expect("it has room");
    }
    at_a.wait_for(Seen::Got(2, 2));
    assert_eq!(wait_for_numbers(&at_b, 10), (1..=10).collect::<Vec<_>>());
    at_b.wait_for(Seen::Started(2));
}
