//! The plant process: person, leg and three motor devices behind UDP, stepped at exactly 1 kHz.
//!
//! It is no part of the product and knows nothing of Sinew: drives and sensors use it as they would use
//! hardware. A device holds the last torque of a drive that falls silent. The person begins to walk when all
//! three drives report that walking is released. It prints a line for each stride.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use exoskeleton_model::datagram::{COMMAND_BYTES, CommandFrame, Order, Reading};
use exoskeleton_model::gait::trial::{Trial, TrialError};
use exoskeleton_model::intention::Intention;
use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::plant::{PlantConfig, PlantCore, PlantReadings};
use sinew::Time;
use sinew_figures::stalls::sleep_until;
use thiserror::Error;

use super::topology::PlantPlace;
use super::trace::{PlantRow, Recording, Trace};
use super::{PERIOD, slots};
use crate::output;

const PERIOD_NS: u64 = PERIOD.as_nanos() as u64;
/// Maximum number of delayed steps that are made up for at once; the simulation omits the rest.
const STEPS_MAX: u64 = 100;
/// Datagrams read in one step; the rest waits in the socket.
const READS_MAX: usize = 64;
/// Silence after which a drive counts as silent in the record, ns. Shorter is jitter.
const SILENT_AFTER_NS: u64 = 5_000_000;
/// Silence after which a restarted counter is accepted as a new sender, ns.
const NEW_SENDER_AFTER_NS: u64 = 10_000_000;

/// The reason why the plant does not run.
#[derive(Debug, Error)]
pub enum PlantError {
    /// Its address is not available.
    #[error(
        "the plant cannot have {address}: {cause}; is another plant running? choose another plant.address"
    )]
    Address {
        /// The address.
        address: SocketAddr,
        /// The error of the system.
        cause: io::Error,
    },
    /// The trial is not usable.
    #[error("the trial {path}: {reason}")]
    Trial {
        /// The path.
        path: String,
        /// Place and remedy.
        reason: TrialError,
    },
    /// Its trace cannot be started.
    #[error("no trace can be written: {0}")]
    Trace(io::Error),
    /// The system's timer fails.
    #[error("the system's clock does not wake the plant: {0}")]
    Clock(rustix::io::Errno),
}

/// The intention of the person: a recorded trial, or the built-in curves with variation from `seed`.
///
/// # Errors
/// The trial is not usable.
pub fn intention(trial: Option<&Path>, seed: u64) -> Result<Intention, PlantError> {
    let Some(path) = trial else { return Ok(Intention::from_curves(seed)) };
    let trial =
        Trial::read(path).map_err(|reason| PlantError::Trial { path: path.display().to_string(), reason })?;
    Ok(Intention::from_trial(Arc::new(trial)))
}

/// Runs the plant until `stop`.
///
/// # Errors
/// It could not start, or its clock failed.
pub fn run(place: &PlantPlace, folder: Option<&Path>, stop: &AtomicBool) -> Result<(), PlantError> {
    let address = place.address;
    let socket = UdpSocket::bind(address)
        .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
        .map_err(|cause| PlantError::Address { address, cause })?;
    let recording = Recording::begin(folder, "plant").map_err(PlantError::Trace)?;
    let watchdog_ns = place.device_watchdog.map(|limit| limit.as_nanos() as u64);
    let config = PlantConfig { watchdog_ns, ..PlantConfig::default() };
    let mut plant = Plant {
        core: PlantCore::new(config, intention(place.trial.as_deref(), place.seed)?, place.seed),
        devices: Devices::new(socket),
        trace: recording.trace(),
        walking: false,
        printed_stride: None,
        skipped: 0,
        seq: 0,
    };
    output::print("ready\n");
    let outcome = plant.run(stop);
    let (refused, skipped) = (plant.devices.refused, plant.skipped);
    let lost_rows = recording.finish();
    tracing::info!(refused, skipped, lost_rows, "the plant ends");
    outcome
}

struct Plant {
    core: PlantCore,
    devices: Devices,
    trace: Trace<PlantRow>,
    walking: bool,
    printed_stride: Option<u64>,
    skipped: u64,
    seq: u32,
}

impl Plant {
    fn run(&mut self, stop: &AtomicBool) -> Result<(), PlantError> {
        let mut due = slots::next(Time::now(), slots::PLANT);
        // SYNC: Relaxed, no other data depends on the flag.
        while !stop.load(Ordering::Relaxed) {
            sleep_until(due.as_nanos()).map_err(PlantError::Clock)?;
            let now = Time::now();
            self.devices.receive(now);
            self.start_when_released(now);
            let behind = now.since(due).as_nanos() as u64 / PERIOD_NS;
            let steps = 1 + behind.min(STEPS_MAX);
            self.skipped += 1 + behind - steps;
            for _ in 0..steps {
                self.step(due, now);
                due = due + PERIOD;
            }
            due = due + PERIOD * u32::try_from(1 + behind - steps).unwrap_or(u32::MAX);
        }
        Ok(())
    }

