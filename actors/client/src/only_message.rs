//! The usual case of a receive: one message, on a direct link, and nothing else. It goes from the ring to the caller
//! without a queue in between, because there is nothing that it could be sorted with.

use sinew_runtime::time::Time;

use super::{
    Endpoint, Received,
    direct::LinkRead,
    link::{Arrived, Reader},
    wait_mode::WaitMode,
};

/// What has arrived.
pub(super) enum Only {
    /// One message, which is for the program.
    Received(Received),
    Nothing,
    /// Perhaps something else: [`Endpoint::receive_until`] finds out.
    Other,
}

impl Endpoint {
    /// Waits for a message, until `deadline` at most, as long as nothing arrives but one message on a direct link.
    ///
    /// # Errors
    /// Something else has arrived, or may have: the time of the last look.
    #[inline]
    pub(super) fn receive_only(&mut self, deadline: Time, mut now: Time) -> Result<Option<Received>, Time> {
        if !matches!(self.wait_mode, WaitMode::Blocking) {
            return Err(now);
        }
        let mut arrived = self.look(now);
        loop {
            match self.take_only(arrived, now) {
                Only::Received(received) => return Ok(Some(received)),
                Only::Other => return Err(now),
                Only::Nothing if now >= deadline => return Ok(None),
                Only::Nothing => {}
            }
            let until = self.wake_by(deadline, now, None);
            let has_looked = self.block(until.since(now));
            now = Time::now();
            arrived = if has_looked { self.found(now) } else { self.look(now) };
        }
    }

    /// Looks what has arrived. `None` if one look does not show that.
    pub(super) fn look(&mut self, now: Time) -> Option<Arrived> {
        if !self.is_simple(now) {
            return None;
        }
        match self.wait_mode {
            WaitMode::Blocking => self.node.reader.look(now),
            WaitMode::Async(_) | WaitMode::Polled(_) => self.look_at_rings(now),
        }
    }

    /// Returns what the last look has found.
    fn found(&self, now: Time) -> Option<Arrived> {
        if self.is_simple(now) { self.node.reader.found(now) } else { None }
    }

    /// Returns whether there is nothing to do but to take messages out of rings.
    fn is_simple(&self, now: Time) -> bool {
        self.inbox.is_idle()
            && self.node.is_idle()
            && self.direct.is_quiet(now)
            && !self.leaves.has_pending()
            && !self.ends.is_guarding()
    }

    /// Looks at each ring, for a task, which has no set of them.
    fn look_at_rings(&mut self, now: Time) -> Option<Arrived> {
        let Reader::Ring(reader) = &mut self.node.reader else { return None };
        if !reader.is_ring_empty(now) {
            return None;
        }
        let mut ready =
            (0..).zip(&mut self.direct.open).filter_map(|(index, link)| link.has_unsorted().then_some(index));
        Some(match (ready.next(), ready.next()) {
            (None, _) => Arrived::Nothing,
            (Some(index), None) => Arrived::Only(index),
            (Some(_), Some(_)) => Arrived::Several,
        })
    }

    pub(super) fn take_only(&mut self, arrived: Option<Arrived>, now: Time) -> Only {
        match (arrived, &self.wait_mode) {
            (Some(Arrived::Nothing), _) => Only::Nothing,
            (Some(Arrived::Only(slot)), WaitMode::Blocking) => match self.direct.at_slot(slot) {
                Some(index) => self.take_only_of(index, now),
                None => Only::Other,
            },
            (Some(Arrived::Only(index)), WaitMode::Async(_) | WaitMode::Polled(_)) => {
                self.take_only_of(index.into(), now)
            }
            (Some(Arrived::Several) | None, _) => Only::Other,
        }
    }

    /// Takes the only message of a link.
    fn take_only_of(&mut self, index: usize, now: Time) -> Only {
        let message = match self.direct.open[index].take_only() {
            Some(LinkRead::Message(message)) => message,
            // It was taken before it was reported.
            Some(LinkRead::Nothing) => return Only::Nothing,
            Some(LinkRead::Refused) | None => return Only::Other,
        };
        self.direct.report_received(&message.header, &message.payload, &self.node.writer);
        let message = self.inbox.pass(&self.direct.open[index].sink, message, now);
        message.and_then(|message| self.received(message)).map_or(Only::Other, Only::Received)
    }
}
