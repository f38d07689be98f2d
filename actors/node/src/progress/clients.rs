//! Detects clients that do not read their queued messages. Pure: the observations and their times are parameters.
//!
//! A client (`NodeApi`) has no turns that this node observes. The node observes whether application messages
//! are queued for it, and whether it reads anything. A client without queued messages is alive, however long
//! it is silent. spec: NDL-9.1

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;
use sinew_session::{book::ClientId, outlet::Taking};

/// Time without reading after which a client is reported. A `NodeApi` reads up to 64 records, or 64 KiB, of
/// its ring at once, and its next read is visible only after it has handled them. A socket counts as writable
/// when three quarters of it are free. So a slow but living client has this long for that.
const IDLE_AFTER: Duration = Duration::from_secs(1);
/// Maximum pause between two checks, in usual intervals. After a longer pause no client is newly reported for
/// the time before it: the host or this process was stopped, and possibly the clients too. A client reported
/// before, and still not reading, remains reported.
const CHECKS_MISSED_MAX: u32 = 3;

/// The observations of each client at the last check, for the clients that existed then.
#[derive(Default)]
pub(crate) struct IdleClients {
    seen: BTreeMap<ClientId, Seen>,
    last_check: Option<Time>,
}

struct Seen {
    mark: (u64, u64),
    /// Minimum start of the time in which a message is queued and the client has read nothing.
    since: Option<Time>,
}

impl IdleClients {
    /// Returns the clients that have not read their queued messages for too long, and since when at least.
    /// Called once per `every`; the observations are kept until the next call.
    pub(crate) fn check(
        &mut self,
        now: Time,
        every: Duration,
        clients: impl IntoIterator<Item = (ClientId, Taking)>,
    ) -> BTreeMap<ClientId, Time> {
        let before = std::mem::take(&mut self.seen);
        let last = self.last_check.replace(now);
        let was_reported = |seen: &Seen| last.is_some_and(|last| seen.idle_since(last).is_some());
        let is_late = last.is_some_and(|last| now.since(last) > every * CHECKS_MISSED_MAX);
        let known = |id: &ClientId| before.get(id).filter(|seen| !is_late || was_reported(seen));
        self.seen = clients.into_iter().map(|(id, taking)| (id, Seen::of(now, taking, known(&id)))).collect();
        self.seen.iter().filter_map(|(id, seen)| Some((*id, seen.idle_since(now)?))).collect()
    }
}

impl Seen {
    fn of(now: Time, taking: Taking, known: Option<&Self>) -> Self {
        let Taking { mark, leaves_some } = taking;
        let unmoved = known.filter(|known| known.mark == mark).and_then(|known| known.since);
        Self { mark, since: leaves_some.then(|| unmoved.unwrap_or(now)) }
    }

