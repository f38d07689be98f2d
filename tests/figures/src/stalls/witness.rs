//! An independent witness of the host: threads that only sleep, one pinned to each CPU.
//!
//! A thread that only waits to be woken, and is woken late, shows that its CPU ran something else meanwhile,
//! or did not run at all. It has the scheduling class of the measured loops, so that the same delays affect
//! both. CPU times tell afterwards whether the measured program itself was the cause: see `blame`.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::io::Errno;
use rustix::thread::{CpuSet, clock_nanosleep_absolute, sched_getaffinity, sched_setaffinity};
use rustix::time::{ClockId, Timespec, clock_gettime};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

/// A wake that is later than this is a missed deadline.
pub const LATE_MAX: Duration = Duration::from_millis(2);
/// Time between two wakes, ns. Every stall of a CPU is detected, at a cost of less than 1 % of the CPU.
const PERIOD_NS: u64 = 2_000_000;
/// Minimum lateness of a witness that is a stall, ns: half of the age at which a drive of the example robot
/// rejects its inputs, as two processes contribute to an age.
const STALL_MIN_NS: u64 = 5_000_000;
/// Maximum number of witnesses; on a larger machine they run on every second CPU, or every third.
const WITNESSES_MAX: usize = 16;
/// Maximum number of stalls that one witness keeps: those of an hour in which each hundredth wake is late.
const STALLS_MAX: usize = 20_000;

/// A time in which a CPU did not run its witness, ns of the host's monotonic clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CpuStall {
    /// Time at which the witness was to be woken.
    pub from_ns: u64,
    /// Time at which it was woken.
    pub to_ns: u64,
}

/// The observations of one witness.
#[derive(Debug, Clone, Default)]
pub struct Testimony {
    /// Number of wakes.
    pub wakes: u64,
    /// Wakes later than [`LATE_MAX`].
    pub misses: u64,
    /// In rising order of time.
    pub stalls: Vec<CpuStall>,
}

/// The threads. They end when this is dropped.
#[derive(Debug)]
pub struct Witness {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Testimony>>,
}

impl Witness {
    /// Starts a thread for each CPU that this process may use, at the `SCHED_FIFO` priority of the measured
    /// loops if they have one.
    ///
    /// # Errors
    /// The system provides no thread.
    pub fn start(realtime_priority: Option<u8>) -> io::Result<Self> {
        let allowed = sched_getaffinity(None)?;
        let cpus: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu)).collect();
        let mut witness = Self { stop: Arc::new(AtomicBool::new(false)), threads: Vec::new() };
        for cpu in cpus.iter().copied().step_by(cpus.len().div_ceil(WITNESSES_MAX).max(1)) {
            let stop = witness.stop.clone();
            let thread = std::thread::Builder::new().name(format!("witness-{cpu}"));
            witness.threads.push(thread.spawn(move || {
                // Not permitted: then the witness observes the whole machine, which is still useful.
                let mut only = CpuSet::new();
                only.set(cpu);
                let _ = sched_setaffinity(None, &only);
                realtime_priority.into_iter().for_each(set_priority);
                watch(&stop)
            })?);
        }
        Ok(witness)
    }

    /// Ends the threads. Returns the observations of each.
    pub fn end(&mut self) -> Vec<Testimony> {
        // SYNC: Relaxed, no other data depends on the flag.
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).filter_map(|thread| thread.join().ok()).collect()
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        self.end();
    }
}

/// If it is not granted, the measured loops do not get it either.
fn set_priority(priority: u8) {
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    if let Ok(value) = priority.try_into() {
        let priority = ThreadPriority::Crossplatform(value);
        let _ = set_thread_priority_and_policy(thread_native_id(), priority, policy);
    }
}

fn watch(stop: &AtomicBool) -> Testimony {
    let mut testimony = Testimony::default();
    let mut due_ns = now_ns() + PERIOD_NS;
    // SYNC: Relaxed, no other data depends on the flag.
    while !stop.load(Ordering::Relaxed) {
        if sleep_until(due_ns).is_err() {
            break;
        }
        let woken_ns = now_ns();
        testimony.note(due_ns, woken_ns);
        due_ns = (due_ns + PERIOD_NS).max(woken_ns);
    }
    testimony
}

fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec.cast_unsigned() * 1_000_000_000 + now.tv_nsec.cast_unsigned()
}

/// Sleeps until a moment of the host's monotonic clock, ns.
///
/// # Errors
/// The system's timer fails.
pub fn sleep_until(due_ns: u64) -> Result<(), Errno> {
    let request = Timespec {
        tv_sec: (due_ns / 1_000_000_000).cast_signed(),
        tv_nsec: (due_ns % 1_000_000_000).cast_signed(),
    };
    loop {
        match clock_nanosleep_absolute(ClockId::Monotonic, &request) {
            // A signal arrived in between; the moment has not.
            Err(Errno::INTR) => {}
            ended => return ended,
        }
    }
}

impl Testimony {
    fn note(&mut self, due_ns: u64, woken_ns: u64) {
        let late_ns = woken_ns.saturating_sub(due_ns);
        self.wakes += 1;
        self.misses += u64::from(u128::from(late_ns) > LATE_MAX.as_nanos());
        if late_ns >= STALL_MIN_NS && self.stalls.len() < STALLS_MAX {
            self.stalls.push(CpuStall { from_ns: due_ns, to_ns: woken_ns });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_wakes_are_stalls_or_misses() {
        let mut testimony = Testimony::default();
        let due_ns = 1_000_000_000;
        for late_us in [0, 2_000, 2_001, 4_999, 5_000] {
            testimony.note(due_ns, due_ns + 1_000 * late_us);
        }
        assert_eq!((testimony.wakes, testimony.misses), (5, 3));
        assert_eq!(testimony.stalls, [CpuStall { from_ns: 1_000_000_000, to_ns: 1_005_000_000 }]);
    }

    #[test]
    fn witness_runs_on_an_allowed_cpu() {
        let mut witness = Witness::start(None).unwrap();
        while !witness.threads.iter().any(|thread| thread.is_finished()) {
            std::thread::yield_now();
            witness.stop.store(true, Ordering::Relaxed);
        }
        assert!(!witness.end().is_empty());
    }
}
