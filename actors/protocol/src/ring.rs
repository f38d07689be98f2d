//! Frames through rings in shared memory: the code that both ends of a link share, the node and the client.
//!
//! A ring carries the byte stream that the socket would carry: the bytes of consecutive records are frames,
//! without checksums. A frame that fits into half the ring is one record, so that it can be written in place
//! and is read at once; a longer one is sent in pieces. A record without bytes withdraws the frame that
//! started before it.

#[cfg(all(test, target_os = "linux"))]
mod tests;

use std::{
    collections::VecDeque,
    io::{self, IoSlice},
    os::fd::{AsFd, BorrowedFd},
};

use bytes::BytesMut;
use sinew_runtime::wire::{FrameCodec, FrameError, HEADER_LEN, Header, Message};
use sinew_shm::{
    Accepted, Bell, Capacity, Consumer, CorruptError, CreateError, LoanError, Offer, OfferError, Only,
    PassError, Producer, Received, ReceivedMessage, Region, Terms,
};
use tokio_util::codec::Decoder;

/// Maximum number of records per poll: a peer may cut its frames arbitrarily small.
const RECORDS_PER_POLL: usize = 64;
/// Bytes that a record counts as, in addition to those of its frame: taking one costs some 50 ns, however short it is.
const RECORD_WORK: usize = 256;
/// Bytes of the ring's mark before each record.
const MARK_BYTES: usize = 8;
/// Minimum number of bytes that one poll takes, if available: or half a ring, in the pieces of long frames,
/// if that is less.
const ENOUGH_MIN: usize = 128 * 1024;

/// Why the exchange of offers failed. The caller falls back to the socket, or ends the link.
#[derive(Debug, thiserror::Error)]
pub enum ExchangeError {
    /// The environment's fault.
    #[error("no shared memory: {0}")]
    Create(#[from] CreateError),
    /// The peer is at fault, or has ended.
    #[error("no offer of shared memory: {0}")]
    Pass(#[from] PassError),
    /// The peer is at fault.
    #[error("the peer's offer of shared memory is refused: {0}")]
    Refused(#[from] OfferError),
    /// The peer is at fault: it claims to have sent an offer.
    #[error("the peer has offered no shared memory")]
    Missing,
    /// The peer is at fault.
    #[error("the peer has sent more than its offer")]
    Stray,
    /// This side is at fault.
    #[error(
        "the thread that maps shared memory has panicked or has too much to do, which is a fault of this node's; connect again"
    )]
    Fault,
    /// Other rings use all of the available memory.
    #[error("the rings of this process's direct links have their most in bytes")]
    Budget,
}

impl ExchangeError {
    /// Returns whether this side caused the failure: it had no descriptor or no memory left, or has a fault.
    pub const fn is_of_this_side(&self) -> bool {
        match self {
            Self::Create(_)
            | Self::Pass(PassError::System(_))
            | Self::Refused(OfferError::System { .. })
            | Self::Fault
            | Self::Budget => true,
            Self::Pass(PassError::Closed | PassError::Broken { .. })
            | Self::Refused(_)
            | Self::Missing
            | Self::Stray => false,
        }
    }
}

/// The exchange of offers over a socket, which carries nothing else meanwhile. Both ends do the same, in any order.
#[derive(Debug)]
pub struct Exchange {
    region: Region,
    terms: Terms,
}

impl Exchange {
    /// Allocates this side's memory, and returns the offer for the peer. Once the offer is sent, this side
    /// has two descriptors, its wake-up sockets, or none if it uses futexes. The peer's ring may be as large
    /// as this side's.
    pub fn prepare(capacity: Capacity, bell: impl Into<Bell>) -> Result<(Self, Offer), ExchangeError> {
        Self::prepare_for(capacity, bell, capacity)
    }

    /// Like [`prepare`](Self::prepare), for a peer's ring of at most `theirs`.
    pub fn prepare_for(
        capacity: Capacity,
        bell: impl Into<Bell>,
        theirs: Capacity,
    ) -> Result<(Self, Offer), ExchangeError> {
        let (region, offer) = Region::create(capacity, bell)?;
        Ok((Self { region, terms: Terms { capacity_max: theirs, ..Terms::default() } }, offer))
    }

