//! Which lengths of datagrams arrive at a peer. RFC 8899, with the probes of its section 4.3 and the
//! detection of black holes of section 4.4.
//!
//! A length is used only after a datagram at least as long was acknowledged. Lengths that stop being
//! acknowledged while shorter datagrams are acknowledged are not used any more, and are probed again later.
//!
//! ```text
//!  Top ── longest arrives ──► Complete
//!   └── it does not ──► Search ── the edge is known to 16 bytes ──► Settled ── 1 s, up to 10 s ──► TopAgain ──► Edge ──► Settled
//! ```

use std::{collections::VecDeque, time::Duration};

use sinew_runtime::time::Time;

use super::packet::{DATAGRAM_MAX, Range};

/// Length of the shortest probe. An acknowledgement alone is no longer, until longer datagrams are known to arrive.
pub const SHORTEST: usize = 140;
/// Maximum number of probes of a length before it counts as not arriving.
const TRIES: u32 = 3;
/// Same as [`TRIES`], for the first probes of the longest length: a wrong result there costs connections.
const TRIES_AT_FIRST: u32 = 5;
/// Precision of the search for the longest arriving length, in bytes.
const GRAIN: usize = 16;
/// Number of lost datagrams, with a shorter one that arrived meanwhile, after which these lengths count as
/// not arriving any more.
const LOSSES_MAX: usize = 4;
/// Number of losses after which the shortest probe is sent, to get a shorter datagram that arrives.
const LOSSES_ASKED: usize = 2;
/// Time after which a lost length is probed. Until one as long arrives, values carry no acknowledgement,
/// because that would make them longer; each acknowledgement is then a datagram of its own.
const RECHECK: Duration = Duration::from_secs(1);
/// Shortest wait for the answer to a probe.
const ANSWER_MIN: Duration = Duration::from_millis(20);
/// First delay before longer lengths are tried again; it doubles.
const AGAIN_MIN: Duration = Duration::from_secs(1);
/// Longest such delay.
const AGAIN_MAX: Duration = Duration::from_secs(10);
/// Shortest time between two reports of the same path.
const REPORT_PERIOD: Duration = Duration::from_secs(60);
/// Maximum number of unanswered probes that are kept.
const PROBES_MAX: usize = 16;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// Nothing is known yet, or the longest length arrives.
    Rest,
    /// The longest length is being tried.
    Top,
    /// The edge is being searched.
    Search,
    /// The edge is known.
    Settled { again: Time },
    /// The longest length is being tried again.
    TopAgain,
    /// The shortest length that did not arrive is being tried again.
    Edge,
}

/// A length that is being tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Trial {
    length: usize,
    tries: u32,
    next: Time,
    /// Whether a shorter datagram was acknowledged since the first try.
    has_witness: bool,
}

/// A change that is worth a log line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Report {
    /// Datagrams up to this length arrive, longer ones do not.
    Narrow(usize),
    /// The longest datagrams arrive again.
    Full,
}

/// The lengths of datagrams that arrive at a peer.
#[derive(Clone, Debug)]
pub(super) struct Lengths {
    /// The longest acknowledged length; 0: none.
    passes: usize,
    /// The shortest length that was not acknowledged.
    fails: usize,
    stage: Stage,
    trial: Option<Trial>,
    /// Lengths to probe now.
    orders: VecDeque<usize>,
    /// Unanswered probes: number and length.
    unanswered: VecDeque<(u64, usize)>,
    /// Lengths of lost datagrams that are longer than all that arrived since.
    lost: Vec<usize>,
    /// When the longest of these is probed, if no datagram as long arrives before.
    recheck: Time,
    /// The longest length that arrived since the first of these was lost; 0: none.
    arrived: usize,
    again_after: Duration,
    /// How often the edge was found again.
    confirmations: u32,
    reported: Option<usize>,
    report_next: Time,
    report: Option<Report>,
    #[cfg(feature = "testing")]
    pub(super) planted: Option<super::Fault>,
}

impl Lengths {
    pub(super) const fn new() -> Self {
        Self {
            passes: 0,
            fails: DATAGRAM_MAX + 1,
            stage: Stage::Rest,
            trial: None,
            orders: VecDeque::new(),
            unanswered: VecDeque::new(),
            lost: Vec::new(),
            recheck: Time::ZERO,
            arrived: 0,
            again_after: AGAIN_MIN,
            confirmations: 0,
            reported: None,
            report_next: Time::ZERO,
            report: None,
            #[cfg(feature = "testing")]
            planted: None,
        }
    }