    /// Returns since when the client has not read, if that is too long at this check.
    fn idle_since(&self, now: Time) -> Option<Time> {
        self.since.filter(|since| now.since(*since) >= IDLE_AFTER)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KNEE: ClientId = ClientId(7);
    const HIP: ClientId = ClientId(8);
    const EVERY: Duration = Duration::from_millis(500);

    fn at(ms: u64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    const fn taking(taken: u64, leaves_some: bool) -> Taking {
        Taking { mark: (taken, 0), leaves_some }
    }

    /// Checks one client with the progress `taken`.
    fn check(clients: &mut IdleClients, ms: u64, taken: u64, leaves_some: bool) -> Option<Time> {
        clients.check(at(ms), EVERY, [(KNEE, taking(taken, leaves_some))]).remove(&KNEE)
    }

    // spec: NDL-9.1
    #[test]
    fn stuck_client_is_reported_until_it_reads() {
        let mut clients = IdleClients::default();
        assert_eq!(check(&mut clients, 1_000, 96, true), None, "it may have come just now");
        assert_eq!(check(&mut clients, 1_999, 96, true), None);
        assert_eq!(check(&mut clients, 2_000, 96, true), Some(at(1_000)));
        assert_eq!(check(&mut clients, 3_000, 96, true), Some(at(1_000)));
        assert_eq!(check(&mut clients, 3_100, 97, true), None, "it has taken some");
        assert_eq!(check(&mut clients, 4_100, 97, true), Some(at(3_100)));
        assert_eq!(check(&mut clients, 4_200, 40_000, false), None);
    }

    #[test]
    fn idle_client_without_messages_is_healthy() {
        let mut clients = IdleClients::default();
        for ms in (0..100_000).step_by(500) {
            assert_eq!(check(&mut clients, ms, 96, false), None);
        }
        assert_eq!(
            check(&mut clients, 100_400, 96, true),
            None,
            "the waiting messages arrived after the last check"
        );
    }

    #[test]
    fn client_reading_at_each_check_is_healthy() {
        let mut clients = IdleClients::default();
        for number in 0..100 {
            let idle = check(&mut clients, number * 1_000, number, true);
            assert_eq!(idle, None, "at check {number}");
        }
    }

    #[test]
    fn paused_checks_report_no_new_stall_from_before() {
        let mut clients = IdleClients::default();
        assert_eq!(check(&mut clients, 500, 96, true), None);
        assert_eq!(check(&mut clients, 60_500, 96, true), None, "the client may have stood still as long");
        assert_eq!(check(&mut clients, 61_000, 96, true), None);
        assert_eq!(check(&mut clients, 61_500, 96, true), Some(at(60_500)));
        // When: another client leaves messages unread a moment before a pause.
        let both = [(KNEE, taking(96, true)), (HIP, taking(5, true))];
        assert_eq!(clients.check(at(62_000), EVERY, both).get(&HIP), None);
        assert_eq!(
            clients.check(at(63_500), EVERY, both).get(&HIP),
            Some(&at(62_000)),
            "three of the usual checks"
        );
        let later = [(KNEE, taking(96, true)), (HIP, taking(6, true))];
        assert_eq!(clients.check(at(63_600), EVERY, later).get(&HIP), None);
        assert_eq!(
            clients.check(at(65_101), EVERY, later).get(&HIP),
            None,
            "a pause that is longer by a moment"
        );
    }

    // spec: NDL-9.1
    #[test]
    fn stall_report_persists_through_paused_checks() {
        let mut clients = IdleClients::default();
        assert_eq!(check(&mut clients, 500, 96, true), None);
        assert_eq!(check(&mut clients, 1_500, 96, true), Some(at(500)));
        for ms in [61_500, 62_000, 90_000, 120_000] {
            assert_eq!(
                check(&mut clients, ms, 96, true),
                Some(at(500)),
                "it has taken nothing at {ms} ms either"
            );
        }
        assert_eq!(check(&mut clients, 180_000, 97, true), None, "it has taken some meanwhile");
        assert_eq!(check(&mut clients, 240_000, 97, true), None, "and was not reported before this pause");
        assert_eq!(check(&mut clients, 241_000, 97, true), Some(at(240_000)));
        assert_eq!(check(&mut clients, 300_000, 97, false), None, "nothing waits for it any more");
    }

    #[test]
    fn false_progress_marks_harm_no_other_client() {
        let mut clients = IdleClients::default();
        // Any change of a mark counts as progress, forwards or backwards.
        for (number, taken) in [u64::MAX, 0, 96, 95, u64::MAX - 1].into_iter().enumerate() {
            let ms = number as u64 * 1_000;
            let both = [(KNEE, taking(taken, true)), (HIP, taking(5, true))];
            let idle = clients.check(at(ms), EVERY, both);
            assert_eq!(idle.get(&KNEE), None);
            assert_eq!(idle.get(&HIP).copied(), (ms > 0).then_some(at(0)));
        }
    }

    #[test]
    fn removed_client_is_forgotten() {
        let mut clients = IdleClients::default();
        assert_eq!(check(&mut clients, 0, 1, true), None);
        assert_eq!(check(&mut clients, 1_000, 1, true), Some(at(0)));
        assert!(clients.check(at(1_500), EVERY, []).is_empty() && clients.seen.is_empty());
    }
}
