//! Frames of the connection itself: urgent ones, which are sent ahead of the queue, and the last one.

use std::collections::VecDeque;

use sinew_runtime::{
    outcome::Rejection,
    router::SubmitError,
    wire::{Kind, Message},
};

/// The frames of the connection itself that wait to be sent.
#[derive(Default)]
pub(super) struct LinkFrames {
    /// Frames that are sent ahead of the queue, in their order.
    urgent: VecDeque<Message>,
    /// The message sent when the queue is empty, on the connection current at that time. Nothing is accepted
    /// after it.
    last: Option<Message>,
    /// Whether `last` was sent on the current connection.
    is_last_sent: bool,
    /// Whether an ACK with the next expected message was sent on the current connection, or is about to be.
    has_sent_ack: bool,
}

/// The effect of an urgent frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pushed {
    Queued,
    /// The frame replaces an older ACK that has not been sent.
    ReplacedAck,
}

impl LinkFrames {
    /// Starts on a new connection.
    pub(super) const fn restart(&mut self) {
        (self.is_last_sent, self.has_sent_ack) = (false, false);
    }

    /// Drops the urgent frames of a connection that has ended.
    pub(super) fn clear_urgent(&mut self) {
        self.urgent.clear();
    }

    /// Queues an urgent frame behind earlier ones, at most `waiting_max`. `has_session`: with a session, no
    /// frame of any thread precedes the ACK with the next expected message. spec: SESSION-3
    pub(super) fn push(
        &mut self,
        frame: Message,
        waiting_max: usize,
        has_session: bool,
    ) -> Result<Pushed, SubmitError> {
        let is_ack = frame.header.kind == Kind::GNCL_ACK;
        self.has_sent_ack |= is_ack || !has_session;
        if !self.has_sent_ack {
            return Err(SubmitError::new(frame, Rejection::Closed));
        }
        if is_ack
            && let Some(older) = self.urgent.iter_mut().find(|older| older.header.kind == Kind::GNCL_ACK)
        {
            // The newer ACK contains all information of the older one, so an ACK never exceeds the bound.
            // Without the last ACK, the peer would keep taken messages forever, and hold back messages for
            // an application that accepts them again.
            *older = frame;
            return Ok(Pushed::ReplacedAck);
        }
        // At most one ACK is pending.
        if self.urgent.len() >= waiting_max && !is_ack {
            return Err(SubmitError::new(frame, Rejection::QueueFull));
        }
        self.urgent.push_back(frame);
        Ok(Pushed::Queued)
    }

    #[inline]
    pub(super) fn pop_urgent(&mut self) -> Option<Message> {
        self.urgent.pop_front()
    }

    /// Returns the number of urgent frames.
    #[inline]
    pub(super) fn urgent(&self) -> usize {
        self.urgent.len()
    }

    /// Sets the last frame.
    pub(super) fn finish(&mut self, last: Message) {
        self.last = Some(last);
    }

    /// Whether nothing is accepted any more, because the last frame is set.
    #[inline]
    pub(super) const fn is_finishing(&self) -> bool {
        self.last.is_some()
    }

    /// Whether the last frame is set and was not sent on the current connection.
    #[inline]
    pub(super) const fn is_last_pending(&self) -> bool {
        self.last.is_some() && !self.is_last_sent
    }

    /// Returns the last frame, once per connection: a broken connection loses it.
    pub(super) fn take_last(&mut self) -> Option<Message> {
        self.is_last_sent = true;
        self.last.as_ref().map(|last| Message::new(last.header, last.payload.clone()))
    }
}
