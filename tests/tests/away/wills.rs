//! Last wills: sent once on behalf of a dead application, after all messages that it sent itself.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use rustix::process::Signal;
use sinew::{StartError, fault::Fault, message::Sender, node::NodeEnd, prelude::*, supervision::Reason};
use sinew_testkit::{
    Log, Loopback, NodeProcess, TestDirectory, all_run, own_group,
    scripted::{Job, Order, Script, ScriptedApp, Seen, incarnations, numbers, outcome_of_job, sender_app},
};
use sinew_tests::node_under_test;

/// The payload of the wills; other messages have other numbers.
const WILL: Order = Order { number: 1_000_000 };

fn wills(log: &Log<Seen>) -> usize {
    numbers(&log.all()).into_iter().filter(|number| *number == WILL.number).count()
}

/// The recipient of the wills, called `heir`, and its log.
fn heir() -> (AppSpec<ScriptedApp>, Log<Seen>) {
    Script::new().app("heir")
}

/// Ends at the first message, after it has sent `before` orders to the heir.
fn mortal(before: u64) -> (AppSpec<ScriptedApp>, Log<Seen>) {
    let last_words = move |_: &mut ScriptedApp, context: &mut AppContext<ScriptedApp>| {
        for number in 1..=before {
            context.send("heir", &Order { number }).expect("the heir has room");
        }
        panic!("its end");
    };
    Script::new().got(last_words).app("mortal")
}

/// Ends the mortal; returns when it runs again.
fn kill(sender: &Sender, log: &Log<Seen>) {
    let next = incarnations(log) as u64 + 1;
    assert_eq!(outcome_of_job(sender, "mortal", 1), Outcome::Failed);
    log.wait_for(Seen::Started(next));
}

