//! Protected commands between two applications, and the output that they move: it is safe after any end, hang
//! or forgery.

use std::{
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, Handler};
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    mailbox::Mailbox,
    protection::{ArmError, Cause, Guard, Protection},
    tid::Tid,
    wire::{Class, Payload},
};

use sinew_runtime_tests::{DEADLINE, Number, Stage, tid};

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

/// The same type in the sender's next version, which the receiver does not have.
#[derive(Debug, Serialize, Deserialize)]
struct LaterTorque {
    newton_metres: f64,
}

impl Payload for LaterTorque {
    const NAME: &'static str = Torque::NAME;
    const CLASS: Class = Torque::CLASS;
    const PROTECTION: Option<Protection> = Torque::PROTECTION;
}

/// Sends a torque each period, while permitted.
struct Central {
    drive: Tid,
    sends: Arc<AtomicBool>,
    is_later: Arc<AtomicBool>,
}

impl Actor for Central {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |central, _, context| {
            if central.is_later.load(Ordering::Relaxed) {
                context.send(central.drive, &LaterTorque { newton_metres: 12.5 }).unwrap();
            } else if central.sends.load(Ordering::Relaxed) {
                context.send(central.drive, &Torque { nm: 12.5 }).unwrap();
            }
        });
    }
}

/// Events at the motor, in their order.
#[derive(Debug, PartialEq)]
enum Seen {
    Moved(f64),
    Safe(Cause),
}

/// The drive's reaction to the next torque.
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
    arms: Arc<AtomicU64>,
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
        // A quick operator.
        context.every(PERIOD, |drive, _, _| {
            let is_armed = drive.guard.as_ref().unwrap().arm().is_ok();
            drive.arms.fetch_add(is_armed.into(), Ordering::Relaxed);
        });
    }
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, torque: Delivery<Torque>, _: &mut Self::Context) {
        match self.mood.try_recv().unwrap_or(Mood::Moves) {
            Mood::Moves => {}
            // Until the test drops the other end.
            Mood::Hangs => while self.mood.recv().is_ok() {},
            Mood::Panics => panic!("a planted panic"),
        }
        let moved = self.guard.as_ref().unwrap().apply(|motor| motor.send(Seen::Moved(torque.nm)).unwrap());
        let _ = moved; // on a slow machine the watchdog may have been first
    }
}

struct Scene {
    stage: Stage,
    sends: Arc<AtomicBool>,
    is_later: Arc<AtomicBool>,
    /// How often the output was armed.
    arms: Arc<AtomicU64>,
    seen: Receiver<Seen>,
    mood: SyncSender<Mood>,
}

impl Scene {
    fn start() -> Self {
        let [central, drive] = [0, 1].map(tid);
        let sends = Arc::new(AtomicBool::new(true));
        let (motor, seen) = sync_channel(100_000);
        let (mood, moods) = sync_channel(1);
        let moods = std::sync::Mutex::new(Some(moods));
        let is_later = Arc::new(AtomicBool::new(false));
        let (may_send, has_changed) = (sends.clone(), is_later.clone());
        let sender = AppSpec::new("central", move || Central {
            drive,
            sends: may_send.clone(),
            is_later: has_changed.clone(),
        });
        let arms = Arc::new(AtomicU64::new(0));
        let counted = arms.clone();
        let receiver = AppSpec::new("drive", move || Drive {
            central,
            arms: counted.clone(),
            motor: motor.clone(),
            mood: moods.lock().unwrap().take().unwrap_or_else(|| sync_channel(1).1),
            guard: None,
        });
        let apps = vec![sender.own_thread().into(), receiver.handles::<Torque>().own_thread().into()];
        let stage = Stage::start(apps);
        let scene = Self { stage, sends, is_later, arms, seen, mood };
        assert_eq!(scene.next(), Seen::Safe(Cause::NotArmed), "the output is safe before anything else");
        scene.wait_for(|seen| *seen == Seen::Moved(12.5));
        scene
    }

    fn next(&self) -> Seen {
        self.seen.recv_timeout(DEADLINE).expect("something happens to the motor")
    }

    /// Waits until the output is safe because of silence, without a later event: on a busy machine it may
    /// have been so before, for a while.
    fn wait_for_silence(&self) {
        self.wait_for_last(|last| *last == Seen::Safe(Cause::Silent));
    }

