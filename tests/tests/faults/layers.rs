//! Layers that fail while applications run: who is restarted, who is not, and what nobody notices.

use sinew::{NodeHandle, fault::Fault, message::Sender, prelude::*};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    puppet::{Job, Seen, Stage, desk, lives, numbers, outcome_of_job, send_jobs, wait, wait_for_numbers},
    ready_for, sees, until,
};

const LAYERS: [&str; 4] = ["LNCL", "sync", "GNCL", "NDL"];

fn readies(node: &NodeHandle) -> [u64; 4] {
    LAYERS.map(|layer| node.lives(layer).expect("every node has it").readies)
}

/// A layer panics, and it and those behind it are ready again.
#[track_caller]
fn kill(node: &NodeHandle, layer: &str) {
    let from = LAYERS.iter().position(|name| *name == layer).expect("a layer");
    let before = readies(node);
    node.inject(layer, Fault::panic()).expect("every node has it");
    for index in from..LAYERS.len() {
        ready_for(node, LAYERS[index], before[index] + 1);
    }
}

/// Two nodes that see each other: a puppet there, the test's own sender here, a witness on each.
struct Pair {
    here: Node,
    there: Node,
    sender: Sender,
    puppet: Log<Seen>,
    witnesses: [Log<Seen>; 2],
}

impl Pair {
    fn new() -> Self {
        let ground = Ground::new();
        let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
        let witness = |name| {
            let (app, log) = Stage::new().app(name);
            (app.handles::<NodeEvent>().handles::<RequirementEvent>().requires(["puppet"]), log)
        };
        let ((first, at_first), (second, at_second)) = (witness("first"), witness("second"));
        let there = ground.node("there").app(puppet).app(second).start().expect("a node");
        let here = ground.node("home").app(desk).app(first).start().expect("a node");
        all_run(&[&there, &here]);
        sees(&here.handle(), there.address());
        sees(&there.handle(), here.address());
        for log in [&at_first, &at_second] {
            log.wait("it hears who is there", |seen| {
                seen.iter().any(|seen| matches!(seen, Seen::Node(_))).then_some(())
            });
        }
        Self { here, there, sender: key.sender(), puppet: log, witnesses: [at_first, at_second] }
    }

    /// The next job that gets through; those before it had an outcome, too.
    #[track_caller]
    fn gets_through(&self, number: u64) {
        until("a job gets through", || {
            let sent = self.sender.message("puppet", &Job { number }).confirmed(DEADLINE).ok()?;
            (wait(sent) == Outcome::Delivered).then_some(())
        });
    }

    /// That each witness heard of the other node once, of no loss, and lives its first life.
    #[track_caller]
    fn nobody_noticed(&self) {
        for log in &self.witnesses {
            let requirement = |seen: &Seen| matches!(seen, Seen::Requirement(_));
            assert!(!log.all().iter().any(requirement), "{:?}", log.all());
        }
        self.nobody_is_lost();
    }

    /// The same, but that a link that is down for long may take a requirement away until it is back; not from whoever is on the
    /// node of what it requires.
    #[track_caller]
    fn nobody_is_lost(&self) {
        let at_home = self.witnesses[1].all();
        assert!(!at_home.iter().any(|seen| matches!(seen, Seen::Requirement(_))), "{at_home:?}");
        for log in &self.witnesses {
            let name = || "puppet".to_owned();
            let (lost, met) =
                (RequirementEvent::Lost { name: name() }, RequirementEvent::Met { name: name() });
            let (lost, met) = (Seen::Requirement(lost), Seen::Requirement(met));
            let all = log.wait("as often met as lost", |seen| {
                let count = |what: &Seen| seen.iter().filter(|one| *one == what).count();
                (count(&lost) == count(&met)).then(|| seen.to_vec())
            });
            let nodes: Vec<_> = all.iter().filter(|seen| matches!(seen, Seen::Node(_))).collect();
            assert!(matches!(*nodes, [Seen::Node(NodeEvent::NodeFound { .. })]), "{nodes:?}");
            assert_eq!(lives(log), 1);
        }
    }
}

#[test]
fn a_layer_takes_those_behind_it_along_and_no_application() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").app(puppet).start().expect("a node");
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
fn layers_become_ready_again_in_the_order_of_their_start() {
    let node = Ground::new().node("node").start().expect("a node");
    kill(&node.handle(), "LNCL");
    let ready =
        LAYERS.map(|layer| node.handle().lives(layer).and_then(|lives| lives.ready).expect("it was ready"));
    assert!(ready.is_sorted(), "{ready:?}");
}

