//! The ends of links: how they are noticed, and what is left then.

use super::*;
use crate::routes::{HangUpAction, LINKS_MAX, Unread};

impl Direct {
    /// Ends the links that their peers have closed, once the rings are empty.
    pub(super) fn check_hang_ups(&mut self, now: Time) {
        let established =
            self.open.iter().chain(&self.held).map(|link| (link.peer, link.number, &link.socket));
        let setups = self.setups.iter().map(|link| (link.peer, link.number, &link.socket));
        let links: Vec<_> = established.chain(setups).collect();
        if links.is_empty() {
            return;
        }
        let gone: Vec<_> = socket::which_hung_up(links.iter().map(|(_, _, socket)| &****socket))
            .into_iter()
            .map(|index| (links[index].0, links[index].1))
            .chain(self.reordered.iter().map(|(peer, buffer)| (*peer, buffer.after)))
            .filter(|(peer, number)| self.routes.link(*peer) == Some(*number))
            .collect();
        for (peer, number) in gone {
            let unread = self.unread(number);
            match (self.routes.on_hang_up(peer, unread, now), unread) {
                (HangUpAction::Keep, _) | (HangUpAction::Drain, Unread::Some) => {}
                (HangUpAction::Drop, _) | (HangUpAction::Drain, Unread::None) => self.end(peer, number, now),
            }
        }
    }

    pub(super) fn unread(&mut self, number: LinkNumber) -> Unread {
        let mut established = self.open.iter_mut().chain(&mut self.held);
        let has_unread = match established.find(|link| link.number == number) {
            Some(link) => link.has_unsorted(),
            None => self.setups.iter().any(|link| link.number == number && link.has_unread()),
        };
        if has_unread { Unread::Some } else { Unread::None }
    }

    /// Ends a link: the peer observes that its socket is closed.
    pub(super) fn end(&mut self, peer: Tid, number: LinkNumber, now: Time) {
        if self.writing == Some(number) {
            self.cut = self.established(number).and_then(|link| link.cut());
        }
        // The caller gets back the message that it was writing.
        let has_caller = self.writing == Some(number);
        if let Some(link) = self.established(number) {
            link.log_unsent();
            let cut = link.cut().filter(|cut| !has_caller && cut.header.class == Class::Stream);
            let waiting = link.waiting() + usize::from(cut.is_some());
            self.add_unsent(peer, waiting as u64);
        }
        let account = self.established(number).map(|link| std::mem::take(&mut link.account));
        if let (Some(accounts), Some(account)) = (&mut self.accounts, account) {
            accounts.end(account);
        }
        self.open.retain(|link| link.number != number);
        self.index_slots();
        self.held.retain(|link| link.number != number);
        self.setups.retain(|link| link.number != number);
        if self.routes.link(peer) == Some(number) {
            self.routes.ended(peer, now);
        }
    }
}

/// Values that are lost when a link ends.
impl Direct {
    /// Counts Stream values that were waiting for room on a link to this peer.
    fn add_unsent(&mut self, peer: Tid, values: u64) {
        if values > 0 {
            let is_full = self.unsent.len() >= LINKS_MAX && !self.unsent.contains_key(&peer);
            *self.unsent.entry(if is_full { Tid::NONE } else { peer }).or_default() += values;
        }
    }

    /// Ends all links.
    pub(crate) fn end_all(&mut self) {
        let links =
            self.open.iter().chain(&self.held).map(|link| (link.peer, link.number)).collect::<Vec<_>>();
        let now = Time::now();
        links.into_iter().for_each(|(peer, number)| self.end(peer, number, now));
    }

    /// Removes and returns a destination of links that have ended, and the number of Stream values that were waiting
    /// for room in them.
    pub(crate) fn next_unsent(&mut self) -> Option<(Tid, u64)> {
        self.unsent.pop_first()
    }
}