    fn wait_for_last(&self, is_it: impl Fn(&Seen) -> bool) {
        let deadline = std::time::Instant::now() + DEADLINE;
        let mut last = self.next();
        loop {
            match self.seen.recv_timeout(PERIOD * 20) {
                Ok(seen) => last = seen,
                Err(_) if is_it(&last) => return,
                Err(_) => assert!(std::time::Instant::now() < deadline, "{last:?} was the last"),
            }
        }
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
fn silent_sender_leaves_the_output_safe() {
    let scene = Scene::start();
    scene.sends.store(false, Ordering::Relaxed);
    scene.wait_for_silence();
    // However often it is armed, nothing moves it without commands.
    assert!(scene.seen.recv_timeout(PERIOD * 20).is_err(), "nothing moves it");
    scene.sends.store(true, Ordering::Relaxed);
    scene.wait_for(|seen| *seen == Seen::Moved(12.5));
}

#[test]
fn undecodable_commands_leave_the_output_safe() {
    let scene = Scene::start();
    scene.is_later.store(true, Ordering::Relaxed);
    // The second one exceeds the limit, unless the machine is slow.
    scene.wait_for_last(|last| {
        [Cause::TooManyBad, Cause::Silent, Cause::TooMuchLost].map(Seen::Safe).contains(last)
    });
    let armed = scene.arms.load(Ordering::Relaxed);
    assert!(scene.seen.recv_timeout(PERIOD * 20).is_err(), "nothing moves it");
    assert_eq!(scene.arms.load(Ordering::Relaxed), armed, "none of them counts as good");
    scene.is_later.store(false, Ordering::Relaxed);
    scene.wait_for(|seen| *seen == Seen::Moved(12.5));
}

/// Guards the commands of several senders in turn; each message that is no torque of theirs selects the next
/// sender.
struct Turncoat {
    senders: std::vec::IntoIter<Tid>,
    guard: Option<Guard<()>>,
}

impl Turncoat {
    fn turn(&mut self, context: &mut AppContext<Self>) {
        let Some(sender) = self.senders.next() else { return };
        self.guard = None;
        self.guard = Some(context.guard::<Torque, _>(sender, (), |(), _| ()).unwrap());
    }
}

impl Actor for Turncoat {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.turn(context);
    }
}

impl Handler<Delivery<Number>> for Turncoat {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, context: &mut Self::Context) {
        self.turn(context);
    }
}

/// Does nothing.
struct Idle;

impl Actor for Idle {
    type Context = AppContext<Self>;
}

#[test]
fn replaced_guard_sends_no_echoes() {
    let [old, new] = [0, 1].map(tid);
    let idle = |name| AppSpec::new(name, || Idle).own_thread().into();
    let turncoat =
        AppSpec::new("drive", move || Turncoat { senders: vec![old, new].into_iter(), guard: None });
    let drive = turncoat.handles::<Number>().own_thread().into();
    let stage = Stage::start(vec![idle("old"), idle("new"), drive]);
    let echoes = |of: usize| stage.mailboxes[of].tally(Class::Stream).taken;
    let wait_for = |of: usize, at_least: u64| {
        let deadline = std::time::Instant::now() + DEADLINE;
        while echoes(of) < at_least {
            assert!(std::time::Instant::now() < deadline, "{at_least} echoes come");
            std::thread::sleep(PERIOD);
        }
    };
    wait_for(0, 2);
    stage.send(2, 0);
    wait_for(1, 1);
    let so_far = echoes(0);
    wait_for(1, 5);
    assert_eq!(echoes(0), so_far, "the guard that asked for them is gone");
}

/// Protected, too, and from the same sender.
#[derive(Debug, Serialize, Deserialize)]
struct Stiffness {
    nm_per_rad: f64,
}

/// As slow as a test on a busy machine may be.
const UNHURRIED: Protection = Protection {
    within: DEADLINE,
    age_max: Duration::from_millis(400),
    lost_max: 0,
    bad_max: 1,
    good_min: 4,
};

impl Payload for Stiffness {
    const NAME: &'static str = "test.stiffness";
    const CLASS: Class = Class::Stream;
    const PROTECTION: Option<Protection> = Some(UNHURRIED);
}

#[derive(Debug, Serialize, Deserialize)]
struct Damping {
    nms_per_rad: f64,
}

impl Payload for Damping {
    const NAME: &'static str = "test.damping";
    const CLASS: Class = Class::Stream;
    const PROTECTION: Option<Protection> = Some(UNHURRIED);
}

/// Sends a stiffness and a damping for each number. It then blocks until its drive has sent two more echoes.
struct Busy {
    drive: Tid,
    mailbox: Arc<OnceLock<Arc<Mailbox>>>,
}

