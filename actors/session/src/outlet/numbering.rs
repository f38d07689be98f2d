//! The session of an outlet: numbers of sent messages, and retransmission on the next connection.

use std::collections::BTreeSet;

use sinew_runtime::{
    mailbox::is_same_stream,
    time::Time,
    wire::{Checksum, Class, Flags, Header, Kind, Message},
};

use super::{
    partial::{FrameOrigin, Partial},
    queue::SendQueue,
};
use crate::{Ack, AckEffect, SendPosition, Sending, Window};

/// The messages kept for the peer.
pub struct Session {
    sending: Sending<Message>,
    /// The header of a void, which replaces a message that is not needed any more.
    void: Header,
    /// The header of a frame with several outcomes, each alone or in runs, if the peer supports it.
    outcomes: Option<Header>,
    /// Maximum number of confirmed messages for which the peer has room for outcomes.
    pub(super) outcome_room: usize,
}

impl Session {
    /// Creates a session in which nothing was sent yet; see [`Sending::new`].
    pub fn new(epoch: u64, window: Window, void: Header, outcomes: Option<Header>) -> Self {
        Self { sending: Sending::new(epoch, window), void, outcomes, outcome_room: usize::MAX }
    }

    /// Sets the peer's room for outcomes: no more confirmed messages are pending, even if the local bounds
    /// allow more.
    pub fn answered_up_to(self, outcome_room: usize) -> Self {
        Self { outcome_room, ..self }
    }

    /// Returns the bounds of the unacknowledged messages.
    pub(super) const fn window(&self) -> Window {
        self.sending.window()
    }
}

/// The numbers of sent messages, which a session keeps for retransmission. Without a session there is only
/// one connection, and messages have no numbers.
pub(super) struct Numbering(Option<Session>);

impl Numbering {
    pub(super) const fn new(session: Option<Session>) -> Self {
        Self(session)
    }

    /// Whether there is a session.
    #[inline]
    pub(super) const fn has_session(&self) -> bool {
        self.0.is_some()
    }

    /// Whether a message that was never sent may be sent now.
    #[inline]
    pub(super) fn has_room(&self) -> bool {
        self.0.as_ref().is_none_or(|session| session.sending.has_room())
    }

    /// Whether every numbered message was written on this connection or acknowledged.
    pub(super) fn is_through(&self) -> bool {
        self.0.as_ref().is_none_or(|session| session.sending.is_through())
    }

    /// Returns the number of messages to retransmit.
    #[inline]
    pub(super) fn behind(&self) -> usize {
        self.0.as_ref().map_or(0, |session| session.sending.behind())
    }

    /// Returns the number of written messages that the peer has not acknowledged.
    pub(super) fn kept(&self) -> usize {
        self.0.as_ref().map_or(0, |session| session.sending.kept())
    }

    /// Returns the number of kept messages, without voids, that satisfy `is_one`.
    pub(super) fn kept_that(&self, is_one: impl Fn(&Message) -> bool) -> usize {
        self.0.as_ref().map_or(0, |session| session.sending.kept_that(is_one))
    }

    /// Returns the number of numbered messages that are not known to have arrived, and the position of the
    /// session.
    pub(super) fn unacknowledged(&self) -> (u64, Option<SendPosition>) {
        let Some(Session { sending, .. }) = &self.0 else { return (0, None) };
        (sending.kept_without_voids() as u64, Some(sending.position()))
    }

    pub(super) fn epoch(&self) -> u64 {
        self.0.as_ref().map_or(0, |session| session.sending.epoch())
    }

    /// Returns the header of a frame with several outcomes, if the peer supports it.
    #[inline]
    pub(super) fn outcomes_header(&self) -> Option<Header> {
        self.0.as_ref().and_then(|session| session.outcomes)
    }

    /// Assigns a number to a message, and keeps a copy that shares its payload. Returns whether there is a
    /// session.
    #[inline]
    pub(super) fn number(&mut self, message: &mut Message) -> bool {
        if let Some(session) = &mut self.0 {
            let kept = Message::new(message.header, message.payload.clone());
            message.header.number = session.sending.keep(kept, message.size()) as u16;
        }
        self.0.is_some()
    }

    /// Sets the number of a message that is [kept](Self::keep) next. Returns whether there is a session.
    #[inline]
    pub(super) fn assign(&self, header: &mut Header) -> bool {
        if let Some(session) = &self.0 {
            header.number = session.sending.next_number() as u16;
        }
        self.0.is_some()
    }

    /// Keeps a message with an [assigned](Self::assign) number itself, not a copy.
    #[inline]
    pub(super) fn keep(&mut self, message: Message) {
        if let Some(session) = &mut self.0 {
            let size = message.size();
            session.sending.keep(message, size);
        }
    }

    /// Removes the last number, because no byte of its message was written. Returns whether there is a
    /// session.
    pub(super) fn take_back(&mut self) -> bool {
        if let Some(session) = &mut self.0 {
            session.sending.take_back();
        }
        self.0.is_some()
    }

    /// Removes all kept messages. Returns their number, without voids.
    pub(super) fn forget(&mut self) -> u64 {
        self.0.as_mut().map_or(0, |session| session.sending.drain().len() as u64)
    }

    /// Processes the end of the connection.
    pub(super) const fn link_ended(&mut self) {
        if let Some(session) = &mut self.0 {
            session.sending.link_ended();
        }
    }

    /// Returns the next frame to retransmit.
    #[inline]
    pub(super) fn next_retransmission(&mut self, checksum: impl FnOnce() -> Checksum) -> Option<Partial> {
        let session = self.0.as_mut()?;
        let (number, kept) = session.sending.again()?;
        let mut message = match kept {
            Some(kept) => Message::new(kept.header, kept.payload.clone()),
            None => Message::new(session.void, bytes::Bytes::new()),
        };
        message.header.number = number as u16;
        Some(Partial::new(message, checksum(), FrameOrigin::Retransmission))
    }

    /// Processes the peer's ACK; `None` without a session.
    pub(super) fn on_ack(&mut self, ack: &Ack) -> Option<AckEffect<Message>> {
        self.0.as_mut().map(|session| session.sending.on_ack(ack))
    }

    /// Records that an ACK naming `epoch` is sent ahead of later messages. Returns whether messages may
    /// follow that waited for it.
    pub(super) fn epoch_announced(&mut self, epoch: u64) -> bool {
        self.0.as_mut().is_some_and(|session| session.sending.epoch_announced(epoch))
    }

    /// Replaces messages that have expired or been superseded by voids, so that they are not retransmitted.
    /// They have not arrived, so the outcome is true. Returns these messages. spec: SESSION-6
    pub(super) fn void(&mut self, queue: &SendQueue, now: Time) -> Vec<Message> {
        let Some(session) = &mut self.0 else { return Vec::new() };
        let mut newer = Vec::<Header>::new();
        // The message that cancels a request is queued behind it.
        let cancels = queue.iter().filter(|message| message.header.kind == Kind::CANCEL);
        let given_up: BTreeSet<_> =
            cancels.map(|message| (message.header.source, message.header.correlation)).collect();
        let is_given_up = |header: &Header| {
            header.flags.has(Flags::ASK) && given_up.contains(&(header.source, header.correlation))
        };
        session.sending.void(|Message { header, .. }| {
            let is_old = queue.supersedes(header) || newer.iter().any(|newer| is_same_stream(newer, header));
            if header.class == Class::Stream {
                newer.push(*header);
                is_old || header.is_expired(now)
            } else {
                header.is_expired(now) || is_given_up(header)
            }
        })
    }
}
