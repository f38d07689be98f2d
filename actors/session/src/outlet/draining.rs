//! Continued writing: the next frame, the next piece of a long one, and when to yield to other tasks.

use std::{
    io,
    task::{Context, Poll},
};

use sinew_runtime::{
    time::Time,
    wire::{HEADER_LEN, Kind, Message},
};

use super::{
    LinkNumber, Socket,
    batch::SHORT,
    deferred::DeferredActions,
    outcomes::{self, with_outcomes_behind},
    outstanding::confirming_destination,
    partial::{Partial, Written},
    writer_state::{Step, WriterState},
};

/// Frames, or pieces of frames, that the drain task writes before it yields to other tasks of its thread.
const WRITES_PER_WAKE: usize = 64;
/// Bytes that the drain task writes before it yields.
const BYTES_PER_WAKE: usize = 64 << 10;

/// Queued bytes of short frames at which a sender writes them itself, all at once: nearly as many as a receiver reads
/// in a turn. A write has a fixed cost at both ends, for the system call and perhaps a wake. Meanwhile other senders
/// and acknowledgements of the connection wait for the lock, for as long as a piece of a long frame takes.
const HELP_AT_BYTES: usize = 60 << 10;
/// Queued messages at which a sender writes them itself, however short they are.
const HELP_AT: usize = 128;
/// Same as [`HELP_AT`], for longer messages. The drain task writes these better while it keeps up, because
/// each takes about as long as a wake.
const HELP_AT_LONG: usize = 32;

/// Why the drain task stops writing.
pub(super) enum Drained {
    /// The connection cannot be written to any more.
    Over(io::Error),
    /// The drain task has used its share of this turn.
    Enough,
}

impl<S: Socket> WriterState<S> {
    pub(super) fn poll_drain(
        &mut self,
        link: LinkNumber,
        cx: &mut Context<'_>,
        deferred: &mut DeferredActions,
    ) -> Poll<Drained> {
        self.connection.poll_delayed_wake(cx);
        self.checked_at = None;
        let mut bytes = 0;
        for _ in 0..WRITES_PER_WAKE {
            if let Some(end) = self.connection.end_of(link) {
                return Poll::Ready(Drained::Over(end));
            }
            self.connection.register_drainer(cx.waker());
            if !self.has_frame() {
                return Poll::Pending;
            }
            match self.connection.poll_writable(cx) {
                None => continue,
                Some(Poll::Pending) => return Poll::Pending,
                Some(Poll::Ready(Err(error))) => self.connection.fail(error),
                Some(Poll::Ready(Ok(()))) => bytes += self.gather_next(deferred),
            }
            if bytes >= BYTES_PER_WAKE || self.connection.is_gathered_full() {
                break;
            }
        }
        self.connection.write_gathered();
        Poll::Ready(Drained::Enough)
    }

    /// Lets a sender write the queued messages, if they are many and the socket may accept them. A sender
    /// of a burst therefore writes its messages on its own thread.
    pub(super) fn help(&mut self, deferred: &mut DeferredActions) {
        if !self.connection.gathers() || self.connection.is_within_frame() || !self.has_much() {
            return;
        }
        self.checked_at = None;
        let mut bytes = 0;
        for _ in 0..HELP_AT {
            if bytes >= BYTES_PER_WAKE || self.connection.is_gathered_full() || !self.has_frame() {
                break;
            }
            bytes += self.gather_next(deferred);
        }
        self.connection.write_gathered();
        self.connection.wrote_delayed();
        self.bursts.written(Time::now());
        if !self.connection.is_up() {
            // The drain task reports the failed write. Its delayed wake has ended with the socket.
            self.connection.wake_drainer(deferred);
        }
    }

    /// Whether the number of queued messages is so high that the sender should write them itself.
    fn has_much(&self) -> bool {
        let queue = &self.unsent.queue;
        // Outcomes that were added to others count, too: as many messages are about to wait for them.
        let messages = queue.len().max(queue.outcomes());
        let bytes = messages * HEADER_LEN + queue.bytes();
        if bytes <= messages * SHORT {
            bytes >= HELP_AT_BYTES || messages >= HELP_AT
        } else {
            messages >= HELP_AT_LONG
        }
    }

    /// Makes the drain task write queued messages. The wake is delayed if `is_delayable`, because more
    /// messages of this kind are expected.
    pub(super) fn request_drain(&mut self, is_delayable: bool, deferred: &mut DeferredActions) {
        let (has_frame, is_stuck) = (self.has_frame(), self.connection.is_within_frame());
        if self.connection.is_up()
            && (!has_frame || is_delayable && !is_stuck && self.connection.wake_later())
        {
            return;
        }
        self.connection.wake_drainer(deferred);
    }

    /// Wakes the drain task if there is anything to write.
    pub(super) fn hand_to_drainer(&mut self, deferred: &mut DeferredActions) {
        if self.waiting() > 0 {
            self.connection.wake_drainer(deferred);
        }
    }

    /// Gathers the next frame. If there is none, or no room for it, writes the gathered bytes and then the
    /// next piece of the frame. Returns how many bytes the socket has accepted.
    fn gather_next(&mut self, deferred: &mut DeferredActions) -> usize {
        let frame = if let Some(frame) = self.next_started() {
            let Err(frame) = self.gather(frame) else { return 0 };
            frame
        } else {
            let Some(message) = self.next_message(deferred) else { return self.connection.write_gathered() };
            let Err(message) = self.gather_message(message) else { return 0 };
            self.frame(message)
        };
        let taken = self.connection.write_gathered();
        if self.connection.gathered() > 0 {
            self.connection.partial = Some(frame);
            return taken;
        }
        // The frame joins the frames behind it, unless it is too long for the buffer.
        match self.gather(frame) {
            Ok(()) => taken,
            Err(frame) => taken + self.write_frame(frame),
        }
    }

