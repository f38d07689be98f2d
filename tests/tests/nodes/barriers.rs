//! Run-time barriers on real nodes: actors, threads and tasks, as in other processes, meet in any number of
//! rounds.

use std::{
    path::{Path, PathBuf},
    sync::mpsc::{SyncSender, sync_channel},
    thread,
    time::Duration,
};

use sinew::{
    AsyncEndpoint, Endpoint, NodeApi, Registration,
    barrier::{Barrier, BarrierError, BarrierStatus, Meet, OnPartyLoss},
    prelude::*,
};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory, all_run, sees, until};

/// Arrives this many times, from its start on, and reports the generations that it passed.
struct Party {
    barrier: Barrier,
    rounds: u32,
    results: SyncSender<(Tid, Result<u64, String>)>,
}

impl Actor for Party {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.go(context);
    }
}

impl Party {
    fn go(&mut self, context: &mut AppContext<Self>) {
        if self.rounds == 0 {
            return;
        }
        self.rounds -= 1;
        let meeting = context.meet(&self.barrier).into_actor(self);
        context.spawn(meeting.map(|passed, this, context| {
            this.results
                .send((context.tid(), passed.map_err(|error| error.to_string())))
                .expect("the test listens");
            this.go(context);
        }));
    }
}

fn party(
    name: &str,
    barrier: &Barrier,
    rounds: u32,
    results: &SyncSender<(Tid, Result<u64, String>)>,
) -> AppSpec<Party> {
    let (barrier, results) = (barrier.clone(), results.clone());
    AppSpec::new(name, move || Party { barrier: barrier.clone(), rounds, results: results.clone() })
}

/// Arrives, arrives again, and cancels the first wait.
struct Undecided {
    barrier: Barrier,
    results: SyncSender<Result<u64, String>>,
}

impl Actor for Undecided {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let given_up = context.meet(&self.barrier);
        let meeting = context.meet(&self.barrier).into_actor(self);
        drop(given_up);
        context.spawn(meeting.map(|passed, this, _| {
            this.results.send(passed.map_err(|error| error.to_string())).expect("the test listens");
        }));
    }
}

/// A node with a client socket.
fn with_door(loopback: &Loopback, directory: &TestDirectory, name: &str) -> (NodeBuilder, PathBuf) {
    let socket = directory.join(&format!("{name}.sock"));
    let node = loopback.node(name).configure(|config| config.lncl.socket = Some(socket.clone()));
    (node, socket)
}

fn endpoint(socket: &Path, name: &str) -> Endpoint {
    let api = NodeApi::connect(socket).expect("the node is there");
    api.register_transport_address(Registration::new().name(name)).expect("the node is there")
}

#[test]
fn actors_of_three_nodes_pass_every_generation_together() {
    const ROUNDS: u32 = 20;
    let loopback = Loopback::new();
    let (results, reports) = sync_channel(64);
    let barrier = Barrier::new("step", ["hip", "knee", "ankle"]).within(DEADLINE);
    let nodes: Vec<Node> = ["hip", "knee", "ankle"]
        .into_iter()
        .map(|name| {
            loopback.node(name).app(party(name, &barrier, ROUNDS, &results)).start().expect("it starts")
        })
        .collect();
    all_run(&nodes.iter().collect::<Vec<_>>());
    let mut passed: Vec<(u64, Tid)> = Vec::new();
    for _ in 0..3 * ROUNDS {
        let (member, generation) = reports.recv_timeout(DEADLINE).expect("all meet");
        passed.push((generation.expect("it opens"), member));
    }
    passed.sort();
    let generations: Vec<u64> = passed.iter().map(|(generation, _)| *generation).collect();
    let expected: Vec<u64> = (1..=u64::from(ROUNDS)).flat_map(|generation| [generation; 3]).collect();
    assert_eq!(generations, expected);
}

/// The missing parties, with reasons.
fn missing(status: &BarrierStatus) -> Vec<(&str, &str)> {
    status.missing.iter().map(|absence| (&*absence.name, &*absence.why)).collect()
}

