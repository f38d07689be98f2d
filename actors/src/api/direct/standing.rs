//! One direct link that stands: a ring each way, and the socket whose hang-up is the peer's end.

use std::{
    os::{fd::AsFd, unix::net::UnixStream},
    sync::Arc,
};

use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    wire::{Class, Flags, Kind, Message},
};
use sinew_shm::{Consumer, Ends, HangUp};

use super::hang_up;
use crate::{
    api::{
        ApiError,
        lent::{Content, Draft},
        link::ring::{self, ENOUGH, End},
        routes::LinkNumber,
    },
    ring::{RingError, RingFrames, Taken},
};

/// Kinds of Stream whose newest value waits for room in the ring, at most. One of a further kind waits as other classes do.
const PARKED_MAX: usize = 64;

/// A link with both rings.
pub(in crate::api) struct Standing {
    own: Tid,
    pub(in crate::api) peer: Tid,
    pub(in crate::api) number: LinkNumber,
    pub(super) socket: Arc<UnixStream>,
    pub(super) writer: Arc<ring::Writer>,
    /// What comes on this link is settled on it.
    pub(in crate::api) sink: Arc<dyn ReceiptSink>,
    consumer: Consumer,
    frames: RingFrames,
    /// The newest value of each kind of Stream that found no room: an older one must not come later.
    parked: Vec<Message>,
    has_forged: bool,
}

/// Whom a link is between.
pub(super) struct Pair {
    pub(super) own: Tid,
    pub(super) peer: Tid,
    pub(super) number: LinkNumber,
    /// Hangs up with the peer.
    pub(super) socket: Arc<UnixStream>,
}

/// What the ring of a link gave.
pub(in crate::api) enum Came {
    Message(Message),
    /// It was none to be received; there may be more.
    Refused,
    Nothing,
}

impl Standing {
    pub(super) fn new(pair: Pair, writer: ring::Writer, consumer: Consumer, payload_max: usize) -> Self {
        let Pair { own, peer, number, socket } = pair;
        let (writer, frames) = (Arc::new(writer), RingFrames::new(payload_max));
        Self {
            own,
            peer,
            number,
            socket,
            sink: writer.clone(),
            writer,
            consumer,
            frames,
            parked: Vec::new(),
            has_forged: false,
        }
    }

    /// Sends a message: in place if it lies in this link's ring, else as [`send`](Self::send) does.
    pub(super) fn send_draft(&mut self, draft: Draft) -> Result<(), (ApiError, Draft)> {
        let Draft { header, payload } = draft;
        match payload {
            Content::InRing(loan) if loan.is_of(&self.writer) => {
                if header.class == Class::Stream {
                    // It is the newest: an older one that waits must not come later.
                    self.parked.retain(|older| older.header.kind != header.kind);
                }
                loan.publish(&header);
                Ok(())
            }
            payload @ (Content::Bytes(_) | Content::InRing(_)) => {
                let message = Draft { header, payload }.into_message();
                self.send(message).map_err(|(error, message)| (error, message.into()))
            }
        }
    }

    /// Writes a message; waits for room as long as the endpoint's patience lasts. Of a Stream the newest value waits here
    /// instead, and is written when there is room: a late setpoint is a hazard.
    pub(super) fn send(&mut self, message: Message) -> Result<(), (ApiError, Message)> {
        if message.header.class != Class::Stream {
            self.flush();
            return self.writer.write(&message).map_err(|error| (error, message));
        }
        if let Some(parked) = self.parked.iter_mut().find(|other| other.header.kind == message.header.kind) {
            *parked = message;
            self.flush();
            return Ok(());
        }
        match self.writer.try_write(&message) {
            Ok(true) => Ok(()),
            Ok(false) if self.parked.len() < PARKED_MAX => {
                self.parked.push(message);
                Ok(())
            }
            Ok(false) => self.writer.write(&message).map_err(|error| (error, message)),
            Err(error) => Err((error, message)),
        }
    }

