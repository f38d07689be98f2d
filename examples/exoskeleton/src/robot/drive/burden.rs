//! A planted fault: a drive that computes longer than its period lasts, as a busy loop in its tick would.
//!
//! It shows how the launcher tells a robot that overloads itself from a host that other programs load.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use crate::joint::Joint;

/// The variable that plants it: `EXOSKELETON_BUSY=knee:12` for 12 ms in each tick of the knee's drive.
const VARIABLE: &str = "EXOSKELETON_BUSY";
/// Time of walking before it begins: a robot that is overloaded from its start is not released at all.
pub(super) const FREE: Duration = Duration::from_millis(500);
/// Longest time in a tick, ms. More is a drive that hangs.
const MS_MAX: u64 = 50;

/// CPU time to waste in each tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Burden(Duration);

impl Burden {
    /// That of this joint's drive, if the environment of this process plants one.
    #[must_use]
    pub fn planted(joint: Joint) -> Option<Self> {
        Self::parse(&std::env::var(VARIABLE).ok()?, joint)
    }

    fn parse(text: &str, joint: Joint) -> Option<Self> {
        let (name, ms) = text.split_once(':')?;
        let ms = ms.parse::<u64>().ok().filter(|ms| (1..=MS_MAX).contains(ms))?;
        (name == joint.name()).then(|| Self(Duration::from_millis(ms)))
    }

    /// Uses it up. Time of this thread, which stands still while other programs have the CPU.
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
mod tests {
    use super::*;

    #[test]
    fn only_the_joint_that_is_named_has_a_burden_and_a_limited_one() {
        let twelve = Some(Burden(Duration::from_millis(12)));
        assert_eq!(Burden::parse("knee:12", Joint::Knee), twelve);
        for text in ["knee:12", "hip", "hip:", "hip:0", "hip:51", "hip:x"] {
            assert_eq!(Burden::parse(text, Joint::Hip), None, "{text}");
        }
    }
}
