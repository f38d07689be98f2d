//! Progress messages of a run: its position and the queue lengths. They show whether the machine is loaded or
//! a link stalls.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use super::trouble::Trouble;

/// Minimum interval between two messages.
const PERIOD: Duration = Duration::from_secs(10);

/// One direction of the link.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Way {
    /// Bulk messages sent so far by the sender's current incarnation.
    pub(super) sent: u64,
    /// The last of them that arrived.
    pub(super) got: u64,
    /// Messages per second, of all classes, that are to be sent.
    pub(super) rate: u64,
}

/// The progress of a run.
#[derive(Debug)]
pub(super) struct Progress {
    began: Instant,
    printed_at: Instant,
    before: [Way; 2],
    faults: u64,
    fault: u64,
    trouble: Option<Trouble>,
}

impl Progress {
    /// Starts a run with this many faults.
    pub(super) fn begin(faults: u64) -> Self {
        let now = Instant::now();
        Self { began: now, printed_at: now, before: [Way::default(); 2], faults, fault: 0, trouble: None }
    }

    /// Records the next fault.
    pub(super) const fn strikes(&mut self, trouble: Trouble) {
        self.fault += 1;
        self.trouble = Some(trouble);
    }

    /// Returns whether the next progress message is due.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now.duration_since(self.printed_at) >= PERIOD
    }

    /// Formats the progress: the traffic in both directions, the event that it waits for, and the queue
    /// lengths reported by the nodes.
    pub(super) fn line(
        &mut self,
        now: Instant,
        ways: [Way; 2],
        waits_for: &str,
        queues: &[(u16, String)],
    ) -> String {
        let seconds = now.duration_since(self.printed_at).as_secs_f64();
        let mut text = format!(
            "after {:.0} s: fault {} of {}{}",
            now.duration_since(self.began).as_secs_f64(),
            self.fault,
            self.faults,
            self.trouble.map(|trouble| format!(" ({trouble})")).unwrap_or_default(),
        );
        for (name, (way, before)) in ["there", "back"]
            .into_iter()
            .zip(ways.into_iter().zip(self.before))
            .filter(|(_, (way, _))| way.rate > 0)
        {
            // A new incarnation counts from 1.
            let each_second = |now: u64, before: u64| now.saturating_sub(before) as f64 / seconds;
            let _ = write!(
                text,
                "; {name} Bulk {} sent ({:.0} a second; {} of all classes are asked for), {} delivered ({:.0} a second)",
                way.sent,
                each_second(way.sent, before.sent),
                way.rate,
                way.got,
                each_second(way.got, before.got),
            );
        }
        let _ = write!(text, "; waits for {waits_for}");
        for (station, queues) in queues {
            let _ = write!(text, "\n  node {station}: {queues}");
        }
        (self.printed_at, self.before) = (now, ways);
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_reported_per_period_with_rates() {
        let mut progress = Progress::begin(1_000);
        let begin = progress.began;
        progress.strikes(Trouble::Cut);
        assert!(!progress.is_due(begin) && progress.is_due(begin + PERIOD));
        let way = |sent, got, rate| Way { sent, got, rate };
        let first = progress.line(begin + PERIOD, [way(850, 800, 100), way(0, 0, 0)], "number 860", &[]);
        assert_eq!(
            first,
            "after 10 s: fault 1 of 1000 (cut); there Bulk 850 sent (85 a second; 100 of all classes are asked for), 800 delivered (80 a \
             second); waits for number 860"
        );
        assert!(!progress.is_due(begin + PERIOD));
        let queues = [(1, "nothing waits".to_owned())];
        let next =
            progress.line(begin + 2 * PERIOD, [way(950, 950, 100), way(0, 0, 0)], "number 960", &queues);
        assert!(next.contains("950 sent (10 a second"), "{next}");
        assert!(next.ends_with("\n  node 1: nothing waits"), "{next}");
    }
}
