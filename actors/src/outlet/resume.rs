//! The session of an outlet: numbers on the way out, and what is sent again on the next connection.

use std::collections::BTreeSet;

use sinew_runtime::{
    mailbox::is_same_stream,
    outcome::Outcome,
    time::Time,
    wire::{Class, Flags, Header, Kind, Message},
};

use super::{
    LinkNumber, Socket,
    after::After,
    half::Half,
    held::LIMITS_OF_LINES,
    partial::{Partial, Sort},
};
use crate::session::{Ack, Heard, Held, Sending, Sent, ShelfLimits, Window};

/// What is kept for the peer.
pub(crate) struct Session {
    sending: Sending<Message>,
    /// What waits for destinations that take nothing now.
    pub(super) held: Held<u64, Message>,
    /// The header of what stands for a message that has lost its use.
    void: Header,
    /// That of several outcomes in one frame, where the peer takes them.
    pub(super) outcomes: Option<Header>,
    /// Confirmed messages at most for whose outcomes the peer has room.
    pub(super) answers_there: usize,
}

impl Session {
    /// Nothing was sent yet; see [`Sending::new`].
    pub(crate) fn new(epoch: u64, window: Window, void: Header, outcomes: Option<Header>) -> Self {
        let lines = ShelfLimits {
            line_messages: window.messages.div_ceil(4),
            messages: window.messages,
            ..LIMITS_OF_LINES
        };
        let sending = Sending::new(epoch, window);
        Self { sending, held: Held::new(lines), void, outcomes, answers_there: usize::MAX }
    }

    /// The peer has room for the outcomes of so many confirmed messages: no more are open, whatever our own bounds say.
    pub(crate) fn answered_up_to(self, answers_there: usize) -> Self {
        Self { answers_there, ..self }
    }
}

impl<S: Socket> Half<S> {
    pub(super) fn session_has_room(&self) -> bool {
        self.session.as_ref().is_none_or(|session| session.sending.has_room())
    }

    pub(super) fn session_is_through(&self) -> bool {
        self.session.as_ref().is_none_or(|session| session.sending.is_through())
    }

    /// Messages that are to be sent again.
    pub(super) fn behind(&self) -> usize {
        self.session.as_ref().map_or(0, |session| session.sending.behind())
    }

    /// What waits, and what is kept because nobody has said that it arrived.
    pub(super) fn left(&self) -> usize {
        let kept = self.session.as_ref().map_or(0, |session| session.sending.kept());
        self.waits_for_its_number() + kept
    }

    /// The messages of applications among these: not what layers tell each other.
    pub(super) fn left_of_applications(&self) -> usize {
        let is_one = |message: &Message| !message.header.source.app.is_layer();
        let waiting = self.queue.iter().chain(&self.interrupted).filter(|message| is_one(message)).count();
        let kept = self.session.as_ref().map_or(0, |session| session.sending.kept_that(is_one));
        // What waits in lines is for mailboxes.
        waiting + kept + self.in_lines()
    }

    /// What waits and has no number yet.
    pub(super) fn waits_for_its_number(&self) -> usize {
        self.queue.len() + usize::from(self.interrupted.is_some()) + self.in_lines()
    }

    /// Messages that have a number and have not arrived, as far as is known here, and how far the session is.
    pub(super) fn kept(&self) -> (u64, Option<Sent>) {
        let Some(Session { sending, .. }) = &self.session else { return (0, None) };
        (sending.kept_with_a_use() as u64, Some(sending.position()))
    }

    pub(super) fn epoch(&self) -> u64 {
        self.session.as_ref().map_or(0, |session| session.sending.epoch())
    }

    /// Gives a message its number, and keeps a copy that shares its payload.
    pub(super) fn number(&mut self, message: &mut Message) {
        if let Some(session) = &mut self.session {
            let kept = Message::new(message.header, message.payload.clone());
            message.header.number = session.sending.keep(kept, message.size()) as u16;
            self.tally.numbered += 1;
        }
    }

    pub(super) fn take_back(&mut self) {
        if let Some(session) = &mut self.session {
            session.sending.take_back();
            self.tally.numbered -= 1;
        }
    }

