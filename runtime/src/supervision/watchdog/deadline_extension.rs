//! Deadline extensions: a deadline is extended by the time in which the machine was suspended, and by the
//! time in which a thread waited for a CPU.
//!
//! The CPU account is read only when the deadline has passed, so an extension costs two reads of the kernel's account.

use std::{sync::Arc, time::Duration};

use super::{
    account::Account,
    lateness::Lateness,
    processor::{Condition, Sample, sample},
};
use crate::{supervision::actor_handle::ActorHandle, time::Time};

/// Time between two checks of a thread that waits for a CPU when its deadline has passed.
const RECHECK: Duration = Duration::from_millis(5);
/// Maximum extension for a thread that gets no CPU: nine times its time limit, and at least this. After that
/// it counts as lost.
const TIMES_MAX: u32 = 9;
const MOST_AT_LEAST: Duration = Duration::from_secs(10);

/// The deadline extension of one step of an incarnation.
pub(in crate::supervision) struct DeadlineExtension {
    handle: ActorHandle,
    lateness: Arc<Lateness>,
    grants: Grants,
}

impl DeadlineExtension {
    pub(super) fn new(handle: ActorHandle, within: Duration, lateness: Arc<Lateness>) -> Self {
        let now = Time::now();
        lateness.add_reader(now);
        let grants = Grants::new(within, lateness.sum(now), sample_of(&handle));
        Self { handle, lateness, grants }
    }

    /// Returns the extended deadline, if there is one, when the deadline has passed. `is_done`: the step is
    /// complete, and its report is on the way.
    pub(in crate::supervision) fn until(&mut self, deadline: Time, now: Time, is_done: bool) -> Option<Time> {
        let late = self.lateness.sum(now);
        let sample = sample_of(&self.handle);
        let more = self.grants.more(late, sample, is_done)?;
        Some((deadline + more).max(now + RECHECK))
    }
}

impl Drop for DeadlineExtension {
    fn drop(&mut self) {
        self.lateness.remove_reader();
    }
}

fn sample_of(handle: &ActorHandle) -> Option<Sample> {
    sample(handle.slot()?.tid()?)
}

/// The decision, pure.
#[derive(Debug)]
struct Grants {
    /// The time limit on an idle machine.
    within: Duration,
    late_before: Duration,
    account: Account,
    /// Whether the last check was to see the activity at this moment.
    is_probed: bool,
    /// The extension granted for lost time.
    granted: Duration,
    /// The extension granted to check whether the thread is losing time at this moment.
    probed: Duration,
}

impl Grants {
    fn new(within: Duration, late: Duration, sample: Option<Sample>) -> Self {
        let mut account = Account::default();
        account.enter(sample);
        Self {
            within,
            late_before: late,
            account,
            is_probed: false,
            granted: Duration::ZERO,
            probed: Duration::ZERO,
        }
    }

    fn more(&mut self, late: Duration, sample: Option<Sample>, is_done: bool) -> Option<Duration> {
        let is_runnable = sample.is_some_and(|sample| sample.condition == Condition::Runnable);
        // For a runnable thread, only a second check, shortly after, shows whether it gets the CPU.
        let may_wait = !std::mem::take(&mut self.is_probed) && is_runnable;
        let waits = self.account.enter(sample) || may_wait;
        let most = self.within.saturating_mul(TIMES_MAX).max(MOST_AT_LEAST);
        let lost = late.saturating_sub(self.late_before) + self.account.waited().min(most);
        let more = lost.saturating_sub(self.granted);
        if more >= RECHECK {
            self.granted = lost;
            return Some(more);
        }
        let is_extended = (waits || is_done) && self.probed < most;
        is_extended.then(|| {
            self.probed += RECHECK;
            self.is_probed = true;
            RECHECK
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);
    const WITHIN: Duration = Duration::from_secs(2);
    const PUNCTUAL: Duration = Duration::ZERO;

    fn cpu(ran: u64, waited: u64, condition: Condition) -> Option<Sample> {
        Some(Sample { ran: ran * 1_000_000, waited: waited * 1_000_000, condition })
    }

    fn opened() -> Grants {
        Grants::new(WITHIN, 7 * MS, cpu(50, 50, Condition::Blocked))
    }

    #[test]
    fn wait_for_other_than_a_cpu_gets_no_extension() {
        assert_eq!(opened().more(7 * MS, cpu(51, 50, Condition::Blocked), false), None);
        assert_eq!(opened().more(7 * MS, None, false), None, "nor one of whom there is no account");
    }

    #[test]
    fn endless_computation_gets_one_more_check() {
        let mut grants = opened();
        assert_eq!(grants.more(7 * MS, cpu(150, 50, Condition::Runnable), false), Some(RECHECK));
        assert_eq!(grants.more(7 * MS, cpu(155, 50, Condition::Runnable), false), None);
    }

    #[test]
    fn stall_of_the_machine_is_given_back_once() {
        let mut grants = opened();
        let still = 3_600 * 1_000 * MS;
        assert_eq!(grants.more(7 * MS + still, cpu(50, 50, Condition::Blocked), false), Some(still));
        assert_eq!(grants.more(7 * MS + still, cpu(50, 50, Condition::Blocked), false), None);
    }

    #[test]
    fn cpu_wait_extends_the_deadline_up_to_ninefold() {
        let mut grants = opened();
        assert_eq!(grants.more(7 * MS, cpu(60, 130, Condition::Blocked), false), Some(80 * MS));
        assert_eq!(grants.more(7 * MS, cpu(70, 200, Condition::Blocked), false), Some(70 * MS));
        assert_eq!(grants.more(7 * MS, cpu(70, 99_999, Condition::Blocked), false), Some(17_850 * MS));
        assert_eq!(grants.more(7 * MS, cpu(70, 999_999, Condition::Blocked), false), None);
    }

    #[test]
    fn unfinished_wait_is_seen_after_an_extension() {
        let mut grants = opened();
        assert_eq!(grants.more(7 * MS, cpu(60, 130, Condition::Runnable), false), Some(80 * MS));
        // It ran, and waits again; the kernel counts that when it is over.
        assert_eq!(grants.more(7 * MS, cpu(63, 131, Condition::Runnable), false), Some(RECHECK));
        assert_eq!(grants.more(7 * MS, cpu(63, 131, Condition::Runnable), false), Some(RECHECK));
        assert_eq!(grants.more(7 * MS, cpu(66, 161, Condition::Runnable), false), Some(31 * MS));
    }

    #[test]
    fn thread_that_never_gets_a_cpu_is_lost() {
        let mut grants = Grants::new(WITHIN, PUNCTUAL, cpu(50, 50, Condition::Runnable));
        let waits = || cpu(50, 50, Condition::Runnable);
        let checks = (0..10_000).take_while(|_| grants.more(PUNCTUAL, waits(), false).is_some()).count();
        assert_eq!(checks, 3_600, "nine times two seconds, in checks of 5 ms");
    }

    #[test]
    fn report_in_flight_is_awaited() {
        assert_eq!(opened().more(7 * MS, cpu(50, 50, Condition::Blocked), true), Some(RECHECK));
    }
}
