//! The cores and the messages between them, millisecond by millisecond.

use super::{LockStepConfig, PERIOD_NS};
use crate::central::{CentralConfig, CentralCore, CentralInput};
use crate::control::drive::{DriveConfig, DriveCore, DriveOutput};
use crate::joint::{Joint, PerJoint};
use crate::message::{DriveState, DriveStatus, FootLoad, GaitState, JointSample};
use crate::part::Part;
use crate::plant::{PlantCore, PlantReadings};
use crate::record::{JointRow, Outage, Record, Row};
use crate::sensor::{SensorConfig, SensorCore};

/// 200 statuses a second.
const STATUS_PERIOD_MS: u64 = 5;

/// Sensor and drive of one joint.
struct JointNode {
    sensor: SensorCore,
    /// `None`: it died alone.
    drive: Option<DriveCore>,
}

/// All messages sent in one millisecond; they arrive in the next.
#[derive(Debug, Clone, Copy, Default)]
struct Mail {
    samples: PerJoint<Option<JointSample>>,
    load: Option<FootLoad>,
    gait: Option<GaitState>,
    commands_nm: PerJoint<Option<f64>>,
    statuses: PerJoint<Option<DriveStatus>>,
}

pub(super) struct World<'a> {
    config: &'a LockStepConfig,
    t_ms: u64,
    plant: PlantCore,
    readings: PlantReadings,
    joints: PerJoint<Option<JointNode>>,
    central: Option<CentralCore>,
    central_epoch: u32,
    last_gait: Option<GaitState>,
    in_flight: Mail,
    release_at_ms: Option<u64>,
    /// Time at which the drive that dies alone died, ms.
    drive_died_ms: Option<u64>,
    record: Record,
}

impl<'a> World<'a> {
    pub(super) fn new(config: &'a LockStepConfig) -> Self {
        let mut plant = PlantCore::new(config.plant, config.intention.clone(), config.seed);
        let readings = plant.read();
        Self {
            config,
            t_ms: 0,
            plant,
            readings,
            joints: [None, None, None],
            central: Some(CentralCore::new(config.central)),
            central_epoch: config.central.epoch,
            last_gait: None,
            in_flight: Mail::default(),
            release_at_ms: None,
            drive_died_ms: None,
            record: Record {
                strides: config.strides,
                first_start_s: 0.0,
                ready_s: [None; 3],
                released_s: None,
                outage: None,
                stalls: Vec::new(),
                rows: Vec::new(),
            },
        }
    }

    pub(super) fn strides_walked(&self) -> f64 {
        self.plant.truth().intended.strides
    }

    pub(super) fn into_record(self) -> Record {
        self.record
    }

    /// Runs one millisecond: starts and deaths, then every core once, then the plant.
    pub(super) fn step(&mut self) {
        self.start_nodes();
        self.kill_and_restart();
        self.kill_drive_and_restart();
        self.release();
        let now_ns = self.t_ms * PERIOD_NS;
        let arrived = std::mem::take(&mut self.in_flight);
        self.sense(now_ns);
        self.coordinate(now_ns, &arrived);
        let outputs = self.drive(now_ns, &arrived);
        self.note(&outputs);
        self.readings = self.plant.step(PERIOD_NS, &arrived.commands_nm);
        self.t_ms += 1;
    }

    fn start_nodes(&mut self) {
        for joint in Joint::ALL {
            if self.config.start_ms[joint.index()] == self.t_ms {
                self.joints[joint.index()] = Some(JointNode::new(joint));
            }
        }
    }

    fn kill_and_restart(&mut self) {
        let Some(kill) = self.config.kill else { return };
        let now_s = self.now_s();
        match self.record.outage {
            None if self.strides_walked() >= f64::from(kill.stride - 1)
                && self.record.released_s.is_some() =>
            {
                self.record.outage = Some(Outage { part: kill.part, from_s: now_s, to_s: None });
                match kill.part {
                    Part::Central => (self.central, self.last_gait) = (None, None),
                    Part::Joint(joint) => self.joints[joint.index()] = None,
                }
            }
            Some(outage)
                if outage.to_s.is_none() && now_s >= outage.from_s + self.config.outage_ms as f64 * 1e-3 =>
            {
                self.record.outage = Some(Outage { to_s: Some(now_s), ..outage });
                match kill.part {
                    Part::Central => self.central = Some(self.next_central()),
                    Part::Joint(joint) => self.joints[joint.index()] = Some(JointNode::new(joint)),
                }
            }
            None | Some(_) => {}
        }
    }

