//! Monitors on real nodes: who watches a life is told once that it ended, and why.

use sinew::{
    NodeApi, Registration,
    events::{DownClass, MonitorId},
    fault::Fault,
    message::Sender,
    prelude::*,
};
use sinew_tests::{
    Ground, Log, OwnDirectory, all_run,
    puppet::{Job, Puppet, Seen, Stage, desk, outcome_of_job},
    sees, until,
};

/// Monitors whom the test says, and writes down what it is told.
struct Watcher {
    told: Log<Down>,
    sender: Log<Sender>,
}

impl Actor for Watcher {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.sender.write(context.sender());
    }
}

impl Handler<Delivery<Down>> for Watcher {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, _: &mut Self::Context) {
        self.told.write(down.payload);
    }
}

impl Handler<Delivery<Job>> for Watcher {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {
        panic!("the watcher's own end");
    }
}

/// The watcher as the test sees it.
struct Eye {
    told: Log<Down>,
    sender: Log<Sender>,
}

fn watcher() -> (AppSpec<Watcher>, Eye) {
    let eye = Eye { told: Log::default(), sender: Log::default() };
    let (told, sender) = (eye.told.clone(), eye.sender.clone());
    let spec = AppSpec::new("watcher", move || Watcher { told: told.clone(), sender: sender.clone() });
    (spec.handles::<Down>().handles::<Job>().own_thread(), eye)
}

impl Eye {
    fn sender(&self) -> Sender {
        self.sender.wait("the watcher", |all| all.last().cloned())
    }

    fn watch(&self, tid: Tid) -> MonitorId {
        self.sender().monitor(tid).expect("it has room")
    }

    /// Waits for what this monitor says.
    #[track_caller]
    fn down(&self, monitor: MonitorId) -> Down {
        let find = |all: &[Down]| all.iter().find(|down| down.monitor == monitor).cloned();
        self.told.wait(&format!("{monitor:?}"), find)
    }

    #[track_caller]
    fn told_once(&self, monitors: &[MonitorId]) {
        let mut told: Vec<_> = self.told.all().into_iter().map(|down| down.monitor).collect();
        told.sort();
        assert_eq!(told, monitors);
    }
}

/// Panics at 13, and stops at 14.
fn target() -> (AppSpec<Puppet>, Log<Seen>) {
    let act = |puppet: &mut Puppet, context: &mut AppContext<Puppet>| match puppet.number {
        13 => panic!("thirteen"),
        14 => context.stop(),
        _ => {}
    };
    Stage::new().got(act).app("target")
}

/// A watcher here, and its target there, with a desk beside it.
struct Across {
    there: Node,
    here: Node,
    eye: Eye,
    sender: Sender,
    tid: Tid,
    log: Log<Seen>,
}

impl Across {
    fn start() -> Self {
        let ground = Ground::new();
        let ((target, log), (watcher, eye), (desk, key)) = (target(), watcher(), desk("desk"));
        let there = ground.node("there").app(target).app(desk).start().expect("a node");
        let here = ground.node("home").app(watcher.requires(["target"])).start().expect("a node");
        all_run(&[&there, &here]);
        let tid = there.handle().resolve("target").expect("it is registered");
        Self { there, here, eye, sender: key.sender(), tid, log }
    }
}

#[test]
fn the_end_of_each_life_on_this_node_is_told_once_with_its_reason() {
    let ((target, log), (watcher, eye), (desk, key)) = (target(), watcher(), desk("desk"));
    let node = Ground::new().node("node").app(target).app(watcher).app(desk).start().expect("a node");
    all_run(&[&node]);
    let (sender, tid) = (key.sender(), node.handle().resolve("target").expect("it is registered"));
    let first = eye.watch(tid);
    assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
    let down = eye.down(first);
    assert_eq!((down.tid, down.class), (tid, DownClass::Panic));
    assert!(down.why.contains("thirteen"), "{down}");
    // Of the second life, which nobody watched, nothing is said.
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
    log.wait_for(Seen::Started(3));
    let second = eye.watch(tid);
    assert_eq!(outcome_of_job(&sender, "target", 14), Outcome::Delivered);
    assert_eq!(eye.down(second).class, DownClass::Normal);
    let nobody = eye.watch(Tid::new(NodeAddress::HERE, AppAddress::fixed(99).expect("a fixed one")));
    assert_eq!(eye.down(nobody).class, DownClass::NoSuchAddress);
    eye.told_once(&[first, second, nobody]);
}

