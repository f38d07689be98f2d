//! Supervisors that a user builds, on real nodes: strategies, escalation, children added and removed while
//! the node runs.

use std::sync::Mutex;

use sinew::{
    StartError,
    message::Rejection,
    node::{CommandError, LifeState, NodeEnd, Supervised},
    prelude::*,
    supervision::ChildCommandError,
};
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run,
    scripted::{Job, Script, ScriptedApp, Seen, incarnations, outcome_of_job, sender_app},
    until,
};

/// A scripted application that panics at message 13, and writes the start of each incarnation into a shared
/// log.
fn member(name: &'static str, order: &Log<String>) -> (AppSpec<ScriptedApp>, Log<Seen>) {
    let (begun, stopped) = (order.clone(), order.clone());
    Script::new()
        .started(move |scripted, _| begun.write(format!("{name} {}", scripted.incarnation)))
        .got(|scripted, _| assert!(scripted.number != 13, "thirteen"))
        .stopping(move |_, _| {
            stopped.write(format!("stop {name}"));
            Running::Stop
        })
        .app(name)
}

fn begun(order: &Log<String>) -> Vec<String> {
    order.all().into_iter().filter(|line| !line.starts_with("stop")).collect()
}

#[test]
fn one_for_all_restarts_all_siblings_in_order() {
    let order = Log::default();
    let [(a, _), (b, _), (c, _)] = ["a", "b", "c"].map(|name| member(name, &order));
    let (sender_app, key) = sender_app("sender");
    let leg = SupervisorSpec::new("leg").strategy(Strategy::OneForAll).app(a).app(b).app(c);
    let node = Loopback::new().node("node").supervisor(leg).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(begun(&order), ["a 1", "b 1", "c 1"]);
    assert_eq!(outcome_of_job(&key.sender(), "b", 13), Outcome::Failed);
    order.wait_for("c 2".to_owned());
    assert_eq!(order.all()[3..], ["stop c", "stop a", "a 2", "b 2", "c 2"]);
}

#[test]
fn rest_for_one_restarts_only_later_siblings() {
    let order = Log::default();
    let [(a, _), (b, _), (c, _)] = ["a", "b", "c"].map(|name| member(name, &order));
    let (sender_app, key) = sender_app("sender");
    let leg = SupervisorSpec::new("leg").strategy(Strategy::RestForOne).app(a).app(b).app(c);
    let node = Loopback::new().node("node").supervisor(leg).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "b", 13), Outcome::Failed);
    order.wait_for("c 2".to_owned());
    assert_eq!(order.all()[3..], ["stop c", "b 2", "c 2"]);
    assert_eq!(outcome_of_job(&sender, "a", 1), Outcome::Delivered);
}

#[test]
fn child_that_is_not_ready_delays_later_children() {
    let order = Log::default();
    let (open, opened) = std::sync::mpsc::sync_channel::<()>(1);
    let opened = Mutex::new(Some(opened));
    let (slow, slow_log) = Script::new()
        .started(move |scripted, context| {
            let gate = context.hold_ready().expect("asked for once in this incarnation");
            let opened = opened.lock().unwrap().take().expect("it has one incarnation");
            std::thread::spawn(move || {
                opened.recv_timeout(DEADLINE).expect("the test opens it");
                gate.reached();
            });
            scripted.note("holds");
        })
        .app("slow");
    let (next, _) = member("next", &order);
    let leg = SupervisorSpec::new("leg").strategy(Strategy::RestForOne).app(slow).app(next);
    let node = Loopback::new().node("node").supervisor(leg).start().expect("a node");
    slow_log.wait_for(Seen::Note(1, "holds"));
    // A child without requirements is released at once, so only the order can hold it.
    until("the barrier is open", || node.handle().waiting().is_empty().then_some(()));
    assert_eq!(begun(&order), [""; 0]);
    open.send(()).unwrap();
    all_run(&[&node]);
    assert_eq!(begun(&order), ["next 1"]);
}

#[test]
fn failed_supervisor_restarts_without_its_neighbours() {
    let order = Log::default();
    let [(a, _), (b, _), (outside, outside_log)] = ["a", "b", "outside"].map(|name| member(name, &order));
    let (sender_app, key) = sender_app("sender");
    let leg = SupervisorSpec::new("leg").intensity(1, DEADLINE).app(a).app(b);
    let node =
        Loopback::new().node("node").supervisor(leg).app(outside).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "a", 13), Outcome::Failed);
    order.wait_for("a 2".to_owned());
    assert_eq!(outcome_of_job(&sender, "a", 13), Outcome::Failed);
    for line in ["stop b", "a 3", "b 2"] {
        order.wait_for(line.to_owned());
    }
    assert_eq!(outcome_of_job(&sender, "a", 1), Outcome::Delivered);
    assert_eq!(incarnations(&outside_log), 1);
}

