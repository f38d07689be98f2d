//! Sleeping on several futexes at once.

use std::{io, sync::atomic::AtomicU32, time::Duration};

use rustix::{
    fs::Timespec,
    io::Errno,
    thread::{
        ClockId,
        futex::{self, WaitFlags, WaitPtr, WaitvFlags},
    },
    time::clock_gettime,
};

use super::bells::timespec;
use crate::{
    any::ENDS_MAX,
    bell::{BellState, Woken},
};

/// Sleep time on one futex of several where the system cannot wait for all (before Linux 5.16).
const TURN: Duration = Duration::from_millis(1);

/// Words to sleep at, each with its last read value.
pub(crate) struct FutexSet<'a> {
    first: Option<(&'a AtomicU32, u32)>,
    waits: [futex::Wait; ENDS_MAX],
    count: usize,
}

impl<'a> FutexSet<'a> {
    pub(crate) const fn new() -> Self {
        Self { first: None, waits: [futex::Wait::new(); ENDS_MAX], count: 0 }
    }

    /// Adds a word with its value. False when there are too many.
    pub(crate) fn add(&mut self, word: &'a AtomicU32, seen: BellState) -> bool {
        let Some(wait) = self.waits.get_mut(self.count) else {
            return false;
        };
        wait.val = u64::from(seen.0);
        wait.uaddr = WaitPtr::new(word.as_ptr().cast());
        // Not private: the ringing side is in another process.
        wait.flags = WaitFlags::SIZE_U32;
        self.first.get_or_insert((word, seen.0));
        self.count += 1;
        true
    }

    /// Sleeps until one of them rings after `listen`, or `left` has passed. May end early without a reason.
    pub(crate) fn sleep(&self, left: Duration) -> io::Result<Woken> {
        let slept = match self.first {
            None => return Ok(Woken::TimedOut),
            Some((word, seen)) => match self.sleep_on_all(left) {
                Err(Errno::NOSYS) => sleep_on(word, seen, left.min(TURN)),
                other => other,
            },
        };
        woken(slept)
    }

    fn sleep_on_all(&self, left: Duration) -> Result<(), Errno> {
        let until = after(clock_gettime(ClockId::Monotonic), left);
        futex::waitv(&self.waits[..self.count], WaitvFlags::empty(), Some(&until), ClockId::Monotonic)?;
        Ok(())
    }
}

/// Sleeps on one word until it is rung after `seen`, or `left` has passed. May end early without a reason.
pub(crate) fn sleep_at(word: &AtomicU32, seen: BellState, left: Duration) -> io::Result<Woken> {
    woken(sleep_on(word, seen.0, left))
}

fn woken(slept: Result<(), Errno>) -> io::Result<Woken> {
    match slept {
        // Rung before the sleep, or interrupted by a signal. The caller checks again.
        Ok(()) | Err(Errno::AGAIN | Errno::INTR) => Ok(Woken::Rung),
        Err(Errno::TIMEDOUT) => Ok(Woken::TimedOut),
        Err(errno) => Err(errno.into()),
    }
}

fn sleep_on(word: &AtomicU32, seen: u32, left: Duration) -> Result<(), Errno> {
    futex::wait(word, futex::Flags::empty(), seen, Some(&timespec(left)))
}

fn after(now: Timespec, left: Duration) -> Timespec {
    let left = timespec(left);
    let nanos = now.tv_nsec + left.tv_nsec;
    Timespec { tv_sec: now.tv_sec + left.tv_sec + nanos / 1_000_000_000, tv_nsec: nanos % 1_000_000_000 }
}
