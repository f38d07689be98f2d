//! Messages on their way in: from the node and from direct links, without waiting; and the wait.

use std::{future::poll_fn, pin::pin, time::Duration};

use sinew_runtime::{
    outcome::Rejection,
    tid::Tid,
    time::Time,
    wire::{Header, Kind, Message},
};

use super::{
    ApiError, Endpoint,
    direct::{Came, Everything, InTurn, Room, ToNode},
    form::Form,
    inbox::{Answer, Awaited, Sorted},
    link::{Read, Reader, ring::NAP},
    reactor::Until,
    routes::LinkNumber,
    undelivered::unsent,
};
use crate::ring::Taken;

/// Chunks of 64 KiB that are read before the caller has its turn. In tests each read is the last of its look: a message
/// that ends with it must not be left lying until more comes.
const READS_PER_LOOK: usize = if cfg!(test) { 1 } else { 16 };

/// Time until it is looked again whether there is room for the rest of a long frame.
const REST_AGAIN: Duration = Duration::from_millis(1);

/// What to do with messages that find the inbox full.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum WhenFull {
    /// They stay in the socket: somebody is about to make room.
    Leave,
    /// They are kept beyond its capacity, and refused beyond a bound in bytes: the answer that is waited for may be behind them.
    Refuse,
}

impl Endpoint {
    /// Sorts in what has come so far, without waiting. Returns the answer that is awaited, if it was there.
    pub(super) fn take_in(
        &mut self,
        wanted: Option<Wanted>,
        when_full: WhenFull,
        now: Time,
    ) -> Result<Option<Answer>, ApiError> {
        // The node first: there a peer may say that from now on its link is read.
        let answer = self.take_in_from_node(wanted, when_full, now);
        let answer = answer.map(|answer| answer.or_else(|| self.take_in_directly(wanted, when_full, now)));
        self.refusals.count_own(self.tid, self.inbox.take_untold(), now);
        self.count_unsent(now);
        answer
    }

    /// Counts what was lost with direct links.
    pub(super) fn count_unsent(&mut self, now: Time) {
        for (destination, count) in self.direct.take_unsent() {
            self.refusals.add(unsent(destination, Rejection::Closed, count, now));
        }
    }

    /// Sorts in what has come past the node.
    fn take_in_directly(&mut self, wanted: Option<Wanted>, when_full: WhenFull, now: Time) -> Option<Answer> {
        if self.direct.is_empty() {
            return None;
        }
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.look(now, &mut node);
        if let Some(answer) = self.take_in_early(wanted, when_full, now) {
            return Some(answer);
        }
        // From the last one on: one that ends makes no other one's turn go by.
        let mut links = (0..self.direct.open.len()).rev();
        let answer = links.find_map(|index| self.take_in_from_link(index, wanted, when_full));
        answer.or_else(|| self.take_in_early(wanted, when_full, now))
    }

    /// Sorts in what has come on links that are about to end; what finds no room is refused.
    pub(super) fn take_in_from_links(&mut self) {
        for index in (0..self.direct.open.len()).rev() {
            self.take_in_from_link(index, None, WhenFull::Refuse);
        }
    }

    /// Sorts in what had come through the node and was sent after what a link's ring held.
    fn take_in_early(&mut self, wanted: Option<Wanted>, when_full: WhenFull, now: Time) -> Option<Answer> {
        while when_full == WhenFull::Refuse || self.inbox.has_room() {
            let message = self.direct.next_early(now)?;
            let awaited = self.at_node(&message, wanted);
            if let Sorted::Answer(answer) = self.inbox.sort(message, awaited) {
                return Some(answer);
            }
        }
        None
    }

