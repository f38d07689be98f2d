//! The state under an outlet's mutex, composed of its parts: the connection, its frames, the unsent messages,
//! their numbers, and the counters.

use std::{sync::Arc, task::Waker};

use sinew_runtime::{
    mailbox::Budget,
    outcome::{Outcome, Receipt, Rejection, Ticket},
    router::SubmitError,
    time::Time,
    wire::{Class, Flags, Kind, Message},
};

use super::{
    LinkNumber, OutletAccount, OutletCounts, OutletLimits, Socket, Taking,
    account::Counters,
    batch::{BurstDetector, is_delayable, is_for_drainer},
    connection::Connection,
    deferred::DeferredActions,
    link_frames::{LinkFrames, Pushed},
    numbering::{Numbering, Session},
    outcomes::{self, messages_in},
    outstanding::{Open, SentMessage, Shares, confirming_destination},
    partial::{FrameOrigin, Partial, Written},
    unsent::{Bound, Unsent},
};
use crate::{Ack, AckEffect, SendPosition};

/// Whether a sender's thread has more to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Done,
    /// A long frame of this sender is in progress; the lock was released in between.
    More,
}

pub(super) struct WriterState<S> {
    pub(super) limits: OutletLimits,
    /// Longest payload that both sides accept.
    pub(super) payload_max: usize,
    pub(super) connection: Connection<S>,
    pub(super) link_frames: LinkFrames,
    pub(super) unsent: Unsent,
    pub(super) numbering: Numbering,
    /// Queued confirmed messages, and the receipts of sent ones.
    pub(super) receipts: Arc<Open>,
    /// Outcomes that arrived before the writes of their messages returned. They are settled when the lock is
    /// free again.
    pub(super) early_outcomes: Vec<(Receipt, Outcome)>,
    pub(super) bursts: BurstDetector,
    pub(super) counters: Counters,
    /// The time at which expiry was first checked in the present turn of writing.
    pub(super) checked_at: Option<Time>,
}

impl<S: Socket> WriterState<S> {
    /// Returns the state of an outlet without a connection. `budget` counts the queued messages, too.
    pub(super) fn new(limits: OutletLimits, session: Option<Session>, budget: Option<Arc<Budget>>) -> Self {
        Self {
            limits,
            payload_max: limits.payload_max,
            connection: Connection::new(),
            link_frames: LinkFrames::default(),
            unsent: Unsent::new(limits, budget, session.as_ref().map(Session::window)),
            receipts: Arc::new(Open::new(Shares::of(limits, session.as_ref()))),
            numbering: Numbering::new(session),
            early_outcomes: Vec::new(),
            bursts: BurstDetector::new(),
            counters: Counters::default(),
            checked_at: None,
        }
    }

    pub(super) fn submit(
        &mut self,
        message: Message,
        bound: Bound,
        deferred: &mut DeferredActions,
    ) -> Result<Step, SubmitError> {
        let is_own = !message.header.kind.is_user();
        let step = self.take(message, bound, deferred)?;
        self.counters.accept(is_own);
        Ok(step)
    }

    /// Submits an outcome: the bounds do not apply while fewer than `waiting_max` are queued.
    pub(super) fn submit_outcome(
        &mut self,
        message: Message,
        waiting_max: usize,
        deferred: &mut DeferredActions,
    ) -> Result<Step, SubmitError> {
        let is_waived = self.unsent.queue.outcomes() < waiting_max;
        self.submit(message, if is_waived { Bound::Waived } else { Bound::Kept }, deferred)
    }

