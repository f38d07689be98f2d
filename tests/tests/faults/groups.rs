//! Groups under supervisors of their own, and children added and removed at run time, while other faults
//! occur.

use sinew::{fault::Fault, prelude::*};
use sinew_testkit::{
    Log, Loopback, all_run, ready_for,
    scripted::{
        Job, Script, ScriptedApp, Seen, incarnations, outcome_of_job, send_jobs, sender_app, wait_for_numbers,
    },
    until,
};

use super::node_that_fails_at_each_job;

/// Three scripted applications under one supervisor, and their logs.
fn leg(strategy: Strategy) -> (SupervisorSpec, [Log<Seen>; 3]) {
    let [a, b, c] = ["a", "b", "c"].map(member);
    let leg = SupervisorSpec::new("leg").strategy(strategy).app(a.0).app(b.0).app(c.0);
    (leg, [a.1, b.1, c.1])
}

fn member(name: &str) -> (AppSpec<ScriptedApp>, Log<Seen>) {
    Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen")).app(name)
}

#[test]
fn queued_messages_survive_a_group_restart() {
    let (leg, logs) = leg(Strategy::OneForAll);
    let (sender_app, key) = sender_app("sender");
    let node = Loopback::new().node("node").supervisor(leg).app(sender_app).start().expect("a node");
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
fn group_restart_completes_despite_a_layer_death() {
    for layer in ["LNCL", "sync", "GNCL", "NDL"] {
        let (leg, logs) = leg(Strategy::OneForAll);
        let (sender_app, key) = sender_app("sender");
        let node = Loopback::new().node("node").supervisor(leg).app(sender_app).start().expect("a node");
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
fn fault_during_group_restart_loses_no_member() {
    let (leg, logs) = leg(Strategy::RestForOne);
    let (sender_app, key) = sender_app("sender");
    // Both fail again during their restart.
    let node = Loopback::new()
        .node("node")
        .supervisor(leg)
        .app(sender_app)
        .fault("b:panic@start(2), c:panic@start(2)");
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "a", 13), Outcome::Failed);
    for name in ["a", "b", "c"] {
        assert_eq!(outcome_of_job(&sender, name, 1), Outcome::Delivered, "{name}");
    }
    let starts = |name: &str| node.handle().lives(name).map(|lives| lives.starts);
    assert_eq!((starts("a"), starts("b"), starts("c")), (Some(2), Some(3), Some(3)));
    assert_eq!(logs.each_ref().map(incarnations), [2, 2, 2]);
}

#[test]
fn app_added_while_layers_die_starts_and_is_found() {
    let (sender_app, key) = sender_app("sender");
    let node = Loopback::new().node("node").app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for (number, layer) in ["sync", "LNCL", "NDL", "GNCL"].into_iter().enumerate() {
        let handle = node.handle();
        // While it handles the event about the new application, if the layer gets one.
        handle.inject(layer, Fault::panic().at_event(1)).expect("every node has it");
        let (name, (app, log)) = (format!("late {number}"), Script::new().app(&format!("late {number}")));
        handle.add_app(app, None).expect("its name is free");
        handle.inject(layer, Fault::panic()).expect("every node has it");
        log.wait_for(Seen::Started(1));
        until("it is found", || sender.resolve(&name));
        assert_eq!(outcome_of_job(&sender, &name, 1), Outcome::Delivered, "{layer}");
        until("it is known as ready", || {
            handle.directory().iter().any(|entry| entry.name == name && entry.ready).then_some(())
        });
        assert_eq!(incarnations(&log), 1);
    }
}

#[test]
fn app_removed_while_failing_frees_its_name() {
    let (node, log, sender) = node_that_fails_at_each_job();
    send_jobs(&sender, "scripted", 0..100);
    log.wait_for(Seen::Started(2));
    node.handle().stop_app("scripted").expect("it is there");
    node.handle().remove_app("scripted").expect("it is stopped");
    until("its name is free", || sender.resolve("scripted").is_none().then_some(()));
    let (next, at_next) = Script::new().app("scripted");
    node.handle().add_app(next, None).expect("its name is free");
    at_next.wait_for(Seen::Started(1));
    assert_eq!(outcome_of_job(&sender, "scripted", 1), Outcome::Delivered);
    let count = |what: fn(&Seen) -> bool| log.all().iter().filter(|seen| what(seen)).count();
    assert_eq!(count(|seen| matches!(seen, Seen::Made(_))), count(|seen| matches!(seen, Seen::Dropped(_))));
}

#[test]
fn failed_supervisor_keeps_messages_for_restarted_members() {
    let (a, at_a) = member("a");
    let (b, at_b) = member("b");
    let (sender_app, key) = sender_app("sender");
    let leg = SupervisorSpec::new("leg").intensity(0, Duration::from_secs(10)).app(a).app(b);
    let node = Loopback::new().node("node").supervisor(leg).app(sender_app).start().expect("a node");
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
