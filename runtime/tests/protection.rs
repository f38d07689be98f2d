//! Protected commands between two applications, and the output that they move: safe whatever ends, hangs or is forged.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, Handler};
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    protection::{ArmError, Cause, Guard, Protection},
    tid::Tid,
    wire::{Class, Payload},
};

use self::stage::{DEADLINE, Stage};

const PERIOD: Duration = Duration::from_millis(20);

#[derive(Debug, Serialize, Deserialize)]
struct Torque {
    nm: f64,
}

impl Payload for Torque {
    const NAME: &'static str = "test.torque";
    const CLASS: Class = Class::Stream;
    const PROTECTION: Option<Protection> = Some(Protection::of_period(PERIOD));
}

/// Sends a torque each period, while it may.
struct Central {
    drive: Tid,
    sends: Arc<AtomicBool>,
}

impl Actor for Central {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |central, _, context| {
            if central.sends.load(Ordering::Relaxed) {
                context.send(central.drive, &Torque { nm: 12.5 }).unwrap();
            }
        });
    }
}

/// What happened to the motor, in its order.
#[derive(Debug, PartialEq)]
enum Seen {
    Moved(f64),
    Safe(Cause),
}

/// What the drive does with the next torque.
#[derive(Clone, Copy, PartialEq)]
enum Mood {
    Moves,
    Hangs,
    Panics,
}

struct Drive {
    central: Tid,
    motor: SyncSender<Seen>,
    mood: Receiver<Mood>,
    guard: Option<Guard<SyncSender<Seen>>>,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let motor = self.motor.clone();
        let safe = |motor: &mut SyncSender<Seen>, cause| motor.send(Seen::Safe(cause)).unwrap();
        self.guard = Some(context.guard::<Torque, _>(self.central, motor, safe).unwrap());
        let twice = context.guard::<Torque, _>(self.central, (), |(), _| ()).unwrap_err();
        assert!(twice.to_string().contains("guarded already"), "{twice}");
        // An operator who is quick.
        context.every(PERIOD, |drive, _, _| {
            let _ = drive.guard.as_ref().unwrap().arm();
        });
    }
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, torque: Delivery<Torque>, _: &mut Self::Context) {
        match self.mood.try_recv().unwrap_or(Mood::Moves) {
            Mood::Moves => {}
            // Until the test lets go of the other end.
            Mood::Hangs => while self.mood.recv().is_ok() {},
            Mood::Panics => panic!("a planted panic"),
        }
        let moved = self.guard.as_ref().unwrap().apply(|motor| motor.send(Seen::Moved(torque.nm)).unwrap());
        let _ = moved; // the watchdog may have been quicker on a slow machine
    }
}

struct Scene {
    stage: Stage,
    sends: Arc<AtomicBool>,
    seen: Receiver<Seen>,
    mood: SyncSender<Mood>,
}

impl Scene {
    fn start() -> Self {
        let [central, drive] = [0, 1].map(stage::tid);
        let sends = Arc::new(AtomicBool::new(true));
        let (motor, seen) = sync_channel(100_000);
        let (mood, moods) = sync_channel(1);
        let moods = std::sync::Mutex::new(Some(moods));
        let may_send = sends.clone();
        let sender = AppSpec::new("central", move || Central { drive, sends: may_send.clone() });
        let receiver = AppSpec::new("drive", move || Drive {
            central,
            motor: motor.clone(),
            mood: moods.lock().unwrap().take().unwrap_or_else(|| sync_channel(1).1),
            guard: None,
        });
        let apps = vec![sender.own_thread().into(), receiver.handles::<Torque>().own_thread().into()];
        let stage = Stage::start(apps);
        let scene = Self { stage, sends, seen, mood };
        assert_eq!(scene.next(), Seen::Safe(Cause::NotArmed), "the output is safe before anything else");
        scene.wait_for(|seen| *seen == Seen::Moved(12.5));
        scene
    }

    fn next(&self) -> Seen {
        self.seen.recv_timeout(DEADLINE).expect("something happens to the motor")
    }

    fn wait_for(&self, is_it: impl Fn(&Seen) -> bool) -> Seen {
        loop {
            let seen = self.next();
            if is_it(&seen) {
                return seen;
            }
        }
    }
}

#[test]
fn a_sender_that_falls_silent_leaves_the_output_safe() {
    let scene = Scene::start();
    scene.sends.store(false, Ordering::Relaxed);
    scene.wait_for(|seen| *seen == Seen::Safe(Cause::Silent));
    // However often it is armed, nothing moves it while nothing comes.
    assert!(scene.seen.recv_timeout(PERIOD * 20).is_err(), "nothing moves it");
    scene.sends.store(true, Ordering::Relaxed);
    scene.wait_for(|seen| *seen == Seen::Moved(12.5));
}

#[test]
fn a_receiver_that_hangs_has_a_safe_output_all_the_same() {
    let scene = Scene::start();
    scene.mood.send(Mood::Hangs).unwrap();
    scene.wait_for(|seen| *seen == Seen::Safe(Cause::Silent));
}

#[test]
fn a_receiver_that_panics_has_a_safe_output_until_its_successor_is_armed() {
    let scene = Scene::start();
    scene.mood.send(Mood::Panics).unwrap();
    let safe = scene.wait_for(|seen| matches!(seen, Seen::Safe(_)));
    // Its guard is dropped with it, unless the machine was slow and the watchdog quicker.
    assert!([Cause::Dropped, Cause::Silent].map(Seen::Safe).contains(&safe), "{safe:?}");
    scene.wait_for(|seen| *seen == Seen::Safe(Cause::NotArmed));
    scene.wait_for(|seen| *seen == Seen::Moved(12.5));
}

#[test]
fn what_is_not_sealed_moves_nothing() {
    let scene = Scene::start();
    scene.sends.store(false, Ordering::Relaxed);
    scene.wait_for(|seen| *seen == Seen::Safe(Cause::Silent));
    let central = &scene.stage.senders[0];
    let plain = sinew_runtime::wire::encode(&Torque { nm: 99.0 });
    for _ in 0..10 {
        let mut message = central.create_message(stage::tid(1), Torque::KIND, plain.len()).unwrap();
        message.copy_from_slice(&plain);
        central.send_message(message).unwrap();
    }
    assert!(scene.seen.recv_timeout(PERIOD * 20).is_err(), "nothing moves it");
}

#[test]
fn an_output_whose_making_safe_panics_is_made_safe_again_and_not_armed_before() {
    let (safe, made_safe) = sync_channel(100);
    let mut fails = 3;
    let guard =
        Guard::new::<Torque>(stage::tid(0), stage::tid(1), safe, move |safe: &mut SyncSender<()>, _| {
            if fails > 0 {
                fails -= 1;
                panic!("a planted panic");
            }
            safe.send(()).unwrap();
        })
        .unwrap();
    // By the thread of the watchdogs, of itself.
    made_safe.recv_timeout(DEADLINE).expect("it is tried until it is done");
    assert!(
        matches!(guard.arm(), Err(ArmError::NotGood { .. })),
        "now it is only that nothing good has come"
    );
}

#[test]
fn one_that_can_never_be_made_safe_is_never_armed() {
    let guard =
        Guard::new::<Torque>(stage::tid(0), stage::tid(1), (), |(), _| panic!("a planted panic")).unwrap();
    assert_eq!(guard.arm(), Err(ArmError::SafeFails));
}
