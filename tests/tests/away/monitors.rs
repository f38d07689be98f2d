//! Monitors on real nodes: a watcher is notified once of the end of an incarnation, with its reason.

use sinew::{
    NodeApi, Registration,
    events::{DownClass, MonitorId},
    fault::Fault,
    message::Sender,
    prelude::*,
};
use sinew_testkit::{
    Log, Loopback, TestDirectory, all_run,
    scripted::{Job, Script, ScriptedApp, Seen, outcome_of_job, sender_app},
    sees, until,
};

/// Monitors the targets that the test names, and records its notifications.
struct Watcher {
    notified: Log<Down>,
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
        self.notified.write(down.payload);
    }
}

impl Handler<Delivery<Job>> for Watcher {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {
        panic!("the watcher's own end");
    }
}

/// The test's view of the watcher.
struct Eye {
    notified: Log<Down>,
    sender: Log<Sender>,
}

fn watcher() -> (AppSpec<Watcher>, Eye) {
    let eye = Eye { notified: Log::default(), sender: Log::default() };
    let (notified, sender) = (eye.notified.clone(), eye.sender.clone());
    let spec =
        AppSpec::new("watcher", move || Watcher { notified: notified.clone(), sender: sender.clone() });
    (spec.handles::<Down>().handles::<Job>().own_thread(), eye)
}

impl Eye {
    fn sender(&self) -> Sender {
        self.sender.wait("the watcher", |all| all.last().cloned())
    }

    fn watch(&self, tid: Tid) -> MonitorId {
        self.sender().monitor(tid).expect("it has room")
    }

    /// Waits for the notification of this monitor.
    #[track_caller]
    fn down(&self, monitor: MonitorId) -> Down {
        let find = |all: &[Down]| all.iter().find(|down| down.monitor == monitor).cloned();
        self.notified.wait(&format!("{monitor:?}"), find)
    }

    #[track_caller]
    fn notified_once(&self, monitors: &[MonitorId]) {
        let mut ended: Vec<_> = self.notified.all().into_iter().map(|down| down.monitor).collect();
        ended.sort();
        assert_eq!(ended, monitors);
    }
}

/// Panics at 13, and stops at 14.
fn target() -> (AppSpec<ScriptedApp>, Log<Seen>) {
    let act = |scripted: &mut ScriptedApp, context: &mut AppContext<ScriptedApp>| match scripted.number {
        13 => panic!("thirteen"),
        14 => context.stop(),
        _ => {}
    };
    Script::new().got(act).app("target")
}

/// A watcher on one node, and its target on another with a sender_app beside it.
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
        let loopback = Loopback::new();
        let ((target, log), (watcher, eye), (sender_app, key)) = (target(), watcher(), sender_app("sender"));
        let there = loopback.node("there").app(target).app(sender_app).start().expect("a node");
        let here = loopback.node("home").app(watcher.requires(["target"])).start().expect("a node");
        all_run(&[&there, &here]);
        let tid = there.handle().resolve("target").expect("it is registered");
        Self { there, here, eye, sender: key.sender(), tid, log }
    }
}

#[test]
fn local_end_is_reported_once_with_reason() {
    let ((target, log), (watcher, eye), (sender_app, key)) = (target(), watcher(), sender_app("sender"));
    let node = Loopback::new().node("node").app(target).app(watcher).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let (sender, tid) = (key.sender(), node.handle().resolve("target").expect("it is registered"));
    let first = eye.watch(tid);
    assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
    let down = eye.down(first);
    assert_eq!((down.tid, down.class), (tid, DownClass::Panic));
    assert!(down.why.contains("thirteen"), "{down}");
    // The second incarnation is not monitored, so its end is not reported.
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
    log.wait_for(Seen::Started(3));
    let second = eye.watch(tid);
    assert_eq!(outcome_of_job(&sender, "target", 14), Outcome::Delivered);
    assert_eq!(eye.down(second).class, DownClass::Normal);
    let nobody = eye.watch(Tid::new(NodeAddress::HERE, AppAddress::fixed(99).expect("a fixed one")));
    assert_eq!(eye.down(nobody).class, DownClass::NoSuchAddress);
    eye.notified_once(&[first, second, nobody]);
}

#[test]
fn remote_end_is_reported_once_with_reason() {
    let Across { there, here: _here, eye, sender, tid, log } = Across::start();
    let mut all = Vec::new();
    for incarnation in 1..=5 {
        log.wait_for(Seen::Started(incarnation));
        let monitor = eye.watch(tid);
        all.push(monitor);
        // No wait here: the monitor may be in flight while the incarnation ends.
        assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
        let down = eye.down(monitor);
        assert!(down.class == DownClass::Panic && down.why.contains("thirteen"), "{down}");
    }
    log.wait_for(Seen::Started(6));
    let nobody = eye.watch(Tid::new(there.address(), AppAddress::fixed(99).expect("a fixed one")));
    assert_eq!(eye.down(nobody).class, DownClass::NoSuchAddress);
    all.push(nobody);
    // A target that runs until its node leaves is reported either as stopped, or as lost with its node.
    let last = eye.watch(tid);
    all.push(last);
    there.stop();
    assert!(matches!(eye.down(last).class, DownClass::Shutdown | DownClass::NodeLost));
    let unknown = eye.watch(Tid::new(NodeAddress::from([127, 0, 0, 99]), tid.app));
    assert_eq!(eye.down(unknown).class, DownClass::NodeLost);
    all.push(unknown);
    eye.notified_once(&all);
}

