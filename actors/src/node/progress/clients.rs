//! Which clients take nothing of what waits for them. Pure: what was seen of them, and when.
//!
//! A client (`NodeApi`) has no turns that this node sees. What is seen is whether messages of applications wait for it, and whether it takes
//! anything. Who has none waiting is well, however long it says nothing. spec: NDL-9.1

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

use crate::{lncl::ClientId, outlet::Taking};

/// A client that takes nothing for longer is told. A `NodeApi` takes up to 64 records, or 64 KiB, of its ring at once and is not seen to take
/// any before it is through with them, and a socket is seen to have room when three quarters of it are free: who is slow and lives has this
/// long for that.
const IDLE_AFTER: Duration = Duration::from_secs(1);
/// After a pause longer than so many of the usual ones between two looks, nobody is told anew for what was before it: the host has stood
/// still, or this process, and the clients perhaps with it. Who was told before it, and has taken nothing, is told still.
const LOOKS_MISSED: u32 = 3;

/// What was seen of each client at the last look: of those that there were then.
#[derive(Default)]
pub(in crate::node) struct IdleClients {
    seen: BTreeMap<ClientId, Seen>,
    looked: Option<Time>,
}

struct Seen {
    mark: (u64, u64),
    /// Since when at least a message waits and it has taken nothing.
    since: Option<Time>,
}

impl IdleClients {
    /// Who has taken nothing for too long of what waits for it, and since when at least. Looks come once in `every`; what was seen is
    /// remembered until the next one.
    pub(in crate::node) fn look(
        &mut self,
        now: Time,
        every: Duration,
        clients: impl IntoIterator<Item = (ClientId, Taking)>,
    ) -> BTreeMap<ClientId, Time> {
        let before = std::mem::take(&mut self.seen);
        let last = self.looked.replace(now);
        let was_told = |seen: &Seen| last.is_some_and(|last| seen.idle_since(last).is_some());
        let is_late = last.is_some_and(|last| now.since(last) > every * LOOKS_MISSED);
        let known = |id: &ClientId| before.get(id).filter(|seen| !is_late || was_told(seen));
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

    /// Since when it has taken nothing, if that is too long at this look.
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

    /// Looks at one client, of which `taken` was seen to be taken.
    fn look(clients: &mut IdleClients, ms: u64, taken: u64, leaves_some: bool) -> Option<Time> {
        clients.look(at(ms), EVERY, [(KNEE, taking(taken, leaves_some))]).remove(&KNEE)
    }

    // spec: NDL-9.1
    #[test]
    fn who_takes_nothing_of_what_waits_is_told_since_it_was_seen_first_and_no_more_when_it_takes_some() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 1_000, 96, true), None, "it may have come just now");
        assert_eq!(look(&mut clients, 1_999, 96, true), None);
        assert_eq!(look(&mut clients, 2_000, 96, true), Some(at(1_000)));
        assert_eq!(look(&mut clients, 3_000, 96, true), Some(at(1_000)));
        assert_eq!(look(&mut clients, 3_100, 97, true), None, "it has taken some");
        assert_eq!(look(&mut clients, 4_100, 97, true), Some(at(3_100)));
        assert_eq!(look(&mut clients, 4_200, 40_000, false), None);
    }

    #[test]
    fn who_has_nothing_waiting_is_well_however_long() {
        let mut clients = IdleClients::default();
        for ms in (0..100_000).step_by(500) {
            assert_eq!(look(&mut clients, ms, 96, false), None);
        }
        assert_eq!(look(&mut clients, 100_400, 96, true), None, "what waits came after the last look");
    }

    #[test]
    fn who_is_seen_to_take_some_at_each_look_is_well() {
        let mut clients = IdleClients::default();
        for look_number in 0..100 {
            let told = look(&mut clients, look_number * 1_000, look_number, true);
            assert_eq!(told, None, "at look {look_number}");
        }
    }

    #[test]
    fn after_a_pause_of_the_looks_nobody_is_told_anew_for_what_was_before_it() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 500, 96, true), None);
        assert_eq!(look(&mut clients, 60_500, 96, true), None, "the client may have stood still as long");
        assert_eq!(look(&mut clients, 61_000, 96, true), None);
        assert_eq!(look(&mut clients, 61_500, 96, true), Some(at(60_500)));
        // When: another one leaves what came a moment before a pause.
        let both = [(KNEE, taking(96, true)), (HIP, taking(5, true))];
        assert_eq!(clients.look(at(62_000), EVERY, both).get(&HIP), None);
        assert_eq!(
            clients.look(at(63_500), EVERY, both).get(&HIP),
            Some(&at(62_000)),
            "three of the usual looks"
        );
        let later = [(KNEE, taking(96, true)), (HIP, taking(6, true))];
        assert_eq!(clients.look(at(63_600), EVERY, later).get(&HIP), None);
        assert_eq!(
            clients.look(at(65_101), EVERY, later).get(&HIP),
            None,
            "a pause that is longer by a moment"
        );
    }

    // spec: NDL-9.1
    #[test]
    fn who_is_told_stays_so_through_any_pause_of_the_looks_until_it_takes_some() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 500, 96, true), None);
        assert_eq!(look(&mut clients, 1_500, 96, true), Some(at(500)));
        for ms in [61_500, 62_000, 90_000, 120_000] {
            assert_eq!(
                look(&mut clients, ms, 96, true),
                Some(at(500)),
                "it has taken nothing at {ms} ms either"
            );
        }
        assert_eq!(look(&mut clients, 180_000, 97, true), None, "it has taken some meanwhile");
        assert_eq!(look(&mut clients, 240_000, 97, true), None, "and was not told before this pause");
        assert_eq!(look(&mut clients, 241_000, 97, true), Some(at(240_000)));
        assert_eq!(look(&mut clients, 300_000, 97, false), None, "nothing waits for it any more");
    }

    #[test]
    fn whatever_a_client_says_that_it_has_taken_it_harms_nobody() {
        let mut clients = IdleClients::default();
        // A mark that goes anywhere is one that moves, forwards or backwards.
        for (look_number, taken) in [u64::MAX, 0, 96, 95, u64::MAX - 1].into_iter().enumerate() {
            let ms = look_number as u64 * 1_000;
            let both = [(KNEE, taking(taken, true)), (HIP, taking(5, true))];
            let told = clients.look(at(ms), EVERY, both);
            assert_eq!(told.get(&KNEE), None);
            assert_eq!(told.get(&HIP).copied(), (ms > 0).then_some(at(0)));
        }
    }

    #[test]
    fn who_is_gone_is_forgotten() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 0, 1, true), None);
        assert_eq!(look(&mut clients, 1_000, 1, true), Some(at(0)));
        assert!(clients.look(at(1_500), EVERY, []).is_empty() && clients.seen.is_empty());
    }
}
