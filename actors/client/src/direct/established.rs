//! One established direct link: a ring in each direction, and a socket that is closed when the peer ends.

use std::{
    os::{fd::BorrowedFd, unix::net::UnixStream},
    sync::Arc,
    time::Duration,
};

use sinew_protocol::ring::{RingError, RingFrames, Taken, TakenOnly};
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    wire::{Class, Flags, HEADER_LEN, Header, Kind, Message},
};
use sinew_shm::{Armed, Consumer, WaitSet};

use super::{
    Terms,
    accounts::LinkAccount,
    budget::Share,
    hang_up,
    peer_fd::{self, PeerSocket},
};
use crate::{
    ApiError,
    link::ring::{self, Begun, ENOUGH, Rest},
    loan::{Content, Draft},
    routes::LinkNumber,
};

/// Maximum number of Stream kinds with a newest value that waits for room in the ring. A value of a further
/// kind waits as other classes do.
const PARKED_MAX: usize = 64;

/// A link with both rings.
pub(crate) struct EstablishedLink {
    own: Tid,
    pub(crate) peer: Tid,
    pub(crate) number: LinkNumber,
    pub(super) socket: PeerSocket,
    pub(super) writer: Arc<ring::Writer>,
    /// The receipts of messages that arrive on this link are settled on it.
    pub(crate) sink: Arc<dyn ReceiptSink>,
    pub(super) consumer: Consumer,
    /// The set of all rings of the endpoint, if it has one.
    set: Option<WaitSet>,
    /// The share of this link's rings in the budget of the process.
    _share: Share,
    frames: RingFrames,
    /// The newest value of each Stream kind that found no room: an older value must not arrive later.
    parked: Vec<Message>,
    /// The rest of a long frame. Nothing else is written before it.
    rest: Option<Rest>,
    has_forged: bool,
    /// Whether a sender has reached its stall timeout on this link.
    pub(super) is_stalled: bool,
    /// Counts its messages for the node.
    pub(super) account: LinkAccount,
    /// The frame that has begun, to be counted when it is whole.
    begun: Option<Header>,
}

/// The two ends of a link.
pub(super) struct Pair {
    pub(super) own: Tid,
    pub(super) peer: Tid,
    pub(super) number: LinkNumber,
    /// Closes when the peer closes it.
    pub(super) socket: PeerSocket,
}

/// The result of writing a message.
pub(crate) enum Put {
    /// It is in the ring, or waits for room as the newest of its Stream.
    Taken,
    /// Part of the message is in the ring: the rest is written when there is room, unless it is withdrawn.
    Begun,
    /// Nothing of the message was written.
    Full(Message),
}

/// The result of reading the ring of a link.
pub(crate) enum LinkRead {
    Message(Message),
    /// The message must not be received; there may be more.
    Refused,
    Nothing,
}

impl EstablishedLink {
    pub(super) fn new(
        pair: Pair,
        writer: ring::Writer,
        consumer: Consumer,
        share: Share,
        terms: &Terms,
    ) -> Self {
        let Pair { own, peer, number, socket } = pair;
        let (payload_max, set) = (terms.payload_max, terms.options.set().cloned());
        let (writer, frames) = (Arc::new(writer), RingFrames::new(payload_max));
        Self {
            own,
            peer,
            number,
            socket,
            sink: writer.clone(),
            writer,
            consumer,
            set,
            _share: share,
            frames,
            parked: Vec::new(),
            rest: None,
            has_forged: false,
            is_stalled: false,
            account: LinkAccount::default(),
            begun: None,
        }
    }

