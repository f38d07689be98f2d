//! The record of a process: rows in a CSV file, written by a thread of low priority a tenth of a second
//! later.
//!
//! A loop passes its row on without waiting and without allocating memory of its own. The rows of a killed
//! process up to a tenth of a second before its end are on disk.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use exoskeleton_model::joint::PerJoint;
use exoskeleton_model::message::{DriveState, GaitMode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sinew::Time;

/// Capacity for unwritten rows: four seconds of a 1 kHz loop. Rows that find it full are lost and counted.
const ROWS_MAX: usize = 4096;
const WRITE_PERIOD: Duration = Duration::from_millis(100);
/// Maximum number of incarnations of one part in one run.
const INCARNATIONS_MAX: u32 = 100;
/// Below all control loops.
const WRITER_NICENESS: i32 = 10;

/// A row of a trace.
pub trait TraceRow: Clone + Serialize + DeserializeOwned + Send + 'static {
    /// The first line of the file.
    const HEADER: &'static str;
}

/// The plant's data of one step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct PlantRow {
    /// Due time of the step, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// Its lateness, us.
    pub late_us: u32,
    /// Strides walked: the whole part counts, the rest is the true phase.
    pub strides: f64,
    /// Whether the person walks.
    pub walking: bool,
    /// True angles, rad.
    pub angle_rad: PerJoint<f64>,
    /// True velocities, rad/s.
    pub velocity_rad_s: PerJoint<f64>,
    /// Angles that the person intends, rad.
    pub intended_rad: PerJoint<f64>,
    /// Torques applied, Nm.
    pub applied_nm: PerJoint<f64>,
    /// Torques commanded; none from a drive that is silent for 5 ms.
    pub commanded_nm: PerJoint<Option<f64>>,
    /// States of the drives; none from one that is silent for 5 ms.
    pub state: PerJoint<Option<DriveState>>,
    /// Which drives' torque laws reached their limits.
    pub saturated: PerJoint<bool>,
    /// Which devices damp by themselves.
    pub watchdog: PerJoint<bool>,
}

impl TraceRow for PlantRow {
    const HEADER: &'static str = "t_ns,late_us,strides,walking,\
        hip_rad,knee_rad,ankle_rad,hip_rad_s,knee_rad_s,ankle_rad_s,\
        hip_intended_rad,knee_intended_rad,ankle_intended_rad,hip_applied_nm,knee_applied_nm,ankle_applied_nm,\
        hip_commanded_nm,knee_commanded_nm,ankle_commanded_nm,hip_state,knee_state,ankle_state,\
        hip_saturated,knee_saturated,ankle_saturated,hip_watchdog,knee_watchdog,ankle_watchdog";
}

/// A drive's data of one tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct DriveRow {
    /// Time, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// Lateness, us.
    pub late_us: u32,
    /// Time since the last tick, us; 0 at the first.
    pub period_us: u32,
    /// Age of the joint sample used, us.
    pub sample_age_us: Option<u32>,
    /// Age of the gait state used, us.
    pub gait_age_us: Option<u32>,
    /// State after the tick.
    pub state: DriveState,
    /// Torque commanded, Nm.
    pub torque_nm: Option<f64>,
    /// Gain of assistance, 0..1.
    pub assist_gain: f64,
    /// Bits of `FaultBits`.
    pub faults: u16,
    /// Torques from outside that were accepted so far.
    pub commands_taken: u32,
    /// Torques from outside rejected so far: NaN or infinite.
    pub refused_not_finite: u32,
    /// Above every limit.
    pub refused_out_of_range: u32,
    /// Of an old sequence number, or over the age limit.
    pub refused_old: u32,
    /// Opposite to the required direction.
    pub refused_opposed: u32,
}

impl TraceRow for DriveRow {
    const HEADER: &'static str = "t_ns,late_us,period_us,sample_age_us,gait_age_us,state,torque_nm,assist_gain,faults,\
        commands_taken,refused_not_finite,refused_out_of_range,refused_old,refused_opposed";
}

/// Central's data of one tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct GaitRow {
    /// Time, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// Lateness, us.
    pub late_us: u32,
    /// Estimated phase, cycles 0..1.
    pub phase: f32,
    /// Trust in the phase, 0..1.
    pub confidence: f32,
    /// The command for the drives; none while central sent none.
    pub mode: Option<GaitMode>,
    /// Joints with drives that do not assist; bit 0 hip, bit 1 knee, bit 2 ankle.
    pub degraded: u8,
}

impl TraceRow for GaitRow {
    const HEADER: &'static str = "t_ns,late_us,phase,confidence,mode,degraded";
}

/// A single event.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, serde::Deserialize)]
pub struct EventRow {
    /// Time of its detection, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// Its name: `node_lost`, `input_silent`...
    pub what: String,
    /// The part that it is about.
    pub whom: String,
    /// The source of the detection.
    pub how: String,
}

impl TraceRow for EventRow {
    const HEADER: &'static str = "t_ns,what,whom,how";
}

