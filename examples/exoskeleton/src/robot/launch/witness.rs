//! An independent witness of the host: threads of the launcher that only sleep, one pinned to each CPU.
//!
//! A thread that asks for nothing but to be woken, and is woken late, shows that its CPU ran something else meanwhile, or did not run
//! at all. It has the scheduling class of the robot's loops, so that what delays them delays it too. Whether the robot itself was the
//! cause is decided afterwards, from CPU times: see `blame`.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use sinew::Time;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

use crate::robot::figures::LATE_MAX_US;
use crate::robot::plant::sleep_until;

/// Time between two wakes. A CPU that is away for longer than a stall is noticed surely, at a cost of less than 1 % of it.
const PERIOD: Duration = Duration::from_millis(2);
/// Lateness of a witness that is a stall: half of the age at which a drive refuses its inputs, as two processes stand behind an age.
const STALL_MIN: Duration = Duration::from_millis(5);
/// Witnesses at most; on a larger machine they stand on every second CPU, or every third.
const WITNESSES_MAX: usize = 16;
/// Stalls that one witness keeps: those of an hour in which each hundredth wake is late.
const STALLS_MAX: usize = 20_000;

/// A time in which a CPU did not run its witness, ns of the host's monotonic clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CpuStall {
    pub(super) from_ns: u64,
    pub(super) to_ns: u64,
}

/// What one witness has seen.
#[derive(Debug, Clone, Default)]
pub(super) struct Testimony {
    /// Times at which it was woken.
    pub(super) wakes: u64,
    /// Of these, later than the deadline of a tick of the robot (2 ms).
    pub(super) misses: u64,
    /// Rising in time.
    pub(super) stalls: Vec<CpuStall>,
}

/// The threads. They end with it.
#[derive(Debug)]
pub(super) struct Witness {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Testimony>>,
}

impl Witness {
    /// Starts a thread for each CPU that this process may use, at the `SCHED_FIFO` priority of the robot's loops if they have one.
    pub(super) fn start(realtime_priority: Option<u8>) -> io::Result<Self> {
        let allowed = sched_getaffinity(None)?;
        let cpus: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu)).collect();
        let mut witness = Self { stop: Arc::new(AtomicBool::new(false)), threads: Vec::new() };
        for cpu in cpus.iter().copied().step_by(cpus.len().div_ceil(WITNESSES_MAX).max(1)) {
            let stop = witness.stop.clone();
            let thread = std::thread::Builder::new().name(format!("witness-{cpu}"));
            witness.threads.push(thread.spawn(move || {
                // Not granted: then the witness is one of the whole machine, and still one.
                let mut only = CpuSet::new();
                only.set(cpu);
                let _ = sched_setaffinity(None, &only);
                realtime_priority.into_iter().for_each(set_priority);
                watch(&stop)
            })?);
        }
        Ok(witness)
    }

    /// Ends them. Returns what each has seen.
    pub(super) fn end(&mut self) -> Vec<Testimony> {
        // SYNC: Relaxed, the flag carries nothing but itself.
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).filter_map(|thread| thread.join().ok()).collect()
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        self.end();
    }
}

/// Not granted to the robot's loops either, then.
fn set_priority(priority: u8) {
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    if let Ok(value) = priority.try_into() {
        let priority = ThreadPriority::Crossplatform(value);
        let _ = set_thread_priority_and_policy(thread_native_id(), priority, policy);
    }
}

fn watch(stop: &AtomicBool) -> Testimony {
    let mut testimony = Testimony::default();
    let mut due = Time::now() + PERIOD;
    // SYNC: Relaxed, the flag carries nothing but itself.
    while !stop.load(Ordering::Relaxed) {
        if sleep_until(due).is_err() {
            break;
        }
        let now = Time::now();
        testimony.note(due, now);
        due = (due + PERIOD).max(now);
    }
    testimony
}

impl Testimony {
    fn note(&mut self, due: Time, woken: Time) {
        let late = woken.since(due);
        self.wakes += 1;
        self.misses += u64::from(late > Duration::from_micros(LATE_MAX_US));
        if late >= STALL_MIN && self.stalls.len() < STALLS_MAX {
            self.stalls.push(CpuStall { from_ns: due.as_nanos(), to_ns: woken.as_nanos() });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_wake_later_than_5_ms_is_a_stall_and_later_than_2_ms_a_miss() {
        let mut testimony = Testimony::default();
        let due = Time::ZERO + Duration::from_secs(1);
        for late_us in [0, 2_000, 2_001, 4_999, 5_000] {
            testimony.note(due, due + Duration::from_micros(late_us));
        }
        assert_eq!((testimony.wakes, testimony.misses), (5, 3));
        assert_eq!(testimony.stalls, [CpuStall { from_ns: 1_000_000_000, to_ns: 1_005_000_000 }]);
    }

    #[test]
    fn there_is_a_witness_on_a_cpu_that_this_process_may_use() {
        let mut witness = Witness::start(None).unwrap();
        while !witness.threads.iter().any(|thread| thread.is_finished()) {
            std::thread::yield_now();
            witness.stop.store(true, Ordering::Relaxed);
        }
        assert!(!witness.end().is_empty());
    }
}