    /// Resets the state for another path; only the last report is kept.
    pub(super) fn reset(&mut self) {
        (self.passes, self.fails) = (0, DATAGRAM_MAX + 1);
        (self.stage, self.trial) = (Stage::Rest, None);
        self.orders.clear();
        self.unanswered.clear();
        self.lost.clear();
        (self.again_after, self.confirmations) = (AGAIN_MIN, 0);
    }

    /// Returns the longest datagram that may carry a value; 0: none.
    pub(super) const fn limit(&self) -> usize {
        self.passes
    }

    /// Returns the longest datagram that an acknowledgement may form.
    pub(super) const fn room(&self) -> usize {
        if self.passes == 0 || !self.lost.is_empty() { SHORTEST } else { self.passes }
    }

    /// Returns the longest arriving length, if longer ones are known not to arrive.
    pub(super) const fn narrow(&self) -> Option<usize> {
        match self.stage {
            Stage::Settled { .. } | Stage::TopAgain | Stage::Edge => Some(self.passes),
            Stage::Rest | Stage::Top | Stage::Search => None,
        }
    }

    /// Whether all lengths arrive.
    pub(super) const fn is_full(&self) -> bool {
        self.passes == DATAGRAM_MAX
    }

    /// Orders probes of the longest and the shortest length, because it is unknown whether the path is open.
    pub(super) fn probe_both(&mut self) {
        self.orders.clear();
        self.orders.extend([DATAGRAM_MAX, SHORTEST]);
    }

    /// Returns the length of a probe to send now; the caller calls [`probed`](Self::probed) next.
    pub(super) fn order(&mut self) -> Option<usize> {
        self.orders.pop_front()
    }

    /// Records a sent probe.
    pub(super) fn probed(&mut self, number: u64, length: usize) {
        if self.unanswered.len() >= PROBES_MAX {
            self.unanswered.pop_front();
        }
        self.unanswered.push_back((number, length));
    }

    /// Returns the longest probe that these ranges acknowledge; 0: none.
    pub(super) fn answered(&mut self, ranges: &[Range]) -> usize {
        let mut longest = 0;
        self.unanswered.retain(|(number, length)| {
            let is_answered = ranges.iter().any(|range| range.has(*number));
            longest = longest.max(if is_answered { *length } else { 0 });
            !is_answered
        });
        longest
    }

    /// Records that a datagram of at least this length was acknowledged. spec: DATAGRAM-7
    pub(super) fn arrived(&mut self, now: Time, length: usize) {
        #[cfg(feature = "testing")]
        let length =
            if self.planted == Some(super::Fault::AllLengthsTrusted) { DATAGRAM_MAX } else { length };
        self.lost.retain(|lost| *lost > length);
        self.arrived = if self.lost.is_empty() { 0 } else { self.arrived.max(length) };
        if self.judge(now) {
            return;
        }
        self.passes = self.passes.max(length);
        if self.fails <= self.passes {
            // The length arrives after all, and nothing is known of longer ones.
            self.fails = DATAGRAM_MAX + 1;
            self.stage = if self.stage == Stage::Edge { Stage::Search } else { Stage::Top };
            // The longest length has just been tried.
            self.fails -= usize::from(self.stage == Stage::Search);
            (self.trial, self.confirmations, self.again_after) = (None, 0, AGAIN_MIN);
        }
        if self.passes == DATAGRAM_MAX {
            (self.stage, self.trial) = (Stage::Rest, None);
            (self.again_after, self.confirmations) = (AGAIN_MIN, 0);
            if self.reported.take().is_some() {
                self.report = Some(Report::Full);
            }
            return;
        }
        match &mut self.trial {
            Some(trial) if trial.length > length => trial.has_witness = true,
            Some(_) | None => {
                if self.stage == Stage::Rest {
                    self.stage = Stage::Top;
                }
                self.begin_trial(now);
            }
        }
    }

    /// Records a lost datagram of this length.
    pub(super) fn lost(&mut self, now: Time, length: usize) {
        if length > self.passes || length <= SHORTEST {
            return;
        }
        if self.lost.is_empty() {
            self.recheck = now + RECHECK;
        }
        if self.lost.len() < LOSSES_MAX {
            self.lost.push(length);
        }
        if self.lost.len() >= LOSSES_ASKED && self.arrived == 0 && self.orders.is_empty() {
            self.orders.push_back(SHORTEST);
        }
        self.judge(now);
    }

