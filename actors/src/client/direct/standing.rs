//! One direct link that stands: a ring each way, and the socket whose hang-up is the peer's end.

use std::{
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net::UnixStream,
    },
    sync::Arc,
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    wire::{Class, Flags, HEADER_LEN, Kind, Message},
};
use sinew_shm::{Armed, Consumer, Ends, HangUp};

use super::{
    budget::Share,
    foreign::{self, LinkEnd},
    hang_up,
};
use crate::{
    client::{
        ApiError,
        link::ring::{self, Begun, ENOUGH, End, Rest},
        loan::{Content, Draft},
        routes::LinkNumber,
    },
    ring::{RingError, RingFrames, Taken},
};

/// Kinds of Stream whose newest value waits for room in the ring, at most. One of a further kind waits as other classes do.
const PARKED_MAX: usize = 64;

/// A link with both rings.
pub(in crate::client) struct Standing {
    own: Tid,
    pub(in crate::client) peer: Tid,
    pub(in crate::client) number: LinkNumber,
    pub(super) socket: LinkEnd,
    pub(super) writer: Arc<ring::Writer>,
    /// What comes on this link is settled on it.
    pub(in crate::client) sink: Arc<dyn ReceiptSink>,
    consumer: Consumer,
    /// What its ring takes of what all may.
    _share: Share,
    frames: RingFrames,
    /// The newest value of each kind of Stream that found no room: an older one must not come later.
    parked: Vec<Message>,
    /// What is left of a long frame. Nothing else is written before it.
    rest: Option<Rest>,
    has_forged: bool,
    /// A sender has waited for room in vain.
    pub(super) is_stalled: bool,
}

/// Whom a link is between.
pub(super) struct Pair {
    pub(super) own: Tid,
    pub(super) peer: Tid,
    pub(super) number: LinkNumber,
    /// Hangs up with the peer.
    pub(super) socket: LinkEnd,
}

/// What became of a message that was to be written.
pub(in crate::client) enum Put {
    /// It is in the ring, or waits for room as the newest of its Stream.
    Taken,
    /// Part of it is in the ring: the rest is written when there is room, unless it is withdrawn.
    Begun,
    /// Nothing of it was written.
    Full(Message),
}

/// What the ring of a link gave.
pub(in crate::client) enum Came {
    Message(Message),
    /// It was none to be received; there may be more.
    Refused,
    Nothing,
}