    /// Gathers the frame of a message that was never sent, if there is room. In a burst this is nearly every message:
    /// it is encoded where it is gathered, and the session keeps the message itself.
    fn gather_message(&mut self, mut message: Message) -> Result<(), Message> {
        if message.size() > self.connection.gather_room() {
            return Err(message);
        }
        self.counters.numbered += u64::from(self.numbering.assign(&mut message.header));
        self.connection.gather_message(&message);
        self.sent_message(&mut message);
        self.numbering.keep(message);
        Ok(())
    }

    /// Gathers a frame that has not been started, if there is room.
    fn gather(&mut self, mut frame: Partial) -> Result<(), Partial> {
        if self.connection.gather(&frame) {
            self.sent(&mut frame);
            return Ok(());
        }
        Err(frame)
    }

    /// Writes the next frame, or its next piece. Returns how many bytes the socket has accepted.
    pub(super) fn write_next(&mut self, deferred: &mut DeferredActions) -> usize {
        self.checked_at = None;
        self.next_frame(deferred).map_or(0, |frame| self.write_frame(frame))
    }

    fn write_frame(&mut self, mut frame: Partial) -> usize {
        let before = frame.written;
        let result = self.write(&mut frame);
        let taken = frame.written - before;
        match result {
            Written::Whole => self.sent(&mut frame),
            Written::Piece | Written::InPart | Written::Broken => self.connection.partial = Some(frame),
        }
        taken
    }

    fn next_frame(&mut self, deferred: &mut DeferredActions) -> Option<Partial> {
        self.next_started().or_else(|| {
            let message = self.next_message(deferred)?;
            Some(self.frame(message))
        })
    }

    /// Returns the next frame that precedes all messages that were never sent, or the last one behind them.
    fn next_started(&mut self) -> Option<Partial> {
        // Nearly always there is none, which is cheaper to see than to take.
        if self.connection.partial.is_some() {
            return self.connection.partial.take();
        }
        if let Some(urgent) = self.link_frames.pop_urgent() {
            return Some(self.link_frame(urgent));
        }
        if let Some(again) = self.numbering.next_retransmission(|| self.connection.checksum()) {
            return Some(again);
        }
        if self.unsent.is_empty() {
            let last = if self.is_last_due() { self.link_frames.take_last() } else { None };
            return last.map(|last| self.link_frame(last));
        }
        None
    }

    /// Returns the next message that was never sent.
    fn next_message(&mut self, deferred: &mut DeferredActions) -> Option<Message> {
        if self.unsent.is_empty() || !self.numbering.has_room() {
            return None;
        }
        let mut message = self.unsent.pop()?;
        // One look at the clock serves all frames of a turn. The receiver checks the time to live again.
        let is_expired = message.header.time_to_live_us != 0
            && message.header.is_expired(*self.checked_at.get_or_insert_with(Time::now));
        if message.header.kind == Kind::OUTCOME && !is_expired {
            message = self.with_outcomes_behind(message);
        }
        // Outcomes that left with the first one have made room, too.
        if self.unsent.is_awaited() {
            deferred.room.extend(self.unsent.room_made());
        }
        if is_expired {
            self.receipts.remove_waiting(confirming_destination(&message));
            self.expired(message, deferred);
            return None;
        }
        Some(message)
    }

    /// Combines an outcome with those behind it.
    fn with_outcomes_behind(&mut self, first: Message) -> Message {
        if outcomes::count(&first) > 1 && self.connection.gathers() {
            // An outcome that is added to another is no part of the burst, which saves a look at the clock.
            self.bursts.written(Time::now());
        }
        let link = self.numbering.outcomes_header();
        with_outcomes_behind(first, link, self.payload_max, &mut self.unsent.queue, &mut self.counters)
    }

    /// Writes the next piece of the started frame.
    pub(super) fn write_on(&mut self, deferred: &mut DeferredActions) -> Step {
        let Some(mut frame) = self.connection.partial.take() else { return Step::Done };
        match self.write(&mut frame) {
            Written::Whole => self.sent(&mut frame),
            Written::Piece => {
                self.connection.partial = Some(frame);
                return Step::More;
            }
            Written::InPart | Written::Broken => self.connection.partial = Some(frame),
        }
        self.hand_to_drainer(deferred);
        Step::Done
    }

    /// Whether a frame can be written now. Each step that makes this true wakes the drain task, now or
    /// [later](super::delayed_wake): an ACK does not wake it again.
    pub(super) fn has_frame(&self) -> bool {
        let waits = !self.unsent.is_empty();
        self.connection.is_within_frame()
            || self.link_frames.urgent() > 0
            || self.numbering.behind() > 0
            || waits && self.numbering.has_room()
            || !waits && self.is_last_due()
    }

    /// Whether the last frame is due: the session has nothing left to send, neither here nor for
    /// retransmission.
    fn is_last_due(&self) -> bool {
        self.link_frames.is_last_pending() && self.unsent.in_backlog() == 0 && self.numbering.is_through()
    }
}
