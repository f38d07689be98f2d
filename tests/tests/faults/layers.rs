//! Layers that fail while applications run: which actors restart, which do not, and which failures stay
//! unnoticed.

use sinew::{NodeHandle, fault::Fault, message::Sender, prelude::*};
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run, ready_for,
    scripted::{
        Job, Script, Seen, incarnations, numbers, outcome_of_job, send_jobs, sender_app, wait,
        wait_for_numbers,
    },
    sees, until,
};
use sinew_tests::load::LAYERS;

use super::{gets_through, perform};

fn readies(node: &NodeHandle) -> [u64; 4] {
    LAYERS.map(|layer| node.lives(layer).expect("every node has it").readies)
}

/// Lets a layer panic, and waits until it and the layers after it are ready again.
#[track_caller]
fn kill(node: &NodeHandle, layer: &str) {
    let from = LAYERS.iter().position(|name| *name == layer).expect("a layer");
    let before = readies(node);
    node.inject(layer, Fault::panic()).expect("every node has it");
    for index in from..LAYERS.len() {
        ready_for(node, LAYERS[index], before[index] + 1);
    }
}

/// Two connected nodes: a scripted application on one, the test's own sender on the other, a witness on each.
struct Pair {
    here: Node,
    there: Node,
    sender: Sender,
    scripted: Log<Seen>,
    witnesses: [Log<Seen>; 2],
}

impl Pair {
    fn new() -> Self {
        let loopback = Loopback::new();
        let ((scripted, log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
        let witness = |name| {
            let (app, log) = Script::new().app(name);
            (app.handles::<NodeEvent>().handles::<RequirementEvent>().requires(["scripted"]), log)
        };
        let ((first, at_first), (second, at_second)) = (witness("first"), witness("second"));
        let there = loopback.node("there").app(scripted).app(second).start().expect("a node");
        let here = loopback.node("home").app(sender_app).app(first).start().expect("a node");
        all_run(&[&there, &here]);
        sees(&here.handle(), there.address());
        sees(&there.handle(), here.address());
        for log in [&at_first, &at_second] {
            log.wait("it is notified of the nodes", |seen| {
                seen.iter().any(|seen| matches!(seen, Seen::Node(_))).then_some(())
            });
        }
        Self { here, there, sender: key.sender(), scripted: log, witnesses: [at_first, at_second] }
    }

    #[track_caller]
    fn gets_through(&self, number: u64) {
        gets_through(&self.sender, number);
    }

    /// Checks that each witness saw the other node once, saw no loss, and runs its first incarnation.
    #[track_caller]
    fn nobody_noticed(&self) {
        for log in &self.witnesses {
            let requirement = |seen: &Seen| matches!(seen, Seen::Requirement(_));
            assert!(!log.all().iter().any(requirement), "{:?}", log.all());
        }
        self.nobody_is_lost();
    }

    /// The same, except that a long link failure may lose a requirement until the link is back. An
    /// application on the node of its requirement never loses it.
    #[track_caller]
    fn nobody_is_lost(&self) {
        let at_home = self.witnesses[1].all();
        assert!(!at_home.iter().any(|seen| matches!(seen, Seen::Requirement(_))), "{at_home:?}");
        for log in &self.witnesses {
            let name = || "scripted".to_owned();
            let (lost, met) =
                (RequirementEvent::Lost { name: name() }, RequirementEvent::Met { name: name() });
            let (lost, met) = (Seen::Requirement(lost), Seen::Requirement(met));
            let all = log.wait("as often met as lost", |seen| {
                let count = |what: &Seen| seen.iter().filter(|one| *one == what).count();
                (count(&lost) == count(&met)).then(|| seen.to_vec())
            });
            let nodes: Vec<_> = all.iter().filter(|seen| matches!(seen, Seen::Node(_))).collect();
            assert!(matches!(*nodes, [Seen::Node(NodeEvent::NodeFound { .. })]), "{nodes:?}");
            assert_eq!(incarnations(log), 1);
        }
    }
}

#[test]
fn layer_failure_restarts_later_layers_but_no_application() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").app(scripted).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    for (layer, expected) in
        [("NDL", [1, 1, 1, 2]), ("GNCL", [1, 1, 2, 3]), ("sync", [1, 2, 3, 4]), ("LNCL", [2, 3, 4, 5])]
    {
        kill(&handle, layer);
        assert_eq!(readies(&handle), expected, "after {layer}");
    }
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1)]);
}

