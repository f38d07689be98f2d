//! A thread that repeats the order to damp while the thread of the drive sends nothing.
//!
//! An order is one datagram, and may be lost. A drive repeats its own in each tick; one that hangs does not.
//! The thread `safe-output` sends it once, as it must not wait. This thread repeats it, a bounded number of
//! times, until the drive sends a torque again that counts.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, Thread};

use exoskeleton_model::message::DriveState;
use sinew::prelude::{Duration, Place, Time};

use crate::robot::device::Damper;

/// SCHED_FIFO priority, if the system allows it: above all control loops, below the thread that makes outputs
/// safe.
const PRIORITY: u8 = 89;
/// Time between two orders to damp.
const PERIOD: Duration = Duration::from_millis(2);
/// Silence of a drive that ramps a torque to zero past a shut guard, after which its device is ordered to
/// damp.
const RAMP_SILENT_MAX: Duration = Duration::from_millis(5);
/// Orders sent in a row, over 100 ms: enough against loss. A hung incarnation of the drive must not repeat
/// them forever, as the device accepts a new one only when the old one is silent.
const ORDERS_MAX: u32 = 50;
/// Orders that are still sent when the drive has ended while one was due.
const LAST_ORDERS: u32 = 3;
/// No order is due.
const NEVER: u64 = u64::MAX;

/// The drive's handle of the thread, which ends with it.
pub(super) struct DampingRepeater {
    handle: RepeaterHandle,
}

/// Sets the time from which the device has to be ordered to damp. No call waits or takes a lock.
#[derive(Clone)]
pub(super) struct RepeaterHandle {
    due: Arc<Due>,
    thread: Thread,
}

struct Due {
    /// Time from which the order is due, ns.
    from_ns: AtomicU64,
    has_ended: AtomicBool,
}

impl DampingRepeater {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system provides no thread.
    pub(super) fn start(damper: Box<dyn Damper>) -> io::Result<Self> {
        let due = Arc::new(Due { from_ns: AtomicU64::new(NEVER), has_ended: AtomicBool::new(false) });
        let own = due.clone();
        let thread = thread::Builder::new().name("damp-again".to_owned()).spawn(move || {
            Place::layer("damp-again").realtime_at_best(PRIORITY).prepare();
            own.keep(&*damper);
        })?;
        Ok(Self { handle: RepeaterHandle { due, thread: thread.thread().clone() } })
    }

    pub(super) const fn handle(&self) -> &RepeaterHandle {
        &self.handle
    }
}

impl Drop for DampingRepeater {
    fn drop(&mut self) {
        // SYNC: Release, so that the due time is seen with it; with the Acquire in `keep`.
        self.handle.due.has_ended.store(true, Ordering::Release);
        self.handle.thread.unpark();
    }
}

impl RepeaterHandle {
    /// The device was ordered to damp: the thread repeats the order.
    pub(super) fn damps(&self) {
        self.due_from(Time::now().as_nanos());
    }

    /// The device got a torque through the open guard, or zero.
    pub(super) fn rests(&self) {
        // The thread reads this when it wakes; a torque a thousand times a second need not wake it.
        // SYNC: Relaxed, no other data depends on the time.
        self.due.from_ns.store(NEVER, Ordering::Relaxed);
    }

    /// The device got a torque that is being ramped to zero, past a shut guard.
    pub(super) fn ramps(&self) {
        self.due_from((Time::now() + RAMP_SILENT_MAX).as_nanos());
    }

    fn due_from(&self, from_ns: u64) {
        // SYNC: Relaxed, no other data depends on the time; `unpark` is a Release.
        self.due.from_ns.store(from_ns, Ordering::Relaxed);
        self.thread.unpark();
    }
}

impl Due {
    fn keep(&self, damper: &dyn Damper) {
        let (mut sent, mut sent_for_ns) = (0, NEVER);
        // SYNC: Acquire, with the Release in `drop`.
        while !self.has_ended.load(Ordering::Acquire) {
            // SYNC: Relaxed, see `due_from`.
            let from_ns = self.from_ns.load(Ordering::Relaxed);
            if from_ns != std::mem::replace(&mut sent_for_ns, from_ns) {
                sent = 0;
            }
            match left(from_ns).filter(|_| sent < ORDERS_MAX) {
                None => thread::park(),
                Some(Duration::ZERO) => {
                    sent += 1;
                    damper.damp(Time::now(), DriveState::Safe);
                    thread::park_timeout(PERIOD);
                }
                Some(left) => thread::park_timeout(left),
            }
        }
        // The device accepts the drive's next incarnation only when this one is silent. If all orders of this
        // one were sent, that incarnation may walk by now: its drive hung for longer than a supervisor
        // allows.
        for _ in 0..LAST_ORDERS {
            // SYNC: Relaxed, see `due_from`.
            let from_ns = self.from_ns.load(Ordering::Relaxed);
            if from_ns == NEVER || from_ns == sent_for_ns && sent >= ORDERS_MAX {
                return;
            }
            damper.damp(Time::now(), DriveState::Safe);
            thread::sleep(PERIOD);
        }
    }
}

/// Time until an order is due; `None` while none is.
fn left(from_ns: u64) -> Option<Duration> {
    (from_ns != NEVER).then(|| Time::from_nanos(from_ns).since(Time::now()))
}

#[cfg(test)]
#[path = "../../../tests/unit/damping_repeater.rs"]
mod tests;
