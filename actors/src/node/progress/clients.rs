//! Which clients take nothing of what waits for them. Pure: what was seen of them, and when.
//!
//! A client (`NodeApi`) has no turns that this node sees. What is seen is what waits for it, and whether it takes any. Who has nothing
//! waiting is well, however long it says nothing, and so is who is slow and takes some. spec: NDL-9.1

use std::collections::BTreeMap;

use sinew_runtime::time::Time;

use super::STALLED_AFTER;
use crate::{
    lncl::ClientId,
    outlet::{Left, Taking},
};

/// What was seen of each client at the last look: of those that there were then.
#[derive(Default)]
pub(in crate::node) struct IdleClients(BTreeMap<ClientId, Seen>);

struct Seen {
    mark: (u64, u64),
    /// Messages that had come for it when it was last seen to have taken them all. What it leaves lying of the layers' own frames counts
    /// for nothing before another message comes: who only sends need not read what LNCL tells it.
    before: u64,
    /// Since when at least a message waits and it has taken nothing.
    since: Option<Time>,
}

impl IdleClients {
    /// Who has taken nothing for too long of what waits for it, and since when at least. What was seen is remembered until the next look.
    pub(in crate::node) fn look(
        &mut self,
        now: Time,
        clients: impl IntoIterator<Item = (ClientId, Taking)>,
    ) -> BTreeMap<ClientId, Time> {
        let known = std::mem::take(&mut self.0);
        self.0 =
            clients.into_iter().map(|(id, taking)| (id, Seen::of(now, taking, known.get(&id)))).collect();
        let waited = self.0.iter().filter_map(|(id, seen)| Some((*id, seen.since?)));
        waited.filter(|(_, since)| now.since(*since) >= STALLED_AFTER).collect()
    }
}

impl Seen {
    fn of(now: Time, taking: Taking, known: Option<&Self>) -> Self {
        let Taking { mark, left, messages } = taking;
        let before = known.map_or(0, |known| known.before);
        match left {
            Left::Nothing => Self { mark, before: messages, since: None },
            Left::Ungiven => Self { mark, before, since: None },
            Left::Untaken => {
                let unmoved = known.filter(|known| known.mark == mark).and_then(|known| known.since);
                let since = (messages > before).then(|| unmoved.unwrap_or(now));
                Self { mark, before, since }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KNEE: ClientId = ClientId(7);

    fn at(ms: u64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    /// Looks at one client, of which `taken` was seen to be taken, and for which so many messages had come.
    fn look(clients: &mut IdleClients, ms: u64, taken: u64, left: Left, messages: u64) -> Option<Time> {
        clients.look(at(ms), [(KNEE, Taking { mark: (taken, 0), left, messages })]).remove(&KNEE)
    }

    // spec: NDL-9.1
    #[test]
    fn who_takes_nothing_of_what_waits_is_told_since_it_was_seen_first_and_no_more_when_it_takes_some() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 1_000, 96, Left::Untaken, 1), None, "it may have come just now");
        assert_eq!(look(&mut clients, 1_249, 96, Left::Untaken, 1), None);
        assert_eq!(look(&mut clients, 1_250, 96, Left::Untaken, 2), Some(at(1_000)));
        assert_eq!(look(&mut clients, 9_000, 96, Left::Untaken, 400), Some(at(1_000)));
        assert_eq!(look(&mut clients, 9_100, 97, Left::Untaken, 400), None, "it has taken some");
        assert_eq!(look(&mut clients, 9_350, 97, Left::Untaken, 400), Some(at(9_100)));
        assert_eq!(look(&mut clients, 9_400, 40_000, Left::Nothing, 400), None);
    }

    #[test]
    fn who_has_nothing_waiting_is_well_however_long() {
        let mut clients = IdleClients::default();
        for ms in [0, 1_000, 100_000] {
            assert_eq!(look(&mut clients, ms, 96, Left::Nothing, 1), None);
        }
        assert_eq!(
            look(&mut clients, 200_000, 96, Left::Untaken, 2),
            None,
            "what waits came after the last look"
        );
    }

    #[test]
    fn who_is_slow_and_takes_some_is_well() {
        let mut clients = IdleClients::default();
        for look_number in 0..100 {
            let told = look(&mut clients, look_number * 1_000, look_number, Left::Untaken, 10_000);
            assert_eq!(told, None, "at look {look_number}");
        }
    }

    #[test]
    fn who_takes_all_that_it_is_given_does_not_answer_for_what_waits_elsewhere() {
        let mut clients = IdleClients::default();
        for ms in [0, 1_000, 2_000] {
            assert_eq!(look(&mut clients, ms, 96, Left::Ungiven, 9), None);
        }
        // It is given that now, and leaves it.
        assert_eq!(look(&mut clients, 3_000, 96, Left::Untaken, 9), None);
        assert_eq!(look(&mut clients, 3_250, 96, Left::Untaken, 9), Some(at(3_000)));
    }

    #[test]
    fn who_only_sends_need_not_read_what_the_layers_tell_it() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 0, 64, Left::Nothing, 3), None);
        for ms in [1_000, 2_000, 3_000] {
            assert_eq!(look(&mut clients, ms, 64, Left::Untaken, 3), None, "frames of the layers alone");
        }
        assert_eq!(look(&mut clients, 4_000, 64, Left::Untaken, 4), None, "a message has come");
        assert_eq!(look(&mut clients, 5_000, 64, Left::Untaken, 4), Some(at(4_000)));
    }

    #[test]
    fn whatever_a_client_says_that_it_has_taken_it_harms_nobody() {
        let mut clients = IdleClients::default();
        // A mark that goes anywhere is one that moves, forwards or backwards.
        for (look_number, taken) in [u64::MAX, 0, 96, 95, u64::MAX - 1].into_iter().enumerate() {
            let ms = look_number as u64 * 1_000;
            let liar = Taking { mark: (taken, 0), left: Left::Untaken, messages: u64::MAX };
            let honest = Taking { mark: (5, 0), left: Left::Untaken, messages: 1 };
            let told = clients.look(at(ms), [(KNEE, liar), (ClientId(8), honest)]);
            assert_eq!(told.get(&KNEE), None);
            assert_eq!(told.get(&ClientId(8)).copied(), (ms > 0).then_some(at(0)));
        }
    }

    #[test]
    fn who_is_gone_is_forgotten() {
        let mut clients = IdleClients::default();
        assert_eq!(look(&mut clients, 0, 1, Left::Untaken, 1), None);
        assert_eq!(look(&mut clients, 250, 1, Left::Untaken, 1), Some(at(0)));
        assert!(clients.look(at(500), []).is_empty() && clients.0.is_empty());
    }
}