#[test]
fn escalation_ends_the_node_and_names_each_level() {
    let order = Log::default();
    let (knee, _) = Script::new().started(|_, _| panic!("no bus")).app("knee");
    let (other, _) = member("other", &order);
    let leg = SupervisorSpec::new("leg").intensity(1, DEADLINE).app(knee);
    let node = Loopback::new().node("node").app(other).supervisor(leg);
    // However long the restarts take.
    let node = node.configure(|config| {
        (config.supervision.app_restarts_max, config.supervision.app_window) = (1, 10 * DEADLINE);
    });
    let NodeEnd::GaveUp(why) = node.start().expect("its layers start").wait_for_end() else {
        panic!("it stopped as if nothing had been");
    };
    assert!(why.contains("'leg'") && why.contains("'knee'") && why.contains("no bus"), "{why}");
    assert!(order.all().contains(&"stop other".to_owned()), "an application that still runs is notified");
}

#[test]
fn stop_runs_in_reverse_order_through_all_levels() {
    let order = Log::default();
    let [(a, _), (b, _), (c, _), (d, _)] = ["a", "b", "c", "d"].map(|name| member(name, &order));
    let toes = SupervisorSpec::new("toes").app(c);
    let leg = SupervisorSpec::new("leg").app(b).supervisor(toes);
    let node = Loopback::new().node("node").app(a).supervisor(leg).app(d).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert_eq!(order.all()[4..], ["stop d", "stop c", "stop b", "stop a"]);
}

#[test]
fn app_added_at_run_time_behaves_like_others() {
    let order = Log::default();
    let (sender_app, key) = sender_app("sender");
    let node = Loopback::new().node("node").app(sender_app).supervisor(SupervisorSpec::new("leg")).start();
    let node = node.expect("a node");
    let sender = key.sender();
    let (late, _) = member("late", &order);
    node.handle().add_app(late.requires(["sender"]), Some("leg")).expect("it is taken in");
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&sender, "late", 1), Outcome::Delivered);
    assert_eq!(outcome_of_job(&sender, "late", 13), Outcome::Failed);
    order.wait_for("late 2".to_owned());
    assert_eq!(outcome_of_job(&sender, "late", 2), Outcome::Delivered);
}

