//! The plant process: person, leg and three motor devices behind UDP, stepped at exactly 1 kHz.
//!
//! It is no part of the product and knows nothing of Sinew: drives and sensors meet it as they would meet hardware. A
//! device holds the last torque of a drive that falls silent. The person begins to walk when all three drives say that
//! walking is released. A line on standard output tells each stride.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::thread::{ClockId, clock_nanosleep_absolute};
use sinew::Time;
use thiserror::Error;

use super::PERIOD;
use super::datagram::{Order, Reading, WORD_BYTES, Word};
use super::topology::PlantPlace;
use super::trace::{PlantRow, Recording, Trace};
use crate::gait::trial::{Trial, TrialError};
use crate::intention::Intention;
use crate::joint::{Joint, PerJoint};
use crate::output;
use crate::plant::{PlantConfig, PlantCore, PlantReadings};

const PERIOD_NS: u64 = PERIOD.as_nanos() as u64;
/// Steps that are made up for at once after the process was held up; the world waits for the rest.
const STEPS_MAX: u64 = 100;
/// Datagrams taken in one step; the rest waits in the socket.
const READS_MAX: usize = 64;
/// Silence after which a drive counts as silent in the record, ns. Shorter is jitter.
const SILENT_AFTER_NS: u64 = 5_000_000;
/// Silence after which a sender that counts from the beginning is a new one, ns.
const NEW_SENDER_AFTER_NS: u64 = 10_000_000;

/// Why the plant does not run.
#[derive(Debug, Error)]
pub enum PlantError {
    /// Its address cannot be had.
    #[error(
        "the plant cannot have {address}: {cause}; is another plant running? choose another plant.address"
    )]
    Address {
        /// The address.
        address: SocketAddr,
        /// What the system said.
        cause: io::Error,
    },
    /// The trial is not usable.
    #[error("plant.trial {path}: {reason}")]
    Trial {
        /// The path.
        path: String,
        /// Place and remedy.
        reason: TrialError,
    },
    /// Its trace cannot be begun.
    #[error("no trace can be written: {0}")]
    Trace(io::Error),
    /// The system's timer fails.
    #[error("the system's clock does not wake the plant: {0}")]
    Clock(rustix::io::Errno),
}

/// What the person of `place` means to do.
///
/// # Errors
/// The trial is not usable.
pub fn intention(place: &PlantPlace) -> Result<Intention, PlantError> {
    let Some(path) = &place.trial else { return Ok(Intention::from_curves(place.seed)) };
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
        core: PlantCore::new(config, intention(place)?, place.seed),
        devices: Devices::new(socket),
        trace: recording.trace(),
        walking: false,
        stride_told: None,
        skipped: 0,
        seq: 0,
    };
    tell("ready");
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
    stride_told: Option<u64>,
    skipped: u64,
    seq: u32,
}

