//! Phases on real nodes: applications that start in steps before they are ready, and one that is restarted.

use std::sync::mpsc::{SyncSender, sync_channel};

use sinew::{
    barrier::{Barrier, BarrierKind, Meet},
    prelude::*,
    supervision::ReadyGate,
};
use sinew_testkit::{DEADLINE, Loopback, until};

const DRIVES: [&str; 2] = ["hip.drive", "knee.drive"];

/// Homes, becomes ready when all drives are homed, and reports it.
struct Drive {
    held: Option<ReadyGate>,
    results: SyncSender<Result<u64, String>>,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.held = context.hold_ready();
        let homed = Barrier::phase("homed", DRIVES).within(DEADLINE);
        let meeting = context.meet(&homed).into_actor(self);
        context.spawn(meeting.map(|passed, this, _| {
            this.results.send(passed.map_err(|error| error.to_string())).expect("the test listens");
            this.held.take().expect("it was held").reached();
        }));
    }
}

fn drive(name: &str, results: &SyncSender<Result<u64, String>>) -> AppSpec<Drive> {
    let results = results.clone();
    AppSpec::new(name, move || Drive { held: None, results: results.clone() }).start_within(DEADLINE)
}

/// Requires homed drives, ready or not.
struct Gait(SyncSender<()>);

impl Actor for Gait {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        self.0.send(()).expect("the test listens");
    }
}

#[test]
fn drives_start_together_and_a_restart_affects_no_other() {
    let loopback = Loopback::new();
    let (results, passed) = sync_channel(16);
    let (start, started) = sync_channel(16);
    let gait = AppSpec::new("gait", move || Gait(start.clone())).requires(["2 of *.drive at homed"]);
    let hip = loopback.node("hip").app(drive("hip.drive", &results)).app(gait).start().expect("it starts");
    // Given: one drive is homed, and waits for the other.
    let status = until("the hip's drive waits", || hip.handle().barriers().pop());
    assert_eq!((status.barrier.as_str(), status.kind), ("homed", BarrierKind::Phase));
    let missing: Vec<_> = status.missing.iter().map(|absence| (&*absence.name, &*absence.why)).collect();
    assert_eq!(missing, [("knee.drive at homed", "not there")]);
    let waits = until("the gait waits", || hip.handle().waiting().pop());
    let missing: Vec<_> = waits.missing.iter().map(|absence| (&*absence.name, &*absence.why)).collect();
    assert_eq!(missing, [("2 of *.drive at homed (1 there)", "not there")]);
    assert!(passed.try_recv().is_err() && started.try_recv().is_err(), "nobody has gone on");
    // When the other one starts, then both continue, and so does the application that requires them.
    let knee = loopback.node("knee").app(drive("knee.drive", &results)).start().expect("it starts");
    for _ in DRIVES {
        assert_eq!(passed.recv_timeout(DEADLINE).expect("both go on"), Ok(1));
    }
    started.recv_timeout(DEADLINE).expect("the gait starts");
    // When one is restarted, then it goes through its phase alone.
    until("the knee's drive is ready", || {
        knee.handle().directory().iter().any(|entry| entry.name == "knee.drive" && entry.ready).then_some(())
    });
    knee.handle().stop_app("knee.drive").expect("it stops");
    knee.handle().restart_app("knee.drive").expect("it is started again");
    assert_eq!(passed.recv_timeout(DEADLINE).expect("it goes on"), Ok(1));
    assert!(passed.try_recv().is_err(), "the hip's is not brought back");
}
