//! Whether datagrams get through to a peer, and when that is to be tried.
//!
//! ```text
//!  Unknown ── announced ──► Trying ── answered ──► Open ── silent for 500 ms ──► Trying
//! ```
//!
//! As long as it is not open, values go by the connection. spec: DATAGRAM-5

use std::time::Duration;

use sinew_runtime::time::Time;

/// As long as nothing at all is acknowledged of what was sent, until the datagrams count as lost. By then the last value was repeated
/// seven times: where every second datagram is lost, one silence in seven is an error, and mended by the next probe.
pub(super) const SILENCE: Duration = Duration::from_millis(500);
/// Wait between the first two probes; doubles.
const PROBE_MIN: Duration = Duration::from_millis(20);
/// Longest wait between two probes.
const PROBE_MAX: Duration = Duration::from_secs(10);
/// The peer has spoken on the connection so long after a probe that it has not answered: it lives, and datagrams do not get through.
const ANSWERED_WITHIN: Duration = Duration::from_millis(500);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// The peer has not said where it reads datagrams.
    Unknown,
    /// Probes are sent, at `next` again.
    Trying { probed: Option<Time>, next: Time, wait: Duration },
    /// `unanswered`: when the first datagram was sent since something was acknowledged last.
    Open { unanswered: Option<Time> },
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Nothing,
    /// Ask the peer for an answer.
    Probe,
    /// Nothing was acknowledged for too long: what is not known to have arrived goes by the connection.
    GoBack,
}

/// The way of datagrams to a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Path {
    state: State,
    has_warned: bool,
}

impl Path {
    pub(super) const fn new() -> Self {
        Self { state: State::Unknown, has_warned: false }
    }

    pub(super) const fn is_open(&self) -> bool {
        matches!(self.state, State::Open { .. })
    }

    /// The peer reads datagrams somewhere else than was known: it is tried at once.
    pub(super) const fn announced(&mut self, now: Time) {
        self.state = State::Trying { probed: None, next: now, wait: PROBE_MIN };
    }

    /// There is a new connection to where datagrams go already: if they did not get through, it is tried at once.
    pub(super) const fn reconnected(&mut self, now: Time) {
        if matches!(self.state, State::Trying { .. }) {
            self.announced(now);
        }
    }

    /// The peer does not read datagrams any more.
    pub(super) const fn over(&mut self) {
        self.state = State::Unknown;
    }

    /// The peer has answered one. Returns whether datagrams are used from now on, and were not before.
    pub(super) const fn answered(&mut self) -> bool {
        match self.state {
            State::Unknown => false,
            State::Trying { .. } => {
                self.state = State::Open { unanswered: None };
                true
            }
            State::Open { .. } => {
                self.state = State::Open { unanswered: None };
                false
            }
        }
    }

    /// A datagram was sent that is to be acknowledged.
    pub(super) const fn sent(&mut self, now: Time) {
        if let State::Open { unanswered: unanswered @ None } = &mut self.state {
            *unanswered = Some(now);
        }
    }

    /// Time has passed.
    pub(super) fn tick(&mut self, now: Time) -> Step {
        match &mut self.state {
            State::Open { unanswered: Some(since) } if now.since(*since) >= SILENCE => {
                self.announced(now);
                Step::GoBack
            }
            State::Trying { probed, next, wait } if *next <= now => {
                *probed = Some(now);
                *next = now + *wait;
                *wait = (*wait * 2).min(PROBE_MAX);
                Step::Probe
            }
            State::Unknown | State::Trying { .. } | State::Open { .. } => Step::Nothing,
        }
    }

    /// Whether it is to be said, once, that datagrams do not get through though the peer lives: it spoke on the connection at `heard`. To be
    /// asked before each [`tick`](Self::tick).
    pub(super) fn is_to_warn(&mut self, now: Time, heard: Time) -> bool {
        let State::Trying { probed: Some(probed), next, .. } = self.state else { return false };
        let is_blocked = next <= now && heard >= probed + ANSWERED_WITHIN;
        is_blocked && !std::mem::replace(&mut self.has_warned, true)
    }

    pub(super) fn next_wake(&self) -> Option<Time> {
        match self.state {
            State::Unknown | State::Open { unanswered: None } => None,
            State::Trying { next, .. } => Some(next),
            State::Open { unanswered: Some(since) } => Some(since + SILENCE),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_millis(1_000 + millis)
    }

    /// When it is probed up to `until`, and whether it is warned; the peer speaks on the connection all the while if `speaks`.
    fn probes(path: &mut Path, until: u64, speaks: bool) -> (Vec<u64>, usize) {
        let (mut probes, mut warnings) = (Vec::new(), 0);
        for now in 0..until {
            warnings += usize::from(path.is_to_warn(at(now), if speaks { at(now) } else { Time::ZERO }));
            if path.tick(at(now)) == Step::Probe {
                probes.push(now);
            }
        }
        (probes, warnings)
    }

    #[test]
    fn a_path_is_tried_at_once_and_then_less_and_less_often_and_used_when_it_answers() {
        let mut path = Path::new();
        assert!(probes(&mut path, 100, true).0.is_empty());
        path.announced(at(0));
        assert_eq!(probes(&mut path, 700, true).0, [0, 20, 60, 140, 300, 620]);
        assert!(!path.is_open());
        assert!(path.answered());
        assert!(path.is_open() && !path.answered());
        assert_eq!(path.next_wake(), None);
    }

    #[test]
    fn silence_closes_it_and_an_answer_to_anything_puts_that_off() {
        let mut path = Path::new();
        path.announced(at(0));
        path.answered();
        path.sent(at(0));
        path.sent(at(400));
        assert_eq!(path.next_wake(), Some(at(500)));
        path.answered();
        assert_eq!(path.tick(at(600)), Step::Nothing);
        path.sent(at(600));
        assert_eq!((path.tick(at(1_099)), path.tick(at(1_100))), (Step::Nothing, Step::GoBack));
        assert!(!path.is_open());
        assert_eq!(path.tick(at(1_100)), Step::Probe, "it is tried again at once");
    }

    #[test]
    fn a_warning_comes_once_and_only_for_a_peer_that_lives() {
        let mut path = Path::new();
        path.announced(at(0));
        assert_eq!(probes(&mut path, 30_000, false).1, 0, "it is frozen: nothing is known of the network");
        let mut path = Path::new();
        path.announced(at(0));
        assert_eq!(probes(&mut path, 30_000, true).1, 1);
        path.announced(at(0));
        assert_eq!(probes(&mut path, 30_000, true).1, 0);
    }
}
