//! Incoming messages, from the node and from direct links: reading without waiting, and the wait.

use std::{future::poll_fn, pin::pin, time::Duration};

use sinew_protocol::ring::Taken;
use sinew_runtime::{
    outcome::Rejection,
    tid::Tid,
    time::Time,
    wire::{Header, Kind, Message},
};
use sinew_shm::Any;

use super::{
    ApiError, Endpoint,
    direct::{AllEnds, EstablishedLink, LinkRead, NodeWriter, ReorderDecision, Room},
    endpoint::LNCL,
    inbox::{Answer, Awaited, Sorted},
    link::{Read, Reader, ring::CHECK_INTERVAL},
    reactor::Until,
    routes::LinkNumber,
    undelivered::unsent,
    wait_mode::WaitMode,
};

/// Chunks of 64 KiB that are read before the caller continues. In tests each poll reads one chunk, so that a
/// message at its end must not be left unhandled until more data arrives.
const READS_PER_POLL: usize = if cfg!(test) { 1 } else { 16 };

/// The policy for messages when the inbox is full.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum WhenFull {
    /// Leave them in the socket: the caller is about to make room.
    Leave,
    /// Keep them beyond the inbox's capacity, and refuse them beyond a bound in bytes: the awaited answer may
    /// be behind them.
    Refuse,
}

impl Endpoint {
    /// Sorts in all messages that have arrived, without waiting. Returns the awaited answer if it was among
    /// them.
    pub(super) fn poll_incoming(
        &mut self,
        wanted: Option<Wanted>,
        when_full: WhenFull,
        now: Time,
    ) -> Result<Option<Answer>, ApiError> {
        // A message is awaited mostly before it comes: the poll before the sleep finds nothing.
        if self.node.is_quiet(now) && self.direct.is_quiet(now) {
            return Ok(None);
        }
        let answer = if self.direct.have_links_turn() {
            match self.poll_links(wanted, when_full, now) {
                Some(answer) => Ok(Some(answer)),
                None => self.poll_node(wanted, when_full, now),
            }
        } else {
            // There a peer may announce that its link is to be read from now on.
            let answer = self.poll_node(wanted, when_full, now);
            answer.map(|answer| answer.or_else(|| self.poll_links(wanted, when_full, now)))
        };
        if !self.inbox.has_room() {
            self.direct.change_turns();
        }
        self.refusals.count_own(self.tid, self.inbox.take_unreported(), now);
        self.count_unsent(now);
        answer
    }

    /// Counts the values that were lost with direct links.
    pub(super) fn count_unsent(&mut self, now: Time) {
        while let Some((destination, count)) = self.direct.next_unsent() {
            self.refusals.add(unsent(destination, Rejection::Closed, count, now));
        }
    }

    /// Sorts in the messages that have arrived on direct links.
    fn poll_links(&mut self, wanted: Option<Wanted>, when_full: WhenFull, now: Time) -> Option<Answer> {
        self.direct.take_wake();
        if self.direct.is_empty() {
            return None;
        }
        let mut node = NodeWriter { writer: &self.node.writer, correlation: &mut self.requests.correlation };
        if self.direct.check(now, &mut node) {
            self.check_all_rings();
        }
        if let Some(answer) = self.poll_reordered(wanted, when_full, now) {
            return Some(answer);
        }
        let answer = match self.direct.ready() {
            Some(mut ready) => ready.find_map(|slot| {
                let index = self.direct.at_slot(slot)?;
                self.poll_link_in_turn(index, slot.into(), wanted, when_full)
            }),
            None => {
                let (first, count) = (self.direct.first_turn(), self.direct.open.len());
                let mut turns = (0..count).map(|turn| (first + turn) % count);
                turns.find_map(|index| self.poll_link_in_turn(index, index, wanted, when_full))
            }
        };
        answer.or_else(|| self.poll_reordered(wanted, when_full, now))
    }

    /// Checks each ring for unreported messages: a hostile peer can clear the bit that reports them.
    fn check_all_rings(&mut self) {
        if let Reader::Ring(reader) = &mut self.node.reader {
            let links = &mut self.direct.open[..];
            let checked = reader.check_all(|node| AllEnds { node, links });
            reader.note(&checked);
            self.direct.note(&checked);
        }
    }

    /// Sorts in the messages on links that are about to end; messages without room are refused.
    pub(super) fn drain_links(&mut self) {
        for index in (0..self.direct.open.len()).rev() {
            self.poll_link(index, None, WhenFull::Refuse);
        }
    }

    /// Sorts in messages that arrived through the node but were sent after the content of a link's ring.
    fn poll_reordered(&mut self, wanted: Option<Wanted>, when_full: WhenFull, now: Time) -> Option<Answer> {
        while when_full == WhenFull::Refuse || self.inbox.has_room() {
            let message = self.direct.next_reordered(now)?;
            let awaited = self.awaited_from_node(&message, wanted);
            if let Sorted::Answer(answer) = self.inbox.sort(message, awaited) {
                return Some(answer);
            }
        }
        None
    }

