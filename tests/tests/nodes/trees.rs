//! Supervisors that a user builds, on real nodes: strategies, escalation, children that come and go while the node runs.

use std::sync::Mutex;

use sinew::{
    StartError,
    message::Rejection,
    node::{CommandError, LifeState, NodeEnd, Supervised},
    prelude::*,
    supervision::Refusal,
};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    puppet::{Job, Puppet, Seen, Stage, desk, lives, outcome_of_job},
    until,
};

/// A puppet that panics over message 13, and writes the beginning of each life into a log that it shares.
fn member(name: &'static str, order: &Log<String>) -> (AppSpec<Puppet>, Log<Seen>) {
    let (begun, told) = (order.clone(), order.clone());
    Stage::new()
        .started(move |puppet, _| begun.write(format!("{name} {}", puppet.life)))
        .got(|puppet, _| assert!(puppet.number != 13, "thirteen"))
        .stopping(move |_, _| {
            told.write(format!("stop {name}"));
            Running::Stop
        })
        .app(name)
}

fn begun(order: &Log<String>) -> Vec<String> {
    order.all().into_iter().filter(|line| !line.starts_with("stop")).collect()
}

#[test]
fn one_for_all_starts_in_order_and_takes_all_siblings_with_the_one_that_fails() {
    let order = Log::default();
    let [(a, _), (b, _), (c, _)] = ["a", "b", "c"].map(|name| member(name, &order));
    let (desk, key) = desk("desk");
    let leg = SupervisorSpec::new("leg").strategy(Strategy::OneForAll).app(a).app(b).app(c);
    let node = Ground::new().node("node").supervisor(leg).app(desk).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(begun(&order), ["a 1", "b 1", "c 1"]);
    assert_eq!(outcome_of_job(&key.sender(), "b", 13), Outcome::Failed);
    order.wait_for("c 2".to_owned());
    assert_eq!(order.all()[3..], ["stop c", "stop a", "a 2", "b 2", "c 2"]);
}

#[test]
fn rest_for_one_leaves_those_before_alone() {
    let order = Log::default();
    let [(a, _), (b, _), (c, _)] = ["a", "b", "c"].map(|name| member(name, &order));
    let (desk, key) = desk("desk");
    let leg = SupervisorSpec::new("leg").strategy(Strategy::RestForOne).app(a).app(b).app(c);
    let node = Ground::new().node("node").supervisor(leg).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "b", 13), Outcome::Failed);
    order.wait_for("c 2".to_owned());
    assert_eq!(order.all()[3..], ["stop c", "b 2", "c 2"]);
    assert_eq!(outcome_of_job(&sender, "a", 1), Outcome::Delivered);
}

#[test]
fn one_that_holds_its_readiness_keeps_those_after_it_from_starting() {
    let order = Log::default();
    let (open, opened) = std::sync::mpsc::sync_channel::<()>(1);
    let opened = Mutex::new(Some(opened));
    let (slow, slow_log) = Stage::new()
        .started(move |puppet, context| {
            let gate = context.hold_ready().expect("asked for once in this life");
            let opened = opened.lock().unwrap().take().expect("it has one life");
            std::thread::spawn(move || {
                opened.recv_timeout(DEADLINE).expect("the test opens it");
                gate.reached();
            });
            puppet.say("holds");
        })
        .app("slow");
    let (next, _) = member("next", &order);
    let leg = SupervisorSpec::new("leg").strategy(Strategy::RestForOne).app(slow).app(next);
    let node = Ground::new().node("node").supervisor(leg).start().expect("a node");
    slow_log.wait_for(Seen::Said(1, "holds"));
    // What requires nothing is released at once, so that only the order can hold it.
    until("the barrier is open", || node.handle().waiting().is_empty().then_some(()));
    assert_eq!(begun(&order), [""; 0]);
    open.send(()).unwrap();
    all_run(&[&node]);
    assert_eq!(begun(&order), ["next 1"]);
}

#[test]
fn a_supervisor_that_gives_up_is_restarted_with_a_fresh_set_and_its_neighbours_live_on() {
    let order = Log::default();
    let [(a, _), (b, _), (outside, outside_log)] = ["a", "b", "outside"].map(|name| member(name, &order));
    let (desk, key) = desk("desk");
    let leg = SupervisorSpec::new("leg").intensity(1, DEADLINE).app(a).app(b);
    let node = Ground::new().node("node").supervisor(leg).app(outside).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "a", 13), Outcome::Failed);
    order.wait_for("a 2".to_owned());
    assert_eq!(outcome_of_job(&sender, "a", 13), Outcome::Failed);
    for line in ["stop b", "a 3", "b 2"] {
        order.wait_for(line.to_owned());
    }
    assert_eq!(outcome_of_job(&sender, "a", 1), Outcome::Delivered);
    assert_eq!(lives(&outside_log), 1);
}

