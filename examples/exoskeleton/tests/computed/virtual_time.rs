//! The applications of the robot in virtual time: the torques of its actors are those of the lock-step loop,
//! bit by bit.

mod gains;
mod recorded;

use std::sync::atomic::AtomicU32;
use std::sync::{Arc, Mutex, PoisonError};

use exoskeleton::robot::device::{Damper, DriveCommand, JointDevice};
use exoskeleton::robot::drive::{self, DriveParts};
use exoskeleton::robot::edges::{GAIT, Release, drive_name, sensor_name};
use exoskeleton::robot::gait::{self, GaitParts};
use exoskeleton::robot::sensor::{self, DeviceMaker};
use exoskeleton::robot::trace::Recording;
use exoskeleton_model::central::Resume;
use exoskeleton_model::datagram::Reading;
use exoskeleton_model::intention::Intention;
use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::lockstep::{LockStepConfig, PERIOD_NS, run};
use exoskeleton_model::message::DriveState;
use exoskeleton_model::plant::{PlantCore, PlantReadings};
use exoskeleton_model::record::Record;
use sinew::prelude::*;
use sinew::replay::{Replay, TimedMessage};

const PERIOD: Duration = Duration::from_nanos(PERIOD_NS);
/// The slot of all applications: they tick together, as in the loop.
const TOGETHER: Duration = Duration::ZERO;
/// A message that is sent in one turn arrives before the next one, as in the loop.
const LATENCY: Duration = Duration::from_micros(500);
/// The plant steps after the turns of all applications, and after the messages.
const PLANT_AFTER: Duration = Duration::from_micros(750);

/// The state of the leg in one millisecond, as bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Row {
    t_ms: u64,
    angle: PerJoint<u64>,
    applied: PerJoint<u64>,
}

/// The hardware: the plant's readings, and the orders of the drives.
#[derive(Default)]
struct Bench {
    readings: PerJoint<Option<Reading>>,
    /// Torques that were ordered since the plant's last step.
    ordered_nm: PerJoint<Option<f64>>,
    /// Those before: an order takes a millisecond.
    arrived_nm: PerJoint<Option<f64>>,
    rows: Vec<Row>,
}

type SharedBench = Arc<Mutex<Bench>>;

fn with<R>(bench: &SharedBench, step: impl FnOnce(&mut Bench) -> R) -> R {
    step(&mut bench.lock().unwrap_or_else(PoisonError::into_inner))
}

/// The device of a joint, in memory.
#[derive(Clone)]
struct Device(Joint, SharedBench);

impl JointDevice for Device {
    fn read_newest(&mut self, _: Time) -> Option<Reading> {
        with(&self.1, |bench| bench.readings[self.0.index()].take())
    }

    fn command(&mut self, _: Time, command: &DriveCommand) {
        with(&self.1, |bench| bench.ordered_nm[self.0.index()] = Some(command.torque_nm));
    }

    fn damper(&self) -> Box<dyn Damper> {
        Box::new(self.clone())
    }
}

impl Damper for Device {
    fn damp(&self, _: Time, state: DriveState) {
        // A drive that ends has it repeated by a thread of its own, outside of virtual time.
        assert_ne!(state, DriveState::Walk, "no drive damps while the leg walks");
    }
}

/// The leg, as an application under test.
struct Plant {
    core: PlantCore,
    bench: SharedBench,
    released_at: Time,
    walks: bool,
}

impl Plant {
    fn step(&mut self, now: Time) {
        let released = now >= self.released_at;
        if released && !std::mem::replace(&mut self.walks, released) {
            self.core.start_walking();
        }
        let truth = self.core.truth();
        let bits = |values: PerJoint<f64>| values.map(f64::to_bits);
        let row = Row {
            t_ms: truth.t_ns / PERIOD_NS,
            angle: bits(truth.leg.angle_rad),
            applied: bits(truth.applied_nm),
        };
        let commands = with(&self.bench, |bench| {
            bench.rows.push(row);
            let ordered = std::mem::take(&mut bench.ordered_nm);
            std::mem::replace(&mut bench.arrived_nm, ordered)
        });
        let readings = self.core.step(PERIOD_NS, &commands);
        self.publish(&readings);
    }

    fn publish(&self, readings: &PlantReadings) {
        with(&self.bench, |bench| {
            for joint in Joint::ALL {
                bench.readings[joint.index()] = Some(Reading {
                    joint,
                    seq: (readings.t_ns / PERIOD_NS) as u32,
                    t_ns: readings.t_ns,
                    device: readings.joints[joint.index()],
                    foot: (joint == Joint::Ankle).then_some(readings.foot),
                });
            }
        });
    }
}

impl Actor for Plant {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.after(PLANT_AFTER, |plant, _, context| {
            plant.step(context.now());
            context.every(PERIOD, |plant, tick, _| plant.step(tick.scheduled));
        });
    }
}