    pub(super) fn poll_node(
        &mut self,
        wanted: Option<Wanted>,
        when_full: WhenFull,
        now: Time,
    ) -> Result<Option<Answer>, ApiError> {
        self.node.continue_writing();
        if self.node.reader.is_empty(now) {
            return Ok(None);
        }
        for read in 0.. {
            if let Some(answer) = self.sort_in(wanted, when_full)? {
                return Ok(Some(answer));
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_POLL {
                return Ok(None);
            }
            match self.node.reader.read(now) {
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

    /// Sorts in the messages that have been read from the node.
    fn sort_in(&mut self, wanted: Option<Wanted>, when_full: WhenFull) -> Result<Option<Answer>, ApiError> {
        while when_full == WhenFull::Refuse || self.inbox.has_room() {
            let Some(message) = self.node.reader.next()? else { break };
            let Some(message) = self.handle_frame(message, wanted) else { continue };
            let message = match self.direct.reorder(message) {
                ReorderDecision::Deliver(message) => message,
                ReorderDecision::Kept => continue,
                ReorderDecision::Refuse(message) => {
                    self.inbox.refuse(message);
                    continue;
                }
            };
            let awaited = self.awaited_from_node(&message, wanted);
            match self.inbox.sort(message, awaited) {
                Sorted::Answer(answer) => return Ok(Some(answer)),
                Sorted::Refusal(refusal) => self.end(refusal.into()),
                Sorted::Undelivered(undelivered) => {
                    self.refusals.on_report(self.tid, undelivered, Time::now())
                }
                Sorted::Message | Sorted::Nothing => {}
            }
        }
        Ok(None)
    }

    /// Returns the awaited number if this message of the node may answer it. The node forwards messages only
    /// with their true source. Its own report about a message (no such application, full queue, lost) has the
    /// destination of that message as its source. The number is a counter: guessing it does not allow an
    /// answer in another application's name.
    fn awaited_from_node(&self, message: &Message, wanted: Option<Wanted>) -> Option<(u64, Awaited)> {
        wanted.and_then(|wanted| wanted.from(self.absolute(message.header.source)))
    }

    /// Handles messages about direct links and about groups that the endpoint re-joined. Returns all others.
    fn handle_frame(&mut self, message: Message, wanted: Option<Wanted>) -> Option<Message> {
        let Header { kind, correlation, .. } = message.header;
        // The number alone is not sufficient: a mark and an introduction carry numbers that other processes
        // have chosen.
        let is_answer = matches!(kind, Kind::OUTCOME | Kind::MEMBERS | Kind::LNCL_RESOLVED)
            && wanted.is_some_and(|wanted| wanted.number == correlation);
        if kind.is_user() || is_answer {
            return Some(message);
        }
        let is_of_lncl = kind == Kind::OUTCOME && self.absolute(message.header.source) == self.absolute(LNCL);
        if is_of_lncl && self.reconnect.on_rejoin_outcome(&message, self.tid) {
            return None;
        }
        let mut node = NodeWriter { writer: &self.node.writer, correlation: &mut self.requests.correlation };
        self.direct.handle_frame(message, Time::now(), &mut node)
    }

    /// Sorts in the messages of a link. If the inbox is full then, the links behind it come first the next time.
    fn poll_link_in_turn(
        &mut self,
        index: usize,
        turn: usize,
        wanted: Option<Wanted>,
        when_full: WhenFull,
    ) -> Option<Answer> {
        // Another link may have ended meanwhile.
        if index >= self.direct.open.len() {
            return None;
        }
        let had_room = self.inbox.has_room();
        let answer = self.poll_link(index, wanted, when_full);
        if had_room && !self.inbox.has_room() {
            self.direct.set_first_turn(turn + 1);
        }
        answer
    }

    /// Sorts in the messages that have arrived on an open link.
    fn poll_link(&mut self, index: usize, wanted: Option<Wanted>, when_full: WhenFull) -> Option<Answer> {
        for read in 0.. {
            while when_full == WhenFull::Refuse || self.inbox.has_room() {
                let link = &mut self.direct.open[index];
                let awaited = wanted.and_then(|wanted| wanted.from(link.peer));
                match link.next() {
                    Ok(LinkRead::Nothing) => break,
                    Ok(LinkRead::Refused) => {}
                    Ok(LinkRead::Message(message)) => {
                        self.direct.report_received(&message.header, &message.payload, &self.node.writer);
                        let link = &self.direct.open[index];
                        if let Sorted::Answer(answer) = self.inbox.sort_from(&link.sink, message, awaited) {
                            return Some(answer);
                        }
                    }
                    Err(why) => return self.direct.fail(index, &why),
                }
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_POLL {
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

    /// Waits until a message arrives, from the node or a link, or until there is something to do.
    pub(super) async fn wait(&mut self, deadline: Time, now: Time) {
        if self.has_unsorted() {
            return match self.wait_mode {
                WaitMode::Blocking => {}
                WaitMode::Async(_) | WaitMode::Polled(_) => tokio::task::yield_now().await,
            };
        }
        let deadline = self.wake_by(deadline, now, None);
        let until = Until { deadline, room: None };
        match &mut self.wait_mode {
            WaitMode::Blocking => _ = self.block(deadline.since(now)),
            WaitMode::Async(reactor) => {
                yield_if_ready(reactor.wait(
                    &mut self.node.reader,
                    &self.node.writer,
                    &mut self.direct,
                    until,
                ))
                .await;
            }
            WaitMode::Polled(events) => {
                yield_if_ready(events.wait(
                    &mut self.node.reader,
                    &self.node.writer,
                    &mut self.direct,
                    until,
                ))
                .await;
            }
        }
    }

    /// Returns whether frames were read that are not sorted in yet: the inbox was full then, and all that it held has
    /// expired. No ring reports them again.
    fn has_unsorted(&self) -> bool {
        self.node.reader.has_frame() || self.direct.open.iter().any(EstablishedLink::has_frame)
    }

    /// The same for a task, and until there may be room on a direct link. Without a node it waits for the
    /// links alone.
    pub(super) async fn wait_for_room(&mut self, room: Room, deadline: Time, now: Time) {
        let deadline = self.wake_by(deadline, now, Some(room.link)).min(now + CHECK_INTERVAL);
        let until = Until { deadline, room: Some(room) };
        // Messages that wait in a ring would end each wait at once.
        let has_room = self.inbox.has_room();
        let has_node = self.node.ended.is_none() && !self.node.reader.has_ended(now);
        let (reader, writer, direct) = (&mut self.node.reader, &self.node.writer, &mut self.direct);
        match &mut self.wait_mode {
            WaitMode::Blocking => {}
            WaitMode::Async(reactor) if !has_room => reactor.wait_for_room(direct, room, deadline).await,
            WaitMode::Async(reactor) if !has_node => reactor.wait_for_links(direct, until).await,
            WaitMode::Async(reactor) => reactor.wait(reader, writer, direct, until).await,
            WaitMode::Polled(events) if !has_room => events.wait_for_room(direct, room, deadline).await,
            WaitMode::Polled(events) if !has_node => events.wait_for_links(direct, until).await,
            WaitMode::Polled(events) => events.wait(reader, writer, direct, until).await,
        }
    }

    /// Returns the latest time of the next check, if no event occurs before.
    pub(super) fn wake_by(&mut self, deadline: Time, now: Time, rings: Option<LinkNumber>) -> Time {
        let deadline = self.node.wake_by(deadline, now);
        // There is no notification of room for pending requests to the node.
        let deadline = if self.leaves.has_pending() { deadline.min(now + CHECK_INTERVAL) } else { deadline };
        let deadline = self.direct.wake_by(deadline, now, rings);
        match self.wait_mode {
            // A thread wakes at least once per `CHECK_INTERVAL` in any case.
            WaitMode::Blocking => deadline,
            WaitMode::Async(_) | WaitMode::Polled(_)
                if self.node.writer.has_pending() || self.direct.needs_checks() =>
            {
                deadline.min(now + CHECK_INTERVAL)
            }
            WaitMode::Async(_) | WaitMode::Polled(_) => deadline,
        }
    }

    /// Blocks until a message arrives, or until there is something to do. Returns whether a look at the set of rings
    /// has shown that.
    pub(super) fn block(&mut self, left: Duration) -> bool {
        match &mut self.node.reader {
            Reader::Ring(reader) if !self.direct.open.is_empty() => {
                let links = &mut self.direct.open[..];
                let ended = reader.wait_for_all(left, |node| AllEnds { node, links });
                if matches!(ended, Ok(Any::Ready)) {
                    return true;
                }
                reader.note(&ended);
                self.direct.note(&ended);
            }
            Reader::Ring(_) => self.node.reader.wait(left),
            // There is no notification here when another thread leaves a pending outcome.
            Reader::Socket(_) => self.node.reader.wait(left.min(CHECK_INTERVAL)),
        }
        false
    }
}

/// Waits, and yields to other tasks of the thread if the wait ended at once. An endpoint that receives
/// constantly would otherwise occupy the thread until its awaited answer arrives.
async fn yield_if_ready(wait: impl Future<Output = ()>) {
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
    /// The application that must answer.
    pub(super) of: Tid,
}

impl Wanted {
    /// Returns the awaited answer if `peer` is the application that must answer: no other may answer for it.
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
    async fn instant_wait_yields_and_real_wait_continues() {
        let mut at_once = pin!(yield_if_ready(ready(())));
        assert!(poll!(at_once.as_mut()).is_pending());
        assert!(poll!(at_once.as_mut()).is_ready());
        let mut waits = pin!(yield_if_ready(yield_now()));
        assert!(poll!(waits.as_mut()).is_pending());
        assert!(poll!(waits.as_mut()).is_ready());
    }
}
