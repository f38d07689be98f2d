//! Who tells a device to damp again while the thread of its drive says nothing.
//!
//! An order is one datagram, and may be lost. A drive repeats its own in each tick; one that hangs does not, and the thread
//! `safe-output` says it once, as it may not wait. This thread repeats it, a bounded number of times, until the drive gives a torque again that counts.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, Thread};

use sinew::prelude::{Duration, Place, Time};

use crate::message::DriveState;
use crate::robot::device::Damper;

/// SCHED_FIFO priority, where the system allows it: above all that controls, below what makes outputs safe.
const PRIORITY: u8 = 89;
/// Time between two orders to damp.
const PERIOD: Duration = Duration::from_millis(2);
/// Silence of a drive that ramps a torque to zero past a shut guard, after which its device is told to damp.
const RAMP_SILENT_MAX: Duration = Duration::from_millis(5);
/// Orders that are said in a row, over 100 ms: enough against loss. A hung life of the drive must not go on for ever, as the device hears
/// a new one only when the old one is silent.
const ORDERS_MAX: u32 = 50;
/// Orders that are still said when the drive has ended while one was due.
const LAST_ORDERS: u32 = 3;
/// Nothing is due.
const NEVER: u64 = u64::MAX;

/// The drive's hold on the thread, which ends with it.
pub(super) struct Lookout {
    watch: Watch,
}

/// Tells the thread from when on the device has to be told to damp. No call waits or takes a lock.
#[derive(Clone)]
pub(super) struct Watch {
    due: Arc<Due>,
    thread: Thread,
}

struct Due {
    /// When the device has to be told, ns.
    from_ns: AtomicU64,
    has_ended: AtomicBool,
}

impl Lookout {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system gives none.
    pub(super) fn start(damper: Box<dyn Damper>) -> io::Result<Self> {
        let due = Arc::new(Due { from_ns: AtomicU64::new(NEVER), has_ended: AtomicBool::new(false) });
        let own = due.clone();
        let thread = thread::Builder::new().name("damp-again".to_owned()).spawn(move || {
            Place::layer("damp-again").realtime_at_best(PRIORITY).prepare();
            own.keep(&*damper);
        })?;
        Ok(Self { watch: Watch { due, thread: thread.thread().clone() } })
    }

    pub(super) const fn watch(&self) -> &Watch {
        &self.watch
    }
}

impl Drop for Lookout {
    fn drop(&mut self) {
        // SYNC: Release, what is due is seen with it; with the Acquire in `keep`.
        self.watch.due.has_ended.store(true, Ordering::Release);
        self.watch.thread.unpark();
    }
}

impl Watch {
    /// The device was told to damp: it is told so again and again.
    pub(super) fn damps(&self) {
        self.due_from(Time::now().as_nanos());
    }

    /// The device was told a torque for which the open guard answers, or zero.
    pub(super) fn rests(&self) {
        // It looks when it wakes; a torque a thousand times a second need not wake it.
        // SYNC: Relaxed, the time stands for itself.
        self.due.from_ns.store(NEVER, Ordering::Relaxed);
    }

    /// The device was told a torque on its way to zero, past a shut guard.
    pub(super) fn ramps(&self) {
        self.due_from((Time::now() + RAMP_SILENT_MAX).as_nanos());
    }

    fn due_from(&self, from_ns: u64) {
        // SYNC: Relaxed, the time stands for itself; to unpark is a Release.
        self.due.from_ns.store(from_ns, Ordering::Relaxed);
        self.thread.unpark();
    }
}

impl Due {
    fn keep(&self, damper: &dyn Damper) {
        let (mut said, mut said_of_ns) = (0, NEVER);
        // SYNC: Acquire, with the Release in `drop`.
        while !self.has_ended.load(Ordering::Acquire) {
            // SYNC: Relaxed, see `due_from`.
            let from_ns = self.from_ns.load(Ordering::Relaxed);
            if from_ns != std::mem::replace(&mut said_of_ns, from_ns) {
                said = 0;
            }
            match left(from_ns).filter(|_| said < ORDERS_MAX) {
                None => thread::park(),
                Some(Duration::ZERO) => {
                    said += 1;
                    damper.damp(Time::now(), DriveState::Safe);
                    thread::park_timeout(PERIOD);
                }
                Some(left) => thread::park_timeout(left),
            }
        }
        // The next life of the drive is heard only when this one is silent; and where all orders of this were said it may walk by now, its
        // drive having hung for longer than a supervisor lets it.
        for _ in 0..LAST_ORDERS {
            // SYNC: Relaxed, see `due_from`.
            let from_ns = self.from_ns.load(Ordering::Relaxed);
            if from_ns == NEVER || from_ns == said_of_ns && said >= ORDERS_MAX {
                return;
            }
            damper.damp(Time::now(), DriveState::Safe);
            thread::sleep(PERIOD);
        }
    }
}

/// How long nothing is to be said yet; `None` while nothing is due.
fn left(from_ns: u64) -> Option<Duration> {
    (from_ns != NEVER).then(|| Time::from_nanos(from_ns).since(Time::now()))
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

    use super::*;

    const DEADLINE: Duration = Duration::from_secs(60);

    impl Damper for SyncSender<()> {
        fn damp(&self, _: Time, _: DriveState) {
            // The test may look no more.
            let _ = self.try_send(());
        }
    }

    fn lookout() -> (Lookout, Receiver<()>) {
        let (damper, told) = sync_channel(ORDERS_MAX as usize);
        (Lookout::start(Box::new(damper)).expect("a thread"), told)
    }

    #[track_caller]
    fn is_told(told: &Receiver<()>, times: u32) {
        for time in 1..=times {
            told.recv_timeout(DEADLINE).unwrap_or_else(|_| panic!("told {time} times of {times}"));
        }
    }

    #[test]
    fn device_is_told_to_damp_again_and_again_while_its_drive_says_nothing_but_not_for_ever() {
        let (lookout, told) = lookout();
        lookout.watch().damps();
        is_told(&told, ORDERS_MAX);
        // Long enough for many more: the next life of the drive would not be heard.
        assert!(told.recv_timeout(PERIOD * ORDERS_MAX).is_err());
        lookout.watch().damps();
        is_told(&told, ORDERS_MAX);
    }

    #[test]
    fn device_of_a_drive_that_falls_silent_in_a_ramp_is_told_to_damp() {
        let (lookout, told) = lookout();
        lookout.watch().ramps();
        is_told(&told, 2);
    }

    #[test]
    fn device_that_gives_nothing_is_told_nothing_and_the_thread_ends_with_its_drive() {
        let (lookout, told) = lookout();
        lookout.watch().rests();
        drop(lookout);
        // The thread has the only sender: it is gone when this returns.
        assert_eq!(told.recv_timeout(DEADLINE), Err(std::sync::mpsc::RecvTimeoutError::Disconnected));
    }

    #[test]
    fn life_that_ends_long_after_its_orders_says_nothing_to_the_device_of_the_next_one() {
        let (lookout, told) = lookout();
        lookout.watch().damps();
        is_told(&told, ORDERS_MAX);
        drop(lookout);
        assert_eq!(told.recv_timeout(DEADLINE), Err(std::sync::mpsc::RecvTimeoutError::Disconnected));
    }

    #[test]
    fn drive_that_ends_while_its_device_has_to_damp_leaves_a_few_orders_behind_and_no_more() {
        let (lookout, told) = lookout();
        lookout.watch().damps();
        is_told(&told, 1);
        drop(lookout);
        is_told(&told, LAST_ORDERS);
        while told.recv_timeout(DEADLINE).is_ok() {}
    }
}