    fn take(
        &mut self,
        mut message: Message,
        bound: Bound,
        deferred: &mut DeferredActions,
    ) -> Result<Step, SubmitError> {
        if let Err(why) = self.admit(&message, bound) {
            self.counters.counts.refused += 1;
            return Err(SubmitError::new(message, why));
        }
        if message.header.kind == Kind::OUTCOME {
            // In the queue it is the number of further outcomes.
            message.header.sequence = 0;
        }
        message.header.flags = match message.receipt {
            Some(_) => message.header.flags.with(Flags::CONFIRM),
            None => message.header.flags.without(Flags::CONFIRM),
        };
        let held = self.unsent.held_key(&message.header);
        // The check runs in any case, because messages that arrive while others are queued count, too.
        let is_burst = held.is_none() && self.connection.gathers() && self.bursts.is_burst(&message);
        // A message of a burst is queued. It is checked when it is taken out, mostly within microseconds. A value is
        // checked here, because an expired one must not take the place of an older one that has not expired.
        let is_checked_later = is_burst && message.header.class != Class::Stream;
        if !is_checked_later && message.header.time_to_live_us != 0 && message.header.is_expired(Time::now())
        {
            self.expired(message, deferred);
            return Ok(Step::Done);
        }
        if let Some(key) = held {
            return self.hold(key, message).map(|()| Step::Done);
        }
        let is_left = is_for_drainer(&message);
        if self.waiting() > 0 || !self.takes_new() || is_burst || is_left {
            let is_delayable = is_delayable(&message);
            self.enqueue(message, bound)?;
            if !is_left {
                self.help(deferred);
            }
            self.request_drain(is_delayable, deferred);
            return Ok(Step::Done);
        }
        let mut frame = self.frame(message);
        self.receipts.add_waiting(confirming_destination(&frame.message));
        match self.write(&mut frame) {
            Written::Whole => {
                self.sent(&mut frame);
                // The clock is read only if the rate matters.
                if self.connection.gathers() {
                    self.bursts.written(Time::now());
                }
            }
            Written::Piece => {
                self.connection.partial = Some(frame);
                return Ok(Step::More);
            }
            Written::InPart if frame.written > 0 => {
                self.connection.partial = Some(frame);
                self.connection.wake_drainer(deferred);
            }
            Written::InPart | Written::Broken => {
                return self.requeue(frame, bound, deferred).map(|()| Step::Done);
            }
        }
        Ok(Step::Done)
    }

    fn admit(&self, message: &Message, bound: Bound) -> Result<(), Rejection> {
        let confirmed = message.receipt.is_some();
        if let Some(why) = self.connection.why_closed() {
            Err(why)
        } else if self.link_frames.is_finishing() {
            Err(Rejection::Closed)
        } else if message.payload.len() > self.payload_max {
            Err(Rejection::TooLong)
        } else if confirmed && message.header.class == Class::Stream {
            // A Stream message may be superseded, and no outcome describes that truthfully.
            Err(Rejection::Unsupported)
        } else if let Some(destination) = confirming_destination(message)
            && bound == Bound::Kept
            && self.receipts.is_at_bound(destination)
        {
            Err(Rejection::QueueFull)
        } else {
            Ok(())
        }
    }

    /// Adds an outcome to the queued one of the message before, if the peer accepts both in one frame. Returns whether
    /// it does. The drain task is awake or will be woken for that one.
    pub(super) fn extend_outcome(
        &mut self,
        ticket: Ticket,
        outcome: Outcome,
        deferred: &mut DeferredActions,
    ) -> bool {
        let Some(link) = self.numbering.outcomes_header() else { return false };
        let max = outcomes::frame_max(link.kind, self.payload_max);
        let is_added =
            !self.link_frames.is_finishing() && self.unsent.queue.extend_outcome(ticket, outcome, max);
        if is_added {
            self.connection.joins_delayed();
            self.help(deferred);
        }
        is_added
    }

    fn hold(&mut self, key: u64, message: Message) -> Result<(), SubmitError> {
        let confirming_destination = confirming_destination(&message);
        self.unsent.hold(key, message).inspect_err(|_| self.counters.counts.refused += 1)?;
        self.receipts.add_waiting(confirming_destination);
        Ok(())
    }

    fn enqueue(&mut self, message: Message, bound: Bound) -> Result<(), SubmitError> {
        let confirming_destination = confirming_destination(&message);
        let supersedes =
            self.unsent.enqueue(message, bound).inspect_err(|_| self.counters.counts.refused += 1)?;
        self.counters.counts.superseded += u64::from(supersedes);
        self.receipts.add_waiting(confirming_destination);
        Ok(())
    }

    /// Queues a frame that was to be written at once and could not be.
    fn requeue(
        &mut self,
        frame: Partial,
        bound: Bound,
        deferred: &mut DeferredActions,
    ) -> Result<(), SubmitError> {
        self.receipts.remove_waiting(confirming_destination(&frame.message));
        self.counters.numbered -= u64::from(self.numbering.take_back());
        self.enqueue(frame.message, bound)?;
        self.request_drain(false, deferred);
        Ok(())
    }

    /// Undoes the refusal of a message that found no room, as its sender keeps it, and registers the sender. Does
    /// nothing after another refusal.
    pub(super) fn undo_refusal(
        &mut self,
        SubmitError { message, why }: &SubmitError,
        room: Option<&Waker>,
        deferred: &mut DeferredActions,
    ) {
        if *why != Rejection::QueueFull {
            return;
        }
        self.counters.counts.refused -= 1;
        let Some(room) = room else { return };
        if !confirming_destination(message)
            .is_some_and(|destination| self.receipts.await_fewer(destination, room, deferred))
        {
            deferred.room.extend(self.unsent.offered(message, room));
        }
    }