    pub(super) fn forget_kept(&mut self) {
        if let Some(session) = &mut self.session {
            let unknown = session.sending.drain().len() as u64;
            self.counts.lost += unknown;
            self.tally.unknown += unknown;
        }
    }

    /// The connection has ended. The frame that was being written is kept, like all before it.
    pub(super) fn pause(&mut self, partial: Option<Partial>) {
        if let Some(session) = &mut self.session {
            session.sending.link_ended();
            session.held.link_ended();
        }
        if let Some(partial) = partial {
            self.sent(partial);
        }
    }

    /// The next frame that is to be written again.
    pub(super) fn frame_again(&mut self) -> Option<Partial> {
        let checksum = self.checksum();
        let session = self.session.as_mut()?;
        let (number, kept) = session.sending.again()?;
        let mut message = match kept {
            Some(kept) => Message::new(kept.header, kept.payload.clone()),
            None => Message::new(session.void, bytes::Bytes::new()),
        };
        message.header.number = number as u16;
        Some(Partial::new(message, checksum, Sort::Again))
    }

    /// The peer has said on `link` what it takes next. Returns whether it must be told at once in which epoch that is.
    pub(super) fn heard(&mut self, link: LinkNumber, ack: &Ack, now: Time, after: &mut After) -> bool {
        if link.0 != self.number {
            return false;
        }
        let Some(session) = &mut self.session else { return false };
        let heard = session.sending.heard(ack);
        let turn = session.held.heard(ack.change, ack.held.iter().copied());
        self.turn(turn);
        self.wake_drainer(after);
        match heard {
            Heard::Known => false,
            Heard::Resumed => {
                self.void(now, after);
                false
            }
            Heard::Reset(kept) => {
                self.counts.lost += kept.len() as u64;
                self.tally.unknown += kept.len() as u64;
                self.unknown(after);
                true
            }
        }
    }

    /// An ACK that names `epoch` goes ahead of all that waits; what was held back until the peer knows of that epoch follows it. Returns
    /// whether that is the present one: if not, the frame is dropped, and another one is to be made.
    pub(super) fn acknowledge(
        &mut self,
        ack: Message,
        link: LinkNumber,
        epoch: u64,
        after: &mut After,
    ) -> bool {
        if epoch != self.epoch() {
            return false;
        }
        if !self.is_present(link) {
            return true;
        }
        // Without a connection nobody needs it, and the next one begins with another.
        if self.submit_urgent(ack, usize::MAX, after).is_ok()
            && let Some(session) = &mut self.session
            && session.sending.told(epoch)
        {
            self.hand_to_drainer(after);
        }
        true
    }

    /// What has expired, or has a newer value behind it, is not sent again. It has not arrived, so the outcome is true.
    fn void(&mut self, now: Time, after: &mut After) {
        let Some(session) = &mut self.session else { return };
        let (queue, mut newer) = (&self.queue, Vec::<Header>::new());
        // What tells the peer that a request was given up waits behind it.
        let cancels = queue.iter().filter(|message| message.header.kind == Kind::CANCEL);
        let given_up: BTreeSet<_> =
            cancels.map(|message| (message.header.source, message.header.correlation)).collect();
        let is_given_up = |header: &Header| {
            header.flags.has(Flags::ASK) && given_up.contains(&(header.source, header.correlation))
        };
        let void = session.sending.void(|Message { header, .. }| {
            let is_old = queue.supersedes(header) || newer.iter().any(|newer| is_same_stream(newer, header));
            if header.class == Class::Stream {
                newer.push(*header);
                is_old || header.is_expired(now)
            } else {
                header.is_expired(now) || is_given_up(header)
            }
        });
        for message in void {
            if message.header.is_expired(now) || message.header.flags.has(Flags::ASK) {
                self.tally.void_expired += 1;
            } else {
                self.tally.void_superseded += 1;
            }
            if message.header.flags.has(Flags::CONFIRM) {
                self.receipts.confirm(message.ticket(), Outcome::Expired, after);
            }
        }
    }
}