impl Standing {
    pub(super) fn new(
        pair: Pair,
        writer: ring::Writer,
        consumer: Consumer,
        share: Share,
        payload_max: usize,
    ) -> Self {
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
            _share: share,
            frames,
            parked: Vec::new(),
            rest: None,
            has_forged: false,
            is_stalled: false,
        }
    }

    /// The descriptor of the bell for messages, if the ring has one.
    pub(in crate::client) fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.consumer.fd()
    }

    /// Hangs up with the peer.
    pub(in crate::client) fn socket(&self) -> &UnixStream {
        &self.socket
    }

    /// Announces that a task waits for a message. [`Armed::Ready`]: there is one.
    pub(in crate::client) fn arm(&mut self) -> Armed {
        // Corrupt memory is found when it is read.
        self.consumer.arm().unwrap_or(Armed::Ready)
    }

    /// Says that it is awake.
    pub(in crate::client) fn disarm(&mut self) {
        self.consumer.disarm();
    }

    /// Sends a message: in place if it lies in this link's ring, else as [`send`](Self::send) does.
    pub(super) fn send_draft(&mut self, draft: Draft) -> Result<Put, (ApiError, Draft)> {
        let Draft { header, payload } = draft;
        match payload {
            Content::InRing(loan)
                if loan.is_of(&self.writer) && (header.class != Class::Stream || self.parked.is_empty()) =>
            {
                loan.publish(&header);
                Ok(Put::Taken)
            }
            // Behind the values that wait it goes as a copy.
            payload @ (Content::Bytes(_) | Content::InRing(_)) => {
                let message = Draft { header, payload }.into_message();
                self.send(message).map_err(|(error, message)| (error, message.into()))
            }
        }
    }

    /// Writes a message as far as there is room. Of a Stream the newest value waits here for more, and is written when there
    /// is: a late setpoint is a hazard.
    ///
    /// # Errors
    /// The link cannot be used any more, or its ring is lent; the message was not written.
    pub(super) fn send(&mut self, message: Message) -> Result<Put, (ApiError, Message)> {
        let is_stream = message.header.class == Class::Stream;
        let same_kind = |other: &&mut Message| is_stream && other.header.kind == message.header.kind;
        if let Some(parked) = self.parked.iter_mut().find(same_kind) {
            *parked = message;
            self.flush();
            return Ok(Put::Taken);
        }
        if !self.parked.is_empty() {
            self.flush();
        }
        // What was sent earlier in its class goes first.
        let put = if is_stream && !self.parked.is_empty() { Put::Full(message) } else { self.put(message)? };
        match put {
            Put::Full(message) if is_stream && self.parked.len() < PARKED_MAX => {
                self.parked.push(message);
                Ok(Put::Taken)
            }
            whole_or_full @ (Put::Taken | Put::Begun | Put::Full(_)) => Ok(whole_or_full),
        }
    }

    /// Values that wait for room.
    pub(super) const fn waiting(&self) -> usize {
        self.parked.len()
    }

    fn put(&mut self, message: Message) -> Result<Put, (ApiError, Message)> {
        match self.go_on() {
            Ok(true) => {}
            Ok(false) => return Ok(Put::Full(message)),
            Err(error) => return Err((error, message)),
        }
        let begun = self.writer.begin(message)?;
        self.is_stalled &= matches!(begun, Begun::Full(_));
        Ok(match begun {
            Begun::Whole => Put::Taken,
            Begun::Part(rest) => {
                self.rest = Some(rest);
                Put::Begun
            }
            Begun::Full(message) => Put::Full(message),
        })
    }

    /// Writes what waits for room, as far as there is room.
    pub(in crate::client) fn flush(&mut self) {
        // An error shows itself again when the ring is read: the socket is closed.
        while self.go_on().unwrap_or(false) && !self.parked.is_empty() {
            let first = self.parked.remove(0);
            match self.put(first) {
                Ok(Put::Taken | Put::Begun) => {}
                Ok(Put::Full(first)) | Err((_, first)) => {
                    // An error shows itself again when the ring is read.
                    self.parked.insert(0, first);
                    break;
                }
            }
        }
        self.writer.pay();
    }

    /// Takes back what is left half written: the peer receives nothing of it.
    pub(super) fn withdraw(&mut self) {
        if let Some(rest) = &mut self.rest {
            rest.withdraw();
        }
    }

    /// The message that is half written, which the link's end cuts.
    pub(super) fn cut(&self) -> Option<Message> {
        self.rest.as_ref().and_then(Rest::cut)
    }

    /// Writes on with a long frame; whether none is left half written.
    ///
    /// # Errors
    /// The link cannot be written any more: its socket is closed.
    pub(super) fn go_on(&mut self) -> Result<bool, ApiError> {
        let is_whole = self.rest.as_mut().map_or(Ok(true), Rest::go_on)?;
        if is_whole {
            self.rest = None;
        }
        Ok(is_whole)
    }

    /// Announces that a task waits for room for a frame of `length` bytes, or for the rest of the one that is begun.
    pub(super) fn arm_room(&mut self, length: usize, class: Class) -> Armed {
        let length = self.wanted(length, class);
        match &mut self.rest {
            Some(rest) => rest.arm(),
            None => self.writer.arm(length),
        }
    }

    /// Says that it is awake.
    pub(super) fn disarm_room(&mut self) {
        match &mut self.rest {
            Some(rest) => rest.disarm(),
            None => self.writer.disarm(),
        }
    }

    /// Does something with the descriptor of the bell for room, if the ring has one and is not lent.
    pub(super) fn with_room_bell<T>(&self, look: impl FnOnce(Option<BorrowedFd<'_>>) -> T) -> T {
        match &self.rest {
            Some(rest) => look(rest.bell()),
            None => self.writer.with_bell(look),
        }
    }

    /// A count of what the peer takes.
    pub(super) fn taken(&mut self) -> u32 {
        match &mut self.rest {
            Some(rest) => rest.taken(),
            None => self.writer.taken(),
        }
    }

    /// What there has to be room for before a frame of `length` bytes goes out: of a Stream what waits goes first. Of another class it goes
    /// as soon as there is room for it, however long the values are that wait.
    fn wanted(&self, length: usize, class: Class) -> usize {
        let goes_first = self.parked.first().filter(|_| class == Class::Stream);
        goes_first.map_or(length, |first| length.max(HEADER_LEN + first.payload.len()))
    }

    /// Waits until there is room, the peer's end, or `within` this time.
    pub(in crate::client) fn await_room(&mut self, length: usize, class: Class, within: Duration) {
        let length = self.wanted(length, class);
        match &mut self.rest {
            Some(rest) => rest.await_room(within),
            None => self.writer.await_room(length, within),
        }
    }

    /// Waits until there is room for what waits for it, the peer's end, or `within` this time.
    pub(super) fn await_owed(&mut self, within: Duration) {
        let first = self.parked.first().map_or(1, |parked| parked.payload.len());
        self.await_room(HEADER_LEN + first, Class::Stream, within);
    }

    /// Says what waits for room and will find none any more.
    pub(super) fn tell_unsent(&self) {
        let (peer, values) = (self.peer, self.parked.len() + usize::from(self.cut().is_some()));
        if values > 0 || self.writer.owes() {
            let owes_outcomes = self.writer.owes();
            crate::log::here!(warn: %peer, values, owes_outcomes, "a direct link ends whose peer takes nothing; the newest values of so many kinds of Stream do not reach it");
        }
    }

    /// Whether something waits for room in the ring, so that it should be looked at soon.
    pub(in crate::client) fn owes(&self) -> bool {
        !self.parked.is_empty() || self.rest.is_some() || self.writer.owes()
    }

    /// The next message of those that were taken from the ring.
    pub(in crate::client) fn next(&mut self) -> Result<Came, RingError> {
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
    pub(in crate::client) fn take(&mut self) -> Result<Taken, RingError> {
        Ok(self.frames.take(&mut self.consumer, ENOUGH)?)
    }

    /// Whether the peer has left something in its ring, or of what was taken out something is not sorted in.
    pub(super) fn has_something(&mut self) -> bool {
        // Corrupt memory is found when it is read.
        self.frames.has_frame() || self.consumer.is_ready().unwrap_or(true)
    }

    /// spec: LNCL-3: a forged source costs the message, not the link.
    fn refuse(&mut self, message: &Message) {
        let header = &message.header;
        let is_forged = header.source != self.peer;
        if !std::mem::replace(&mut self.has_forged, true) {
            let (source, destination, kind) = (header.source, header.destination, header.kind);
            crate::log::here!(warn: peer = %self.peer, %source, %destination, %kind, "it sent on its direct link what is not its own to send there; this is said once");
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
        foreign::empty_bell(self.consumer.fd());
        // Where half a frame is written, it has the ring.
        self.with_room_bell(foreign::empty_bell);
        match &self.rest {
            Some(rest) => rest.wake_peer(),
            None => self.writer.wake_peer(),
        }
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
pub(in crate::client) struct Everything<'a> {
    pub(in crate::client) node: &'a mut End,
    pub(in crate::client) links: &'a mut [Standing],
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