#[test]
fn escalation_ends_the_node_and_says_who_failed_on_each_floor() {
    let order = Log::default();
    let (knee, _) = Stage::new().started(|_, _| panic!("no bus")).app("knee");
    let (other, _) = member("other", &order);
    let leg = SupervisorSpec::new("leg").intensity(1, DEADLINE).app(knee);
    let node = Ground::new().node("node").app(other).supervisor(leg);
    // However long the restarts take.
    let node = node.configure(|config| {
        (config.supervision.app_restarts_max, config.supervision.app_window) = (1, 10 * DEADLINE);
    });
    let NodeEnd::GaveUp(why) = node.start().expect("its layers start").wait_for_end() else {
        panic!("it stopped as if nothing had been");
    };
    assert!(why.contains("'leg'") && why.contains("'knee'") && why.contains("no bus"), "{why}");
    assert!(order.all().contains(&"stop other".to_owned()), "who still lives is told");
}

#[test]
fn stop_runs_backwards_through_all_floors() {
    let order = Log::default();
    let [(a, _), (b, _), (c, _), (d, _)] = ["a", "b", "c", "d"].map(|name| member(name, &order));
    let toes = SupervisorSpec::new("toes").app(c);
    let leg = SupervisorSpec::new("leg").app(b).supervisor(toes);
    let node = Ground::new().node("node").app(a).supervisor(leg).app(d).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert_eq!(order.all()[4..], ["stop d", "stop c", "stop b", "stop a"]);
}

#[test]
fn an_application_added_at_run_time_is_one_like_all_others() {
    let order = Log::default();
    let (desk, key) = desk("desk");
    let node = Ground::new().node("node").app(desk).supervisor(SupervisorSpec::new("leg")).start();
    let node = node.expect("a node");
    let sender = key.sender();
    let (late, _) = member("late", &order);
    node.handle().add_app(late.requires(["desk"]), Some("leg")).expect("it is taken in");
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&sender, "late", 1), Outcome::Delivered);
    assert_eq!(outcome_of_job(&sender, "late", 13), Outcome::Failed);
    order.wait_for("late 2".to_owned());
    assert_eq!(outcome_of_job(&sender, "late", 2), Outcome::Delivered);
}

#[test]
fn an_application_that_cannot_be_added_leaves_nothing_behind_and_the_error_says_why() {
    let order = Log::default();
    let node = Ground::new().node("node").app(member("first", &order).0).start().expect("a node");
    let handle = node.handle();
    let words = |result: Result<(), CommandError>| result.expect_err("it is refused").to_string();
    let same = words(handle.add_app(member("first", &order).0, None));
    assert!(same.contains("names are unique"), "{same}");
    let nobody = words(handle.add_app(member("second", &order).0, Some("leg")));
    assert!(nobody.contains("called 'leg'"), "{nobody}");
    let no_supervisor = words(handle.add_app(member("second", &order).0, Some("first")));
    assert!(no_supervisor.contains("'first' is an application"), "{no_supervisor}");
    assert_eq!(handle.resolve("second"), None);
    handle.add_app(member("second", &order).0, None).expect("now it is taken in");
    all_run(&[&node]);
}

#[test]
fn a_stopped_application_refuses_messages_keeps_its_tid_and_comes_back_when_it_is_told_to() {
    let order = Log::default();
    let ((app, log), (desk, key)) = (member("app", &order), desk("desk"));
    let node = Ground::new().node("node").app(app).app(desk).start().expect("a node");
    all_run(&[&node]);
    let (handle, sender) = (node.handle(), key.sender());
    let tid = handle.resolve("app").expect("it is there");
    handle.stop_app("app").expect("it stops");
    assert!(order.all().contains(&"stop app".to_owned()), "in order, before the answer comes");
    let refused = sender.send(tid, &Job { number: 1 }).expect_err("nobody takes it");
    assert!(refused.to_string().contains(&Rejection::Closed.to_string()), "{refused}");
    handle.wait_until_running(DEADLINE).expect("one that is not to run is not waited for");
    handle.restart_app("app").expect("it is started again");
    log.wait_for(Seen::Started(2));
    assert_eq!(handle.resolve("app"), Some(tid));
    assert_eq!(outcome_of_job(&sender, "app", 2), Outcome::Delivered);
}