    /// Receives the peer's offer from a non-blocking socket; `None` if it has not arrived yet.
    pub fn receive(socket: impl AsFd) -> Result<Option<Offer>, ExchangeError> {
        match Offer::receive(socket) {
            Ok(offer) => Ok(Some(offer?)),
            Err(PassError::System(cause)) if cause.kind() == io::ErrorKind::WouldBlock => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Receives the peer's descriptors, without closing or validating any yet.
    pub fn take(socket: impl AsFd) -> Result<Received, ExchangeError> {
        Ok(Received::receive(socket)?)
    }

    /// Maps the peer's offer. If the offer is refused, this side's wake-up sockets still exist: they may
    /// contain a descriptor from the peer that takes forever to close.
    pub fn accept(&self, theirs: Offer) -> Result<Accepted, ExchangeError> {
        Ok(self.region.accept(theirs, &self.terms)?)
    }

    /// Returns both rings.
    pub fn join(self, theirs: Accepted) -> (Producer, Consumer) {
        self.region.join(theirs)
    }

    /// Returns the descriptors of this side's wake-up sockets, if there are any.
    pub fn bells(&self) -> [Option<BorrowedFd<'_>>; 2] {
        self.region.bells()
    }
}

/// Returns a ring's capacity for messages around `bytes`: the next power of two within the limits.
pub fn capacity(bytes: usize) -> Capacity {
    let wanted = u64::try_from(bytes).unwrap_or(u64::MAX);
    let bytes = wanted.clamp(Capacity::MIN.bytes().into(), Capacity::MAX.bytes().into());
    Capacity::new(bytes.next_power_of_two()).expect("a power of two within the limits")
}

/// Returns how many of `total` bytes fit into one record.
pub const fn piece(producer: &Producer, total: usize) -> usize {
    let most = producer.payload_max();
    // A quarter of the ring with its mark, so that four fill it: one side writes while the other reads.
    if total <= most { total } else { most / 2 - MARK_BYTES / 2 }
}

/// Writes one record from the start of `parts`. Returns the number of bytes written.
///
/// # Errors
/// [`LoanError::Full`] when there is no room for it now.
pub fn write(producer: &mut Producer, parts: &[IoSlice<'_>]) -> Result<usize, LoanError> {
    let total = parts.iter().map(|part| part.len()).sum();
    let length = piece(producer, total);
    let mut loan = producer.loan(length)?;
    gather(parts, &mut loan);
    loan.publish();
    Ok(length)
}

/// Writes a frame as one record. Returns whether it was written: it fits into one, and there is room for it now.
pub fn write_frame(producer: &mut Producer, header: &Header, payload: &[u8]) -> bool {
    let Ok(mut loan) = producer.loan(HEADER_LEN + payload.len()) else { return false };
    let memory = &mut loan[..];
    memory[..HEADER_LEN].copy_from_slice(&header.encode_in_memory(payload.len()));
    memory[HEADER_LEN..].copy_from_slice(payload);
    loan.publish();
    true
}

/// Withdraws a partly written frame: the reader drops that part.
///
/// # Errors
/// [`LoanError::Full`] when there is no room for it now.
pub fn withdraw(producer: &mut Producer) -> Result<(), LoanError> {
    producer.loan(0)?.publish();
    Ok(())
}

/// Fills `target` from the start of `parts`, which are at least as long.
pub fn gather(parts: &[IoSlice<'_>], mut target: &mut [u8]) {
    for part in parts {
        let count = part.len().min(target.len());
        target[..count].copy_from_slice(&part[..count]);
        target = &mut target[count..];
    }
}

/// Returns whether bytes begin with a complete frame, or with an error.
pub fn begins_with_frame(bytes: &[u8]) -> bool {
    let Some(head) = bytes.first_chunk() else { return false };
    Header::payload_len(head).map_or(true, |length| bytes.len() >= HEADER_LEN + length as usize)
}

/// Why a ring cannot be read any more. The peer is at fault.
#[derive(Debug, thiserror::Error)]
pub enum RingError {
    #[error("shared memory holds what it cannot: {0}")]
    /// The other process has damaged the ring.
    Corrupt(#[from] CorruptError),
    #[error(transparent)]
    /// A frame in it is damaged.
    Frame(#[from] FrameError),
}

/// The result of a poll of a ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taken {
    /// Bytes; there may be more.
    Some,
    /// Nothing.
    Nothing,
}

/// The result of a look for the only message of a ring.
#[derive(Debug)]
pub enum TakenOnly {
    /// A message, and nothing else.
    Message(Message),
    /// Nothing.
    Nothing,
    /// Something else, which is still there: [`RingFrames::take`] takes it, or says what is wrong.
    Other,
}

/// Reads frames out of a ring.
#[derive(Debug)]
pub struct RingFrames {
    codec: FrameCodec,
    /// Messages that were taken from records of one frame each. They are older than all of `buffer`.
    messages: VecDeque<Message>,
    /// Frames that span records, and what follows them.
    buffer: BytesMut,
    /// Bytes of `buffer` that are known to be complete frames: determined at a record without bytes.
    whole: usize,
    /// Bytes that the last poll copied.
    copied: usize,
    /// Work without a frame, in bytes: that of each record, and withdrawn parts.
    idle: usize,
}

impl RingFrames {
    /// Returns a reader of payloads of at most `payload_max` bytes.
    pub fn new(payload_max: usize) -> Self {
        Self {
            codec: FrameCodec::in_memory(payload_max),
            messages: VecDeque::new(),
            buffer: BytesMut::new(),
            whole: 0,
            copied: 0,
            idle: 0,
        }
    }

    /// Returns the next frame of the taken bytes.
    pub fn next_message(&mut self) -> Result<Option<Message>, FrameError> {
        if let Some(message) = self.messages.pop_front() {
            return Ok(Some(message));
        }
        if self.buffer.is_empty() {
            return Ok(None);
        }
        let before = self.buffer.len();
        let next = self.codec.decode(&mut self.buffer);
        self.whole = self.whole.saturating_sub(before - self.buffer.len());
        next
    }

    /// Returns whether [`next_message`](Self::next_message) has a result: a frame, or an error.
    pub fn has_frame(&self) -> bool {
        !self.messages.is_empty() || self.has_frame_in_buffer()
    }

    fn has_frame_in_buffer(&self) -> bool {
        begins_with_frame(&self.buffer)
    }

    /// Returns whether bytes were taken that [`next_message`](Self::next_message) has not returned.
    pub fn has_bytes(&self) -> bool {
        !self.messages.is_empty() || !self.buffer.is_empty()
    }

    /// Takes records, without waiting, until there are about `enough` bytes, or half a ring's, or the long
    /// frame in progress is complete. Each byte that is used was read once. The peer gets their room back together: a
    /// waiting peer is woken once, and not per record.
    pub fn take(&mut self, consumer: &mut Consumer, enough: usize) -> Result<Taken, CorruptError> {
        let half = consumer.payload_max() - MARK_BYTES;
        let enough = enough.max(half.min(ENOUGH_MIN));
        let mut taken = Taken::Nothing;
        self.copied = 0;
        for _ in 0..RECORDS_PER_POLL {
            let Some(record) = consumer.receive()? else { break };
            if record.is_empty() {
                self.forget_part();
            }
            match self.message_of(&record) {
                Some(message) => self.messages.push_back(message),
                None => {
                    let start = self.buffer.len();
                    self.buffer.resize(start + record.len(), 0);
                    record.copy_to(&mut self.buffer[start..]);
                }
            }
            // Copied bytes count, not those that remain: a part may be withdrawn repeatedly.
            self.copied += record.len();
            // Only a node uses this, and only for its guests.
            self.idle = self.idle.saturating_add(RECORD_WORK);
            record.keep();
            taken = Taken::Some;
            if self.copied >= enough || self.has_filled() {
                break;
            }
        }
        consumer.give_back();
        Ok(taken)
    }

    /// Takes the only message of a ring, if it is one whole frame and nothing was taken before it.
    pub fn take_only(&self, consumer: &mut Consumer) -> TakenOnly {
        if self.has_bytes() {
            return TakenOnly::Other;
        }
        let record = match consumer.receive_only() {
            Only::Message(record) => record,
            Only::Nothing => return TakenOnly::Nothing,
            Only::Other => return TakenOnly::Other,
        };
        match self.message_of(&record) {
            Some(message) => TakenOnly::Message(message),
            None => {
                record.leave();
                TakenOnly::Other
            }
        }
    }

    /// Returns the message of a record that is exactly one frame, the usual case: its payload is copied once, to where
    /// it stays. All other records, and invalid ones, are read as parts of a stream.
    fn message_of(&self, record: &ReceivedMessage<'_>) -> Option<Message> {
        let following = record.len().checked_sub(HEADER_LEN).filter(|_| self.buffer.is_empty())?;
        let mut head = [0; HEADER_LEN];
        record.copy_to(&mut head);
        let copy = |payload: &mut [u8]| _ = record.copy_at(HEADER_LEN, payload);
        self.codec.decode_record(&head, following, copy).ok().flatten()
    }

    /// Returns the number of bytes that the last poll copied.
    pub const fn copied(&self) -> usize {
        self.copied
    }

    /// Returns the work since the last call that yielded no frame, in bytes.
    pub fn take_idle(&mut self) -> usize {
        std::mem::take(&mut self.idle)
    }

    /// Returns whether a complete frame has a buffer of its own. With later bytes that buffer would grow, and
    /// each payload in it would keep all of it alive.
    fn has_filled(&self) -> bool {
        self.buffer.capacity() > FrameCodec::BUFFER_KEPT && self.has_frame_in_buffer()
    }

    /// Drops the incomplete frame.
    fn forget_part(&mut self) {
        while let Some(head) = self.buffer.get(self.whole..).and_then(<[u8]>::first_chunk) {
            // `next` reports an invalid frame.
            let Ok(length) = Header::payload_len(head) else { return };
            let end = self.whole + HEADER_LEN + length as usize;
            if end > self.buffer.len() {
                break;
            }
            self.whole = end;
        }
        self.idle = self.idle.saturating_add(self.buffer.len().saturating_sub(self.whole));
        self.buffer.truncate(self.whole);
    }
}
