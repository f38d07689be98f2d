//! A drive with a thread that hangs while it assists: its device is still ordered to damp. Only central's
//! gait makes it apply a torque again; forged requests do not.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use exoskeleton::robot::device::{Damper, DriveCommand, JointDevice};
use exoskeleton::robot::drive::{self, DriveParts};
use exoskeleton::robot::edges::{Arm, GAIT, Shut, drive_name, sensor_name};
use exoskeleton::robot::trace::{DriveRow, EventRow, Recording};
use exoskeleton_model::datagram::Reading;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode, GaitState, JointSample, Stance};
use sinew::prelude::*;
use sinew::protection::{DataId, Stamp, seal};

/// Time limit of one step on a machine that is busy with other tests.
const DEADLINE: Duration = Duration::from_secs(60);
const PERIOD: Duration = Duration::from_millis(1);
const JOINT: Joint = Joint::Ankle;
/// Torque that only assistance applies at this phase, Nm.
const ASSISTING_NM: f64 = 10.0;

/// An order to a device.
#[derive(Clone, Copy, Debug, PartialEq)]
enum DeviceOrder {
    Torque(f64),
    Damp,
}

impl DeviceOrder {
    fn is_assistance(self) -> bool {
        matches!(self, Self::Torque(torque_nm) if torque_nm.abs() > ASSISTING_NM)
    }
}

/// A device that records its orders.
#[derive(Clone, Default)]
struct Device(Arc<Mutex<Vec<DeviceOrder>>>);

impl Device {
    fn orders(&self) -> std::sync::MutexGuard<'_, Vec<DeviceOrder>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until this holds for its orders so far.
    #[track_caller]
    fn wait(&self, what: &str, is_so: impl Fn(&[DeviceOrder]) -> bool) {
        let deadline = Instant::now() + DEADLINE;
        while !is_so(&self.orders()) {
            let orders = self.orders();
            assert!(Instant::now() < deadline, "{what}: {:?}", &orders[orders.len().saturating_sub(20)..]);
            drop(orders);
            std::thread::sleep(PERIOD);
        }
    }
}

impl JointDevice for Device {
    fn read_newest(&mut self, _: Time) -> Option<Reading> {
        None
    }

    fn command(&mut self, _: Time, command: &DriveCommand) {
        self.orders().push(DeviceOrder::Torque(command.torque_nm));
    }

    fn damper(&self) -> Box<dyn Damper> {
        Box::new(self.clone())
    }
}

impl Damper for Device {
    fn damp(&self, _: Time, _: DriveState) {
        self.orders().push(DeviceOrder::Damp);
    }
}

/// The behaviour of the test's gait: whether it commands to walk, and whether it arms shut drives or forges
/// such requests.
#[derive(Default)]
struct Will {
    walks: AtomicBool,
    arms: AtomicBool,
    forges: AtomicBool,
    /// Number of times that the drive reported that central's commands do not count.
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

/// Like an [`Arm`], from a sender that does not seal it.
#[derive(serde::Serialize, serde::Deserialize)]
struct Unsealed {
    suspect: bool,
}

impl Payload for Unsealed {
    const NAME: &'static str = Arm::NAME;
    const CLASS: Class = Arm::CLASS;
}

/// Sends `drive` forged requests from central's own address: one without an envelope, and one in a valid
/// envelope except for the quoted time, as a recorded one would have.
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

/// An application beside the drive on its thread: hangs on request, until it is released.
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

/// A node at 127.0.0.`host` with all that the drive needs, and the recordings that have to outlive it.
fn joint_node(host: u8, device: &Device, will: &Arc<Will>) -> (NodeBuilder, Recordings) {
    let (rows, events) =
        (Recording::begin(None, "").expect("no file"), Recording::begin(None, "").expect("no file"));
    let (own, of_will) = (device.clone(), will.clone());
    let parts = DriveParts {
        joint: JOINT,
        device: Arc::new(move || Box::new(own.clone())),
        slot: Duration::ZERO,
        trace: rows.trace(),
        events: events.trace(),
        figures: None,
        burden: None,
        sends_ticks: false,
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
fn device_of_hung_drive_damps_until_central_arms_it() {
    // given: a drive that assists
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
    device.wait("the leg is held", |orders| orders.last() == Some(&DeviceOrder::Torque(0.0)));
    will.walks.store(true, Ordering::Relaxed);
    device.wait("it assists", |orders| orders.last().is_some_and(|order| order.is_assistance()));

    // when: its thread hangs
    will.arms.store(false, Ordering::Relaxed);
    hangs.store(true, Ordering::Relaxed);
    is_hung.recv_timeout(DEADLINE).expect("the neighbour hangs");

    // then: another thread orders the device meanwhile, repeatedly, as one order may be lost
    device.wait("the device is ordered to damp repeatedly", |orders| {
        orders.ends_with(&[DeviceOrder::Damp; 20])
    });

    // when: it continues, and all inputs have returned
    let before = device.orders().len();
    let_go.send(()).expect("the neighbour waits");
    let shuts = will.shuts.load(Ordering::Relaxed);
    device.wait("the drive goes on", |_| will.shuts.load(Ordering::Relaxed) > shuts + 20);

    // then: it applies no torque until central's gait requests it
    assert_eq!(device.orders()[before..].iter().find(|order| order.is_assistance()), None);
    will.arms.store(true, Ordering::Relaxed);
    device.wait("it assists again", |orders| orders.last().is_some_and(|order| order.is_assistance()));
    drop(node);
}

#[test]
fn forged_arm_requests_make_no_drive_assist() {
    // given: a drive with a guard that was never opened, and a forger of requests with the address of
    // central's gait
    let device = Device::default();
    let will = Arc::new(Will { forges: true.into(), ..Will::default() });
    let (node, _recordings) = joint_node(2, &device, &will);
    let node = node.start().unwrap();
    let refuses = |orders: &[DeviceOrder], shuts: u64| {
        orders.iter().any(|order| order.is_assistance()) || will.shuts.load(Ordering::Relaxed) > shuts
    };
    device.wait("it was asked in a state in which it may be", |orders| refuses(orders, 100));

    // when: the gait commands to walk, properly sealed
    will.walks.store(true, Ordering::Relaxed);
    let shuts = will.shuts.load(Ordering::Relaxed);
    device.wait("it is asked again, or assists", |orders| refuses(orders, shuts + 100));

    // then: the drive does not assist
    assert_eq!(device.orders().iter().find(|order| order.is_assistance()), None);

    // and: it does when central's gait itself requests it
    will.forges.store(false, Ordering::Relaxed);
    will.arms.store(true, Ordering::Relaxed);
    device.wait("it assists", |orders| orders.last().is_some_and(|order| order.is_assistance()));
    drop(node);
}