#[test]
fn only_a_stopped_application_can_be_restarted_or_removed_and_a_removed_one_frees_its_name() {
    let order = Log::default();
    let node = Ground::new().node("node").app(member("app", &order).0).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    for refused in [handle.restart_app("app"), handle.remove_app("app")] {
        assert!(matches!(refused, Err(CommandError::Refused { why: Refusal::Running, .. })), "{refused:?}");
    }
    handle.stop_app("app").expect("it stops");
    handle.remove_app("app").expect("it is removed");
    assert!(matches!(handle.restart_app("app"), Err(CommandError::Unknown(name)) if name == "app"));
    until("the name is free", || handle.resolve("app").is_none().then_some(()));
    handle.add_app(member("app", &order).0, None).expect("another one of this name");
    all_run(&[&node]);
}

#[test]
fn who_may_not_do_what_he_asks_is_told_what_to_do_instead() {
    let order = Log::default();
    let node = Ground::new().node("node").app(member("app", &order).0).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    let words = |result: Result<(), CommandError>| result.expect_err("it is refused").to_string();
    let runs = words(handle.remove_app("app"));
    assert!(runs.contains("'app'") && runs.contains("stop it first, with `stop_app`"), "{runs}");
    for layer in ["LNCL", "sync manager", "GNCL", "NDL"] {
        let orders = [handle.stop_app(layer), handle.restart_app(layer), handle.remove_app(layer)];
        for refused in orders.into_iter().chain([handle.add_app(member("second", &order).0, Some(layer))]) {
            let refused = words(refused);
            assert!(refused.contains("is a layer") && refused.contains("`NodeHandle::stop`"), "{refused}");
        }
    }
    // Those that the node has by itself, as its tree names them.
    let own: Vec<_> = handle.tree().expect("it runs").supervisors.into_iter().map(|own| own.name).collect();
    assert_eq!(own, ["layers", "applications"]);
    for own in &own {
        for refused in [handle.stop_app(own), handle.restart_app(own), handle.remove_app(own)] {
            let refused = words(refused);
            assert!(refused.contains("is a supervisor of the node's own"), "{refused}");
        }
    }
    let under = words(handle.add_app(member("second", &order).0, Some("layers")));
    assert!(under.contains("is a supervisor of the node's own"), "{under}");
}

#[test]
fn a_stopped_supervisor_has_stopped_its_children_and_brings_them_back() {
    let order = Log::default();
    let [(a, _), (b, _)] = ["a", "b"].map(|name| member(name, &order));
    let leg = SupervisorSpec::new("leg").app(a).app(b);
    let node = Ground::new().node("node").supervisor(leg).start().expect("a node");
    all_run(&[&node]);
    node.handle().stop_app("leg").expect("it stops");
    assert_eq!(order.all()[2..], ["stop b", "stop a"]);
    node.handle().restart_app("leg").expect("it is started again");
    order.wait_for("a 2".to_owned());
    order.wait_for("b 2".to_owned());
    all_run(&[&node]);
}

#[test]
fn the_end_of_a_significant_application_is_the_end_of_the_node_in_order() {
    let order = Log::default();
    let (job, _) = Stage::new().got(|_, context| context.stop()).app("job");
    let ((other, _), (desk, key)) = (member("other", &order), desk("desk"));
    let node = Ground::new()
        .node("node")
        .auto_shutdown(AutoShutdown::AnySignificant)
        .app(other)
        .app(job.restart(Restart::Transient).significant())
        .app(desk)
        .start()
        .expect("a node");
    all_run(&[&node]);
    key.sender().send("job", &Job { number: 1 }).expect("it is there");
    assert_eq!(node.wait_for_end(), NodeEnd::Stopped);
    assert!(order.all().contains(&"stop other".to_owned()));
}

#[test]
fn one_that_had_done_its_work_comes_back_with_its_group_and_takes_messages() {
    let order = Log::default();
    let (job, job_log) = Stage::new()
        .got(|puppet, context| {
            if puppet.life == 1 {
                context.stop();
            }
        })
        .app("job");
    let ((other, _), (desk, key)) = (member("other", &order), desk("desk"));
    let pair = SupervisorSpec::new("pair").strategy(Strategy::OneForAll);
    let pair = pair.app(other).app(job.restart(Restart::Transient));
    let node = Ground::new().node("node").supervisor(pair).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    sender.send("job", &Job { number: 1 }).expect("it is there");
    job_log.wait_for(Seen::Dropped(1));
    until("its mailbox is closed", || sender.send("job", &Job { number: 2 }).is_err().then_some(()));
    assert_eq!(outcome_of_job(&sender, "other", 13), Outcome::Failed);
    job_log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "job", 3), Outcome::Delivered);
}

