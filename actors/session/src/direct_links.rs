//! The counts of messages on direct links between clients, which pass the node by.

use std::{collections::BTreeMap, sync::Arc};

use sinew_runtime::tid::AppAddress;

use crate::{counts::Account, outlet::Taking, place::Place};

/// The golden ratio in 64 bits: odd, and far from small multiples.
const MARK_STEP: u64 = 0x9e37_79b9_7f4a_7c15;

/// The messages that a client counts on one of its links, or on several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DirectCounts {
    /// Sent to the peer.
    pub sent: u64,
    /// Of those, values that a newer one replaced before they were written.
    pub superseded: u64,
    /// Taken from the peer.
    pub taken: u64,
}

impl std::ops::Add for DirectCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        // A client may report any number.
        Self {
            sent: self.sent.saturating_add(other.sent),
            superseded: self.superseded.saturating_add(other.superseded),
            taken: self.taken.saturating_add(other.taken),
        }
    }
}

/// What a client counts: each of its links with the peer, and all that have ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DirectReading {
    /// The peers of its links.
    pub links: Vec<(AppAddress, DirectCounts)>,
    /// The links that have ended.
    pub ended: DirectCounts,
}

impl DirectReading {
    /// Returns the sum over all links.
    pub fn sum(&self) -> DirectCounts {
        self.links.iter().fold(self.ended, |sum, (_, counts)| sum + *counts)
    }
}

/// The counters of a client, which can be read even after its process has ended.
pub trait CountsLinks: Send + Sync {
    /// Returns their current values.
    fn read(&self) -> DirectReading;
}

/// A client with links, as it was read.
pub(crate) struct Reader {
    pub(crate) app: AppAddress,
    pub(crate) name: Arc<str>,
    pub(crate) reading: DirectReading,
}

/// How far an application has read the messages on its direct links.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Progress {
    taken: u64,
    leaves_some: bool,
}

impl Progress {
    /// Returns the progress with these messages and those through the node together.
    pub(crate) const fn beside(self, through_node: Taking) -> Taking {
        let (first, second) = through_node.mark;
        // Both change when messages are taken. A multiple of an odd number, so that one does not undo the other.
        let mark = (first, second.wrapping_add(self.taken.wrapping_mul(MARK_STEP)));
        Taking { mark, leaves_some: through_node.leaves_some || self.leaves_some }
    }
}

/// Returns the progress of each application with a direct link.
pub(crate) fn progress(clients: &[Reader]) -> BTreeMap<AppAddress, Progress> {
    let mut sent: BTreeMap<(AppAddress, AppAddress), u64> = BTreeMap::new();
    for Reader { app, reading, .. } in clients {
        for (peer, counts) in &reading.links {
            sent.insert((*app, *peer), counts.sent.saturating_sub(counts.superseded));
        }
    }
    let mut progress: BTreeMap<AppAddress, Progress> = BTreeMap::new();
    for Reader { app, reading, .. } in clients.iter().filter(|client| !client.reading.links.is_empty()) {
        let of_app = progress.entry(*app).or_default();
        for (peer, counts) in &reading.links {
            of_app.taken = of_app.taken.wrapping_add(counts.taken);
            of_app.leaves_some |= sent.get(&(*peer, *app)).is_some_and(|sent| *sent > counts.taken);
        }
    }
    progress
}

/// Returns the account of each link in each direction, and that of the links of which only one end is left or none.
pub(crate) fn accounts(clients: &[Reader], former: DirectCounts) -> Vec<(Place, Account)> {
    let mut taken: BTreeMap<(AppAddress, AppAddress), u64> = BTreeMap::new();
    for Reader { app, reading, .. } in clients {
        for (peer, counts) in &reading.links {
            let by_pair = taken.entry((*peer, *app)).or_default();
            *by_pair = by_pair.saturating_add(counts.taken);
        }
    }
    let name = |app: AppAddress| {
        clients
            .iter()
            .find(|client| client.app == app)
            .map_or_else(|| app.to_string(), |client| client.name.to_string())
    };
    let (mut read, mut others) = (Vec::new(), former);
    for Reader { app: from, name: from_name, reading } in clients {
        others = others + reading.ended;
        for (to, counts) in &reading.links {
            let (from, to) = (*from, *to);
            let taken = taken.remove(&(from, to)).unwrap_or_default();
            let (account, surplus) = account(DirectCounts { taken, ..*counts });
            others.taken = others.taken.saturating_add(surplus);
            let place = Place::DirectLink { from, from_name: from_name.to_string(), to, to_name: name(to) };
            read.push((place, account));
        }
    }
    // The peers of these have ended, or have counted in a former connection to the node.
    others.taken = taken.into_values().fold(others.taken, u64::saturating_add);
    let (of_others, _) = account(others);
    // Nobody reads the rest any more.
    let of_others = Account { unknown: of_others.waiting, waiting: 0, ..of_others };
    read.push((Place::OtherDirectLinks, of_others));
    read
}

