//! The proof of real time: after the start one thread measures how late it wakes, reads the rights of the process, and
//! ends.
//!
//! The node is ready before that, and waits for nothing of it.

use std::{
    io,
    path::Path,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use sinew_runtime::{
    log,
    protection::SAFE_OUTPUT_PRIORITY,
    real_time::{HostRights, LatenessSummary, Plan, Preemption, probe},
};

use crate::inspect::RealTimeReport;

/// The measurement of a node, and its result.
#[derive(Debug, Default)]
pub(crate) struct RealTime {
    has_ended: AtomicBool,
    report: OnceLock<RealTimeReport>,
}

impl RealTime {
    /// Starts the thread, which measures for `length`; zero starts none.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(crate) fn begin(self: &Arc<Self>, length: Duration) -> io::Result<()> {
        if length.is_zero() {
            return Ok(());
        }
        let real_time = self.clone();
        thread::Builder::new().name("rt-probe".to_owned()).spawn(move || real_time.measure(length))?;
        Ok(())
    }

    fn measure(&self, length: Duration) {
        let plan = Plan::new(Some(SAFE_OUTPUT_PRIORITY), length);
        let found = probe(&plan, || !self.has_ended.load(Ordering::Relaxed));
        // With the ordinary schedule again: files may be slow. The program may have locked its memory meanwhile.
        let rights = HostRights::read(Path::new("/"));
        let report = report(&rights, &plan, found.granted, found.lateness.summary());
        log::debug!(?report, "the lateness of a thread with the priority of the safe outputs");
        // It is set once, here.
        let _ = self.report.set(report);
    }

    /// Returns the result; `None` before the measurement has ended, or without one.
    pub(crate) fn report(&self) -> Option<RealTimeReport> {
        self.report.get().cloned()
    }

    /// Ends the measurement.
    pub(crate) fn end(&self) {
        self.has_ended.store(true, Ordering::Relaxed);
    }
}

fn report(rights: &HostRights, plan: &Plan, granted: u8, lateness: LatenessSummary) -> RealTimeReport {
    let nanos = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    let wanted = plan.priority.unwrap_or(0);
    RealTimeReport {
        wanted,
        granted,
        refusals: rights.refusals(wanted, granted).iter().map(ToString::to_string).collect(),
        memory: rights.locked().to_string(),
        is_preempt_rt: rights.preemption == Preemption::RealTime,
        period_us: u64::try_from(plan.period.as_micros()).unwrap_or(u64::MAX),
        turns: lateness.turns,
        p50_ns: nanos(lateness.p50),
        p99_ns: nanos(lateness.p99),
        p999_ns: nanos(lateness.p999),
        max_ns: nanos(lateness.max),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn report_has_rights_and_percentiles() {
        let rights = HostRights::read(Path::new("/nowhere"));
        let plan = Plan::new(Some(90), Duration::from_secs(2));
        let us = Duration::from_micros;
        let lateness = LatenessSummary { turns: 2_000, p50: us(5), p99: us(20), p999: us(83), max: us(210) };
        let refused = report(&rights, &plan, 0, lateness);
        assert_eq!((refused.wanted, refused.granted, refused.turns), (90, 0, 2_000));
        assert_eq!(refused.refusals, ["RLIMIT_RTPRIO is 0, without CAP_SYS_NICE"]);
        assert_eq!((refused.period_us, refused.p999_ns, refused.max_ns), (1_000, 83_000, 210_000));
        assert!(report(&rights, &plan, 90, lateness).refusals.is_empty());
    }

    #[test]
    fn switched_off_measurement_starts_no_thread() {
        let real_time = Arc::new(RealTime::default());
        real_time.begin(Duration::ZERO).unwrap();
        assert_eq!((Arc::strong_count(&real_time), real_time.report()), (1, None));
    }

    #[test]
    fn measurement_that_is_ended_reports_its_turns_so_far() {
        let real_time = RealTime::default();
        real_time.end();
        real_time.measure(Duration::from_secs(60));
        assert_eq!(real_time.report().map(|report| report.turns), Some(0));
    }
}