#[test]
fn a_layer_that_stops_by_itself_is_started_again() {
    let node = Ground::new().node("node").start().expect("a node");
    for (layer, count) in [("NDL", 2), ("GNCL", 2), ("sync", 2)] {
        node.handle().inject(layer, Fault::stop()).expect("every node has it");
        ready_for(&node.handle(), layer, count);
        ready_for(&node.handle(), "NDL", node.handle().lives("NDL").expect("it").starts);
    }
}

#[test]
fn names_stay_registered_whichever_layer_dies() {
    let ((puppet, _log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let tid = sender.resolve("puppet").expect("it is registered");
    for layer in LAYERS {
        kill(&node.handle(), layer);
        assert_eq!(sender.resolve("puppet"), Some(tid), "after {layer}");
        assert!(node.handle().directory().iter().any(|entry| entry.name == "puppet"), "after {layer}");
    }
}

#[test]
fn messages_within_a_node_flow_while_each_layer_dies() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let (sender, handle) = (key.sender(), node.handle());
    let killer = std::thread::spawn(move || LAYERS.map(|layer| kill(&handle, layer)));
    let mut number = 0;
    while !killer.is_finished() {
        number += 1;
        assert_eq!(outcome_of_job(&sender, "puppet", number), Outcome::Delivered);
    }
    killer.join().expect("each layer comes back");
    assert_eq!(numbers(&log.all()), (1..=number).collect::<Vec<_>>());
}

#[test]
fn a_link_comes_back_after_gncl_died_and_nobody_is_lost() {
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
fn membership_is_kept_while_ndl_dies_on_either_node() {
    let pair = Pair::new();
    for node in [&pair.here, &pair.there, &pair.here, &pair.there] {
        kill(&node.handle(), "NDL");
        assert_eq!(pair.here.handle().members().len(), 1);
        assert_eq!(pair.there.handle().members().len(), 1);
        assert_eq!(
            outcome_of_job(&pair.sender, "puppet", 1),
            Outcome::Delivered,
            "the link is none of NDL's"
        );
    }
    // A change of membership would be told before an answer that is asked for now.
    pair.gets_through(2);
    pair.nobody_noticed();
}

#[test]
fn a_new_node_is_found_by_an_ndl_that_was_just_restarted() {
    let ground = Ground::new();
    let here = ground.node("home").start().expect("a node");
    kill(&here.handle(), "NDL");
    let there = ground.node("there").start().expect("a node");
    sees(&here.handle(), there.address());
    sees(&there.handle(), here.address());
}

#[test]
fn a_barrier_keeps_its_state_while_the_sync_manager_dies() {
    let ground = Ground::new();
    let (puppet, log) = Stage::new().app("puppet");
    let here = ground.node("home").app(puppet.requires(["gate"])).start().expect("a node");
    for layer in ["sync", "LNCL", "GNCL"] {
        kill(&here.handle(), layer);
        let waiting = here.handle().waiting();
        assert!(waiting.iter().any(|waiting| waiting.application == "puppet"), "after {layer}: {waiting:?}");
    }
    assert_eq!(log.all(), [], "it was not let through");
    let there = ground.node("there").app(Stage::new().app("gate").0).start().expect("a node");
    all_run(&[&there, &here]);
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1)]);
}

#[test]
fn what_is_required_of_another_node_is_there_again_after_a_sync_manager_died() {
    let pair = Pair::new();
    for node in [&pair.here, &pair.there] {
        kill(&node.handle(), "sync");
        pair.gets_through(1);
    }
    pair.nobody_is_lost();
}

#[test]
fn a_requirement_that_fails_while_the_sync_manager_is_away_is_never_lost_for_good() {
    let pair = Pair::new();
    pair.gets_through(1);
    // Away for so long: its next start takes its time.
    let slow = Fault::slow(Duration::from_millis(50)).at_start(1);
    pair.here.handle().inject("sync", slow).expect("every node has it");
    pair.here.handle().inject("sync", Fault::panic()).expect("every node has it");
    pair.there.handle().inject("puppet", Fault::panic()).expect("it is there");
    pair.puppet.wait_for(Seen::Started(2));
    pair.gets_through(2);
    let [lost, met] = [
        RequirementEvent::Lost { name: "puppet".to_owned() },
        RequirementEvent::Met { name: "puppet".to_owned() },
    ];
    // Lost and met again, or neither was seen: never lost for good.
    pair.witnesses[0].wait("as often met as lost", |seen| {
        let count = |what: &RequirementEvent| {
            seen.iter().filter(|one| **one == Seen::Requirement(what.clone())).count()
        };
        (count(&lost) == count(&met)).then_some(())
    });
}