impl Plant {
    fn run(&mut self, stop: &AtomicBool) -> Result<(), PlantError> {
        let mut due = Time::now() + PERIOD;
        // SYNC: Relaxed, the flag carries nothing but itself.
        while !stop.load(Ordering::Relaxed) {
            sleep_until(due)?;
            let now = Time::now();
            self.devices.listen(now);
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
        self.devices.tell(self.seq, due, &readings);
        self.tell_stride();
    }

    /// The person is a patient one: they wait for all three drives.
    fn start_when_released(&mut self, now: Time) {
        if !self.walking && self.devices.all_released(now) {
            self.walking = true;
            self.core.start_walking();
        }
    }

    fn note(&self, due: Time, now: Time) {
        let truth = self.core.truth();
        let heard =
            self.devices.words.map(|heard| heard.filter(|heard| !heard.is_silent(now, SILENT_AFTER_NS)));
        self.trace.note(PlantRow {
            t_ns: due.as_nanos(),
            late_us: super::drive::micros(now.since(due)),
            strides: truth.intended.strides,
            walking: truth.intended.rate_hz > 0.0,
            angle_rad: truth.leg.angle_rad,
            velocity_rad_s: truth.leg.velocity_rad_s,
            intended_rad: truth.intended.angle_rad,
            applied_nm: truth.applied_nm,
            commanded_nm: heard.map(|heard| heard?.torque_nm()),
            state: heard.map(|heard| heard.map(|heard| heard.word.state)),
            saturated: heard.map(|heard| heard.is_some_and(|heard| heard.word.saturated)),
            watchdog: truth.watchdog_active,
        });
    }

    fn tell_stride(&mut self) {
        if !self.walking {
            return;
        }
        let stride = self.core.truth().intended.strides as u64;
        if self.stride_told != Some(stride) {
            self.stride_told = Some(stride);
            tell(&format!("stride {stride}"));
        }
    }
}

/// Prints a line for the program that started the plant. Once a stride, so that it may take the microseconds of a write.
fn tell(line: &str) {
    output::print(&format!("{line}\n"));
}

/// Sleeps until a moment of the host's clock.
pub(super) fn sleep_until(due: Time) -> Result<(), PlantError> {
    let nanos = due.as_nanos();
    let request = rustix::thread::Timespec {
        tv_sec: (nanos / 1_000_000_000).cast_signed(),
        tv_nsec: (nanos % 1_000_000_000).cast_signed(),
    };
    loop {
        match clock_nanosleep_absolute(ClockId::Monotonic, &request) {
            Ok(()) => return Ok(()),
            // A signal came in between; the time has not.
            Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(PlantError::Clock(error)),
        }
    }
}

/// The last command of a drive.
#[derive(Debug, Clone, Copy)]
struct Heard {
    word: Word,
    order: Order,
    at: Time,
    /// Not yet given to the device.
    is_new: bool,
}

impl Heard {
    /// What it is to give, Nm; `None` when that is the device's own matter.
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

/// The motor devices' side of the wire.
struct Devices {
    socket: UdpSocket,
    /// Who wants the readings of each joint.
    listeners: PerJoint<Option<SocketAddr>>,
    words: PerJoint<Option<Heard>>,
    refused: u64,
}

impl Devices {
    const fn new(socket: UdpSocket) -> Self {
        Self { socket, listeners: [None; 3], words: [None; 3], refused: 0 }
    }

    fn listen(&mut self, now: Time) {
        let mut buffer = [0; WORD_BYTES + 1];
        for _ in 0..READS_MAX {
            match self.socket.recv_from(&mut buffer) {
                Ok((length, source)) => match Word::decode(&buffer[..length]) {
                    Ok(word) => self.take(word, source, now),
                    Err(_) => self.refused += 1,
                },
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // A listener's port was closed: its process has ended.
                Err(_) => {}
            }
        }
    }

    fn take(&mut self, word: Word, source: SocketAddr, now: Time) {
        let joint = word.joint.index();
        let Some(order) = word.order else {
            self.listeners[joint] = Some(source);
            return;
        };
        let follows = self.words[joint].is_none_or(|last| {
            let ahead = word.seq.wrapping_sub(last.word.seq).cast_signed();
            ahead > 0 || last.is_silent(now, NEW_SENDER_AFTER_NS)
        });
        if follows {
            self.words[joint] = Some(Heard { word, order, at: now, is_new: true });
        } else {
            self.refused += 1;
        }
    }

    /// What the devices are told in this step; `None` for a drive that said nothing since the last.
    fn take_orders(&mut self) -> PerJoint<Option<Order>> {
        self.words.each_mut().map(|heard| {
            let heard = heard.as_mut().filter(|heard| heard.is_new)?;
            heard.is_new = false;
            Some(heard.order)
        })
    }

    fn all_released(&self, now: Time) -> bool {
        let released = |heard: &Heard| heard.word.released && !heard.is_silent(now, SILENT_AFTER_NS);
        self.words.iter().all(|heard| heard.as_ref().is_some_and(released))
    }

    fn tell(&self, seq: u32, at: Time, readings: &PlantReadings) {
        for joint in Joint::ALL {
            let Some(listener) = self.listeners[joint.index()] else { continue };
            let reading = Reading {
                joint,
                seq,
                t_ns: at.as_nanos(),
                device: readings.joints[joint.index()],
                foot: (joint == Joint::Ankle).then_some(readings.foot),
            };
            // A listener that is gone is noticed by nobody here: a device does not care.
            let _ = self.socket.send_to(&reading.encode(), listener);
        }
    }
}
