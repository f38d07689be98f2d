//! A drive whose thread hangs while it assists: its device is told to damp all the same, and nothing but central's gait makes it give
//! a torque again; nor does what only looks like its word.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, GaitMode, GaitState, JointSample, Stance};
use exoskeleton::robot::datagram::Reading;
use exoskeleton::robot::device::{Damper, DriveCommand, JointDevice};
use exoskeleton::robot::drive::{self, DriveParts};
use exoskeleton::robot::edges::{Arm, GAIT, Shut, drive_name, sensor_name};
use exoskeleton::robot::trace::{DriveRow, EventRow, Recording};
use sinew::prelude::*;
use sinew::protection::{DataId, Stamp, seal};

/// How long one thing may take on a machine that is busy with other tests.
const DEADLINE: Duration = Duration::from_secs(60);
const PERIOD: Duration = Duration::from_millis(1);
const JOINT: Joint = Joint::Ankle;
/// Torque that only assistance gives at this phase, Nm.
const ASSISTING_NM: f64 = 10.0;

/// What a device was told.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Told {
    Torque(f64),
    Damp,
}

impl Told {
    fn is_assistance(self) -> bool {
        matches!(self, Self::Torque(torque_nm) if torque_nm.abs() > ASSISTING_NM)
    }
}

/// A device that writes down what it is told.
#[derive(Clone, Default)]
struct Device(Arc<Mutex<Vec<Told>>>);

impl Device {
    fn told(&self) -> std::sync::MutexGuard<'_, Vec<Told>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until this is so of all that it was told.
    #[track_caller]
    fn wait(&self, what: &str, is_so: impl Fn(&[Told]) -> bool) {
        let deadline = Instant::now() + DEADLINE;
        while !is_so(&self.told()) {
            let told = self.told();
            assert!(Instant::now() < deadline, "{what}: {:?}", &told[told.len().saturating_sub(20)..]);
            drop(told);
            std::thread::sleep(PERIOD);
        }
    }
}

impl JointDevice for Device {
    fn read_newest(&mut self, _: Time) -> Option<Reading> {
        None
    }

    fn command(&mut self, _: Time, command: &DriveCommand) {
        self.told().push(Told::Torque(command.torque_nm));
    }

    fn damper(&self) -> Box<dyn Damper> {
        Box::new(self.clone())
    }
}

impl Damper for Device {
    fn damp(&self, _: Time, _: DriveState) {
        self.told().push(Told::Damp);
    }
}

/// Whether central says walk, and whether it asks shut drives to hear it again, or somebody in its place who can do all but that.
#[derive(Default)]
struct Will {
    walks: AtomicBool,
    arms: AtomicBool,
    forges: AtomicBool,
    /// How often the drive has said that central's word does not count.
    shuts: AtomicU64,
}

struct Gait {
    will: Arc<Will>,
    seq: u32,
}

impl Actor for Gait {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |gait, _, context| {
            let Some(drive) = context.resolve(&drive_name(JOINT)) else { return };
            gait.seq += 1;
            let walks = gait.will.walks.load(Ordering::Relaxed);
            let state = GaitState {
                seq: gait.seq,
                t_ns: Time::now().as_nanos(),
                t_error_ns: Some(0),
                phase: 0.5,
                phase_rate_hz: 0.75,
                stance: Stance::Stance,
                mode: if walks { GaitMode::Walk } else { GaitMode::Hold },
                confidence: 1.0,
                epoch: 1,
                degraded: 0,
            };
            let _ = context.send(drive, &state);
        });
    }
}

impl Handler<Delivery<Shut>> for Gait {
    type Result = ();

    fn handle(&mut self, shut: Delivery<Shut>, context: &mut Self::Context) {
        self.will.shuts.fetch_add(1, Ordering::Relaxed);
        if self.will.arms.load(Ordering::Relaxed) {
            let _ = context.send(shut.source, &Arm { suspect: shut.suspect });
        }
        if self.will.forges.load(Ordering::Relaxed) {
            forge(shut.source, context);
        }
    }
}

/// As an [`Arm`], by somebody who does not seal it.
#[derive(serde::Serialize, serde::Deserialize)]
struct Unsealed {
    suspect: bool,
}

impl Payload for Unsealed {
    const NAME: &'static str = Arm::NAME;
    const CLASS: Class = Arm::CLASS;
}

/// Sends `drive` what looks like an [`Arm`] from central's own address: one without an envelope, and one in an envelope that is right but for
/// the time that it quotes, as one that was kept from another day.
fn forge(drive: Tid, context: &AppContext<Gait>) {
    let _ = context.send(drive, &Unsealed { suspect: true });
    let data_id = DataId::of::<Arm>(context.tid(), drive);
    let counter = Time::now().as_nanos();
    let stamp = Stamp { counter, incarnation: 1, echo: Time::from_nanos(1) };
    let sealed = seal(&data_id, stamp, b"\x81\xa7suspect\xc3");
    let sender = context.sender();
    let mut message = sender.create_message(drive, Arm::KIND, sealed.len()).expect("it is short");
    message.copy_from_slice(&sealed);
    let _ = sender.loaned(message).send();
}

#[derive(Default)]
struct Sensor {
    seq: u32,
}