#[test]
fn layers_become_ready_in_start_order() {
    let node = Loopback::new().node("node").start().expect("a node");
    kill(&node.handle(), "LNCL");
    let ready =
        LAYERS.map(|layer| node.handle().lives(layer).and_then(|lives| lives.ready).expect("it was ready"));
    assert!(ready.is_sorted(), "{ready:?}");
}

#[test]
fn layer_that_stops_by_itself_is_restarted() {
    let node = Loopback::new().node("node").start().expect("a node");
    for (layer, count) in [("NDL", 2), ("GNCL", 2), ("sync", 2)] {
        node.handle().inject(layer, Fault::stop()).expect("every node has it");
        ready_for(&node.handle(), layer, count);
        ready_for(&node.handle(), "NDL", node.handle().lives("NDL").expect("it").starts);
    }
}

#[test]
fn names_stay_registered_through_layer_deaths() {
    let (node, sender, _log) = perform(Script::new(), |app| app);
    all_run(&[&node]);
    let tid = sender.resolve("scripted").expect("it is registered");
    for layer in LAYERS {
        kill(&node.handle(), layer);
        assert_eq!(sender.resolve("scripted"), Some(tid), "after {layer}");
        assert!(node.handle().directory().iter().any(|entry| entry.name == "scripted"), "after {layer}");
    }
}

#[test]
fn local_messages_flow_through_layer_deaths() {
    let (node, sender, log) = perform(Script::new(), |app| app);
    all_run(&[&node]);
    let handle = node.handle();
    let killer = std::thread::spawn(move || LAYERS.map(|layer| kill(&handle, layer)));
    let mut number = 0;
    while !killer.is_finished() {
        number += 1;
        assert_eq!(outcome_of_job(&sender, "scripted", number), Outcome::Delivered);
    }
    killer.join().expect("each layer comes back");
    assert_eq!(numbers(&log.all()), (1..=number).collect::<Vec<_>>());
}

#[test]
fn link_returns_after_gncl_death_without_loss() {
    let pair = Pair::new();
    pair.gets_through(1);
    kill(&pair.here.handle(), "GNCL");
    pair.gets_through(2);
    kill(&pair.there.handle(), "GNCL");
    pair.gets_through(3);
    pair.nobody_is_lost();
}

#[test]
fn both_ends_of_a_link_may_die_at_once() {
    let pair = Pair::new();
    pair.gets_through(1);
    let (here, there) = (pair.here.handle(), pair.there.handle());
    let other = std::thread::spawn(move || kill(&there, "GNCL"));
    kill(&here, "GNCL");
    other.join().expect("it comes back");
    pair.gets_through(2);
    pair.nobody_is_lost();
}

#[test]
fn membership_survives_ndl_death_on_either_node() {
    let pair = Pair::new();
    for node in [&pair.here, &pair.there, &pair.here, &pair.there] {
        kill(&node.handle(), "NDL");
        assert_eq!(pair.here.handle().members().len(), 1);
        assert_eq!(pair.there.handle().members().len(), 1);
        assert_eq!(
            outcome_of_job(&pair.sender, "scripted", 1),
            Outcome::Delivered,
            "the link is none of NDL's"
        );
    }
    // A change of membership would arrive before a reply that is requested now.
    pair.gets_through(2);
    pair.nobody_noticed();
}

#[test]
fn restarted_ndl_finds_a_new_node() {
    let loopback = Loopback::new();
    let here = loopback.node("home").start().expect("a node");
    kill(&here.handle(), "NDL");
    let there = loopback.node("there").start().expect("a node");
    sees(&here.handle(), there.address());
    sees(&there.handle(), here.address());
}

