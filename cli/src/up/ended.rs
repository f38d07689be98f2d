//! Waits for the end of a process by a handle of the kernel, with a deadline and without polling.

use std::{io, os::fd::AsFd, time::Duration};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
};

/// Waits until the process of a pidfd has ended, for at most so long. Returns whether it has.
pub(super) fn has_ended(handle: &impl AsFd, within: Duration) -> io::Result<bool> {
    let within = Timespec {
        tv_sec: within.as_secs().try_into().unwrap_or(i64::MAX),
        tv_nsec: within.subsec_nanos().into(),
    };
    loop {
        match poll(&mut [PollFd::new(handle, PollFlags::IN)], Some(&within)) {
            Ok(ready) => return Ok(ready > 0),
            // Nothing of this program sends it signals.
            Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
}
