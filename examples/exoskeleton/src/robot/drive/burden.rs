//! An injected fault: a drive that computes longer than its period lasts, like a busy loop in its tick.
//!
//! It shows how the launcher distinguishes a robot that overloads itself from a host that other programs
//! load.

use std::time::Duration;

use exoskeleton_model::joint::Joint;
use rustix::time::{ClockId, clock_gettime};

/// The variable that injects it: `EXOSKELETON_BUSY=knee:12` for 12 ms in each tick of the knee's drive.
const VARIABLE: &str = "EXOSKELETON_BUSY";
/// Time of walking before it begins: a robot that is overloaded from its start is not released at all.
pub(super) const FREE: Duration = Duration::from_millis(500);
/// Maximum time in a tick, ms. A drive with more than that hangs.
const MS_MAX: u64 = 50;

/// CPU time to waste in each tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Burden(Duration);

impl Burden {
    /// Returns the burden of this joint's drive, if the environment of this process sets one.
    #[must_use]
    pub fn planted(joint: Joint) -> Option<Self> {
        Self::parse(&std::env::var(VARIABLE).ok()?, joint)
    }

    fn parse(text: &str, joint: Joint) -> Option<Self> {
        let (name, ms) = text.split_once(':')?;
        let ms = ms.parse::<u64>().ok().filter(|ms| (1..=MS_MAX).contains(ms))?;
        (name == joint.name()).then(|| Self(Duration::from_millis(ms)))
    }

    /// Uses up the CPU time. It is measured for this thread, so it stops while other programs have the CPU.
    pub(super) fn carry(self) {
        let until = used() + self.0;
        while used() < until {
            std::hint::spin_loop();
        }
    }
}

fn used() -> Duration {
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap_or_default()
}

#[cfg(test)]
#[path = "../../../tests/unit/burden.rs"]
mod tests;
