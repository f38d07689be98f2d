//! What a process leaves behind: rows in a CSV file, written by a thread of low priority a tenth of a second later.
//!
//! A loop hands its row over without waiting and without memory of its own growing; what a killed process did until a
//! tenth of a second before its end is on disk.

use std::fs::File;
use std::io::{self, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::joint::PerJoint;
use crate::message::{DriveState, GaitMode};

/// Rows that may wait for the disk: four seconds of a 1 kHz loop. What comes when it is full is lost and counted.
const ROWS_MAX: usize = 4096;
const WRITE_PERIOD: Duration = Duration::from_millis(100);
/// Lives of one part in one run at most.
const LIVES_MAX: u32 = 100;
/// Below everything that controls.
const WRITER_NICENESS: i32 = 10;

/// A row of a trace.
pub trait TraceRow: Serialize + DeserializeOwned + Send + 'static {
    /// The first line of the file.
    const HEADER: &'static str;
}

/// What the plant did in one step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct PlantRow {
    /// When the step was due, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// How late it was, us.
    pub late_us: u32,
    /// Strides walked: the whole part counts, the rest is the true phase.
    pub strides: f64,
    /// Whether the person walks.
    pub walking: bool,
    /// True angles, rad.
    pub angle_rad: PerJoint<f64>,
    /// True velocities, rad/s.
    pub velocity_rad_s: PerJoint<f64>,
    /// Angles that the person means to have, rad.
    pub intended_rad: PerJoint<f64>,
    /// Torques given, Nm.
    pub applied_nm: PerJoint<f64>,
    /// Torques commanded; none from a drive that is silent for 5 ms.
    pub commanded_nm: PerJoint<Option<f64>>,
    /// States of the drives; none from one that is silent for 5 ms.
    pub state: PerJoint<Option<DriveState>>,
    /// Which drives' torque laws met their limits.
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

/// What a drive did in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct DriveRow {
    /// When, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// How long after it was due, us.
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
    /// Torques from outside that were taken so far.
    pub commands_taken: u32,
    /// Torques from outside refused so far: no numbers.
    pub refused_not_finite: u32,
    /// Above every limit.
    pub refused_out_of_range: u32,
    /// Of an old sequence number, or over the age limit.
    pub refused_old: u32,
    /// The opposite of what must be done.
    pub refused_opposed: u32,
}

impl TraceRow for DriveRow {
    const HEADER: &'static str = "t_ns,late_us,period_us,sample_age_us,gait_age_us,state,torque_nm,assist_gain,faults,\
        commands_taken,refused_not_finite,refused_out_of_range,refused_old,refused_opposed";
}

/// What central did in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct GaitRow {
    /// When, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// How long after it was due, us.
    pub late_us: u32,
    /// Estimated phase, cycles 0..1.
    pub phase: f32,
    /// Trust in the phase, 0..1.
    pub confidence: f32,
    /// What the drives were asked to do; none while central said nothing.
    pub mode: Option<GaitMode>,
    /// Joints whose drives do not help; bit 0 hip, bit 1 knee, bit 2 ankle.
    pub degraded: u8,
}

impl TraceRow for GaitRow {
    const HEADER: &'static str = "t_ns,late_us,phase,confidence,mode,degraded";
}

/// Something that happened once.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, serde::Deserialize)]
pub struct EventRow {
    /// When it was noticed, ns of the host's monotonic clock.
    pub t_ns: u64,
    /// What: `node_lost`, `input_silent`...
    pub what: String,
    /// Whom it is about.
    pub whom: String,
    /// How it is known.
    pub how: String,
}

impl TraceRow for EventRow {
    const HEADER: &'static str = "t_ns,what,whom,how";
}

/// Where a loop puts its rows. Never waits.
#[derive(Debug)]
pub struct Trace<R> {
    /// None: nobody wants the rows.
    rows: Option<SyncSender<R>>,
    lost: Arc<AtomicU64>,
}

// Derived, it would want rows that can be cloned.
impl<R> Clone for Trace<R> {
    fn clone(&self) -> Self {
        Self { rows: self.rows.clone(), lost: self.lost.clone() }
    }
}