/// The input for a loop's rows. Never waits.
#[derive(Clone, Debug)]
pub struct Trace<R> {
    /// `None`: the rows are not recorded.
    rows: Option<SyncSender<R>>,
    lost: Arc<AtomicU64>,
}

impl<R> Trace<R> {
    /// Passes a row on; it is lost and counted when the disk is too slow.
    pub fn note(&self, row: R) {
        if let Some(rows) = &self.rows
            && rows.try_send(row).is_err()
        {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Trace<EventRow> {
    /// Passes on an event of this moment.
    pub fn event(&self, what: &str, whom: &str, how: String) {
        let (what, whom) = (what.to_owned(), whom.to_owned());
        self.note(EventRow { t_ns: Time::now().as_nanos(), what, whom, how });
    }
}

/// A trace being written. [`Recording::finish`] writes the remaining rows.
#[derive(Debug)]
pub struct Recording<R> {
    trace: Trace<R>,
    /// The thread that writes, and its order to end.
    writer: Option<(JoinHandle<()>, Arc<AtomicBool>)>,
}

impl<R: TraceRow> Recording<R> {
    /// Starts `NAME-N.csv` in `folder`, N being the first free number: the N-th incarnation of that part in
    /// this run. Without a folder rows are discarded.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn begin(folder: Option<&Path>, name: &str) -> io::Result<Self> {
        let lost = Arc::new(AtomicU64::new(0));
        let Some(folder) = folder else {
            return Ok(Self { trace: Trace { rows: None, lost }, writer: None });
        };
        let mut file = create(folder, name)?;
        writeln!(file, "{}", R::HEADER)?;
        let (rows, written) = sync_channel(ROWS_MAX);
        let finish = Arc::new(AtomicBool::new(false));
        let finished = finish.clone();
        let thread = std::thread::Builder::new()
            .name("trace".to_owned())
            .spawn(move || write_rows(file, &written, &finished))?;
        Ok(Self { trace: Trace { rows: Some(rows), lost }, writer: Some((thread, finish)) })
    }

    /// Returns the input for the rows.
    #[must_use]
    pub fn trace(&self) -> Trace<R> {
        self.trace.clone()
    }

    /// Writes the remaining rows, and returns the number of lost ones. Later rows are not written.
    pub fn finish(self) -> u64 {
        if let Some((thread, finish)) = self.writer {
            // SYNC: Release, so that the writer sees every row that was passed on before; it pairs with its
            // Acquire.
            finish.store(true, Ordering::Release);
            thread.thread().unpark();
            if thread.join().is_err() {
                tracing::error!("the trace's writer panicked; the end of the trace is missing");
            }
        }
        self.trace.lost.load(Ordering::Relaxed)
    }
}

fn create(folder: &Path, name: &str) -> io::Result<File> {
    for incarnation in 1..=INCARNATIONS_MAX {
        match File::create_new(path(folder, name, incarnation)) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(io::Error::new(error.kind(), format!("{}: {error}", folder.display()))),
            Ok(file) => return Ok(file),
        }
    }
    let text =
        format!("{name} has had {INCARNATIONS_MAX} incarnations in {}; use a new folder", folder.display());
    Err(io::Error::new(io::ErrorKind::AlreadyExists, text))
}

fn path(folder: &Path, name: &str, incarnation: u32) -> PathBuf {
    folder.join(format!("{name}-{incarnation}.csv"))
}

fn write_rows<R: Serialize>(file: File, rows: &Receiver<R>, finish: &AtomicBool) {
    // A higher priority than requested is no reason to write nothing.
    let _ = rustix::process::setpriority_process(None, WRITER_NICENESS);
    let mut out = csv::WriterBuilder::new().has_headers(false).buffer_capacity(1 << 16).from_writer(file);
    loop {
        // SYNC: Acquire, pairs with the Release in `finish`: rows from before it are in the queue below.
        let is_last = finish.load(Ordering::Acquire);
        let written: Result<(), csv::Error> = rows.try_iter().try_for_each(|row| out.serialize(row));
        if let Err(error) = written.and_then(|()| out.flush().map_err(csv::Error::from)) {
            tracing::error!(%error, "a trace cannot be written any further; is the disk full?");
            return;
        }
        if is_last {
            return;
        }
        std::thread::park_timeout(WRITE_PERIOD);
    }
}

/// Reads all incarnations of a part in one run, in order. Omits a last row that was cut off by the writer's
/// death.
///
/// # Errors
/// A file exists and cannot be opened.
pub fn read_incarnations<R: TraceRow>(folder: &Path, name: &str) -> io::Result<Vec<Vec<R>>> {
    let mut incarnations = Vec::new();
    for incarnation in 1..=INCARNATIONS_MAX {
        let file = match File::open(path(folder, name, incarnation)) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => break,
            Err(error) => return Err(error),
        };
        let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(file);
        // The header is a record of texts, which is no row.
        incarnations.push(reader.deserialize().skip(1).map_while(Result::ok).collect());
    }
    Ok(incarnations)
}

#[cfg(test)]
#[path = "trace_tests.rs"]
mod tests;
