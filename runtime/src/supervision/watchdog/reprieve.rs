//! More time for who was not given his: a deadline is later by the time in which the machine stood still, and by that in
//! which a thread waited for a CPU.
//!
//! The account is read when the deadline is over, and not before: whoever keeps it costs two looks at the kernel's account.

use std::{sync::Arc, time::Duration};

use super::{
    account::Account,
    lateness::Lateness,
    processor::{Condition, Sample, sample},
};
use crate::{supervision::tenant::Tenant, time::Time};

/// Time between two looks at one who waits for a CPU when his time is over.
const LOOK: Duration = Duration::from_millis(5);
/// Time at most that is given back to a thread which gets no CPU: nine times what it had, and this at least. Then it counts as
/// lost.
const TIMES_MAX: u32 = 9;
const MOST_AT_LEAST: Duration = Duration::from_secs(10);

/// What one life was given of the time that it has for something.
pub(in crate::supervision) struct Reprieve {
    tenant: Tenant,
    lateness: Arc<Lateness>,
    grants: Grants,
}

impl Reprieve {
    pub(super) fn new(tenant: Tenant, within: Duration, lateness: Arc<Lateness>) -> Self {
        let now = Time::now();
        lateness.add_reader(now);
        let grants = Grants::new(within, lateness.sum(now), look_at(&tenant));
        Self { tenant, lateness, grants }
    }

    /// The time is over. Until when it has more, if it has. `is_done`: it has done it, and its word is on the way.
    pub(in crate::supervision) fn until(&mut self, deadline: Time, now: Time, is_done: bool) -> Option<Time> {
        let late = self.lateness.sum(now);
        let sample = look_at(&self.tenant);
        let more = self.grants.more(late, sample, is_done)?;
        Some((deadline + more).max(now + LOOK))
    }
}

impl Drop for Reprieve {
    fn drop(&mut self) {
        self.lateness.remove_reader();
    }
}

fn look_at(tenant: &Tenant) -> Option<Sample> {
    sample(tenant.seat()?.tid()?)
}

/// The decision, pure.
#[derive(Debug)]
struct Grants {
    /// What it would have had on an idle machine.
    within: Duration,
    late_before: Duration,
    account: Account,
    /// Whether the last look was to see what it does at this moment.
    is_probed: bool,
    /// For time that was lost.
    granted: Duration,
    /// To see whether it is losing time at this moment.
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
        // Of one who wants the CPU, only a second look, shortly after, says whether he gets it.
        let may_wait = !std::mem::take(&mut self.is_probed) && is_runnable;
        let waits = self.account.enter(sample) || may_wait;
        let most = self.within.saturating_mul(TIMES_MAX).max(MOST_AT_LEAST);
        let lost = late.saturating_sub(self.late_before) + self.account.waited().min(most);
        let more = lost.saturating_sub(self.granted);
        if more >= LOOK {
            self.granted = lost;
            return Some(more);
        }
        let goes_on = (waits || is_done) && self.probed < most;
        goes_on.then(|| {
            self.probed += LOOK;
            self.is_probed = true;
            LOOK
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
    fn who_waits_for_something_else_than_a_cpu_has_no_more_time() {
        assert_eq!(opened().more(7 * MS, cpu(51, 50, Condition::Blocked), false), None);
        assert_eq!(opened().more(7 * MS, None, false), None, "nor one of whom there is no account");
    }

    #[test]
    fn who_computes_without_end_has_one_look_more() {
        let mut grants = opened();
        assert_eq!(grants.more(7 * MS, cpu(150, 50, Condition::Runnable), false), Some(LOOK));
        assert_eq!(grants.more(7 * MS, cpu(155, 50, Condition::Runnable), false), None);
    }

    #[test]
    fn time_in_which_the_machine_stood_still_is_given_back_once_however_long() {
        let mut grants = opened();
        let still = 3_600 * 1_000 * MS;
        assert_eq!(grants.more(7 * MS + still, cpu(50, 50, Condition::Blocked), false), Some(still));
        assert_eq!(grants.more(7 * MS + still, cpu(50, 50, Condition::Blocked), false), None);
    }

    #[test]
    fn time_for_which_it_waited_for_a_cpu_is_given_back_up_to_nine_times_its_own() {
        let mut grants = opened();
        assert_eq!(grants.more(7 * MS, cpu(60, 130, Condition::Blocked), false), Some(80 * MS));
        assert_eq!(grants.more(7 * MS, cpu(70, 200, Condition::Blocked), false), Some(70 * MS));
        assert_eq!(grants.more(7 * MS, cpu(70, 99_999, Condition::Blocked), false), Some(17_850 * MS));
        assert_eq!(grants.more(7 * MS, cpu(70, 999_999, Condition::Blocked), false), None);
    }

    #[test]
    fn a_wait_that_has_not_ended_is_seen_after_time_was_given_back() {
        let mut grants = opened();
        assert_eq!(grants.more(7 * MS, cpu(60, 130, Condition::Runnable), false), Some(80 * MS));
        // It ran, and waits again; the kernel counts that when it is over.
        assert_eq!(grants.more(7 * MS, cpu(63, 131, Condition::Runnable), false), Some(LOOK));
        assert_eq!(grants.more(7 * MS, cpu(63, 131, Condition::Runnable), false), Some(LOOK));
        assert_eq!(grants.more(7 * MS, cpu(66, 161, Condition::Runnable), false), Some(31 * MS));
    }

    #[test]
    fn one_that_never_gets_a_cpu_is_lost_in_the_end() {
        let mut grants = Grants::new(WITHIN, PUNCTUAL, cpu(50, 50, Condition::Runnable));
        let waits = || cpu(50, 50, Condition::Runnable);
        let looks = (0..10_000).take_while(|_| grants.more(PUNCTUAL, waits(), false).is_some()).count();
        assert_eq!(looks, 3_600, "nine times two seconds, in looks of 5 ms");
    }

    #[test]
    fn a_word_that_is_on_the_way_is_waited_for() {
        assert_eq!(opened().more(7 * MS, cpu(50, 50, Condition::Blocked), true), Some(LOOK));
    }
}
