//! Last wills: sent on behalf of an application that died, once, behind all that it sent itself.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use rustix::process::Signal;
use sinew::{StartError, fault::Fault, message::Sender, node::NodeEnd, prelude::*, supervision::Reason};
use sinew_tests::{
    Ground, Log, OwnDirectory, Program, all_run, node_under_test, own_group,
    puppet::{Job, Order, Puppet, Seen, Stage, desk, lives, numbers, outcome_of_job},
};

/// The payload of the wills; whatever else is sent has another number.
const WILL: Order = Order { number: 1_000_000 };

fn wills(log: &Log<Seen>) -> usize {
    numbers(&log.all()).into_iter().filter(|number| *number == WILL.number).count()
}

/// The heir, called `heir`, and what it saw.
fn heir() -> (AppSpec<Puppet>, Log<Seen>) {
    Stage::new().app("heir")
}

/// Ends at the first message, after it has sent `before` orders to the heir.
fn mortal(before: u64) -> (AppSpec<Puppet>, Log<Seen>) {
    let last_words = move |_: &mut Puppet, context: &mut AppContext<Puppet>| {
        for number in 1..=before {
            context.send("heir", &Order { number }).expect("the heir has room");
        }
        panic!("its end");
    };
    Stage::new().got(last_words).app("mortal")
}

/// Lets the mortal end; returns when it lives again.
fn kill(sender: &Sender, log: &Log<Seen>) {
    let next = lives(log) as u64 + 1;
    assert_eq!(outcome_of_job(sender, "mortal", 1), Outcome::Failed);
    log.wait_for(Seen::Started(next));
}

#[test]
fn a_will_comes_once_for_each_death_and_behind_all_that_the_dead_one_sent() {
    let ((mortal, log), (heir, seen), (desk, key)) = (mortal(100), heir(), desk("desk"));
    let mortal = mortal.last_will("heir", &WILL);
    let node = Ground::new().node("node").app(heir).app(mortal).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for death in 1..=3 {
        seen.wait_for_many(Seen::Got(1, 100), death - 1);
        assert_eq!(wills(&seen), death - 1);
        assert_eq!(outcome_of_job(&sender, "mortal", 1), Outcome::Failed);
        seen.wait_for_many(Seen::Got(1, WILL.number), death);
        log.wait_for_many(Seen::Started(death as u64 + 1), 1);
    }
    let expected: Vec<u64> = (1..=100).chain([WILL.number]).collect();
    assert_eq!(numbers(&seen.all()), expected.repeat(3));
}

#[test]
fn a_will_is_sent_after_a_missed_start_and_not_after_an_orderly_end_unless_it_says_so() {
    for (when, expected) in [(LastWill::OnDeath, 0), (LastWill::Always, 1)] {
        // Given: one that ends by itself, and stays away
        let (leaver, log) = Stage::new().got(|_, context| context.stop()).app("mortal");
        let leaver = leaver.last_will_when(when, "heir", &WILL).restart(Restart::Temporary);
        // and one that does not become ready in its time
        let (sleeper, _) = Stage::new()
            .started(|puppet, context| {
                if puppet.life == 1 {
                    std::mem::forget(context.hold_ready());
                }
            })
            .app("sleeper");
        let sleeper = sleeper.start_within(Duration::from_secs(2)).last_will("heir", &Order { number: 7 });
        let ((heir, seen), (desk, key)) = (heir(), desk("desk"));
        let node = Ground::new().node("node").app(heir).app(leaver).app(sleeper).app(desk);
        let node = node.start().expect("a node");
        all_run(&[&node]);
        seen.wait_for(Seen::Got(1, 7));
        // When
        let sender = key.sender();
        assert_eq!(outcome_of_job(&sender, "mortal", 1), Outcome::Delivered);
        log.wait_for(Seen::Dropped(1));
        let gone = || node.handle().resolve("mortal").is_none().then_some(());
        sinew_tests::until("it is gone", gone);
        // Then: what is sent now comes behind a will, if there is one
        sender.send("heir", &Order { number: 8 }).expect("it has room");
        seen.wait_for(Seen::Got(1, 8));
        assert_eq!(wills(&seen), expected, "{when:?}");
    }
}

#[test]
fn wills_go_to_names_groups_and_tids_in_the_class_of_their_payload() {
    let ((mortal, log), (heir, seen), (desk, key)) = (mortal(0), heir(), desk("desk"));
    let (member, member_seen) = Stage::new().started(|_, context| context.join("mourners")).app("member");
    let address = AppAddress::fixed(7).expect("a fixed one");
    let (fixed, fixed_seen) = Stage::new().app("fixed");
    let mortal = mortal
        .last_will("heir", &WILL)
        .last_will(Tid::group("mourners"), &WILL)
        .last_will(Tid::new(NodeAddress::HERE, address), &Job { number: 2 })
        .last_will("nobody", &WILL);
    let node = Ground::new().node("node");
    let node = node.app(heir).app(member).app(fixed.address(address)).app(mortal).app(desk).start();
    let node = node.expect("a node");
    all_run(&[&node]);
    kill(&key.sender(), &log);
    seen.wait_for(Seen::Got(1, WILL.number));
    member_seen.wait_for(Seen::Got(1, WILL.number));
    fixed_seen.wait_for(Seen::Got(1, 2));
    assert_eq!((wills(&seen), wills(&member_seen)), (1, 1));
}

