//! Whether the program of a command makes progress. Pure: the signs of life and their times are parameters.

use std::time::Duration;

use sinew_lncl::{Reading, Signs};
use tokio::time::Instant;

/// Detects a program that neither reads nor sends, although something waits for it to be read.
pub(super) struct ProgressTimeout {
    within: Option<Duration>,
    last_check: Instant,
    seen: Option<((u64, u64), u64)>,
    /// Since when at least something is unread, and the program has given no sign of life.
    since: Option<Instant>,
    /// The last time at which it was found idle.
    idle_at: Option<Instant>,
}

/// The state of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// It gives signs of life, or cannot be observed.
    Alive,
    /// It has read everything: without something to read it gives no sign of life. Returned twice in the time limit.
    Idle,
    /// It has given no sign of life for so long.
    Hung(Duration),
}

impl ProgressTimeout {
    pub(super) const fn new(within: Option<Duration>, now: Instant) -> Self {
        Self { within, last_check: now, seen: None, since: None, idle_at: None }
    }

    fn period(within: Duration) -> Duration {
        (within / 8).max(Duration::from_millis(1))
    }

    /// Resolves at the time of the next check.
    pub(super) async fn tick(&self) -> Instant {
        let Some(within) = self.within else { return std::future::pending().await };
        tokio::time::sleep_until(self.last_check + Self::period(within)).await;
        Instant::now()
    }

    /// Returns the state of the program by its signs of life; `None`: it is not registered.
    pub(super) fn check(&mut self, now: Instant, signs: Option<Signs>) -> Verdict {
        let last = std::mem::replace(&mut self.last_check, now);
        let (Some(within), Some(signs)) = (self.within, signs) else {
            (self.seen, self.since) = (None, None);
            return Verdict::Alive;
        };
        let Signs { reading: Reading { mark, unread, leaves_some }, frames } = signs;
        let is_unmoved = self.seen.replace((mark, frames)) == Some((mark, frames));
        if !leaves_some && unread.is_none_or(|bytes| bytes == 0) {
            self.since = None;
            let is_recent = self.idle_at.is_some_and(|at| now.saturating_duration_since(at) < within / 2);
            if unread.is_none() || is_recent {
                return Verdict::Alive;
            }
            self.idle_at = Some(now);
            return Verdict::Idle;
        }
        let since = *if is_unmoved { self.since.get_or_insert(now) } else { self.since.insert(now) };
        let lateness = now.saturating_duration_since(last + Self::period(within));
        if lateness > Self::period(within) {
            // This node itself was delayed, and perhaps the program with it.
            self.since = Some((since + lateness).min(now));
            return Verdict::Alive;
        }
        let silent = now.saturating_duration_since(since);
        if silent > within { Verdict::Hung(silent) } else { Verdict::Alive }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WITHIN: Duration = Duration::from_millis(80);

    fn signs(read: u64, unread: Option<u64>, frames: u64) -> Option<Signs> {
        Some(Signs { reading: Reading { mark: (read, 0), unread, leaves_some: false }, frames })
    }

    /// Checks each 10 ms, as `tick` does. Returns the verdicts.
    fn verdicts(of: impl IntoIterator<Item = Option<Signs>>) -> Vec<Verdict> {
        let start = Instant::now();
        let mut timeout = ProgressTimeout::new(Some(WITHIN), start);
        let checks = (1..).map(|number| start + Duration::from_millis(10) * number);
        checks.zip(of).map(|(now, signs)| timeout.check(now, signs)).collect()
    }

    #[test]
    fn program_that_leaves_something_unread_hangs_after_its_limit() {
        let found = verdicts((0..11).map(|_| signs(5, Some(64), 0)));
        assert_eq!(found[..9], [Verdict::Alive; 9]);
        assert_eq!(
            found[9..],
            [
                Verdict::Hung(WITHIN + Duration::from_millis(10)),
                Verdict::Hung(WITHIN + Duration::from_millis(20))
            ]
        );
    }

    #[test]
    fn reading_and_sending_are_signs_of_life() {
        assert!(
            !verdicts((0..100).map(|at| signs(at / 8, Some(64), 0))).iter().any(|it| *it != Verdict::Alive)
        );
        assert!(
            !verdicts((0..100).map(|at| signs(5, Some(64), at / 8))).iter().any(|it| *it != Verdict::Alive)
        );
    }

    #[test]
    fn idle_program_of_a_known_reader_is_probed() {
        let idle = verdicts((0..9).map(|_| signs(5, Some(0), 0)));
        let probes = idle.iter().map(|it| *it == Verdict::Idle).collect::<Vec<_>>();
        assert_eq!(probes, [true, false, false, false, true, false, false, false, true]);
        assert!(verdicts((0..100).map(|_| signs(5, None, 0))).iter().all(|it| *it == Verdict::Alive));
        assert!(verdicts((0..100).map(|_| None)).iter().all(|it| *it == Verdict::Alive));
    }

    #[test]
    fn delay_of_the_node_is_no_hang() {
        let start = Instant::now();
        let mut timeout = ProgressTimeout::new(Some(WITHIN), start);
        let mut check = |ms| timeout.check(start + Duration::from_millis(ms), signs(5, Some(64), 0));
        assert_eq!(check(10), Verdict::Alive);
        assert_eq!([check(1_000), check(1_010)], [Verdict::Alive; 2], "the node was stopped");
        assert!(
            (102..112).map(|at| check(at * 10)).any(|it| it != Verdict::Alive),
            "the program hangs still"
        );
    }

    #[test]
    fn program_without_a_limit_is_never_hung() {
        let start = Instant::now();
        let mut timeout = ProgressTimeout::new(None, start);
        assert_eq!(timeout.check(start + Duration::from_secs(3_600), signs(5, Some(64), 0)), Verdict::Alive);
    }
}
