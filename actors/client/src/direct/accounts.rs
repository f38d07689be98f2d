//! Counts the messages on direct links where the node can read them, even after the end of this process.

use sinew_protocol::link_counts::{LINKS_MAX, LinkCounters, LinkCounts};
use sinew_runtime::{
    protection::raw::ECHO,
    tid::Tid,
    wire::{Flags, Header, Kind},
};
use sinew_shm::Counters;

/// The counters of an endpoint.
pub(super) struct LinkAccounts {
    counters: Counters,
    /// The places of links, by bits.
    taken: u64,
    ended: LinkCounts,
}

/// The counters of one link.
#[derive(Default)]
pub(super) struct LinkAccount(Option<Account>);

struct Account {
    place: usize,
    counters: LinkCounters,
    counts: LinkCounts,
}

const _: () = assert!(LINKS_MAX == u64::BITS as usize, "a bit for each place");

impl LinkAccounts {
    pub(super) const fn new(counters: Counters) -> Self {
        Self { counters, taken: 0, ended: LinkCounts { sent: 0, superseded: 0, taken: 0 } }
    }

    /// Returns counters for a link with this peer.
    pub(super) fn begin(&mut self, peer: Tid) -> LinkAccount {
        let place = self.taken.trailing_ones() as usize;
        if place >= LINKS_MAX {
            return LinkAccount(None);
        }
        self.taken |= 1 << place;
        let (counters, counts) = (LinkCounters::at(&self.counters, place), LinkCounts::default());
        counters.set(counts);
        counters.set_peer(peer);
        LinkAccount(Some(Account { place, counters, counts }))
    }

    /// Adds the counts of a link that has ended to those of all ended ones.
    pub(super) fn end(&mut self, LinkAccount(account): LinkAccount) {
        let Some(Account { place, counters, counts }) = account else { return };
        self.ended = self.ended + counts;
        counters.set_peer(Tid::NONE);
        LinkCounters::at(&self.counters, LINKS_MAX).set(self.ended);
        self.taken &= !(1 << place);
    }
}

impl LinkAccount {
    pub(super) fn sent(&mut self, header: &Header) {
        self.count(header, |counts| counts.sent += 1);
    }

    /// Counts a value that replaces another one before that was written.
    pub(super) fn superseded(&mut self, header: &Header) {
        self.count(header, |counts| {
            counts.sent += 1;
            counts.superseded += 1;
        });
    }

    pub(super) fn took(&mut self, header: &Header) {
        self.count(header, |counts| counts.taken += 1);
    }

    fn count(&mut self, header: &Header, count: impl FnOnce(&mut LinkCounts)) {
        if let Some(Account { counters, counts, .. }) = &mut self.0
            && is_counted(header)
        {
            count(counts);
            counters.set(*counts);
        }
    }
}

/// Returns whether this is a message for the program of its receiver: no outcome, and none that the endpoint answers or
/// keeps by itself, since a program that only sends need not read those.
fn is_counted(header: &Header) -> bool {
    header.kind.is_user() && !header.flags.has(Flags::REPLY) && ![Kind::PING, ECHO].contains(&header.kind)
}