#[test]
fn a_will_reaches_another_node_behind_all_that_the_dead_one_sent() {
    let ground = Ground::new();
    let ((mortal, log), (heir, seen), (desk, key)) = (mortal(100), heir(), desk("desk"));
    let mortal = mortal.requires(["heir"]).last_will("heir", &WILL);
    let there = ground.node("there").app(heir).start().expect("a node");
    let here = ground.node("home").app(mortal).app(desk).start().expect("a node");
    all_run(&[&there, &here]);
    kill(&key.sender(), &log);
    seen.wait_for(Seen::Got(1, WILL.number));
    assert_eq!(numbers(&seen.all()), (1..=100).chain([WILL.number]).collect::<Vec<_>>());
}

#[test]
fn wills_are_sent_when_the_supervisor_of_the_applications_fails_itself() {
    let ground = Ground::new();
    // One that ends in order when it is told to, and one that does not end in its time.
    let (hung, _) = Stage::new().stopping(|_, _| Running::Continue).app("hung");
    let hung = hung
        .requires(["heir"])
        .stop_within(Duration::from_millis(50))
        .last_will("heir", &Order { number: 7 });
    let ((mortal, log), (heir, seen)) = (mortal(0), heir());
    let mortal = mortal.requires(["heir"]).last_will("heir", &WILL);
    let there = ground.node("there").app(heir).start().expect("a node");
    let here = ground.node("home").app(mortal).app(hung).start().expect("a node");
    all_run(&[&there, &here]);
    here.handle().fail_supervisor();
    seen.wait_for(Seen::Got(1, WILL.number));
    seen.wait_for(Seen::Got(1, 7));
    assert!(log.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "it was told: {:?}", log.all());
    let NodeEnd::GaveUp(why) = here.wait_for_end() else { panic!("it gave up") };
    assert!(why.contains("their supervisor panicked: a fault was planned for a supervisor"), "{why}");
    // The goodbye of a node that ends in order is no second reason for them.
    sinew_tests::until("the node is gone", || there.handle().members().is_empty().then_some(()));
    assert_eq!((wills(&seen), numbers(&seen.all()).len()), (1, 2));
}

/// Nobody is left on that node who could send them, and nobody who says goodbye.
#[test]
fn wills_of_a_node_whose_layers_have_given_up_are_executed_by_the_others() {
    let ground = Ground::new();
    let ((mortal, log), (heir, seen)) = (mortal(0), heir());
    let mortal = mortal.last_will("heir", &WILL);
    let there = ground.node("there").app(heir.requires(["mortal"])).start().expect("a node");
    let here = ground.node("home").configure(|config| config.supervision.layer_restarts_max = 0);
    let here = here.app(mortal).start().expect("a node");
    all_run(&[&here, &there]);
    here.handle().inject("NDL", Fault::panic()).expect("every node has it");
    seen.wait_for(Seen::Got(1, WILL.number));
    assert!(matches!(here.wait_for_end(), NodeEnd::GaveUp(_)));
    assert!(log.all().contains(&Seen::Stopping(1)), "it was told to stop as well");
    assert_eq!(wills(&seen), 1);
}

#[test]
fn more_than_eight_wills_are_refused_in_words() {
    let (mut mortal, _log) = mortal(0);
    for _ in 0..9 {
        mortal = mortal.last_will("heir", &WILL);
    }
    let error = Ground::new().node("node").app(mortal).start().expect_err("it is too many");
    assert!(matches!(error, StartError::Application { .. }));
    assert!(error.to_string().contains("9 last wills are more than the 8"), "{error}");
}

/// 200 applications die one after the other. Seen with `--nocapture`.
#[test]
fn the_time_from_a_death_to_its_will_is_printed() {
    const DEATHS: usize = 200;
    let died = Arc::new(Mutex::new(Time::ZERO));
    let (latencies, mut node) = (Log::<u64>::default(), Ground::new().node("node"));
    for number in 0..DEATHS {
        let died = died.clone();
        let end = move |_: &mut Puppet, _: &mut AppContext<Puppet>| {
            *died.lock().expect("nobody panics with it") = Time::now();
            panic!("its end");
        };
        let (mortal, _) = Stage::new().got(end).app(&format!("mortal {number}"));
        // On one thread together, and not started again: the node would give up.
        let mortal = mortal.place(Place::thread("mortals")).restart(Restart::Temporary);
        node = node.app(mortal.last_will("heir", &WILL));
    }
    let noted = latencies.clone();
    let note = move |_: &mut Puppet, _: &mut AppContext<Puppet>| {
        noted.write(Time::now().since(*died.lock().expect("nobody panics with it")).as_nanos() as u64);
    };
    let ((heir, _), (desk, key)) = (Stage::new().got(note).app("heir"), desk("desk"));
    let node = node.app(heir).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for number in 0..DEATHS {
        sender.send(&*format!("mortal {number}"), &Job { number: 1 }).expect("it has room");
        latencies.wait("the will", |all| (all.len() > number).then_some(()));
    }
    let mut all = latencies.all();
    all.sort_unstable();
    let (half, most) = (all[DEATHS / 2] / 1_000, all[DEATHS * 99 / 100] / 1_000);
    println!("death to will received, {DEATHS} deaths: p50 {half} us, p99 {most} us");
}