#[test]
fn barrier_state_survives_sync_manager_death() {
    let loopback = Loopback::new();
    let (scripted, log) = Script::new().app("scripted");
    let here = loopback.node("home").app(scripted.requires(["gate"])).start().expect("a node");
    for layer in ["sync", "LNCL", "GNCL"] {
        kill(&here.handle(), layer);
        let waiting = here.handle().waiting();
        assert!(
            waiting.iter().any(|waiting| waiting.application == "scripted"),
            "after {layer}: {waiting:?}"
        );
    }
    assert_eq!(log.all(), [], "it was not let through");
    let there = loopback.node("there").app(Script::new().app("gate").0).start().expect("a node");
    all_run(&[&there, &here]);
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1)]);
}

#[test]
fn remote_requirement_returns_after_sync_manager_death() {
    let pair = Pair::new();
    for node in [&pair.here, &pair.there] {
        kill(&node.handle(), "sync");
        pair.gets_through(1);
    }
    pair.nobody_is_lost();
}

#[test]
fn failure_during_sync_manager_death_loses_no_requirement() {
    let pair = Pair::new();
    pair.gets_through(1);
    // The sync manager stays away for this long: its next start is slow.
    let slow = Fault::slow(Duration::from_millis(50)).at_start(1);
    pair.here.handle().inject("sync", slow).expect("every node has it");
    pair.here.handle().inject("sync", Fault::panic()).expect("every node has it");
    pair.there.handle().inject("scripted", Fault::panic()).expect("it is there");
    pair.scripted.wait_for(Seen::Started(2));
    pair.gets_through(2);
    let [lost, met] = [
        RequirementEvent::Lost { name: "scripted".to_owned() },
        RequirementEvent::Met { name: "scripted".to_owned() },
    ];
    // Lost and then met again, or neither was seen: never lost for good.
    pair.witnesses[0].wait("as often met as lost", |seen| {
        let count = |what: &RequirementEvent| {
            seen.iter().filter(|one| **one == Seen::Requirement(what.clone())).count()
        };
        (count(&lost) == count(&met)).then_some(())
    });
}

#[test]
fn confirmed_messages_have_one_outcome_while_gncl_dies() {
    let pair = Pair::new();
    pair.gets_through(0);
    let mut outcomes = Vec::new();
    for round in 0..4 {
        let sent: Vec<_> = (1..=50)
            .map(|number| round * 100 + number)
            .filter_map(|number| {
                Some((number, pair.sender.message("scripted", &Job { number }).confirmed(DEADLINE).ok()?))
            })
            .collect();
        kill(&pair.here.handle(), "GNCL");
        wait(async {
            for (number, confirmation) in sent {
                outcomes.push((number, confirmation.await));
            }
        });
        pair.gets_through(round * 100 + 99);
    }
    let got = numbers(&pair.scripted.all());
    for (number, outcome) in &outcomes {
        let times = got.iter().filter(|one| *one == number).count();
        match outcome {
            Outcome::Delivered => assert_eq!(times, 1, "message {number}"),
            Outcome::Unknown => assert!(times <= 1, "message {number} came {times} times"),
            Outcome::Rejected(_) | Outcome::Expired | Outcome::Failed | Outcome::PeerLost => {
                panic!("message {number} ended as {outcome:?}")
            }
        }
    }
    let mut in_order = got.clone();
    in_order.dedup();
    assert!(in_order.is_sorted(), "{got:?}");
}

#[test]
fn messages_waiting_for_a_link_survive_gncl_death() {
    let pair = Pair::new();
    pair.gets_through(1);
    // The link is down while GNCL's next start takes its time.
    let handle = pair.here.handle();
    handle.inject("GNCL", Fault::slow(Duration::from_millis(30)).at_start(1)).expect("every node has it");
    handle.inject("GNCL", Fault::panic()).expect("every node has it");
    until("GNCL is being started", || (handle.lives("GNCL")?.starts == 2).then_some(()));
    send_jobs(&pair.sender, "scripted", 2..=30);
    let got = wait_for_numbers(&pair.scripted, 30);
    assert_eq!(got, (1..=30).collect::<Vec<_>>());
}