fn node(number: usize) -> NodeAddress {
    NodeAddress::new(0x0a00_0001 + number as u32)
}

fn tid(number: usize, app: u32) -> Tid {
    Tid::new(node(number), AppAddress::new(0x1000 + app))
}

/// The number of central's node; those of the joints are their indices.
const CENTRAL: usize = 3;

/// The robot's own applications, and the plant, released at this time.
fn replay(config: &LockStepConfig, bench: &SharedBench, released_at: Time) -> Replay {
    let gait = GaitParts {
        joints: [node(0), node(1), node(2)],
        epoch: Arc::new(AtomicU32::new(config.central.epoch)),
        slot: TOGETHER,
        trace: Recording::begin(None, "gait").expect("no file").trace(),
        events: Recording::begin(None, "events").expect("no file").trace(),
        resume: Resume::ByItself,
    };
    let place = Place::thread("apps");
    let mut replay = Replay::new()
        .latency(LATENCY)
        .starts_at(Time::ZERO)
        .name(GAIT, tid(CENTRAL, 1))
        .name("plant", tid(4, 1));
    for joint in Joint::ALL {
        let own = bench.clone();
        let device: DeviceMaker = Arc::new(move || Box::new(Device(joint, own.clone())));
        let events = Recording::begin(None, "events").expect("no file").trace();
        let parts = DriveParts {
            joint,
            device: device.clone(),
            slot: TOGETHER,
            trace: Recording::begin(None, "drive").expect("no file").trace(),
            events: events.clone(),
            figures: None,
            burden: None,
            sends_ticks: true,
        };
        replay = replay
            .name(sensor_name(joint), tid(joint.index(), 1))
            .name(drive_name(joint), tid(joint.index(), 2))
            .app(sensor::spec(joint, device, TOGETHER, events, place.clone()))
            .app(drive::spec(parts, place.clone()));
    }
    let (config, bench) = (config.clone(), bench.clone());
    let plant = AppSpec::new("plant", move || {
        let mut core = PlantCore::new(config.plant, config.intention.clone(), config.seed);
        // The loop reads it once before its first step, which takes chance.
        let _ = core.read();
        Plant { core, bench: bench.clone(), released_at, walks: false }
    });
    replay.app(gait::spec(gait, place)).app(plant)
}

/// A walk in the loop, and one of the robot's applications.
struct Walks {
    record: Record,
    rows: Vec<Row>,
    /// All messages of the applications.
    outputs: Vec<TimedMessage>,
}

/// Walks this many strides in the loop, and as long with the robot's applications.
fn both(config: &LockStepConfig) -> Walks {
    let record = run(config).expect("the loop walks");
    let (rows, outputs) = walk_of_apps(config, &record, |replay| replay);
    Walks { record, rows, outputs }
}

/// Walks with the robot's applications and what `more` adds, as long as the loop did.
fn walk_of_apps(
    config: &LockStepConfig,
    record: &Record,
    more: impl FnOnce(Replay) -> Replay,
) -> (Vec<Row>, Vec<TimedMessage>) {
    let released = Time::ZERO + Duration::from_secs_f64(record.released_s.expect("it was released"));
    let bench = SharedBench::default();
    let ends_at = Time::ZERO + PERIOD * u32::try_from(record.rows.len()).expect("minutes");
    let replay = more(replay(config, &bench, released)).ends_at(ends_at);
    let release = TimedMessage::of(released - LATENCY, tid(CENTRAL, 2), tid(CENTRAL, 1), &Release {});
    let outputs = replay.run([release]).expect("nothing panics");
    (with(&bench, |bench| std::mem::take(&mut bench.rows)), outputs)
}

#[test]
fn actors_in_virtual_time_match_torques_of_the_loop() {
    let mut config = LockStepConfig::standard(6, 3, Intention::from_curves(3));
    // An application's first turn is one period after its start.
    config.start_ms = [1, 1, 1];
    let Walks { record, rows, .. } = both(&config);
    assert_eq!(rows.len(), record.rows.len());
    let mut has_torque = false;
    for (row, expected) in rows.iter().zip(&record.rows) {
        let bits = |value: fn(&exoskeleton_model::record::JointRow) -> f64| {
            std::array::from_fn(|joint| value(&expected.joints[joint]).to_bits())
        };
        let t_ms = (expected.t_s * 1e3).round() as u64;
        let expected =
            Row { t_ms, angle: bits(|joint| joint.angle_rad), applied: bits(|joint| joint.applied_nm) };
        assert_eq!(*row, expected, "applied {:?}", row.applied.map(f64::from_bits));
        has_torque |= row.applied.iter().any(|bits| f64::from_bits(*bits).abs() > 5.0);
    }
    assert!(has_torque, "the leg walks");
    assert_eq!(both(&config).rows, rows, "the same seed gives the same bits");
}