    /// Returns the descriptor that signals messages, if the ring has one.
    pub(crate) fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.consumer.fd()
    }

    /// Returns the socket, which closes when the peer closes it.
    pub(crate) fn socket(&self) -> &UnixStream {
        &self.socket
    }

    /// Announces that a task waits for a message. [`Armed::Ready`]: there is one.
    pub(crate) fn arm(&mut self) -> Armed {
        // Corrupt memory is detected when it is read.
        self.consumer.arm().unwrap_or(Armed::Ready)
    }

    /// Records that the task is awake.
    pub(crate) fn disarm(&mut self) {
        self.consumer.disarm_reported();
    }

    /// Sends a message if nothing waits before it and there is room at once for all of it. Returns whether it was sent:
    /// then its memory in the ring is used up.
    pub(super) fn send_at_once(&mut self, header: &Header, payload: &mut Content) -> bool {
        if !self.parked.is_empty() || self.rest.is_some() {
            return false;
        }
        match payload {
            Content::InRing(loan) if loan.is_of(&self.writer) => loan.publish(header),
            Content::InRing(_) => return false,
            Content::Bytes(payload) => {
                if !self.writer.write_at_once(header, payload) {
                    return false;
                }
                self.is_stalled = false;
            }
        }
        self.account.sent(header);
        true
    }

    /// Sends a message: in place if it lies in this link's ring, else as [`send`](Self::send) does.
    pub(super) fn send_draft(&mut self, draft: Draft) -> Result<Put, (ApiError, Draft)> {
        let Draft { header, payload } = draft;
        match payload {
            Content::InRing(mut loan)
                if loan.is_of(&self.writer) && (header.class != Class::Stream || self.parked.is_empty()) =>
            {
                loan.publish(&header);
                self.account.sent(&header);
                Ok(Put::Taken)
            }
            // Behind waiting values the message goes as a copy.
            payload @ (Content::Bytes(_) | Content::InRing(_)) => {
                let message = Draft { header, payload }.into_message();
                self.send(message).map_err(|(error, message)| (error, message.into()))
            }
        }
    }

    /// Writes a message as far as there is room. The newest value of a Stream waits here for room and is
    /// written as soon as there is room: a late setpoint is a hazard.
    ///
    /// # Errors
    /// The link cannot be used any more, or its ring is lent; the message was not written.
    pub(super) fn send(&mut self, message: Message) -> Result<Put, (ApiError, Message)> {
        let is_stream = message.header.class == Class::Stream;
        let same_kind = |other: &&mut Message| is_stream && other.header.kind == message.header.kind;
        if let Some(parked) = self.parked.iter_mut().find(same_kind) {
            self.account.superseded(&message.header);
            *parked = message;
            self.flush();
            return Ok(Put::Taken);
        }
        if !self.parked.is_empty() {
            self.flush();
        }
        // An earlier message of the same class goes first.
        let header = message.header;
        let put = if is_stream && !self.parked.is_empty() { Put::Full(message) } else { self.put(message)? };
        match put {
            Put::Full(message) if is_stream && self.parked.len() < PARKED_MAX => {
                self.parked.push(message);
                self.account.sent(&header);
                Ok(Put::Taken)
            }
            Put::Taken => {
                self.account.sent(&header);
                Ok(Put::Taken)
            }
            Put::Begun => {
                self.begun = Some(header);
                Ok(Put::Begun)
            }
            Put::Full(message) => Ok(Put::Full(message)),
        }
    }

    /// Returns the number of values that wait for room.
    pub(super) const fn waiting(&self) -> usize {
        self.parked.len()
    }

    fn put(&mut self, message: Message) -> Result<Put, (ApiError, Message)> {
        match self.continue_writing() {
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

    /// Writes the waiting values as far as there is room.
    pub(crate) fn flush(&mut self) {
        // The error appears again when the ring is read: the socket is closed.
        while self.continue_writing().unwrap_or(false) && !self.parked.is_empty() {
            let first = self.parked.remove(0);
            match self.put(first) {
                Ok(Put::Taken | Put::Begun) => {}
                Ok(Put::Full(first)) | Err((_, first)) => {
                    // The error appears again when the ring is read.
                    self.parked.insert(0, first);
                    break;
                }
            }
        }
        self.writer.flush_pending();
    }

    /// Withdraws the partly written message: the peer receives nothing of it.
    pub(super) fn withdraw(&mut self) {
        self.begun = None;
        if let Some(rest) = &mut self.rest {
            rest.withdraw();
        }
    }

    /// Returns the partly written message that the link's end cuts off.
    pub(super) fn cut(&self) -> Option<Message> {
        self.rest.as_ref().and_then(Rest::cut)
    }

    /// Continues a long frame. Returns whether it is complete.
    ///
    /// # Errors
    /// The link cannot be written any more: its socket is closed.
    pub(super) fn continue_writing(&mut self) -> Result<bool, ApiError> {
        let is_whole = self.rest.as_mut().map_or(Ok(true), Rest::continue_writing)?;
        if is_whole {
            self.rest = None;
            if let Some(header) = self.begun.take() {
                self.account.sent(&header);
            }
        }
        Ok(is_whole)
    }

    /// Announces that a task waits for room for a frame of `length` bytes, or for the rest of the frame that
    /// has begun.
    pub(super) fn arm_room(&mut self, length: usize, class: Class) -> Armed {
        let length = self.wanted(length, class);
        match &mut self.rest {
            Some(rest) => rest.arm(),
            None => self.writer.arm(length),
        }
    }

    /// Records that the task is awake.
    pub(super) fn disarm_room(&mut self) {
        match &mut self.rest {
            Some(rest) => rest.disarm(),
            None => self.writer.disarm(),
        }
    }

    /// Calls a function with the descriptor that signals room, if the ring has one and is not lent.
    pub(super) fn with_room_bell<T>(&self, call: impl FnOnce(Option<BorrowedFd<'_>>) -> T) -> T {
        match &self.rest {
            Some(rest) => call(rest.bell()),
            None => self.writer.with_bell(call),
        }
    }

    /// Returns the peer's read counter.
    pub(super) fn taken(&mut self) -> u32 {
        match &mut self.rest {
            Some(rest) => rest.taken(),
            None => self.writer.taken(),
        }
    }

    /// Returns the room that must exist before a frame of `length` bytes is written. For a Stream, the first
    /// waiting value is written before it. A frame of another class is written as soon as it fits, regardless
    /// of the length of the waiting values.
    fn wanted(&self, length: usize, class: Class) -> usize {
        let goes_first = self.parked.first().filter(|_| class == Class::Stream);
        goes_first.map_or(length, |first| length.max(HEADER_LEN + first.payload.len()))
    }

    /// Waits until there is room, until the peer's end, or for `within` at most.
    pub(crate) fn await_room(&mut self, length: usize, class: Class, within: Duration) {
        let length = self.wanted(length, class);
        match &mut self.rest {
            Some(rest) => rest.await_room(within),
            None => self.writer.await_room(length, within),
        }
    }

    /// Waits until there is room for the first waiting value, until the peer's end, or for `within` at most.
    pub(super) fn await_pending(&mut self, within: Duration) {
        let first = self.parked.first().map_or(1, |parked| parked.payload.len());
        self.await_room(HEADER_LEN + first, Class::Stream, within);
    }

    /// Logs the waiting values that will find no room any more.
    pub(super) fn log_unsent(&self) {
        let (peer, values) = (self.peer, self.parked.len() + usize::from(self.cut().is_some()));
        if values > 0 || self.writer.has_pending() {
            let has_pending_outcomes = self.writer.has_pending();
            sinew_runtime::log::here!(warn: %peer, values, has_pending_outcomes, "a direct link ends before its peer has read all of it: the newest values of so many types of class Stream are lost; receive more often there, or raise `direct_ring_bytes`");
        }
    }

    /// Returns whether data waits for room in the ring, so that the link must be checked soon.
    pub(crate) fn has_pending(&self) -> bool {
        !self.parked.is_empty() || self.rest.is_some() || self.writer.has_pending()
    }

    /// Returns the next message of those that were taken from the ring.
    pub(crate) fn next(&mut self) -> Result<LinkRead, RingError> {
        Ok(self.frames.next_message()?.map_or(LinkRead::Nothing, |message| self.check(message)))
    }

    /// Takes the only message of the ring. Returns `None` if there are several, or something else, which
    /// [`take`](Self::take) and [`next`](Self::next) find out about.
    pub(crate) fn take_only(&mut self) -> Option<LinkRead> {
        let read = match self.frames.take_only(&mut self.consumer) {
            TakenOnly::Message(message) => self.check(message),
            TakenOnly::Nothing => LinkRead::Nothing,
            TakenOnly::Other => return None,
        };
        self.was_emptied();
        Some(read)
    }

    /// Checks the source and the destination of a message.
    fn check(&mut self, message: Message) -> LinkRead {
        let header = &message.header;
        let is_for_us =
            header.destination == self.own && (header.kind.is_user() || header.kind == Kind::OUTCOME);
        if header.source == self.peer && is_for_us {
            self.account.took(header);
            return LinkRead::Message(message);
        }
        self.refuse(&message);
        LinkRead::Refused
    }

    /// Takes the content of the ring, without waiting.
    pub(crate) fn take(&mut self) -> Result<Taken, RingError> {
        let taken = self.frames.take(&mut self.consumer, ENOUGH)?;
        if taken == Taken::Nothing {
            self.was_emptied();
        }
        Ok(taken)
    }

    fn was_emptied(&self) {
        if let Some(set) = &self.set {
            set.was_emptied(&self.consumer);
        }
    }

    /// Ends waits with its messages from now on: it is read.
    pub(super) fn open(&self) {
        if let Some(set) = &self.set {
            set.set_open(&self.consumer, true);
        }
    }

    /// Returns its place in the set.
    pub(super) fn slot(&self) -> Option<u8> {
        self.consumer.slot()
    }

    /// Returns whether a frame was taken that [`next`](Self::next) has not returned.
    pub(crate) fn has_frame(&self) -> bool {
        self.frames.has_frame()
    }

    /// Returns whether the ring holds data, or data taken from it is not sorted in yet.
    pub(crate) fn has_unsorted(&mut self) -> bool {
        // Corrupt memory is detected when it is read.
        self.frames.has_frame() || self.consumer.is_ready().unwrap_or(true)
    }

    /// spec: LNCL-3: a forged source costs the message, not the link.
    fn refuse(&mut self, message: &Message) {
        let header = &message.header;
        let is_forged = header.source != self.peer;
        if !std::mem::replace(&mut self.has_forged, true) {
            let (source, destination, kind) = (header.source, header.destination, header.kind);
            sinew_runtime::log::here!(warn: peer = %self.peer, %source, %destination, %kind, "it sent on its direct link what is not its own to send there; this is said once");
        }
        if header.flags.has(Flags::CONFIRM) {
            let why = if is_forged { Rejection::ForgedSource } else { Rejection::Unsupported };
            let ticket = Ticket { source: self.peer, destination: self.own, correlation: header.correlation };
            self.writer.settle(ticket, Outcome::Rejected(why));
        }
    }
}

impl Drop for EstablishedLink {
    fn drop(&mut self) {
        // A message that another thread handles may keep the writer, and its socket, alive a little longer.
        hang_up(&self.socket);
        peer_fd::empty_bell(self.consumer.fd());
        // While a frame is partly written, that frame owns the ring.
        self.with_room_bell(peer_fd::empty_bell);
        match &self.rest {
            Some(rest) => rest.wake_peer(),
            None => self.writer.wake_peer(),
        }
    }
}