#[test]
fn layer_failures_and_cut_links_are_no_ends() {
    let Across { there, here, eye, sender, tid, log } = Across::start();
    let mut all = Vec::new();
    for (incarnation, layer) in [(1, "GNCL"), (2, "sync"), (3, "GNCL")] {
        for node in [&here, &there] {
            // Given: a monitor that has survived the failure and restart of a layer
            let (handle, monitor) = (node.handle(), eye.watch(tid));
            let before = handle.lives(layer).expect("every node has it").readies;
            handle.inject(layer, Fault::panic()).expect("every node has it");
            until("the layer is back", || (handle.lives(layer)?.readies > before).then_some(()));
            all.push(monitor);
        }
        // When
        log.wait_for(Seen::Started(incarnation));
        assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
        // Then
        for monitor in &all[all.len() - 2..] {
            let down = eye.down(*monitor);
            assert_eq!(down.class, DownClass::Panic, "{down}");
        }
    }
    eye.notified_once(&all);
}

#[test]
fn process_end_and_orderly_leave_are_reported() {
    let (directory, (watcher, eye)) = (TestDirectory::new(), watcher());
    let socket = directory.join("node.sock");
    let node = Loopback::new().node("node").configure(|config| config.lncl.socket = Some(socket.clone()));
    let node = node.app(watcher).start().expect("a node");
    all_run(&[&node]);
    let api = NodeApi::connect(socket).expect("the node listens");
    let dies = api.register_transport_address(Registration::new()).expect("it is free");
    let leaves = api.register_transport_address(Registration::new()).expect("it is free");
    let (first, second) = (eye.watch(dies.tid()), eye.watch(leaves.tid()));
    // Dropping it closes the socket, as the end of its process does.
    drop(dies);
    assert_eq!(eye.down(first).class, DownClass::ProcessEnded);
    leaves.unregister().expect("the node answers");
    assert_eq!(eye.down(second).class, DownClass::Normal);
    eye.notified_once(&[first, second]);
}

#[test]
fn monitors_end_with_watcher_and_with_demonitor() {
    let Across { there, here, eye, sender, tid, log } = Across::start();
    sees(&there.handle(), here.address());
    let _of_its_first_life = eye.watch(tid);
    assert_eq!(outcome_of_job(&eye.sender(), "watcher", 1), Outcome::Failed);
    eye.sender.wait("its second incarnation", |all| (all.len() == 2).then_some(()));
    let taken_back = eye.watch(tid);
    assert!(eye.sender().demonitor(taken_back));
    let kept = eye.watch(tid);
    assert_eq!(outcome_of_job(&sender, "target", 13), Outcome::Failed);
    assert_eq!(eye.down(kept).class, DownClass::Panic);
    log.wait_for(Seen::Started(2));
    // The other monitors are older: their notifications would have arrived before.
    eye.notified_once(&[kept]);
}

#[test]
fn hung_target_is_reported_and_its_will_is_sent() {
    // Given: the first incarnation never returns from its first message
    let ((target, log), (watcher, eye), (sender_app, key)) = (target(), watcher(), sender_app("sender"));
    let target = target
        .progress_within(Duration::from_millis(100))
        .fault("hang@1".parse::<Fault>().expect("it can be read"));
    let ((heir, seen), will) = (Script::new().app("heir"), Job { number: 1_000_000 });
    let node = Loopback::new()
        .node("node")
        .app(target.last_will("heir", &will))
        .app(watcher)
        .app(heir)
        .app(sender_app);
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
    eye.notified_once(&[monitor]);
}

/// Answers each `Down` with a new monitor, like a client that waits for a target to return.
struct Insistent {
    /// Returns the next target; the argument counts up.
    next: fn(u32) -> Tid,
    count: u32,
    notified: Log<Down>,
    seen: Log<Trace>,
}

/// Other events that an insistent watcher handled.
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
        self.notified.write(down.payload);
        self.watch(context);
    }
}

impl Handler<Delivery<Job>> for Insistent {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {}
}

#[test]
fn repeated_monitoring_does_not_starve_the_watcher() {
    let nobody = |_| Tid::new(NodeAddress::HERE, AppAddress::fixed(99).expect("a fixed one"));
    let no_node =
        |_| Tid::new(NodeAddress::from([127, 0, 0, 99]), AppAddress::fixed(99).expect("a fixed one"));
    let another =
        |number| Tid::new(NodeAddress::HERE, AppAddress::fixed(100 + number % 800).expect("a fixed one"));
    for next in [nobody, no_node, another] as [fn(u32) -> Tid; 3] {
        let (notified, seen) = (Log::default(), Log::default());
        let watcher = {
            let (notified, seen) = (notified.clone(), seen.clone());
            AppSpec::new("watcher", move || Insistent {
                next,
                count: 0,
                notified: notified.clone(),
                seen: seen.clone(),
            })
        };
        let ((sender_app, key), began) = (sender_app("sender"), std::time::Instant::now());
        let watcher = watcher.handles::<Down>().handles::<Job>().own_thread();
        let node = Loopback::new().node("node").app(watcher).app(sender_app).start().expect("a node");
        all_run(&[&node]);
        let sender = key.sender();
        notified.wait("the burst, and the pace after it", |all| (all.len() > 300).then_some(()));
        for number in 0..10 {
            assert_eq!(outcome_of_job(&sender, "watcher", number), Outcome::Delivered);
        }
        seen.wait("its timer", |all| (all.len() >= 10).then_some(()));
        let (count, pace) = (notified.all().len(), began.elapsed().as_millis() / 10);
        assert!(count as u128 <= 257 + pace, "notified {count} times in {pace} times 10 ms");
        node.stop();
        assert_eq!(seen.all().last(), Some(&Trace::Stops));
    }
}