    pub(super) fn submit_urgent(
        &mut self,
        message: Message,
        waiting_max: usize,
        deferred: &mut DeferredActions,
    ) -> Result<(), SubmitError> {
        if !self.connection.is_up() {
            return Err(SubmitError::new(message, Rejection::Closed));
        }
        if self.link_frames.push(message, waiting_max, self.numbering.has_session())? == Pushed::ReplacedAck {
            return Ok(());
        }
        if !self.connection.is_within_frame() && self.link_frames.urgent() == 1 {
            self.write_next(deferred);
        }
        if self.urgent_left() > 0 {
            self.connection.wake_drainer(deferred);
        }
        Ok(())
    }

    /// Returns the urgent frames that are not completely written. Gathered bytes count as one frame, because
    /// an urgent frame may be among them.
    pub(super) fn urgent_left(&self) -> usize {
        let partial = self.connection.partial.as_ref();
        let is_of_link = partial.is_some_and(|partial| partial.origin == FrameOrigin::Link);
        self.link_frames.urgent() + usize::from(is_of_link) + usize::from(self.connection.gathered() > 0)
    }

    pub(super) fn finish(&mut self, last: Message, deferred: &mut DeferredActions) {
        self.link_frames.finish(last);
        if self.waiting() == 1 && self.has_frame() && self.connection.is_up() {
            self.write_next(deferred);
        }
        self.connection.wake_drainer(deferred);
    }

    /// Whether a message that was never sent may be written now.
    fn takes_new(&self) -> bool {
        self.connection.is_up() && self.numbering.has_room()
    }

    /// Encodes a message as a frame of the current connection.
    #[inline]
    pub(super) fn frame(&mut self, mut message: Message) -> Partial {
        self.counters.numbered += u64::from(self.numbering.number(&mut message));
        Partial::new(message, self.connection.checksum(), FrameOrigin::Sender)
    }

    /// Encodes a frame of the connection itself.
    pub(super) fn link_frame(&self, message: Message) -> Partial {
        Partial::new(message, self.connection.checksum(), FrameOrigin::Link)
    }

    pub(super) fn write(&mut self, frame: &mut Partial) -> Written {
        if !self.connection.is_up() {
            return Written::Broken;
        }
        let ticket = frame.message.receipt.as_ref().map(Receipt::ticket);
        // The outcome may arrive before the write has returned, and does not wait for the outlet's lock.
        ticket.into_iter().for_each(|ticket| self.receipts.begin_write(ticket));
        let written = self.connection.write(frame);
        if ticket.is_some() && !matches!(written, Written::Whole) {
            // An incomplete frame cannot have been handled, so a reported outcome is ignored.
            self.receipts.end_write();
        }
        written
    }

    /// Processes a frame that was written whole: takes its receipt.
    pub(super) fn sent(&mut self, frame: &mut Partial) {
        if frame.origin == FrameOrigin::Sender {
            self.sent_message(&mut frame.message);
        }
    }

    /// Same as [`sent`](Self::sent), for a sender's message that was written for the first time.
    #[inline]
    pub(super) fn sent_message(&mut self, message: &mut Message) {
        self.counters.counts.sent += messages_in(message);
        self.connection.note_sent(&message.header);
        let expiry = message.header.expiry();
        if let Some(receipt) = message.receipt.take() {
            let written = self.connection.written();
            self.early_outcomes.extend(self.receipts.sent(SentMessage { receipt, expiry, written }));
        }
    }

    /// Returns the number of messages and frames that wait to be sent, without the backlog.
    pub(super) fn waiting(&self) -> usize {
        let partial = usize::from(self.connection.partial.is_some());
        self.unsent.ready()
            + self.link_frames.urgent()
            + self.numbering.behind()
            + partial
            + usize::from(self.connection.gathered() > 0)
            + usize::from(self.link_frames.is_last_pending())
    }

    /// Processes the peer's ACK on `link`, which names the next message that the peer expects. Returns
    /// whether the new epoch must be announced to the peer at once.
    pub(super) fn on_ack(
        &mut self,
        link: LinkNumber,
        ack: &Ack,
        now: Time,
        deferred: &mut DeferredActions,
    ) -> bool {
        if !self.connection.is_present(link) {
            return false;
        }
        let had_frame = self.has_frame();
        let Some(effect) = self.numbering.on_ack(ack) else { return false };
        deferred.room.extend(self.unsent.on_held(ack));
        // A frame that could be written before has its wake. In a flood another one for each ACK would end its delay.
        if !had_frame && self.has_frame() || !matches!(effect, AckEffect::Known) {
            self.connection.wake_drainer(deferred);
        }
        match effect {
            AckEffect::Known => false,
            AckEffect::Resumed => {
                self.void(now, deferred);
                false
            }
            AckEffect::Reset(kept) => {
                self.counters.lose_numbered(kept.len() as u64);
                self.settle_unknown(deferred);
                true
            }
        }
    }