#[test]
fn will_arrives_once_per_death_after_own_messages() {
    let ((mortal, log), (heir, seen), (sender_app, key)) = (mortal(100), heir(), sender_app("sender"));
    let mortal = mortal.last_will("heir", &WILL);
    let node = Loopback::new().node("node").app(heir).app(mortal).app(sender_app).start().expect("a node");
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
fn will_follows_missed_start_but_not_clean_stop() {
    for (when, expected) in [(LastWill::OnDeath, 0), (LastWill::Always, 1)] {
        // Given: an application that stops by itself and is not restarted
        let (leaver, log) = Script::new().got(|_, context| context.stop()).app("mortal");
        let leaver = leaver.last_will_when(when, "heir", &WILL).restart(Restart::Temporary);
        // and one that does not become ready in time
        let (sleeper, _) = Script::new()
            .started(|scripted, context| {
                if scripted.incarnation == 1 {
                    std::mem::forget(context.hold_ready());
                }
            })
            .app("sleeper");
        let sleeper = sleeper.start_within(Duration::from_secs(2)).last_will("heir", &Order { number: 7 });
        let ((heir, seen), (sender_app, key)) = (heir(), sender_app("sender"));
        let node = Loopback::new().node("node").app(heir).app(leaver).app(sleeper).app(sender_app);
        let node = node.start().expect("a node");
        all_run(&[&node]);
        seen.wait_for(Seen::Got(1, 7));
        // When
        let sender = key.sender();
        assert_eq!(outcome_of_job(&sender, "mortal", 1), Outcome::Delivered);
        log.wait_for(Seen::Dropped(1));
        let gone = || node.handle().resolve("mortal").is_none().then_some(());
        sinew_testkit::until("it is gone", gone);
        // Then: a message that is sent now arrives after the will, if there is one
        sender.send("heir", &Order { number: 8 }).expect("it has room");
        seen.wait_for(Seen::Got(1, 8));
        assert_eq!(wills(&seen), expected, "{when:?}");
    }
}

#[test]
fn wills_reach_names_groups_and_tids_in_their_class() {
    let ((mortal, log), (heir, seen), (sender_app, key)) = (mortal(0), heir(), sender_app("sender"));
    let (member, member_seen) = Script::new().started(|_, context| context.join("mourners")).app("member");
    let address = AppAddress::fixed(7).expect("a fixed one");
    let (fixed, fixed_seen) = Script::new().app("fixed");
    let mortal = mortal
        .last_will("heir", &WILL)
        .last_will(Tid::group("mourners"), &WILL)
        .last_will(Tid::new(NodeAddress::HERE, address), &Job { number: 2 })
        .last_will("nobody", &WILL);
    let node = Loopback::new().node("node");
    let node = node.app(heir).app(member).app(fixed.address(address)).app(mortal).app(sender_app).start();
    let node = node.expect("a node");
    all_run(&[&node]);
    kill(&key.sender(), &log);
    seen.wait_for(Seen::Got(1, WILL.number));
    member_seen.wait_for(Seen::Got(1, WILL.number));
    fixed_seen.wait_for(Seen::Got(1, 2));
    assert_eq!((wills(&seen), wills(&member_seen)), (1, 1));
}

#[test]
fn will_reaches_other_node_after_own_messages() {
    let loopback = Loopback::new();
    let ((mortal, log), (heir, seen), (sender_app, key)) = (mortal(100), heir(), sender_app("sender"));
    let mortal = mortal.requires(["heir"]).last_will("heir", &WILL);
    let there = loopback.node("there").app(heir).start().expect("a node");
    let here = loopback.node("home").app(mortal).app(sender_app).start().expect("a node");
    all_run(&[&there, &here]);
    kill(&key.sender(), &log);
    seen.wait_for(Seen::Got(1, WILL.number));
    assert_eq!(numbers(&seen.all()), (1..=100).chain([WILL.number]).collect::<Vec<_>>());
}

#[test]
fn wills_are_sent_when_the_supervisor_fails() {
    let loopback = Loopback::new();
    // One that stops in order when told to, and one that does not stop in time.
    let (hung, _) = Script::new().stopping(|_, _| Running::Continue).app("hung");
    let hung = hung
        .requires(["heir"])
        .stop_within(Duration::from_millis(50))
        .last_will("heir", &Order { number: 7 });
    let ((mortal, log), (heir, seen)) = (mortal(0), heir());
    let mortal = mortal.requires(["heir"]).last_will("heir", &WILL);
    let there = loopback.node("there").app(heir).start().expect("a node");
    let here = loopback.node("home").app(mortal).app(hung).start().expect("a node");
    all_run(&[&there, &here]);
    here.handle().fail_supervisor();
    seen.wait_for(Seen::Got(1, WILL.number));
    seen.wait_for(Seen::Got(1, 7));
    assert!(log.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "it was stopped: {:?}", log.all());
    let NodeEnd::GaveUp(why) = here.wait_for_end() else { panic!("it gave up") };
    assert!(why.contains("their supervisor panicked: a fault was planned for a supervisor"), "{why}");
    // The GOODBYE of a node that ends in order does not send them a second time.
    sinew_testkit::until("the node is gone", || there.handle().members().is_empty().then_some(()));
    assert_eq!((wills(&seen), numbers(&seen.all()).len()), (1, 2));
}

/// No process of that node is left to send the wills or GOODBYE.
#[test]
fn other_nodes_send_wills_when_layers_give_up() {
    let loopback = Loopback::new();
    let ((mortal, log), (heir, seen)) = (mortal(0), heir());
    let mortal = mortal.last_will("heir", &WILL);
    let there = loopback.node("there").app(heir.requires(["mortal"])).start().expect("a node");
    let here = loopback.node("home").configure(|config| config.supervision.layer_restarts_max = 0);
    let here = here.app(mortal).start().expect("a node");
    all_run(&[&here, &there]);
    here.handle().inject("NDL", Fault::panic()).expect("every node has it");
    seen.wait_for(Seen::Got(1, WILL.number));
    assert!(matches!(here.wait_for_end(), NodeEnd::GaveUp(_)));
    assert!(log.all().contains(&Seen::Stopping(1)), "it was stopped as well");
    assert_eq!(wills(&seen), 1);
}

#[test]
fn more_than_eight_wills_are_rejected_with_reason() {
    let (mut mortal, _log) = mortal(0);
    for _ in 0..9 {
        mortal = mortal.last_will("heir", &WILL);
    }
    let error = Loopback::new().node("node").app(mortal).start().expect_err("it is too many");
    assert!(matches!(error, StartError::Application { .. }));
    assert!(error.to_string().contains("9 last wills are more than the 8"), "{error}");
}

/// 200 applications die one after the other. Run with `--nocapture` to see the figures.
#[test]
fn time_from_death_to_will_is_printed() {
    const DEATHS: usize = 200;
    let died = Arc::new(Mutex::new(Time::ZERO));
    let (latencies, mut node) = (Log::<u64>::default(), Loopback::new().node("node"));
    for number in 0..DEATHS {
        let died = died.clone();
        let end = move |_: &mut ScriptedApp, _: &mut AppContext<ScriptedApp>| {
            *died.lock().expect("nobody panics with it") = Time::now();
            panic!("its end");
        };
        let (mortal, _) = Script::new().got(end).app(&format!("mortal {number}"));
        // All on one thread, and not restarted: otherwise the node would give up.
        let mortal = mortal.place(Place::thread("mortals")).restart(Restart::Temporary);
        node = node.app(mortal.last_will("heir", &WILL));
    }
    let noted = latencies.clone();
    let note = move |_: &mut ScriptedApp, _: &mut AppContext<ScriptedApp>| {
        noted.write(Time::now().since(*died.lock().expect("nobody panics with it")).as_nanos() as u64);
    };
    let ((heir, _), (sender_app, key)) = (Script::new().got(note).app("heir"), sender_app("sender"));
    let node = node.app(heir).app(sender_app).start().expect("a node");
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

/// The hip on 127.0.0.1 is the recipient of the wills of the knee on 127.0.0.2 and of the ankle on 127.0.0.3.
struct Processes {
    directory: TestDirectory,
    group: std::net::SocketAddrV4,
}

impl Processes {
    fn start(&self, name: &str, address: u8, more: &[&str]) -> NodeProcess {
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"wills\"\n\
             [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            self.group
        );
        let path = self.directory.write(&format!("{name}.toml"), &text);
        node_under_test(None, &path, more)
    }
}

#[test]
fn other_nodes_send_wills_only_of_a_killed_node() {
    let processes = Processes { directory: TestDirectory::new(), group: own_group() };
    // The start of the hip proves that it knows the other nodes and their wills.
    let mut hip = processes.start("hip", 1, &["--requires", "knee", "--requires", "ankle"]);
    let knee = processes.start("knee", 2, &["--will", "hip", "--will", "ankle", "--will", "nobody"]);
    let mut ankle = processes.start("ankle", 3, &["--will", "hip", "--requires", "knee"]);
    hip.wait_for(&["started"]);
    ankle.wait_for(&["started"]);
    knee.signal(Signal::KILL);
    hip.wait_for(&["count 1000000 from 127.0.0.2"]);
    ankle.wait_for(&["count 1000000 from 127.0.0.2"]);
    // The next incarnation of the knee has wills, too.
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
    assert_eq!(hip.output().iter().filter(is_will).count(), 2, "{:?}", hip.output());
}

/// Stops at the first message, and panics in each drop.
fn messy() -> (AppSpec<ScriptedApp>, Log<Seen>) {
    let script = Script::new().got(|_, context| context.stop()).dropped(|_| panic!("its drop"));
    script.app("mortal")
}

#[test]
fn self_stop_with_panic_in_drop_is_a_failure() {
    let ((mortal, log), (heir, seen), (sender_app, key)) = (messy(), heir(), sender_app("sender"));
    let mortal = mortal.restart(Restart::Transient).last_will("heir", &WILL);
    let node = Loopback::new().node("node").app(heir).app(mortal).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&key.sender(), "mortal", 1), Outcome::Delivered);
    seen.wait_for(Seen::Got(1, WILL.number));
    log.wait_for(Seen::Started(2));
    let ended = reason_of_last_end(&node, "mortal");
    assert!(matches!(&ended, Some(Reason::Panic(text)) if text.contains("its drop")), "{ended:?}");
}

#[test]
fn ordered_stop_with_panic_in_drop_is_not_counted() {
    let ((mortal, log), (heir, seen)) = (messy(), heir());
    let mortal = mortal.last_will("heir", &WILL);
    let node = Loopback::new().node("node").configure(|config| config.supervision.app_restarts_max = 0);
    let node = node.app(heir).app(mortal).start().expect("a node");
    all_run(&[&node]);
    node.handle().stop_app("mortal").expect("it is there");
    seen.wait_for(Seen::Got(1, WILL.number));
    let ended = reason_of_last_end(&node, "mortal");
    assert!(matches!(&ended, Some(Reason::Panic(text)) if text.contains("its drop")), "{ended:?}");
    // No restart is allowed: a counted one would end the node.
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert_eq!(incarnations(&log), 1);
}

fn reason_of_last_end(node: &Node, name: &str) -> Option<Reason> {
    let tree = node.handle().tree().expect("the root answers");
    tree.find(name).expect("it is declared").last_reason.clone()
}