#[test]
fn the_end_of_a_life_on_another_node_is_told_once_with_its_reason() {
    let Across { there, here: _here, eye, sender, tid, log } = Across::start();
    let mut all = Vec::new();
    for life in 1..=5 {
        log.wait_for(Seen::Started(life));
        let monitor = eye.watch(tid);
        all.push(monitor);
        // At once: the monitor may be on its way while the life ends.
        assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
        let down = eye.down(monitor);
        assert!(down.class == DownClass::Panic && down.why.contains("thirteen"), "{down}");
    }
    log.wait_for(Seen::Started(6));
    let nobody = eye.watch(Tid::new(there.address(), AppAddress::fixed(99).expect("a fixed one")));
    assert_eq!(eye.down(nobody).class, DownClass::NoSuchAddress);
    all.push(nobody);
    // One that stays until the node leaves is told either that the life was stopped, or that the node left.
    let last = eye.watch(tid);
    all.push(last);
    there.stop();
    assert!(matches!(eye.down(last).class, DownClass::Shutdown | DownClass::NodeLost));
    let unknown = eye.watch(Tid::new(NodeAddress::from([127, 0, 0, 99]), tid.app));
    assert_eq!(eye.down(unknown).class, DownClass::NodeLost);
    all.push(unknown);
    eye.told_once(&all);
}

#[test]
fn layers_that_fail_and_a_link_that_is_cut_end_no_life_and_hide_no_end() {
    let Across { there, here, eye, sender, tid, log } = Across::start();
    let mut all = Vec::new();
    for (life, layer) in [(1, "GNCL"), (2, "sync"), (3, "GNCL")] {
        for node in [&here, &there] {
            // Given: a monitor that has seen a layer fail and come back
            let (handle, monitor) = (node.handle(), eye.watch(tid));
            let before = handle.lives(layer).expect("every node has it").readies;
            handle.inject(layer, Fault::panic()).expect("every node has it");
            until("the layer is back", || (handle.lives(layer)?.readies > before).then_some(()));
            all.push(monitor);
        }
        // When
        log.wait_for(Seen::Started(life));
        assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
        // Then
        for monitor in &all[all.len() - 2..] {
            let down = eye.down(*monitor);
            assert_eq!(down.class, DownClass::Panic, "{down}");
        }
    }
    eye.told_once(&all);
}

#[test]
fn the_end_of_another_process_and_its_orderly_leave_are_told() {
    let (directory, (watcher, eye)) = (OwnDirectory::new(), watcher());
    let socket = directory.join("node.sock");
    let node = Ground::new().node("node").configure(|config| config.lncl.socket = Some(socket.clone()));
    let node = node.app(watcher).start().expect("a node");
    all_run(&[&node]);
    let api = NodeApi::connect(socket).expect("the node listens");
    let dies = api.register_transport_address(Registration::new()).expect("it is free");
    let leaves = api.register_transport_address(Registration::new()).expect("it is free");
    let (first, second) = (eye.watch(dies.tid()), eye.watch(leaves.tid()));
    // Dropping it closes the socket, as the end of the process does.
    drop(dies);
    assert_eq!(eye.down(first).class, DownClass::ProcessEnded);
    leaves.unregister().expect("the node answers");
    assert_eq!(eye.down(second).class, DownClass::Normal);
    eye.told_once(&[first, second]);
}

#[test]
fn the_monitors_of_a_watcher_end_with_its_life_and_it_is_told_nothing_after_it_demonitors() {
    let Across { there, here, eye, sender, tid, log } = Across::start();
    sees(&there.handle(), here.address());
    let _of_its_first_life = eye.watch(tid);
    assert_eq!(outcome_of_job(&eye.sender(), "watcher", 1), Outcome::Failed);
    eye.sender.wait("its second life", |all| (all.len() == 2).then_some(()));
    let taken_back = eye.watch(tid);
    assert!(eye.sender().demonitor(taken_back));
    let kept = eye.watch(tid);
    assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
    assert_eq!(eye.down(kept).class, DownClass::Panic);
    log.wait_for(Seen::Started(2));
    // The others are older: what they would say would have been said before.
    eye.told_once(&[kept]);
}