/// Returns the account of one direction, and how many messages were taken that were not sent there.
fn account(DirectCounts { sent, superseded, taken }: DirectCounts) -> (Account, u64) {
    let superseded = superseded.min(sent);
    let delivered = taken.min(sent - superseded);
    let waiting = sent - superseded - delivered;
    (Account { taken: sent, superseded, delivered, waiting, ..Account::default() }, taken - delivered)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn counts(sent: u64, superseded: u64, taken: u64) -> DirectCounts {
        DirectCounts { sent, superseded, taken }
    }

    fn client(app: u32, links: &[(u32, DirectCounts)], ended: DirectCounts) -> Reader {
        let links = links.iter().map(|(peer, counts)| (AppAddress::new(*peer), *counts)).collect();
        Reader {
            app: AppAddress::new(app),
            name: format!("app{app}").into(),
            reading: DirectReading { links, ended },
        }
    }

    #[test]
    fn each_direction_has_its_account() {
        let clients = [
            client(1, &[(2, counts(10, 2, 3))], DirectCounts::default()),
            client(2, &[(1, counts(4, 0, 7))], DirectCounts::default()),
        ];
        let read = accounts(&clients, DirectCounts::default());
        let of = |from: u32| {
            let found = read.iter().find(
                |(place, _)| matches!(place, Place::DirectLink { from: app, .. } if *app == AppAddress::new(from)),
            );
            found.expect("its direction is there").1
        };
        let one = Account { taken: 10, superseded: 2, delivered: 7, waiting: 1, ..Account::default() };
        assert_eq!(of(1), one);
        assert_eq!(of(2), Account { taken: 4, delivered: 3, waiting: 1, ..Account::default() });
        assert_eq!(read.last(), Some(&(Place::OtherDirectLinks, Account::default())));
    }

    #[test]
    fn unread_message_on_a_link_leaves_some() {
        let clients = |taken| {
            [
                client(1, &[(2, counts(5, 1, 0))], DirectCounts::default()),
                client(2, &[(1, counts(0, 0, taken))], DirectCounts::default()),
            ]
        };
        let taking = Taking { mark: (1, 2), leaves_some: false };
        let of = |taken: u64| progress(&clients(taken))[&AppAddress::new(2)].beside(taking);
        assert!(of(3).leaves_some && !of(4).leaves_some);
        assert_ne!(of(3).mark, of(4).mark);
    }

    #[test]
    fn what_an_ended_sender_sent_is_delivered_or_unknown() {
        // The sender of ten has ended; its peer has taken eight so far.
        let left = client(2, &[(1, counts(0, 0, 8))], DirectCounts::default());
        let read = accounts(&[left], counts(10, 0, 0));
        let others = Account { taken: 10, delivered: 8, unknown: 2, ..Account::default() };
        assert_eq!(read.last(), Some(&(Place::OtherDirectLinks, others)));
    }

    proptest! {
        #[test]
        fn any_counters_are_explained(
            links in proptest::collection::vec((0..4_u32, 0..4_u32, any::<[u64; 3]>()), 0..8),
            former in any::<[u64; 3]>(),
        ) {
            let of = |[sent, superseded, taken]: [u64; 3]| counts(sent, superseded, taken);
            let clients: Vec<_> =
                links.iter().map(|(app, peer, words)| client(*app, &[(*peer, of(*words))], of(*words))).collect();
            for (_, account) in accounts(&clients, of(former)) {
                prop_assert_eq!(account.unexplained(), 0);
            }
        }
    }
}