impl Actor for Busy {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Busy {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, context: &mut Self::Context) {
        context.send(self.drive, &Stiffness { nm_per_rad: 80.0 }).unwrap();
        context.send(self.drive, &Damping { nms_per_rad: 1.0 }).unwrap();
        let taken = || self.mailbox.wait().tally(Class::Stream).taken;
        let (before, deadline) = (taken(), std::time::Instant::now() + DEADLINE);
        while taken() < before + 2 && std::time::Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// Guards both types.
struct Compliant {
    central: Tid,
    live: Arc<[AtomicBool; 2]>,
    guards: Option<[Guard<()>; 2]>,
}

impl Actor for Compliant {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let stiffness = context.guard::<Stiffness, _>(self.central, (), |(), _| ()).unwrap();
        let damping = context.guard::<Damping, _>(self.central, (), |(), _| ()).unwrap();
        self.guards = Some([stiffness, damping]);
        context.every(PERIOD, |drive, _, _| {
            for (guard, live) in drive.guards.iter().flatten().zip(&*drive.live) {
                live.fetch_or(guard.arm().is_ok(), Ordering::Relaxed);
            }
        });
    }
}

impl Handler<Delivery<Stiffness>> for Compliant {
    type Result = ();

    fn handle(&mut self, _: Delivery<Stiffness>, _: &mut Self::Context) {}
}

impl Handler<Delivery<Damping>> for Compliant {
    type Result = ();

    fn handle(&mut self, _: Delivery<Damping>, _: &mut Self::Context) {}
}

#[test]
fn echoes_of_two_types_do_not_displace_each_other() {
    let [central, drive] = [0, 1].map(tid);
    let (mailbox, live) = (Arc::new(OnceLock::new()), Arc::new([const { AtomicBool::new(false) }; 2]));
    let (its_mailbox, its_live) = (mailbox.clone(), live.clone());
    let busy = AppSpec::new("central", move || Busy { drive, mailbox: its_mailbox.clone() });
    let compliant =
        AppSpec::new("drive", move || Compliant { central, live: its_live.clone(), guards: None });
    let compliant = compliant.handles::<Stiffness>().handles::<Damping>();
    let stage =
        Stage::start(vec![busy.handles::<Number>().own_thread().into(), compliant.own_thread().into()]);
    mailbox.set(stage.mailboxes[0].clone()).ok().unwrap();
    let deadline = std::time::Instant::now() + DEADLINE;
    for number in 0.. {
        let are_live = live.each_ref().map(|live| live.load(Ordering::Relaxed));
        if are_live == [true; 2] {
            break;
        }
        assert!(std::time::Instant::now() < deadline, "both can be armed: {are_live:?}");
        stage.send(0, number);
        while stage.mailboxes[0].tally(Class::Bulk).open() > 0 && std::time::Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

#[test]
fn hung_receiver_has_a_safe_output() {
    let scene = Scene::start();
    scene.mood.send(Mood::Hangs).unwrap();
    scene.wait_for(|seen| *seen == Seen::Safe(Cause::Silent));
}

#[test]
fn panicked_receiver_has_a_safe_output_until_armed_again() {
    let scene = Scene::start();
    scene.mood.send(Mood::Panics).unwrap();
    let safe = scene.wait_for(|seen| matches!(seen, Seen::Safe(_)));
    // Its guard is dropped with it, unless the machine was slow and the watchdog was first.
    assert!([Cause::Dropped, Cause::Silent].map(Seen::Safe).contains(&safe), "{safe:?}");
    scene.wait_for(|seen| *seen == Seen::Safe(Cause::NotArmed));
    scene.wait_for(|seen| *seen == Seen::Moved(12.5));
}

#[test]
fn unsealed_message_moves_nothing() {
    let scene = Scene::start();
    scene.sends.store(false, Ordering::Relaxed);
    scene.wait_for_silence();
    let central = &scene.stage.senders[0];
    let plain = sinew_runtime::wire::encode(&Torque { nm: 99.0 });
    for _ in 0..10 {
        let mut message = central.create_message(tid(1), Torque::KIND, plain.len()).unwrap();
        message.copy_from_slice(&plain);
        central.loaned(message).send().unwrap();
    }
    assert!(scene.seen.recv_timeout(PERIOD * 20).is_err(), "nothing moves it");
}

#[test]
fn panicking_safe_function_is_retried_before_arming() {
    let (safe, made_safe) = sync_channel(100);
    let mut fails = 3;
    let guard = Guard::new::<Torque>(tid(0), tid(1), safe, move |safe: &mut SyncSender<()>, _| {
        if fails > 0 {
            fails -= 1;
            panic!("a planted panic");
        }
        safe.send(()).unwrap();
    })
    .unwrap();
    // Called by the thread of the watchdogs, on its own.
    made_safe.recv_timeout(DEADLINE).expect("it is tried until it is done");
    assert!(
        matches!(guard.arm(), Err(ArmError::NotGood { .. })),
        "now it is only that nothing good has come"
    );
}

#[test]
fn output_that_cannot_be_made_safe_is_never_armed() {
    let guard = Guard::new::<Torque>(tid(0), tid(1), (), |(), _| panic!("a planted panic")).unwrap();
    assert_eq!(guard.arm(), Err(ArmError::SafeFails));
}