    /// Stops using lengths that do not arrive while shorter ones do. Returns whether there was one. spec: DATAGRAM-7
    fn judge(&mut self, now: Time) -> bool {
        if self.lost.len() < LOSSES_MAX || self.arrived == 0 {
            return false;
        }
        self.fails = self.lost.iter().copied().min().unwrap_or(self.fails);
        self.passes = self.arrived.min(self.fails - 1);
        self.lost.clear();
        self.arrived = 0;
        (self.stage, self.trial) = (Stage::Top, None);
        (self.again_after, self.confirmations) = (AGAIN_MIN, 0);
        self.begin_trial(now);
        true
    }

    /// Starts to try the next length, or settles.
    fn begin_trial(&mut self, now: Time) {
        let length = match self.stage {
            Stage::Rest | Stage::Settled { .. } => return,
            Stage::Top | Stage::TopAgain => DATAGRAM_MAX,
            Stage::Edge if self.fails < DATAGRAM_MAX => self.fails,
            Stage::Edge => return self.settle(now),
            Stage::Search if self.fails - self.passes <= GRAIN => return self.settle(now),
            Stage::Search => self.passes.midpoint(self.fails),
        };
        self.trial = Some(Trial { length, tries: 0, next: now, has_witness: false });
    }

    fn settle(&mut self, now: Time) {
        self.confirmations += u32::from(self.stage == Stage::Edge);
        self.trial = None;
        self.stage = Stage::Settled { again: now + self.again_after };
        self.again_after = (self.again_after * 2).min(AGAIN_MAX);
        let is_new = self.reported.is_none_or(|before| before.abs_diff(self.passes) > 2 * GRAIN);
        if self.confirmations > 0 && is_new && self.report_next <= now {
            (self.reported, self.report_next) = (Some(self.passes), now + REPORT_PERIOD);
            self.report = Some(Report::Narrow(self.passes));
        }
    }

    /// Records another connection to the same datagram address: longer lengths are tried again at once.
    pub(super) const fn reconnected(&mut self, now: Time) {
        if let Stage::Settled { again } = &mut self.stage {
            *again = now;
            self.again_after = AGAIN_MIN;
        }
    }

    /// Handles the passing of time while datagrams get through; `time_out` is the time after which a datagram
    /// counts as lost.
    pub(super) fn tick(&mut self, now: Time, time_out: Duration) {
        if let Some(length) = self.lost.iter().copied().max().filter(|_| self.recheck <= now) {
            self.recheck = now + RECHECK;
            self.orders.push_back(length);
        }
        if matches!(self.stage, Stage::Settled { again } if again <= now) {
            self.stage = Stage::TopAgain;
            self.begin_trial(now);
        }
        let Some(trial) = self.trial.as_mut().filter(|trial| trial.next <= now) else { return };
        let tries = if self.stage == Stage::Top { TRIES_AT_FIRST } else { TRIES };
        if trial.tries < tries {
            trial.tries += 1;
            trial.next = now + (time_out * 2).max(ANSWER_MIN);
            let is_last = trial.tries == tries;
            self.orders.push_back(trial.length);
            if is_last && !trial.has_witness {
                self.orders.push_back(SHORTEST);
            }
        } else if trial.has_witness {
            self.trial_failed(now);
        } else {
            // Nothing at all was acknowledged meanwhile, so the result is not about this length.
            trial.tries = 0;
        }
    }

    fn trial_failed(&mut self, now: Time) {
        let Some(trial) = self.trial.take() else { return };
        self.fails = self.fails.min(trial.length);
        self.stage = match self.stage {
            Stage::Top | Stage::Search => Stage::Search,
            Stage::TopAgain => Stage::Edge,
            // The edge is settled below this length.
            Stage::Edge => return self.settle(now),
            stays @ (Stage::Rest | Stage::Settled { .. }) => stays,
        };
        self.begin_trial(now);
    }

    /// Returns the change to log, once.
    pub(super) const fn report(&mut self) -> Option<Report> {
        self.report.take()
    }