    fn step(&mut self, due: Time, now: Time) {
        let mut commands_nm = [None; 3];
        for (joint, order) in Joint::ALL.into_iter().zip(self.devices.take_orders()) {
            match order {
                Some(Order::Torque(torque_nm)) => commands_nm[joint.index()] = Some(torque_nm),
                Some(Order::Damp) => self.core.damp(joint),
                None => {}
            }
        }
        let readings = self.core.step(PERIOD_NS, &commands_nm);
        self.note(due, now);
        self.seq = self.seq.wrapping_add(1);
        self.devices.send_readings(self.seq, due, &readings);
        self.print_stride();
    }

    /// Starts walking when all three drives are released; the person waits for that without a time limit.
    fn start_when_released(&mut self, now: Time) {
        if !self.walking && self.devices.all_released(now) {
            self.walking = true;
            self.core.start_walking();
        }
    }

    fn note(&self, due: Time, now: Time) {
        let truth = self.core.truth();
        let commands = self
            .devices
            .commands
            .map(|command| command.filter(|command| !command.is_silent(now, SILENT_AFTER_NS)));
        self.trace.note(PlantRow {
            t_ns: due.as_nanos(),
            late_us: super::drive::micros(now.since(due)),
            strides: truth.intended.strides,
            walking: truth.intended.rate_hz > 0.0,
            angle_rad: truth.leg.angle_rad,
            velocity_rad_s: truth.leg.velocity_rad_s,
            intended_rad: truth.intended.angle_rad,
            applied_nm: truth.applied_nm,
            commanded_nm: commands.map(|command| command?.torque_nm()),
            state: commands.map(|command| command.map(|command| command.frame.state)),
            saturated: commands.map(|command| command.is_some_and(|command| command.frame.saturated)),
            watchdog: truth.watchdog_active,
        });
    }

    fn print_stride(&mut self) {
        if !self.walking {
            return;
        }
        let stride = self.core.truth().intended.strides as u64;
        if self.printed_stride != Some(stride) {
            self.printed_stride = Some(stride);
            // Once a stride, so that a write may take its microseconds.
            output::print(&format!("stride {stride}\n"));
        }
    }
}

/// The last command of a drive.
#[derive(Debug, Clone, Copy)]
struct LastCommand {
    frame: CommandFrame,
    order: Order,
    at: Time,
    /// Not yet passed to the device.
    is_new: bool,
}

impl LastCommand {
    /// The torque to apply, Nm; `None` when the device decides that itself.
    const fn torque_nm(&self) -> Option<f64> {
        match self.order {
            Order::Torque(torque_nm) => Some(torque_nm),
            Order::Damp => None,
        }
    }

    fn is_silent(&self, now: Time, after_ns: u64) -> bool {
        now.since(self.at).as_nanos() > u128::from(after_ns)
    }
}

/// The network side of the motor devices.
struct Devices {
    socket: UdpSocket,
    /// The receivers of the readings of each joint.
    listeners: PerJoint<Option<SocketAddr>>,
    commands: PerJoint<Option<LastCommand>>,
    refused: u64,
}

impl Devices {
    const fn new(socket: UdpSocket) -> Self {
        Self { socket, listeners: [None; 3], commands: [None; 3], refused: 0 }
    }

    fn receive(&mut self, now: Time) {
        let mut buffer = [0; COMMAND_BYTES + 1];
        for _ in 0..READS_MAX {
            match self.socket.recv_from(&mut buffer) {
                Ok((length, source)) => match CommandFrame::decode(&buffer[..length]) {
                    Ok(frame) => self.accept(frame, source, now),
                    Err(_) => self.refused += 1,
                },
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // A listener's port was closed: its process has ended.
                Err(_) => {}
            }
        }
    }

    fn accept(&mut self, frame: CommandFrame, source: SocketAddr, now: Time) {
        let joint = frame.joint.index();
        let Some(order) = frame.order else {
            self.listeners[joint] = Some(source);
            return;
        };
        let follows = self.commands[joint].is_none_or(|last| {
            let ahead = frame.seq.wrapping_sub(last.frame.seq).cast_signed();
            ahead > 0 || last.is_silent(now, NEW_SENDER_AFTER_NS)
        });
        if follows {
            self.commands[joint] = Some(LastCommand { frame, order, at: now, is_new: true });
        } else {
            self.refused += 1;
        }
    }

    /// The orders for the devices in this step; `None` for a drive that sent none since the last.
    fn take_orders(&mut self) -> PerJoint<Option<Order>> {
        self.commands.each_mut().map(|command| {
            let command = command.as_mut().filter(|command| command.is_new)?;
            command.is_new = false;
            Some(command.order)
        })
    }

    fn all_released(&self, now: Time) -> bool {
        let released =
            |command: &LastCommand| command.frame.released && !command.is_silent(now, SILENT_AFTER_NS);
        self.commands.iter().all(|command| command.as_ref().is_some_and(released))
    }

    fn send_readings(&self, seq: u32, at: Time, readings: &PlantReadings) {
        for joint in Joint::ALL {
            let Some(listener) = self.listeners[joint.index()] else { continue };
            let reading = Reading {
                joint,
                seq,
                t_ns: at.as_nanos(),
                device: readings.joints[joint.index()],
                foot: (joint == Joint::Ankle).then_some(readings.foot),
            };
            // A listener that is gone is not detected here: a device does not care.
            let _ = self.socket.send_to(&reading.encode(), listener);
        }
    }
}