#[test]
fn groups_reach_remote_members_after_layer_deaths() {
    let loopback = Loopback::new();
    let script = Script::new().started(|_, context| context.join("listeners"));
    let ((scripted, log), (sender_app, key)) = (script.app("scripted"), sender_app("sender"));
    let there = loopback.node("there").app(scripted).start().expect("a node");
    let here = loopback.node("home").app(sender_app).start().expect("a node");
    all_run(&[&there, &here]);
    let sender = key.sender();
    let reaches = |number| {
        until("the group is reached", || {
            // The message is not accepted while the link or the member is not known again.
            let _ = sender.send(Tid::group("listeners"), &Job { number });
            numbers(&log.all()).contains(&number).then_some(())
        });
    };
    reaches(1);
    for (number, layer) in [(2, "sync"), (3, "LNCL"), (4, "GNCL"), (5, "NDL")] {
        let node = if number % 2 == 0 { &here } else { &there };
        kill(&node.handle(), layer);
        reaches(number);
    }
}

#[test]
fn failed_layer_restart_is_retried() {
    let node =
        Loopback::new().node("node").fault("GNCL:panic@start(2), GNCL:panic@start(3), NDL:panic@start(2)");
    let node = node.start().expect("the first start succeeds");
    node.handle().inject("GNCL", Fault::panic()).expect("every node has it");
    ready_for(&node.handle(), "NDL", 2);
    assert_eq!(node.handle().lives("GNCL").map(|lives| (lives.starts, lives.readies)), Some((4, 2)));
}

#[test]
fn permanently_failed_layer_ends_the_node() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").app(scripted);
    let node = (2..9).fold(node, |node, start| node.fault(format!("sync:panic@start({start})")));
    let node = node.start().expect("the first start succeeds");
    all_run(&[&node]);
    node.handle().inject("sync", Fault::panic()).expect("every node has it");
    let sinew::node::NodeEnd::GaveUp(why) = node.wait_for_end() else { panic!("it did not give up") };
    assert!(why.starts_with("layers: more than 5 restarts"), "{why}");
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1), Seen::Stopping(1), Seen::Dropped(1)]);
}

#[test]
fn two_layers_that_die_at_once_both_return() {
    let pair = Pair::new();
    pair.gets_through(1);
    let handle = pair.here.handle();
    for (first, second) in [("LNCL", "NDL"), ("sync", "GNCL")] {
        let before = readies(&handle);
        for layer in [first, second] {
            handle.inject(layer, Fault::panic()).expect("every node has it");
        }
        ready_for(&handle, first, before[LAYERS.iter().position(|layer| *layer == first).expect("it")] + 1);
        pair.gets_through(2);
    }
    pair.nobody_is_lost();
}

#[test]
fn app_and_layer_that_die_at_once_both_return() {
    let pair = Pair::new();
    pair.gets_through(1);
    pair.there.handle().inject("scripted", Fault::panic()).expect("it is there");
    kill(&pair.there.handle(), "sync");
    pair.scripted.wait_for(Seen::Started(2));
    pair.gets_through(2);
}

/// Two nodes with applications that wait for each other, with a fault in the layers of one; all of them run
/// in the end.
#[track_caller]
fn all_run_with(fault: &str) {
    let loopback = Loopback::new();
    let app = |name: &str, requires: &[&str]| Script::new().app(name).0.requires(requires.iter().copied());
    let here = loopback.node("home").app(app("a", &["b"])).app(app("b", &[])).app(app("c", &["d"]));
    let there = loopback.node("there").app(app("d", &["a"])).app(app("e", &["c"]));
    let here = here.fault(fault).start().expect("a node");
    let there = there.start().expect("a node");
    println!("with {fault}");
    all_run(&[&here, &there]);
    sees(&here.handle(), there.address());
    sees(&there.handle(), here.address());
}

#[test]
fn sync_manager_may_die_at_any_start_event() {
    (1..=12).for_each(|event| all_run_with(&format!("sync:panic@{event}")));
}

#[test]
fn ndl_may_die_at_any_start_event() {
    (1..=8).for_each(|event| all_run_with(&format!("NDL:panic@{event}")));
}

#[test]
fn gncl_may_die_at_any_start_event() {
    (1..=3).for_each(|event| all_run_with(&format!("GNCL:panic@{event}")));
}