impl<R> Trace<R> {
    /// Hands a row over; it is lost and counted when the disk is too slow.
    pub fn note(&self, row: R) {
        if let Some(rows) = &self.rows
            && rows.try_send(row).is_err()
        {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// A trace being written. [`Recording::finish`] writes what is left.
#[derive(Debug)]
pub struct Recording<R> {
    trace: Trace<R>,
    writer: Option<Writer>,
    row: PhantomData<fn(R)>,
}

#[derive(Debug)]
struct Writer {
    finish: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl<R: TraceRow> Recording<R> {
    /// Begins `NAME-N.csv` in `folder`, N being the first number that is free: the N-th life of that part in this run.
    /// Without a folder rows are thrown away.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn begin(folder: Option<&Path>, name: &str) -> io::Result<Self> {
        let lost = Arc::new(AtomicU64::new(0));
        let Some(folder) = folder else {
            return Ok(Self { trace: Trace { rows: None, lost }, writer: None, row: PhantomData });
        };
        let mut file = create(folder, name)?;
        writeln!(file, "{}", R::HEADER)?;
        let (rows, written) = sync_channel(ROWS_MAX);
        let finish = Arc::new(AtomicBool::new(false));
        let finished = finish.clone();
        let thread = std::thread::Builder::new()
            .name("trace".to_owned())
            .spawn(move || write_rows(file, &written, &finished))?;
        let writer = Some(Writer { finish, thread });
        Ok(Self { trace: Trace { rows: Some(rows), lost }, writer, row: PhantomData })
    }

    /// Where the rows go in.
    #[must_use]
    pub fn trace(&self) -> Trace<R> {
        self.trace.clone()
    }

    /// Writes what is left, and says how many rows were lost. Rows that come later are not written.
    pub fn finish(self) -> u64 {
        if let Some(writer) = self.writer {
            // SYNC: Release, so that the writer sees every row that was handed over before; it pairs with its Acquire.
            writer.finish.store(true, Ordering::Release);
            writer.thread.thread().unpark();
            if writer.thread.join().is_err() {
                tracing::error!("the trace's writer panicked; the end of the trace is missing");
            }
        }
        self.trace.lost.load(Ordering::Relaxed)
    }
}

fn create(folder: &Path, name: &str) -> io::Result<File> {
    for life in 1..=LIVES_MAX {
        match File::create_new(path(folder, name, life)) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(io::Error::new(error.kind(), format!("{}: {error}", folder.display()))),
            Ok(file) => return Ok(file),
        }
    }
    let words = format!("{name} has had {LIVES_MAX} lives in {}; use a new folder", folder.display());
    Err(io::Error::new(io::ErrorKind::AlreadyExists, words))
}

fn path(folder: &Path, name: &str, life: u32) -> PathBuf {
    folder.join(format!("{name}-{life}.csv"))
}

fn write_rows<R: Serialize>(file: File, rows: &Receiver<R>, finish: &AtomicBool) {
    // A higher priority than wished for is no reason to write nothing.
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

/// All lives of a part in one run, in order. A last row that was cut off by the writer's death is left out.
///
/// # Errors
/// A file is there and cannot be opened.
pub fn read_lives<R: TraceRow>(folder: &Path, name: &str) -> io::Result<Vec<Vec<R>>> {
    let mut lives = Vec::new();
    for life in 1..=LIVES_MAX {
        let file = match File::open(path(folder, name, life)) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => break,
            Err(error) => return Err(error),
        };
        let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(file);
        // The header is a record of words, which is no row.
        lives.push(reader.deserialize().skip(1).map_while(Result::ok).collect());
    }
    Ok(lives)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("exoskeleton-trace-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        folder
    }

    #[test]
    fn rows_read_back_life_by_life() {
        let folder = folder("lives");
        let row = PlantRow {
            t_ns: 5,
            late_us: 3,
            strides: 1.5,
            walking: true,
            angle_rad: [0.1, 0.2, 0.3],
            velocity_rad_s: [1.0, 2.0, 3.0],
            intended_rad: [0.4, 0.5, 0.6],
            applied_nm: [0.0, -1.0, 2.5],
            commanded_nm: [None, Some(7.0), None],
            state: [Some(DriveState::Walk), None, Some(DriveState::Safe)],
            saturated: [false, true, false],
            watchdog: [true, false, false],
        };
        for strides in [1.5, 2.5] {
            let recording = Recording::begin(Some(&folder), "plant").unwrap();
            let trace = recording.trace();
            trace.note(PlantRow { strides, ..row });
            trace.note(PlantRow { strides, t_ns: 6, ..row });
            assert_eq!(recording.finish(), 0);
        }
        let lives: Vec<Vec<PlantRow>> = read_lives(&folder, "plant").unwrap();
        assert_eq!(lives.len(), 2);
        assert_eq!(lives[0][0], row);
        assert_eq!(lives[1].len(), 2);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn row_that_was_cut_off_is_left_out() {
        let folder = folder("cut");
        let text = format!("{}\n1,2,0.5,1.0,2,0\n2,3,0.", GaitRow::HEADER);
        std::fs::write(folder.join("central-1.csv"), text).unwrap();
        let lives: Vec<Vec<GaitRow>> = read_lives(&folder, "central").unwrap();
        assert_eq!(lives[0].len(), 1);
        assert_eq!(lives[0][0].mode, Some(GaitMode::Walk));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
