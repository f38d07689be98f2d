//! What a run says while it goes on: how far it is, and what stands in which queue, so that whoever looks on can tell a loaded machine from a
//! link that stalls.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use super::trouble::Trouble;

/// From one word to the next, at least.
const PERIOD: Duration = Duration::from_secs(10);

/// One way of the link.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Way {
    /// Messages of class Bulk that were sent on it so far, by the sender's present life.
    pub(super) sent: u64,
    /// The last of them that came.
    pub(super) got: u64,
    /// Messages a second of all classes that are to be sent on it.
    pub(super) rate: u64,
}

/// How far a run is.
#[derive(Debug)]
pub(super) struct Progress {
    began: Instant,
    said: Instant,
    before: [Way; 2],
    faults: u64,
    fault: u64,
    trouble: Option<Trouble>,
}

impl Progress {
    /// A run begins that has so many faults.
    pub(super) fn begin(faults: u64) -> Self {
        let now = Instant::now();
        Self { began: now, said: now, before: [Way::default(); 2], faults, fault: 0, trouble: None }
    }

    /// The next fault strikes.
    pub(super) const fn strikes(&mut self, trouble: Trouble) {
        self.fault += 1;
        self.trouble = Some(trouble);
    }

    /// Whether it is time to say how far the run is.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now.duration_since(self.said) >= PERIOD
    }

    /// How far the run is: what went the two ways, for what it waits, and what stands in which queue of which node, as the nodes say.
    pub(super) fn say(
        &mut self,
        now: Instant,
        ways: [Way; 2],
        waits_for: &str,
        queues: &[(u16, String)],
    ) -> String {
        let seconds = now.duration_since(self.said).as_secs_f64();
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
            // A new life counts from 1.
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
        (self.said, self.before) = (now, ways);
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_says_how_far_it_is_once_in_a_period_and_how_fast_it_went_since_the_last_word() {
        let mut progress = Progress::begin(1_000);
        let begin = progress.began;
        progress.strikes(Trouble::Cut);
        assert!(!progress.is_due(begin) && progress.is_due(begin + PERIOD));
        let way = |sent, got, rate| Way { sent, got, rate };
        let first = progress.say(begin + PERIOD, [way(850, 800, 100), way(0, 0, 0)], "number 860", &[]);
        assert_eq!(
            first,
            "after 10 s: fault 1 of 1000 (cut); there Bulk 850 sent (85 a second; 100 of all classes are asked for), 800 delivered (80 a \
             second); waits for number 860"
        );
        assert!(!progress.is_due(begin + PERIOD));
        let queues = [(1, "nothing waits".to_owned())];
        let next =
            progress.say(begin + 2 * PERIOD, [way(950, 950, 100), way(0, 0, 0)], "number 960", &queues);
        assert!(next.contains("950 sent (10 a second"), "{next}");
        assert!(next.ends_with("\n  node 1: nothing waits"), "{next}");
    }
}