    pub(super) fn take_in_from_node(
        &mut self,
        wanted: Option<Wanted>,
        when_full: WhenFull,
        now: Time,
    ) -> Result<Option<Answer>, ApiError> {
        self.go_on();
        for read in 0.. {
            if let Some(answer) = self.sort_in(wanted, when_full)? {
                return Ok(Some(answer));
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_LOOK {
                return Ok(None);
            }
            match self.reader.read(now) {
                Read::Some => {}
                Read::Nothing => return Ok(None),
                Read::Ended(ended) => {
                    self.end(ended);
                    return Ok(None);
                }
            }
        }
        Ok(None)
    }

    /// Sorts in what has been read from the node.
    fn sort_in(&mut self, wanted: Option<Wanted>, when_full: WhenFull) -> Result<Option<Answer>, ApiError> {
        while when_full == WhenFull::Refuse || self.inbox.has_room() {
            let Some(message) = self.reader.next()? else { break };
            let Some(message) = self.heed(message, wanted) else { continue };
            let message = match self.direct.keep_early(message) {
                InTurn::Now(message) => message,
                InTurn::Later => continue,
                InTurn::Never(message) => {
                    self.inbox.refuse(message);
                    continue;
                }
            };
            let awaited = self.at_node(&message, wanted);
            match self.inbox.sort(message, awaited) {
                Sorted::Answer(answer) => return Ok(Some(answer)),
                Sorted::Refusal(refusal) => self.end(refusal.into()),
                Sorted::Undelivered(undelivered) => self.refusals.hear(self.tid, undelivered, Time::now()),
                Sorted::Message | Sorted::Nothing => {}
            }
        }
        Ok(None)
    }

    /// What is awaited, if it may be this message of the node's: what the node passes on is from whom it says it is, and what
    /// it says itself of a message (nobody there, a full queue, lost) it says as from whom that was for. The number counts up by
    /// one: who guesses it answers for nobody else.
    fn at_node(&self, message: &Message, wanted: Option<Wanted>) -> Option<(u64, Awaited)> {
        wanted.and_then(|wanted| wanted.from(self.absolute(message.header.source)))
    }

    /// Hands back what is neither about direct links nor about groups that it asked for when it came back.
    fn heed(&mut self, message: Message, wanted: Option<Wanted>) -> Option<Message> {
        let Header { kind, correlation, .. } = message.header;
        // The number alone says nothing: a mark and an introduction carry numbers that others have given.
        let is_answer = matches!(kind, Kind::OUTCOME | Kind::MEMBERS | Kind::LNCL_RESOLVED)
            && wanted.is_some_and(|wanted| wanted.number == correlation);
        if kind.is_user() || is_answer {
            return Some(message);
        }
        if self.heed_rejoined(&message) {
            return None;
        }
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.heed(message, Time::now(), &mut node)
    }

    /// Sorts in what has come so far on an open link.
    fn take_in_from_link(
        &mut self,
        index: usize,
        wanted: Option<Wanted>,
        when_full: WhenFull,
    ) -> Option<Answer> {
        for read in 0.. {
            while when_full == WhenFull::Refuse || self.inbox.has_room() {
                let link = &mut self.direct.open[index];
                let awaited = wanted.and_then(|wanted| wanted.from(link.peer));
                match link.next() {
                    Ok(Came::Nothing) => break,
                    Ok(Came::Refused) => {}
                    Ok(Came::Message(message)) => {
                        if let Sorted::Answer(answer) = self.inbox.sort_from(&link.sink, message, awaited) {
                            return Some(answer);
                        }
                    }
                    Err(why) => return self.direct.fail(index, &why),
                }
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_LOOK {
                return None;
            }
            match self.direct.open[index].take() {
                Ok(Taken::Some) => {}
                Ok(Taken::Nothing) => return None,
                Err(why) => return self.direct.fail(index, &why),
            }
        }
        None
    }

    /// Waits until something comes, from the node or from a link, or until there is something to do.
    pub(super) async fn wait(&mut self, deadline: Time, now: Time) {
        let deadline = self.wake_by(deadline, now, None);
        match &mut self.form {
            Form::Thread => self.block(deadline.since(now)),
            Form::Reactor(reactor) => {
                let until = Until { deadline, room: None };
                in_turn(reactor.wait(&mut self.reader, &self.writer, &mut self.direct, until)).await;
            }
        }
    }

    /// The same of a task, and until there may be room on a direct link. Without a node it waits for the links alone.
    pub(super) async fn wait_for_room(&mut self, room: Room, deadline: Time, now: Time) {
        let deadline = self.wake_by(deadline, now, Some(room.link)).min(now + NAP);
        let Form::Reactor(reactor) = &mut self.form else { return };
        let until = Until { deadline, room: Some(room) };
        if !self.inbox.has_room() {
            // What waits for it in a ring would end each wait at once.
            reactor.wait_for_room(&mut self.direct, room, deadline).await;
        } else if self.ended.is_some() || self.reader.has_ended(now) {
            reactor.wait_for_links(&mut self.direct, until).await;
        } else {
            reactor.wait(&mut self.reader, &self.writer, &mut self.direct, until).await;
        }
    }

    /// When to look at the latest, if nothing comes before.
    fn wake_by(&mut self, deadline: Time, now: Time, rings: Option<LinkNumber>) -> Time {
        // The rest of a frame goes out meanwhile; that it was taken back is not urgent.
        let deadline = match &self.rest {
            Some(rest) if rest.is_withdrawn() => deadline.min(now + NAP),
            None if !self.is_within_frame() => deadline,
            Some(_) | None => deadline.min(now + REST_AGAIN),
        };
        // Nobody says when there is room for what the node is to be told.
        let deadline = if self.leaves.are_to_be_told() { deadline.min(now + NAP) } else { deadline };
        let deadline = self.direct.wake_by(deadline, now, rings);
        match self.form {
            // It naps in any case.
            Form::Thread => deadline,
            Form::Reactor(_) if self.writer.owes() || self.direct.is_to_be_looked_at() => {
                deadline.min(now + NAP)
            }
            Form::Reactor(_) => deadline,
        }
    }

    fn block(&mut self, left: Duration) {
        match &mut self.reader {
            Reader::Ring(reader) if !self.direct.open.is_empty() => {
                let links = &mut self.direct.open[..];
                let ended = reader.wait_for_all(left, |node| Everything { node, links });
                reader.note(&ended);
                self.direct.note(&ended);
            }
            Reader::Ring(_) => self.reader.wait(left),
            // What another thread leaves owed to it nobody says here.
            Reader::Socket(_) => self.reader.wait(left.min(NAP)),
        }
    }
}

/// Waits, and where that ended at once lets other tasks of the thread have their turn: one to which others send all the time, while it waits
/// for an answer, would have the thread for itself until that is there.
async fn in_turn(wait: impl Future<Output = ()>) {
    let mut wait = pin!(wait);
    let mut has_waited = false;
    poll_fn(|cx| {
        let polled = wait.as_mut().poll(cx);
        has_waited |= polled.is_pending();
        polled
    })
    .await;
    if !has_waited {
        tokio::task::yield_now().await;
    }
}

/// The answer that a call waits for.
#[derive(Clone, Copy)]
pub(super) struct Wanted {
    pub(super) number: u64,
    pub(super) what: Awaited,
    /// Who says it.
    pub(super) of: Tid,
}

impl Wanted {
    /// Nobody answers for others.
    fn from(self, peer: Tid) -> Option<(u64, Awaited)> {
        (peer == self.of).then_some((self.number, self.what))
    }
}

#[cfg(test)]
mod tests {
    use std::future::ready;

    use futures_util::poll;
    use tokio::task::yield_now;

    use super::*;

    #[tokio::test]
    async fn a_wait_that_ends_at_once_lets_others_have_their_turn_and_one_that_has_waited_goes_on() {
        let mut at_once = pin!(in_turn(ready(())));
        assert!(poll!(at_once.as_mut()).is_pending());
        assert!(poll!(at_once.as_mut()).is_ready());
        let mut waits = pin!(in_turn(yield_now()));
        assert!(poll!(waits.as_mut()).is_pending());
        assert!(poll!(waits.as_mut()).is_ready());
    }
}
