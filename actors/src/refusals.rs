//! What was refused from outside: counted for each cause, logged once a second at most.

use std::{
    collections::BTreeMap,
    fmt::Display,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use sinew_runtime::time::Time;

/// Time between two log lines of one cause.
const LOG_PERIOD: Duration = Duration::from_secs(1);

/// Counts refusals by cause. Its memory is bounded by the number of causes in the program's text.
#[derive(Debug, Default)]
pub(crate) struct Refusals(Mutex<BTreeMap<&'static str, Cause>>);

#[derive(Debug, Default)]
struct Cause {
    count: u64,
    suppressed: u64,
    logged: Option<Time>,
}

impl Refusals {
    /// Counts one refusal for `cause` and logs it, unless the last line of this cause is less than a second old.
    pub(crate) fn count(&self, now: Time, cause: &'static str, detail: &dyn Display) {
        let mut causes = self.causes();
        let entry = causes.entry(cause).or_default();
        entry.count += 1;
        if entry.logged.is_some_and(|last| now.since(last) < LOG_PERIOD) {
            entry.suppressed += 1;
            return;
        }
        entry.logged = Some(now);
        let suppressed = std::mem::take(&mut entry.suppressed);
        // Logged outside the lock: a slow terminal must not hold up who refuses next.
        drop(causes);
        tracing::warn!(suppressed, "refused, {cause}: {detail}");
    }

    /// How many refusals there were.
    pub(crate) fn total(&self) -> u64 {
        self.causes().values().map(|cause| cause.count).sum()
    }

    /// How many refusals there were for `cause`.
    pub(crate) fn of(&self, cause: &str) -> u64 {
        self.causes().get(cause).map_or(0, |cause| cause.count)
    }

    fn causes(&self) -> MutexGuard<'_, BTreeMap<&'static str, Cause>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refusal_is_counted_even_when_its_log_line_is_not_written() {
        let refusals = Refusals::default();
        for _ in 0..3 {
            refusals.count(Time::ZERO, "garbage", &"not a frame");
        }
        refusals.count(Time::ZERO, "forged source", &"1/2");
        assert_eq!((refusals.of("garbage"), refusals.of("unheard of"), refusals.total()), (3, 0, 4));
    }
}