impl Actor for Sensor {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |sensor, _, context| {
            let Some(drive) = context.resolve(&drive_name(JOINT)) else { return };
            sensor.seq += 1;
            let sample = JointSample {
                seq: sensor.seq,
                t_ns: Time::now().as_nanos(),
                t_error_ns: Some(0),
                angle_rad: 0.2,
                velocity_rad_s: 1.5,
                torque_nm: 0.0,
                temperature_c: 30,
                flags: 0,
            };
            let _ = context.send(drive, &sample);
        });
    }
}

/// Beside the drive on its thread: hangs when it is told to, until it is let go.
struct Neighbour {
    hangs: Arc<AtomicBool>,
    hung: SyncSender<()>,
    go_on: Arc<Mutex<Receiver<()>>>,
}

impl Actor for Neighbour {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(PERIOD, |neighbour, _, _| {
            if neighbour.hangs.swap(false, Ordering::Relaxed) {
                neighbour.hung.send(()).expect("the test waits");
                let go_on = neighbour.go_on.lock().expect("one hangs at a time");
                let _ = go_on.recv_timeout(DEADLINE);
            }
        });
    }
}

type Recordings = (Recording<DriveRow>, Recording<EventRow>);

/// A node at 127.0.0.`host` with all that the drive needs, and what has to outlive it.
fn joint_node(host: u8, device: &Device, will: &Arc<Will>) -> (NodeBuilder, Recordings) {
    let (rows, events) =
        (Recording::begin(None, "").expect("no file"), Recording::begin(None, "").expect("no file"));
    let (own, of_will) = (device.clone(), will.clone());
    let parts = DriveParts {
        joint: JOINT,
        device: Arc::new(move || Box::new(own.clone())),
        trace: rows.trace(),
        events: events.trace(),
        figures: None,
        burden: None,
    };
    let gait = AppSpec::new(GAIT, move || Gait { will: of_will.clone(), seq: 0 }).handles::<Shut>();
    let node = Node::builder("ankle")
        .address([127, 0, 0, host])
        .configure(|config| (config.ndl.multicast, config.ndl.mdns_port) = (None, None))
        .app(AppSpec::new(sensor_name(JOINT), Sensor::default).own_thread())
        .app(gait.own_thread())
        .app(drive::spec(parts, Place::thread("control")));
    (node, (rows, events))
}

#[test]
fn drive_whose_thread_hangs_has_a_device_that_damps_and_assists_again_only_when_it_is_asked_to() {
    // Given: a drive that assists
    let device = Device::default();
    let will = Arc::new(Will { arms: true.into(), ..Will::default() });
    let hangs = Arc::new(AtomicBool::new(false));
    let ((hung, is_hung), (let_go, go_on)) = (sync_channel(1), sync_channel(1));
    let go_on = Arc::new(Mutex::new(go_on));
    let (node, _recordings) = joint_node(1, &device, &will);
    let to_hang = hangs.clone();
    let neighbour = move || Neighbour { hangs: to_hang.clone(), hung: hung.clone(), go_on: go_on.clone() };
    let node =
        node.app(AppSpec::new("neighbour", neighbour).place(Place::thread("control"))).start().unwrap();
    device.wait("the leg is held", |told| told.last() == Some(&Told::Torque(0.0)));
    will.walks.store(true, Ordering::Relaxed);
    device.wait("it assists", |told| told.last().is_some_and(|told| told.is_assistance()));

    // When: its thread hangs
    will.arms.store(false, Ordering::Relaxed);
    hangs.store(true, Ordering::Relaxed);
    is_hung.recv_timeout(DEADLINE).expect("the neighbour hangs");

    // Then: somebody else tells the device, while it hangs, and not only once, as one may be lost
    device.wait("the device is told to damp again and again", |told| told.ends_with(&[Told::Damp; 20]));

    // When: it goes on, and all inputs are there again
    let before = device.told().len();
    let_go.send(()).expect("the neighbour waits");
    let shuts = will.shuts.load(Ordering::Relaxed);
    device.wait("the drive goes on", |_| will.shuts.load(Ordering::Relaxed) > shuts + 20);

    // Then: it gives no torque, until central's gait asks for it
    assert_eq!(device.told()[before..].iter().find(|told| told.is_assistance()), None);
    will.arms.store(true, Ordering::Relaxed);
    device.wait("it assists again", |told| told.last().is_some_and(|told| told.is_assistance()));
    drop(node);
}

#[test]
fn what_only_looks_like_central_asking_makes_no_drive_assist() {
    // Given: a drive whose guard was never opened, and whatever has the address of central's gait and asks it to without being that
    let device = Device::default();
    let will = Arc::new(Will { forges: true.into(), ..Will::default() });
    let (node, _recordings) = joint_node(2, &device, &will);
    let node = node.start().unwrap();
    let refuses = |told: &[Told], shuts: u64| {
        told.iter().any(|told| told.is_assistance()) || will.shuts.load(Ordering::Relaxed) > shuts
    };
    device.wait("it was asked in a state in which it may be", |told| refuses(told, 100));

    // When: the gait says walk, sealed as it has to be
    will.walks.store(true, Ordering::Relaxed);
    let shuts = will.shuts.load(Ordering::Relaxed);
    device.wait("it is asked again, or assists", |told| refuses(told, shuts + 100));

    // Then: it does not
    assert_eq!(device.told().iter().find(|told| told.is_assistance()), None);

    // And: it does when central's gait itself asks
    will.forges.store(false, Ordering::Relaxed);
    will.arms.store(true, Ordering::Relaxed);
    device.wait("it assists", |told| told.last().is_some_and(|told| told.is_assistance()));
    drop(node);
}