    fn kill_drive_and_restart(&mut self) {
        let Some(death) = self.config.drive_death else { return };
        let walked = self.strides_walked();
        let Some(node) = &mut self.joints[death.joint.index()] else { return };
        match self.drive_died_ms {
            None if walked >= death.at_strides => {
                self.drive_died_ms = Some(self.t_ms);
                node.drive = None;
            }
            Some(died_ms) if node.drive.is_none() && self.t_ms >= died_ms + death.outage_ms => {
                node.drive = Some(DriveCore::new(DriveConfig::standard(death.joint)));
            }
            None | Some(_) => {}
        }
    }

    /// A new incarnation of central with a new epoch, released again at once: the run resumes by itself.
    fn next_central(&mut self) -> CentralCore {
        self.central_epoch += 1;
        let mut central =
            CentralCore::new(CentralConfig { epoch: self.central_epoch, ..self.config.central });
        central.release().expect("a new central has not been stopped");
        central
    }

    /// Acts as the operator: releases the walk half a second after all drives were ready.
    fn release(&mut self) {
        if self.release_at_ms.is_none() && self.record.ready_s.iter().all(Option::is_some) {
            self.release_at_ms = Some(self.t_ms + self.config.release_after_ms);
        }
        if self.release_at_ms == Some(self.t_ms) {
            if let Some(central) = &mut self.central {
                central.release().expect("the e-stop is not pressed here");
            }
            self.plant.start_walking();
            self.record.released_s = Some(self.now_s());
        }
    }

    fn sense(&mut self, now_ns: u64) {
        for joint in Joint::ALL {
            let Some(node) = &mut self.joints[joint.index()] else { continue };
            let reading = &self.readings.joints[joint.index()];
            self.in_flight.samples[joint.index()] = Some(node.sensor.sample(now_ns, reading));
            if joint == Joint::Ankle {
                self.in_flight.load = Some(node.sensor.foot_load(now_ns, &self.readings.foot));
            }
        }
    }

    fn coordinate(&mut self, now_ns: u64, arrived: &Mail) {
        let Some(central) = &mut self.central else { return };
        let input = CentralInput {
            samples: std::array::from_fn(|i| arrived.samples[i].as_ref()),
            load: arrived.load.as_ref(),
        };
        for joint in Joint::ALL {
            if let Some(status) = &arrived.statuses[joint.index()] {
                central.on_drive_status(now_ns, joint, status);
            }
        }
        self.last_gait = central.tick(now_ns, &input);
        self.in_flight.gait = self.last_gait;
    }

    fn drive(&mut self, now_ns: u64, arrived: &Mail) -> PerJoint<Option<DriveOutput>> {
        let mut outputs = [None; 3];
        for joint in Joint::ALL {
            let i = joint.index();
            let Some(drive) = self.joints[i].as_mut().and_then(|node| node.drive.as_mut()) else { continue };
            let output = drive.tick(now_ns, arrived.samples[i].as_ref(), arrived.gait.as_ref());
            self.in_flight.commands_nm[i] = output.command_nm;
            if self.t_ms.is_multiple_of(STATUS_PERIOD_MS) {
                self.in_flight.statuses[i] = Some(drive.status(now_ns));
            }
            if output.state == DriveState::Ready && self.record.ready_s[i].is_none() {
                self.record.ready_s[i] = Some(self.t_ms as f64 * 1e-3);
            }
            outputs[i] = Some(output);
        }
        outputs
    }

    fn note(&mut self, outputs: &PerJoint<Option<DriveOutput>>) {
        let truth = self.plant.truth();
        let joints = std::array::from_fn(|i| JointRow {
            angle_rad: truth.leg.angle_rad[i],
            velocity_rad_s: truth.leg.velocity_rad_s[i],
            intended_rad: truth.intended.angle_rad[i],
            commanded_nm: outputs[i].and_then(|o| o.command_nm),
            applied_nm: truth.applied_nm[i],
            saturated: outputs[i].is_some_and(|o| o.saturated),
            state: outputs[i].map(|o| o.state),
            watchdog: truth.watchdog_active[i],
        });
        self.record.rows.push(Row {
            t_s: self.now_s(),
            strides_true: truth.intended.strides,
            walking: truth.intended.rate_hz > 0.0,
            phase_estimated: self.last_gait.map_or(0.0, |g| f64::from(g.phase)),
            confidence: self.last_gait.map_or(0.0, |g| f64::from(g.confidence)),
            mode: self.last_gait.map(|g| g.mode),
            degraded: self.last_gait.map_or(0, |g| g.degraded),
            joints,
        });
    }

    fn now_s(&self) -> f64 {
        self.t_ms as f64 * 1e-3
    }
}

impl JointNode {
    fn new(joint: Joint) -> Self {
        Self {
            sensor: SensorCore::new(SensorConfig::default()),
            drive: Some(DriveCore::new(DriveConfig::standard(joint))),
        }
    }
}