/// The hip on 127.0.0.1 is the heir of the knee on 127.0.0.2, and of the ankle on 127.0.0.3.
struct Processes {
    directory: OwnDirectory,
    group: std::net::SocketAddrV4,
}

impl Processes {
    fn start(&self, name: &str, address: u8, more: &[&str]) -> Program {
        let path = self.directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"wills\"\n\
             [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            self.group
        );
        std::fs::write(&path, text).expect("the test's own directory");
        node_under_test(None, &path, more)
    }
}

#[test]
fn the_wills_of_a_killed_node_are_executed_by_the_others_and_those_of_one_that_stops_are_not() {
    let processes = Processes { directory: OwnDirectory::new(), group: own_group() };
    // That the hip has started proves that it knows the others, and their wills.
    let mut hip = processes.start("hip", 1, &["--requires", "knee", "--requires", "ankle"]);
    let knee = processes.start("knee", 2, &["--will", "hip", "--will", "ankle", "--will", "nobody"]);
    let mut ankle = processes.start("ankle", 3, &["--will", "hip", "--requires", "knee"]);
    hip.wait_for(&["started"]);
    ankle.wait_for(&["started"]);
    knee.signal(Signal::KILL);
    hip.wait_for(&["count 1000000 from 127.0.0.2"]);
    ankle.wait_for(&["count 1000000 from 127.0.0.2"]);
    // The next life of the knee has wills, too.
    let knee = processes.start("knee", 2, &["--will", "hip"]);
    hip.wait_for(&["Met", "knee"]);
    knee.signal(Signal::KILL);
    hip.wait_for(&["count 1000000 from 127.0.0.2"]);
    hip.wait_for(&["NodeLost", "knee"]);
    ankle.signal(Signal::TERM);
    hip.wait_for(&["NodeLost", "ankle", "Left"]);
    let _knee = processes.start("knee", 2, &[]);
    hip.wait_for(&["Met", "knee"]);
    let is_will = |line: &&String| line.contains("count 1000000");
    assert_eq!(hip.said().iter().filter(is_will).count(), 2, "{:?}", hip.said());
}

/// Stops at the first message, and panics in each drop.
fn messy() -> (AppSpec<Puppet>, Log<Seen>) {
    let stage = Stage::new().got(|_, context| context.stop()).dropped(|_| panic!("its drop"));
    stage.app("mortal")
}

#[test]
fn who_stops_by_itself_and_panics_in_drop_has_failed_and_its_will_is_sent() {
    let ((mortal, log), (heir, seen), (desk, key)) = (messy(), heir(), desk("desk"));
    let mortal = mortal.restart(Restart::Transient).last_will("heir", &WILL);
    let node = Ground::new().node("node").app(heir).app(mortal).app(desk).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&key.sender(), "mortal", 1), Outcome::Delivered);
    seen.wait_for(Seen::Got(1, WILL.number));
    log.wait_for(Seen::Started(2));
    let ended = reason_of_last_end(&node, "mortal");
    assert!(matches!(&ended, Some(Reason::Panic(said)) if said.contains("its drop")), "{ended:?}");
}

#[test]
fn who_is_told_to_stop_and_panics_in_drop_is_told_of_as_panicked_and_neither_started_again_nor_counted() {
    let ((mortal, log), (heir, seen)) = (messy(), heir());
    let mortal = mortal.last_will("heir", &WILL);
    let node = Ground::new().node("node").configure(|config| config.supervision.app_restarts_max = 0);
    let node = node.app(heir).app(mortal).start().expect("a node");
    all_run(&[&node]);
    node.handle().stop_app("mortal").expect("it is there");
    seen.wait_for(Seen::Got(1, WILL.number));
    let ended = reason_of_last_end(&node, "mortal");
    assert!(matches!(&ended, Some(Reason::Panic(said)) if said.contains("its drop")), "{ended:?}");
    // No restart is allowed: one that is counted ends the node.
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert_eq!(lives(&log), 1);
}

fn reason_of_last_end(node: &Node, name: &str) -> Option<Reason> {
    let tree = node.handle().tree().expect("the root answers");
    tree.find(name).expect("it is declared").last_reason.clone()
}