    /// Writes what waits for room, as far as there is room.
    pub(in crate::api) fn flush(&mut self) {
        self.writer.pay();
        while let Some(first) = self.parked.first() {
            // An error shows itself again when the ring is read.
            if !matches!(self.writer.try_write(first), Ok(true)) {
                break;
            }
            self.parked.remove(0);
        }
    }

    /// Whether something waits for room in the ring, so that it should be looked at soon.
    pub(in crate::api) fn owes(&self) -> bool {
        !self.parked.is_empty() || self.writer.owes()
    }

    /// The next message of those that were taken from the ring.
    pub(in crate::api) fn next(&mut self) -> Result<Came, RingError> {
        let Some(message) = self.frames.next()? else { return Ok(Came::Nothing) };
        let header = &message.header;
        let is_for_us =
            header.destination == self.own && (header.kind.is_user() || header.kind == Kind::OUTCOME);
        if header.source == self.peer && is_for_us {
            return Ok(Came::Message(message));
        }
        self.refuse(&message);
        Ok(Came::Refused)
    }

    /// Takes what is in the ring, without waiting.
    pub(in crate::api) fn take(&mut self) -> Result<Taken, RingError> {
        Ok(self.frames.take(&mut self.consumer, ENOUGH)?)
    }

    /// Whether the peer has left something in its ring.
    pub(super) fn has_something(&mut self) -> bool {
        // Corrupt memory is found when it is read.
        self.consumer.is_ready().unwrap_or(true)
    }

    /// spec: LNCL-3: a forged source costs the message, not the link.
    fn refuse(&mut self, message: &Message) {
        let header = &message.header;
        let is_forged = header.source != self.peer;
        if !std::mem::replace(&mut self.has_forged, true) {
            let (source, destination, kind) = (header.source, header.destination, header.kind);
            tracing::warn!(peer = %self.peer, %source, %destination, %kind, "it sent on its direct link what is not its own to send there; this is said once");
        }
        if header.flags.has(Flags::CONFIRM) {
            let why = if is_forged { Rejection::ForgedSource } else { Rejection::Unsupported };
            let ticket = Ticket { source: self.peer, destination: self.own, correlation: header.correlation };
            self.writer.settle(ticket, Outcome::Rejected(why));
        }
    }
}

impl Drop for Standing {
    fn drop(&mut self) {
        // A message in some thread's hand may hold the writer, and the socket with it, a little longer.
        hang_up(&self.socket);
        self.writer.wake_peer();
    }
}

/// The open links, to be waited for while there is no node.
pub(super) struct Alone<'a>(pub(super) &'a mut [Standing]);

impl Ends for Alone<'_> {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn consumer(&self, index: usize) -> &Consumer {
        &self.0[index].consumer
    }

    fn consumer_mut(&mut self, index: usize) -> &mut Consumer {
        &mut self.0[index].consumer
    }

    fn hang_up(&self, index: usize) -> Option<HangUp<'_>> {
        Some(HangUp::Socket(self.0[index].socket.as_fd()))
    }
}

/// The node's ring and those of the open links, to be waited for together.
pub(in crate::api) struct Everything<'a> {
    pub(in crate::api) node: &'a mut End,
    pub(in crate::api) links: &'a mut [Standing],
}

impl Ends for Everything<'_> {
    fn count(&self) -> usize {
        1 + self.links.len()
    }

    fn consumer(&self, index: usize) -> &Consumer {
        match index.checked_sub(1) {
            None => self.node.consumer(0),
            Some(index) => &self.links[index].consumer,
        }
    }

    fn consumer_mut(&mut self, index: usize) -> &mut Consumer {
        match index.checked_sub(1) {
            None => self.node.consumer_mut(0),
            Some(index) => &mut self.links[index].consumer,
        }
    }

    fn hang_up(&self, index: usize) -> Option<HangUp<'_>> {
        match index.checked_sub(1) {
            None => self.node.hang_up(0),
            Some(index) => Some(HangUp::Socket(self.links[index].socket.as_fd())),
        }
    }
}