#[test]
fn thread_task_and_actor_meet_at_a_barrier() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let (results, passed) = sync_channel(64);
    let barrier = Barrier::new("calibrated", ["hip.drive", "2 of *.imu"]).within(DEADLINE);
    let (hip, hip_api) = with_door(&loopback, &directory, "hip");
    let (knee, knee_api) = with_door(&loopback, &directory, "knee");
    let hip = hip.app(party("hip.drive", &barrier, 1, &results)).start().expect("it starts");
    let knee = knee.start().expect("it starts");
    sees(&hip.handle(), knee.handle().address());
    all_run(&[&hip]);
    let status = until("the drive waits", || hip.handle().barriers().pop());
    assert_eq!(status.waiting[0].0, "hip.drive");
    assert_eq!(missing(&status), [("2 of *.imu", "0 of 2 have arrived")]);
    let short = barrier.clone().within(Duration::from_millis(20));
    let mut hip_imu = endpoint(&hip_api, "hip.imu");
    let late = hip_imu.meet(&short).expect_err("the other one is missing");
    assert!(late.to_string().contains("2 of *.imu is missing (1 of 2 have arrived)"), "{late}");
    let both = barrier.clone();
    let blocking = thread::spawn(move || hip_imu.meet(&both));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    let generation = runtime.block_on(async {
        let registration = Registration::new().name("knee.imu");
        let knee_api = NodeApi::connect(&knee_api).expect("the node is there");
        let mut knee_imu: AsyncEndpoint =
            knee_api.register_transport_address_async(registration).await.expect("the node is there");
        knee_imu.meet(&barrier).await
    });
    assert_eq!(generation.expect("it opens"), 1);
    assert_eq!(blocking.join().expect("it ends").expect("it opens"), 1);
    assert_eq!(passed.recv_timeout(DEADLINE).expect("the drive, too").1, Ok(1));
}

#[test]
fn lost_party_is_reported_or_awaited_as_requested() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let (node, api) = with_door(&loopback, &directory, "hip");
    let node = node.start().expect("it starts");
    let barrier = Barrier::new("homed", ["a", "b"]).within(DEADLINE);
    let (mut a, b) = (endpoint(&api, "a"), endpoint(&api, "b"));
    let impatient = barrier.clone().on_loss(OnPartyLoss::Fail);
    let waiting = thread::spawn(move || (a.meet(&impatient), a));
    let status = until("a waits", || node.handle().barriers().pop());
    assert_eq!(missing(&status), [("b", "ready, has not arrived")]);
    b.unregister().expect("the node is there");
    let (met, mut a) = waiting.join().expect("it ends");
    let why = met.expect_err("b has gone");
    assert!(matches!(&why, BarrierError::Lost { missing, .. } if missing[0].1 == "unregistered"), "{why}");
    let again = barrier.clone();
    let waiting = thread::spawn(move || a.meet(&again));
    until("a waits", || (!node.handle().barriers().is_empty()).then_some(()));
    assert_eq!(endpoint(&api, "b").meet(&barrier).expect("it opens"), 1);
    assert_eq!(waiting.join().expect("it ends").expect("it opens"), 1);
}

#[test]
fn cancelled_wait_leaves_a_later_wait_intact() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let (results, passed) = sync_channel(1);
    let barrier = Barrier::new("homed", ["a", "b"]).within(DEADLINE);
    let (node, api) = with_door(&loopback, &directory, "hip");
    let spec = {
        let barrier = barrier.clone();
        AppSpec::new("a", move || Undecided { barrier: barrier.clone(), results: results.clone() })
    };
    let node = node.app(spec).start().expect("it starts");
    all_run(&[&node]);
    let mut b = endpoint(&api, "b");
    assert_eq!(b.meet(&barrier).expect("it opens"), 1);
    assert_eq!(passed.recv_timeout(DEADLINE).expect("a, too"), Ok(1));
}

#[test]
fn invalid_barrier_or_party_is_rejected() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let (node, api) = with_door(&loopback, &directory, "hip");
    let _node = node.start().expect("it starts");
    let mut a = endpoint(&api, "a");
    for (barrier, why) in [
        (Barrier::new("x", ["b", "c"]), "is none of the parties"),
        (Barrier::new("x", ["a", "b ?1s"]), "no wait limit"),
        (Barrier::new("", ["a"]), "1 to 63 bytes"),
        (Barrier::new("x", Vec::<String>::new()), "it has no parties"),
    ] {
        let error = a.meet(&barrier).expect_err("it is refused");
        assert!(matches!(&error, BarrierError::Refused(_)) && error.to_string().contains(why), "{error}");
    }
}