#[test]
fn a_node_that_has_ended_answers_no_command() {
    let order = Log::default();
    let node = Ground::new().node("node").app(member("app", &order).0).start().expect("a node");
    let handle = node.handle();
    node.stop();
    assert!(matches!(handle.stop_app("app"), Err(CommandError::NotRunning)));
    assert!(matches!(handle.add_app(member("b", &order).0, None), Err(CommandError::NotRunning)));
    assert!(matches!(handle.wait_until_running(DEADLINE), Err(StartError::Ended)));
}

#[test]
fn who_waits_until_all_run_is_told_that_the_node_ended_and_not_that_nobody_is_waited_for() {
    let order = Log::default();
    let waits = member("app", &order).0.requires(["nobody"]);
    let node = Ground::new().node("node").app(waits).start().expect("a node");
    let (handle, (say, heard)) = (node.handle(), std::sync::mpsc::sync_channel(1));
    std::thread::spawn(move || say.send(handle.wait_until_running(DEADLINE * 2)).expect("it is heard"));
    let handle = node.handle();
    until("the application is waited for", || (!handle.waiting().is_empty()).then_some(()));
    node.stop();
    let told = heard.recv_timeout(DEADLINE).expect("it does not wait longer than the node lives");
    assert!(matches!(told, Err(StartError::Ended)), "{told:?}");
}

#[test]
fn the_tree_says_who_is_there_in_which_life_and_why_the_last_one_ended() {
    let order = Log::default();
    let ((knee, log), (desk, key)) = (member("knee", &order), desk("desk"));
    let waits = member("waits", &order).0.requires(["nobody"]);
    let leg = SupervisorSpec::new("leg").strategy(Strategy::RestForOne).app(knee).app(waits);
    let node = Ground::new().node("node").app(desk).supervisor(leg).start().expect("a node");
    log.wait_for(Seen::Started(1));
    let handle = node.handle();
    assert_eq!(outcome_of_job(&key.sender(), "knee", 13), Outcome::Failed);
    let tree = until("knee is ready in its second life", || {
        let is_back = |knee: &Supervised| knee.generation == 2 && knee.state == LifeState::Ready;
        handle.tree().ok().filter(|tree| tree.find("knee").is_some_and(is_back))
    });
    let knee = tree.find("knee").expect("it is there");
    assert_eq!((knee.generation, knee.restarts, knee.tid), (2, 1, handle.resolve("knee")));
    assert!(
        knee.last_reason.as_ref().is_some_and(|reason| reason.to_string().contains("thirteen")),
        "{tree}"
    );
    assert_eq!(knee.place.as_deref(), Some("knee"));
    assert_eq!(knee.mailbox.map(|mailbox| (mailbox.depth, mailbox.high_water)), Some((0, 1)));
    assert_eq!(tree.find("waits").map(|app| app.state), Some(LifeState::WaitsForRequirements));
    let leg = tree.find("leg").and_then(|leg| leg.supervises.as_ref()).expect("it is a supervisor");
    assert_eq!((leg.children.len(), leg.restarts_in_window), (2, 1));
    assert!(tree.find("GNCL").is_some_and(|layer| layer.state == LifeState::Ready), "{tree}");
    let shown = tree.to_string();
    assert!(shown.contains("\n   `- leg: ") && shown.contains("\n      |- knee: ready"), "{shown}");
}

#[test]
fn the_tree_is_told_while_an_application_does_not_come_back() {
    let (wake, sleep) = std::sync::mpsc::sync_channel::<()>(1);
    let sleep = Mutex::new(Some(sleep));
    let (sleeper, log) = Stage::new()
        .got(move |_, _| {
            if let Some(sleep) = sleep.lock().unwrap().take() {
                // Over when the test is.
                _ = sleep.recv_timeout(DEADLINE);
            }
        })
        .app("sleeper");
    let (desk, key) = desk("desk");
    let node = Ground::new()
        .node("node")
        .app(sleeper.progress_within(DEADLINE * 2))
        .app(desk)
        .start()
        .expect("a node");
    let sender = key.sender();
    until("it is there", || sender.send("sleeper", &Job { number: 1 }).ok());
    log.wait_for(Seen::Got(1, 1));
    sender.send("sleeper", &Job { number: 2 }).expect("there is room");
    let tree = node.handle().tree().expect("the root answers");
    let depth = tree.find("sleeper").and_then(|app| app.mailbox).map(|mailbox| mailbox.depth);
    assert_eq!(depth, Some(1), "{tree}");
    drop(wake);
}
