//! Whether datagrams get through to a peer, and when to probe that.
//!
//! ```text
//!  Unknown ── announced ──► Trying ── answered ──► Open ── silent for 500 ms ──► Trying
//! ```
//!
//! While the path is not open, values are sent over the connection. spec: DATAGRAM-5

use std::time::Duration;

use sinew_runtime::time::Time;

/// Time without any acknowledgement of sent datagrams after which the path counts as closed. By then the last
/// value was repeated seven times. If every second datagram is lost, one silence in seven is a false alarm,
/// and the next probe corrects it.
pub(super) const SILENCE: Duration = Duration::from_millis(500);
/// Delay between the first two probes; it doubles.
const PROBE_MIN: Duration = Duration::from_millis(20);
/// Longest delay between two probes.
const PROBE_MAX: Duration = Duration::from_secs(10);
/// Time after an unanswered probe. If the peer sends on the connection later than this, it is alive and
/// datagrams do not get through.
const ANSWERED_WITHIN: Duration = Duration::from_millis(500);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// The peer has not announced where it reads datagrams.
    Unknown,
    /// Probes are sent, the next one at `next`.
    Trying { probed: Option<Time>, next: Time, wait: Duration },
    /// `unanswered`: time of the first datagram sent since the last acknowledgement.
    Open { unanswered: Option<Time> },
}

/// The action that is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Nothing,
    /// Send a probe to the peer.
    Probe,
    /// Nothing was acknowledged for too long: unacknowledged values are sent over the connection.
    FallBack,
}

/// The datagram path to a peer.
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

    /// Records a new datagram address of the peer: it is probed at once.
    pub(super) const fn announced(&mut self, now: Time) {
        self.state = State::Trying { probed: None, next: now, wait: PROBE_MIN };
    }

    /// Records a new connection to a peer with the same datagram address: if datagrams did not get through,
    /// it is probed at once.
    pub(super) const fn reconnected(&mut self, now: Time) {
        if matches!(self.state, State::Trying { .. }) {
            self.announced(now);
        }
    }

    /// Records that the peer does not read datagrams any more.
    pub(super) const fn over(&mut self) {
        self.state = State::Unknown;
    }

    /// Records an acknowledgement. Returns whether this opens the path, which was closed before.
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

    /// Records a sent datagram that must be acknowledged.
    pub(super) const fn sent(&mut self, now: Time) {
        if let State::Open { unanswered: unanswered @ None } = &mut self.state {
            *unanswered = Some(now);
        }
    }

    /// Returns the action that is due at `now`.
    pub(super) fn tick(&mut self, now: Time) -> Step {
        match &mut self.state {
            State::Open { unanswered: Some(since) } if now.since(*since) >= SILENCE => {
                self.announced(now);
                Step::FallBack
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

    /// Returns, once, whether to warn that datagrams do not get through though the peer is alive. The peer
    /// sent its last frame on the connection at `received_at`. Must be called before each [`tick`](Self::tick).
    pub(super) fn is_to_warn(&mut self, now: Time, received_at: Time) -> bool {
        let State::Trying { probed: Some(probed), next, .. } = self.state else { return false };
        let is_blocked = next <= now && received_at >= probed + ANSWERED_WITHIN;
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

    /// Returns the times of its probes up to `until`, and the number of warnings; if `speaks`, the peer sends on the
    /// connection all the while.
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
    fn path_is_probed_ever_less_and_used_when_answered() {
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
    fn silence_closes_the_path_and_any_answer_delays_that() {
        let mut path = Path::new();
        path.announced(at(0));
        path.answered();
        path.sent(at(0));
        path.sent(at(400));
        assert_eq!(path.next_wake(), Some(at(500)));
        path.answered();
        assert_eq!(path.tick(at(600)), Step::Nothing);
        path.sent(at(600));
        assert_eq!((path.tick(at(1_099)), path.tick(at(1_100))), (Step::Nothing, Step::FallBack));
        assert!(!path.is_open());
        assert_eq!(path.tick(at(1_100)), Step::Probe, "it is tried again at once");
    }

    #[test]
    fn blocked_path_of_a_living_peer_is_logged_once() {
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