#[test]
fn a_life_that_hangs_is_told_as_hung_and_its_will_is_sent_for_it() {
    // Given: the first life never comes back from its first message
    let ((target, log), (watcher, eye), (desk, key)) = (target(), watcher(), desk("desk"));
    let target = target
        .progress_within(Duration::from_millis(100))
        .fault("hang@1".parse::<Fault>().expect("it can be read"));
    let ((heir, seen), will) = (Stage::new().app("heir"), Job { number: 1_000_000 });
    let node =
        Ground::new().node("node").app(target.last_will("heir", &will)).app(watcher).app(heir).app(desk);
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let monitor = eye.watch(node.handle().resolve("target").expect("it is registered"));
    // When
    key.sender().send("target", &Job { number: 1 }).expect("it has room");
    // Then
    let down = eye.down(monitor);
    assert_eq!(down.class, DownClass::Hung, "{down}");
    seen.wait_for(Seen::Got(1, will.number));
    log.wait_for(Seen::Started(2));
    eye.told_once(&[monitor]);
}

/// Answers each `Down` with the next monitor, as one does who waits for somebody to come back.
struct Insistent {
    /// Who it names next; the number counts up.
    next: fn(u32) -> Tid,
    count: u32,
    told: Log<Down>,
    seen: Log<Trace>,
}

/// What else an insistent watcher came to.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Trace {
    Tick,
    Stops,
}

impl Insistent {
    fn watch(&mut self, context: &AppContext<Self>) {
        self.count += 1;
        context.monitor((self.next)(self.count)).expect("one at a time");
    }
}

impl Actor for Insistent {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.watch(context);
        context.every(Duration::from_millis(20), |this, _, _| this.seen.write(Trace::Tick));
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        self.seen.write(Trace::Stops);
        Running::Stop
    }
}

impl Handler<Delivery<Down>> for Insistent {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, context: &mut Self::Context) {
        self.told.write(down.payload);
        self.watch(context);
    }
}

impl Handler<Delivery<Job>> for Insistent {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {}
}

#[test]
fn a_watcher_that_monitors_again_whom_nobody_has_comes_to_its_timers_its_messages_and_its_stop() {
    let nobody = |_| Tid::new(NodeAddress::HERE, AppAddress::fixed(99).expect("a fixed one"));
    let no_node =
        |_| Tid::new(NodeAddress::from([127, 0, 0, 99]), AppAddress::fixed(99).expect("a fixed one"));
    let another =
        |number| Tid::new(NodeAddress::HERE, AppAddress::fixed(100 + number % 800).expect("a fixed one"));
    for next in [nobody, no_node, another] as [fn(u32) -> Tid; 3] {
        let (told, seen) = (Log::default(), Log::default());
        let watcher = {
            let (told, seen) = (told.clone(), seen.clone());
            AppSpec::new("watcher", move || Insistent {
                next,
                count: 0,
                told: told.clone(),
                seen: seen.clone(),
            })
        };
        let ((desk, key), began) = (desk("desk"), std::time::Instant::now());
        let watcher = watcher.handles::<Down>().handles::<Job>().own_thread();
        let node = Ground::new().node("node").app(watcher).app(desk).start().expect("a node");
        all_run(&[&node]);
        let sender = key.sender();
        told.wait("the burst, and the pace after it", |all| (all.len() > 300).then_some(()));
        for number in 0..10 {
            assert_eq!(outcome_of_job(&sender, "watcher", number), Outcome::Delivered);
        }
        seen.wait("its timer", |all| (all.len() >= 10).then_some(()));
        let (told, pace) = (told.all().len(), began.elapsed().as_millis() / 10);
        assert!(told as u128 <= 257 + pace, "told {told} times in {pace} times 10 ms");
        node.stop();
        assert_eq!(seen.all().last(), Some(&Trace::Stops));
    }
}
