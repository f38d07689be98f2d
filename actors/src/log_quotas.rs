//! Lines in the log that others cause by what they may do: connect, come and go. Many at once, one a second in the long run.

use std::{sync::Mutex, time::Duration};

use sinew_runtime::time::Time;

use crate::stores::lock;

/// Lines of one sort at once: more than a robot of many nodes has when it starts.
const AT_ONCE: u32 = 256;
/// Time in which one more may be written.
const EACH: Duration = Duration::from_secs(1);

/// How many lines may be written, for each sort.
#[derive(Debug, Default)]
pub(crate) struct LogQuotas {
    /// Links that stand, or are down.
    pub(crate) links: Quota,
    /// Nodes that are there, or are lost.
    pub(crate) members: Quota,
    /// Applications of other processes that register, and that go.
    pub(crate) clients: Quota,
    /// Peers that are taken though the times of their certificates do not hold.
    pub(crate) times: Quota,
}

/// How many lines of one sort may be written.
#[derive(Debug)]
pub(crate) struct Quota(Mutex<State>);

#[derive(Debug)]
struct State {
    left: u32,
    /// When `left` was as it is.
    at: Time,
    suppressed: u64,
}

impl Default for Quota {
    fn default() -> Self {
        Self(Mutex::new(State { left: AT_ONCE, at: Time::ZERO, suppressed: 0 }))
    }
}

impl Quota {
    /// Whether one more may be written at `now`: then how many were not, since the last one. `None`: it may not, and is counted.
    pub(crate) fn take(&self, now: Time) -> Option<u64> {
        let mut state = lock(&self.0);
        let more = now.since(state.at).as_secs() / EACH.as_secs();
        let room = u64::from(AT_ONCE - state.left);
        if more >= room {
            (state.left, state.at) = (AT_ONCE, now);
        } else {
            state.left += u32::try_from(more).unwrap_or(AT_ONCE);
            state.at = state.at + EACH * u32::try_from(more).unwrap_or(AT_ONCE);
        }
        match state.left.checked_sub(1) {
            Some(left) => {
                state.left = left;
                Some(std::mem::take(&mut state.suppressed))
            }
            None => {
                state.suppressed += 1;
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1_000) + Duration::from_millis(millis)
    }

    #[test]
    fn many_lines_at_once_and_then_one_a_second_with_how_many_were_left_out() {
        let quota = Quota::default();
        for _ in 0..AT_ONCE {
            assert_eq!(quota.take(at(0)), Some(0));
        }
        assert_eq!([quota.take(at(0)), quota.take(at(999))], [None, None]);
        assert_eq!(
            [quota.take(at(1_000)), quota.take(at(1_001)), quota.take(at(2_500))],
            [Some(2), None, Some(1)]
        );
        // What was begun of a second counts.
        assert_eq!([quota.take(at(2_999)), quota.take(at(3_000))], [None, Some(1)]);
        // After a quiet time as many as at first.
        let later = (0..300).filter(|_| quota.take(at(1_000_000)).is_some()).count();
        assert_eq!(later, usize::try_from(AT_ONCE).unwrap_or_default());
    }
}