    /// Sends an ACK that names `epoch` ahead of all queued messages. Messages that were held back until the
    /// peer knows that epoch follow it. Returns whether `epoch` is the current one; if not, the frame is
    /// dropped, and the caller must create another one.
    pub(super) fn acknowledge(
        &mut self,
        ack: Message,
        link: LinkNumber,
        epoch: u64,
        deferred: &mut DeferredActions,
    ) -> bool {
        if epoch != self.numbering.epoch() {
            return false;
        }
        if !self.connection.is_present(link) {
            return true;
        }
        // Without a connection the ACK is not needed, and the next connection begins with another.
        if self.submit_urgent(ack, usize::MAX, deferred).is_ok() && self.numbering.epoch_announced(epoch) {
            self.hand_to_drainer(deferred);
        }
        true
    }

    /// Replaces numbered messages that are not needed any more by voids.
    fn void(&mut self, now: Time, deferred: &mut DeferredActions) {
        for message in self.numbering.void(&self.unsent.queue, now) {
            let header = &message.header;
            self.counters.void(header.is_expired(now) || header.flags.has(Flags::ASK));
            if header.flags.has(Flags::CONFIRM) {
                self.receipts.confirm(message.ticket(), Outcome::Expired, deferred);
            }
        }
    }

    /// Settles a message that was never sent as expired.
    pub(super) fn expired(&mut self, message: Message, deferred: &mut DeferredActions) {
        self.counters.counts.expired += 1;
        deferred.settle(message.receipt.map(|receipt| (receipt, Outcome::Expired)));
        self.receipts.wake_if_fewer_open(deferred);
        if self.link_frames.is_last_pending() {
            // That frame may have waited for this message alone.
            self.connection.wake_drainer(deferred);
        }
    }

    /// Cancels a request that no caller awaits any more: it expires unless it has been started. Returns
    /// whether it was queued here.
    pub(super) fn cancel(&mut self, ticket: Ticket, deferred: &mut DeferredActions) -> bool {
        let Some(message) = self.unsent.take_request(ticket) else { return false };
        deferred.room.extend(self.unsent.backlog_changed());
        self.receipts.remove_waiting(confirming_destination(&message));
        self.expired(message, deferred);
        true
    }

    /// Returns whether any message is left that can expire, or any outcome that can become overdue.
    pub(super) fn expire(&mut self, now: Time, deferred: &mut DeferredActions) -> bool {
        let expired = self.unsent.take_expired(now);
        if !expired.is_empty() {
            deferred.room.extend(self.unsent.backlog_changed());
        }
        for message in expired {
            self.receipts.remove_waiting(confirming_destination(&message));
            self.expired(message, deferred);
        }
        self.unsent.next_expiry() != Time::MAX || self.receipts.len() > 0
    }

    /// Returns the peer's progress, or `None` without a connection.
    pub(super) fn taking(&mut self) -> Option<Taking> {
        self.connection.progress(&self.unsent, self.counters.counts.sent)
    }

    /// Returns the number of written bytes that the peer has not taken, if it is known.
    pub(super) fn unread(&mut self) -> Option<u64> {
        self.connection.unread()
    }

    /// Returns the number of queued messages, and of those kept because their arrival is not acknowledged.
    pub(super) fn left(&self) -> usize {
        self.unsent.len() + self.numbering.kept()
    }

    /// Returns the number of application messages among [`left`](Self::left), without the messages between
    /// layers.
    pub(super) fn left_of_applications(&self) -> usize {
        let is_one = |message: &Message| !message.header.source.app.is_layer();
        let waiting = self.unsent.iter().filter(|message| is_one(message)).count();
        // Messages in the backlog are for mailboxes.
        waiting + self.numbering.kept_that(is_one) + self.unsent.in_backlog()
    }

    pub(super) const fn counts(&self) -> OutletCounts {
        self.counters.counts
    }

    /// Returns where every accepted message is, and the position of the session.
    pub(super) fn account(&self) -> (OutletAccount, Option<SendPosition>) {
        let partial = self.connection.partial.as_ref();
        let begun = partial.is_some_and(|partial| partial.origin == FrameOrigin::Sender);
        let has_session = self.numbering.has_session();
        let waiting = self.unsent.len() + usize::from(begun && !has_session);
        let (unacknowledged, position) = self.numbering.unacknowledged();
        (self.counters.account(waiting as u64, has_session.then_some(unacknowledged)), position)
    }
}