#[test]
fn rejected_app_leaves_nothing_and_error_says_why() {
    let order = Log::default();
    let node = Loopback::new().node("node").app(member("first", &order).0).start().expect("a node");
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
fn stopped_app_keeps_its_tid_and_can_restart() {
    let order = Log::default();
    let ((app, log), (sender_app, key)) = (member("app", &order), sender_app("sender"));
    let node = Loopback::new().node("node").app(app).app(sender_app).start().expect("a node");
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
fn only_a_stopped_app_can_be_restarted_or_removed() {
    let order = Log::default();
    let node = Loopback::new().node("node").app(member("app", &order).0).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    for refused in [handle.restart_app("app"), handle.remove_app("app")] {
        assert!(
            matches!(refused, Err(CommandError::Refused { why: ChildCommandError::Running, .. })),
            "{refused:?}"
        );
    }
    handle.stop_app("app").expect("it stops");
    handle.remove_app("app").expect("it is removed");
    assert!(matches!(handle.restart_app("app"), Err(CommandError::Unknown(name)) if name == "app"));
    until("the name is free", || handle.resolve("app").is_none().then_some(()));
    handle.add_app(member("app", &order).0, None).expect("another one of this name");
    all_run(&[&node]);
}

#[test]
fn forbidden_command_is_rejected_with_remedy() {
    let order = Log::default();
    let node = Loopback::new().node("node").app(member("app", &order).0).start().expect("a node");
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
    // The supervisors that every node has, as the tree names them.
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
fn stopped_supervisor_restarts_its_children() {
    let order = Log::default();
    let [(a, _), (b, _)] = ["a", "b"].map(|name| member(name, &order));
    let leg = SupervisorSpec::new("leg").app(a).app(b);
    let node = Loopback::new().node("node").supervisor(leg).start().expect("a node");
    all_run(&[&node]);
    node.handle().stop_app("leg").expect("it stops");
    assert_eq!(order.all()[2..], ["stop b", "stop a"]);
    node.handle().restart_app("leg").expect("it is started again");
    order.wait_for("a 2".to_owned());
    order.wait_for("b 2".to_owned());
    all_run(&[&node]);
}

#[test]
fn end_of_a_significant_app_ends_the_node() {
    let order = Log::default();
    let (job, _) = Script::new().got(|_, context| context.stop()).app("job");
    let ((other, _), (sender_app, key)) = (member("other", &order), sender_app("sender"));
    let node = Loopback::new()
        .node("node")
        .auto_shutdown(AutoShutdown::AnySignificant)
        .app(other)
        .app(job.restart(Restart::Transient).significant())
        .app(sender_app)
        .start()
        .expect("a node");
    all_run(&[&node]);
    key.sender().send("job", &Job { number: 1 }).expect("it is there");
    assert_eq!(node.wait_for_end(), NodeEnd::Stopped);
    assert!(order.all().contains(&"stop other".to_owned()));
}

#[test]
fn finished_app_restarts_with_its_group() {
    let order = Log::default();
    let (job, job_log) = Script::new()
        .got(|scripted, context| {
            if scripted.incarnation == 1 {
                context.stop();
            }
        })
        .app("job");
    let ((other, _), (sender_app, key)) = (member("other", &order), sender_app("sender"));
    let pair = SupervisorSpec::new("pair").strategy(Strategy::OneForAll);
    let pair = pair.app(other).app(job.restart(Restart::Transient));
    let node = Loopback::new().node("node").supervisor(pair).app(sender_app).start().expect("a node");
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
fn ended_node_answers_no_command() {
    let order = Log::default();
    let node = Loopback::new().node("node").app(member("app", &order).0).start().expect("a node");
    let handle = node.handle();
    node.stop();
    assert!(matches!(handle.stop_app("app"), Err(CommandError::NotRunning)));
    assert!(matches!(handle.add_app(member("b", &order).0, None), Err(CommandError::NotRunning)));
    assert!(matches!(handle.wait_until_running(DEADLINE), Err(StartError::Ended)));
}

#[test]
fn wait_for_running_reports_the_end_of_the_node() {
    let order = Log::default();
    let waits = member("app", &order).0.requires(["nobody"]);
    let node = Loopback::new().node("node").app(waits).start().expect("a node");
    let (handle, (sender, receiver)) = (node.handle(), std::sync::mpsc::sync_channel(1));
    std::thread::spawn(move || sender.send(handle.wait_until_running(DEADLINE * 2)).expect("the test waits"));
    let handle = node.handle();
    until("the application is waited for", || (!handle.waiting().is_empty()).then_some(()));
    node.stop();
    let result = receiver.recv_timeout(DEADLINE).expect("it does not wait longer than the node lives");
    assert!(matches!(result, Err(StartError::Ended)), "{result:?}");
}

#[test]
fn tree_lists_apps_with_incarnation_and_last_end() {
    let order = Log::default();
    let ((knee, log), (sender_app, key)) = (member("knee", &order), sender_app("sender"));
    let waits = member("waits", &order).0.requires(["nobody"]);
    let leg = SupervisorSpec::new("leg").strategy(Strategy::RestForOne).app(knee).app(waits);
    let node = Loopback::new().node("node").app(sender_app).supervisor(leg).start().expect("a node");
    log.wait_for(Seen::Started(1));
    let handle = node.handle();
    assert_eq!(outcome_of_job(&key.sender(), "knee", 13), Outcome::Failed);
    let tree = until("knee is ready in its second incarnation", || {
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
fn tree_is_answered_while_an_app_hangs() {
    let (wake, sleep) = std::sync::mpsc::sync_channel::<()>(1);
    let sleep = Mutex::new(Some(sleep));
    let (sleeper, log) = Script::new()
        .got(move |_, _| {
            if let Some(sleep) = sleep.lock().unwrap().take() {
                // Ends with the test.
                _ = sleep.recv_timeout(DEADLINE);
            }
        })
        .app("sleeper");
    let (sender_app, key) = sender_app("sender");
    let node = Loopback::new()
        .node("node")
        .app(sleeper.progress_within(DEADLINE * 2))
        .app(sender_app)
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