#[test]
fn confirmed_messages_between_nodes_have_exactly_one_outcome_while_gncl_dies() {
    let pair = Pair::new();
    pair.gets_through(0);
    let mut outcomes = Vec::new();
    for round in 0..4 {
        let sent: Vec<_> = (1..=50)
            .map(|number| round * 100 + number)
            .filter_map(|number| {
                Some((number, pair.sender.message("puppet", &Job { number }).confirmed(DEADLINE).ok()?))
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
    let got = numbers(&pair.puppet.all());
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
fn messages_that_waited_for_a_link_survive_the_death_of_their_own_gncl() {
    let pair = Pair::new();
    pair.gets_through(1);
    // The link is away for as long as GNCL's next start takes.
    let handle = pair.here.handle();
    handle.inject("GNCL", Fault::slow(Duration::from_millis(30)).at_start(1)).expect("every node has it");
    handle.inject("GNCL", Fault::panic()).expect("every node has it");
    until("GNCL is being started", || (handle.lives("GNCL")?.starts == 2).then_some(()));
    send_jobs(&pair.sender, "puppet", 2..=30);
    let got = wait_for_numbers(&pair.puppet, 30);
    assert_eq!(got, (1..=30).collect::<Vec<_>>());
}

#[test]
fn groups_reach_their_members_on_other_nodes_after_each_layer_died() {
    let ground = Ground::new();
    let stage = Stage::new().started(|_, context| context.join("listeners"));
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let there = ground.node("there").app(puppet).start().expect("a node");
    let here = ground.node("home").app(desk).start().expect("a node");
    all_run(&[&there, &here]);
    let sender = key.sender();
    let reaches = |number| {
        until("the group is reached", || {
            // Nobody takes it while the link or the member is not known again.
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
fn a_layer_whose_restart_fails_is_tried_again() {
    let node =
        Ground::new().node("node").fault("GNCL:panic@start(2), GNCL:panic@start(3), NDL:panic@start(2)");
    let node = node.start().expect("the first start succeeds");
    node.handle().inject("GNCL", Fault::panic()).expect("every node has it");
    ready_for(&node.handle(), "NDL", 2);
    assert_eq!(node.handle().lives("GNCL").map(|lives| (lives.starts, lives.readies)), Some((4, 2)));
}

#[test]
fn a_layer_that_never_comes_back_ends_the_node_and_its_applications_are_told() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").app(puppet);
    let node = (2..9).fold(node, |node, start| node.fault(format!("sync:panic@start({start})")));
    let node = node.start().expect("the first start succeeds");
    all_run(&[&node]);
    node.handle().inject("sync", Fault::panic()).expect("every node has it");
    let sinew::node::NodeEnd::GaveUp(why) = node.wait_for_end() else { panic!("it did not give up") };
    assert!(why.starts_with("layers: more than 5 restarts"), "{why}");
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1), Seen::Stopping(1), Seen::Dropped(1)]);
}

#[test]
fn two_layers_that_die_at_once_both_come_back() {
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
fn an_application_and_a_layer_that_die_at_once_both_come_back() {
    let pair = Pair::new();
    pair.gets_through(1);
    pair.there.handle().inject("puppet", Fault::panic()).expect("it is there");
    kill(&pair.there.handle(), "sync");
    pair.puppet.wait_for(Seen::Started(2));
    pair.gets_through(2);
}

/// Two nodes whose applications wait for each other, with a fault in the layers of one; all of them run in the end.
#[track_caller]
fn all_run_with(fault: &str) {
    let ground = Ground::new();
    let app = |name: &str, requires: &[&str]| Stage::new().app(name).0.requires(requires.iter().copied());
    let here = ground.node("home").app(app("a", &["b"])).app(app("b", &[])).app(app("c", &["d"]));
    let there = ground.node("there").app(app("d", &["a"])).app(app("e", &["c"]));
    let here = here.fault(fault).start().expect("a node");
    let there = there.start().expect("a node");
    println!("with {fault}");
    all_run(&[&here, &there]);
    sees(&here.handle(), there.address());
    sees(&there.handle(), here.address());
}

#[test]
fn a_sync_manager_may_die_with_any_event_of_the_start_in_its_hand() {
    (1..=12).for_each(|event| all_run_with(&format!("sync:panic@{event}")));
}

#[test]
fn an_ndl_may_die_with_any_event_of_the_start_in_its_hand() {
    (1..=8).for_each(|event| all_run_with(&format!("NDL:panic@{event}")));
}

#[test]
fn a_gncl_may_die_with_any_event_of_the_start_in_its_hand() {
    (1..=3).for_each(|event| all_run_with(&format!("GNCL:panic@{event}")));
}