    /// Returns when to call [`tick`](Self::tick), if nothing happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let again = if let Stage::Settled { again } = self.stage { Some(again) } else { None };
        let next = self.trial.map(|trial| trial.next);
        let order = (!self.orders.is_empty()).then_some(Time::ZERO);
        let recheck = (!self.lost.is_empty()).then_some(self.recheck);
        [again, next, order, recheck].into_iter().flatten().min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIME_OUT: Duration = Duration::from_millis(4);

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_millis(1_000 + millis)
    }

    /// Simulates a path on which datagrams up to `longest` arrive at once, for this many milliseconds. Returns the
    /// reports.
    fn pass(lengths: &mut Lengths, from: u64, millis: u64, longest: usize) -> Vec<Report> {
        let mut reports = Vec::new();
        for now in from..from + millis {
            lengths.tick(at(now), TIME_OUT);
            let mut longest_answered = 0;
            while let Some(length) = lengths.order() {
                longest_answered = longest_answered.max(if length <= longest { length } else { 0 });
            }
            if longest_answered > 0 {
                lengths.arrived(at(now), longest_answered);
            }
            reports.extend(lengths.report());
        }
        reports
    }

    // spec: DATAGRAM-7
    #[test]
    fn longest_arriving_length_is_found_and_reported_once() {
        for hole in [200, 472, 944, 972, 1_150, 1_199] {
            let mut lengths = Lengths::new();
            lengths.probe_both();
            let reports = pass(&mut lengths, 0, 20_000, hole);
            assert!(lengths.limit() <= hole && lengths.limit() + GRAIN >= hole, "{hole}: {lengths:?}");
            assert_eq!(reports, [Report::Narrow(lengths.limit())]);
            assert_eq!(lengths.narrow(), Some(lengths.limit()));
        }
    }

    #[test]
    fn unlimited_path_is_known_by_the_first_probe() {
        let mut lengths = Lengths::new();
        lengths.probe_both();
        assert_eq!(lengths.limit(), 0, "nothing was measured");
        assert_eq!(pass(&mut lengths, 0, 1, DATAGRAM_MAX), []);
        assert_eq!((lengths.limit(), lengths.next_wake(), lengths.narrow()), (DATAGRAM_MAX, None, None));
    }

    // spec: DATAGRAM-7
    #[test]
    fn vanishing_lengths_are_left_after_four_losses() {
        let mut lengths = Lengths::new();
        lengths.probe_both();
        pass(&mut lengths, 0, 1, DATAGRAM_MAX);
        (0..LOSSES_MAX).for_each(|_| lengths.lost(at(10), 1_100));
        assert_eq!(lengths.limit(), DATAGRAM_MAX, "perhaps nothing arrives at all");
        assert_eq!(lengths.order(), Some(SHORTEST));
        lengths.arrived(at(11), SHORTEST);
        assert_eq!(lengths.limit(), SHORTEST);
        assert_eq!(pass(&mut lengths, 12, 3_000, 972).len(), 1);
        assert!(lengths.limit() <= 972 && lengths.limit() + GRAIN >= 972, "{lengths:?}");
        assert_eq!(pass(&mut lengths, 3_012, 11_000, DATAGRAM_MAX), [Report::Full]);
        assert_eq!(lengths.limit(), DATAGRAM_MAX);
    }

    #[test]
    fn loss_before_an_equally_long_datagram_is_no_evidence() {
        let mut lengths = Lengths::new();
        lengths.probe_both();
        pass(&mut lengths, 0, 1, DATAGRAM_MAX);
        for now in 10..100 {
            (1..LOSSES_MAX).for_each(|_| lengths.lost(at(now), 1_100));
            lengths.arrived(at(now), 200);
            lengths.arrived(at(now), 1_100);
        }
        assert_eq!((lengths.limit(), lengths.room()), (DATAGRAM_MAX, DATAGRAM_MAX));
    }

    #[test]
    fn lost_length_is_probed_and_reused_if_it_arrives() {
        let mut lengths = Lengths::new();
        lengths.probe_both();
        pass(&mut lengths, 0, 1, DATAGRAM_MAX);
        lengths.lost(at(10), 300);
        lengths.arrived(at(11), 200);
        assert_eq!((lengths.room(), lengths.next_wake()), (SHORTEST, Some(at(1_010))));
        pass(&mut lengths, 1_010, 1, 250);
        assert_eq!((lengths.room(), lengths.next_wake()), (SHORTEST, Some(at(2_010))));
        pass(&mut lengths, 2_010, 1, DATAGRAM_MAX);
        assert_eq!((lengths.room(), lengths.next_wake()), (DATAGRAM_MAX, None));
    }

    #[test]
    fn no_length_is_blamed_without_any_acknowledgement() {
        let mut lengths = Lengths::new();
        lengths.probe_both();
        pass(&mut lengths, 0, 1, SHORTEST);
        pass(&mut lengths, 1, 2_000, 0);
        assert_eq!((lengths.fails, lengths.narrow()), (DATAGRAM_MAX + 1, None));
    }

    #[test]
    fn slightly_longer_path_is_found_again() {
        let mut lengths = Lengths::new();
        lengths.probe_both();
        pass(&mut lengths, 0, 3_000, 600);
        pass(&mut lengths, 3_000, 12_000, 1_000);
        assert!(lengths.limit() <= 1_000 && lengths.limit() + GRAIN >= 1_000, "{lengths:?}");
    }
}
