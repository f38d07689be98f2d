//! Frames through rings in shared memory: the code that both ends of a link share, the node and the client.
//!
//! A ring carries the byte stream that the socket would carry: the bytes of consecutive records are frames,
//! without checksums. A frame that fits into half the ring is one record, so that it can be written in place
//! and is read at once; a longer one is sent in pieces. A record without bytes withdraws the frame that
//! started before it.

use std::{
    io::{self, IoSlice},
    os::fd::{AsFd, BorrowedFd},
};

use bytes::BytesMut;
use sinew_runtime::wire::{FrameCodec, FrameError, HEADER_LEN, Header, Message};
use sinew_shm::{
    Accepted, Bell, Capacity, Consumer, Corrupt, CreateError, LoanError, Offer, PassError, Producer,
    Received, RefusedOffer, Region, Terms,
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
    Refused(#[from] RefusedOffer),
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
            | Self::Refused(RefusedOffer::System { .. })
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

/// Why a ring cannot be read any more. The peer is at fault.
#[derive(Debug, thiserror::Error)]
pub enum RingError {
    #[error("shared memory holds what it cannot: {0}")]
    /// The other process has damaged the ring.
    Corrupt(#[from] Corrupt),
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

/// Reads frames out of a ring.
#[derive(Debug)]
pub struct RingFrames {
    codec: FrameCodec,
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
            buffer: BytesMut::new(),
            whole: 0,
            copied: 0,
            idle: 0,
        }
    }

    /// Returns the next frame of the taken bytes.
    pub fn next_message(&mut self) -> Result<Option<Message>, FrameError> {
        let before = self.buffer.len();
        let next = self.codec.decode(&mut self.buffer);
        self.whole = self.whole.saturating_sub(before - self.buffer.len());
        next
    }

    /// Returns whether [`next_message`](Self::next_message) has a result: a frame, or an error.
    pub fn has_frame(&self) -> bool {
        let Some(head) = self.buffer.first_chunk() else { return false };
        Header::payload_len(head).map_or(true, |length| self.buffer.len() >= HEADER_LEN + length as usize)
    }

    /// Takes records, without waiting, until there are about `enough` bytes, or half a ring's, or the long
    /// frame in progress is complete. Each byte is read once. The peer gets their room back together: a
    /// waiting peer is woken once, and not per record.
    pub fn take(&mut self, consumer: &mut Consumer, enough: usize) -> Result<Taken, Corrupt> {
        let half = consumer.payload_max() - MARK_BYTES;
        let enough = enough.max(half.min(ENOUGH_MIN));
        let mut taken = Taken::Nothing;
        self.copied = 0;
        for _ in 0..RECORDS_PER_POLL {
            let Some(record) = consumer.receive()? else { break };
            if record.is_empty() {
                self.forget_part();
            }
            let start = self.buffer.len();
            self.buffer.resize(start + record.len(), 0);
            record.copy_to(&mut self.buffer[start..]);
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
        self.buffer.capacity() > FrameCodec::BUFFER_KEPT && self.has_frame()
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

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use sinew_runtime::{tid::Tid, wire::Kind};
    use sinew_shm::BellKind;

    use super::*;

    fn ring() -> (Producer, Consumer) {
        let make = || Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let ((left, left_offer), (right, right_offer)) = (make(), make());
        let (producer, _) = left.connect(right_offer, &Terms::default()).expect("an honest offer");
        let (_, consumer) = right.connect(left_offer, &Terms::default()).expect("an honest offer");
        (producer, consumer)
    }

    fn frame(length: usize) -> Vec<u8> {
        let header = Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST);
        [&header.encode_in_memory(length)[..], &vec![7; length]].concat()
    }

    #[test]
    fn one_poll_reads_half_of_four_pieces() {
        // given
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(100_000));
        let long = frame(50_000);
        let mut left = &long[..];
        // when
        for piece in 1..=4 {
            let written = write(&mut producer, &[IoSlice::new(left)]).expect("there is room");
            assert_eq!(written + MARK_BYTES, Capacity::MIN.bytes() as usize / 4, "piece {piece}");
            left = &left[written..];
        }
        // then
        assert!(matches!(write(&mut producer, &[IoSlice::new(left)]), Err(LoanError::Full { .. })));
        assert_eq!(frames.take(&mut consumer, 1).expect("an honest peer"), Taken::Some);
        let taken = Capacity::MIN.bytes() - producer.unread().expect("an honest peer");
        assert_eq!(taken, Capacity::MIN.bytes() / 2);
    }

    #[test]
    fn repeatedly_withdrawn_frames_bound_each_poll() {
        // Given: a ring full of starts of a long frame, each with the record that withdraws it
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(1 << 20));
        let (begins, mut written) = (&frame(1 << 20)[..64], 0);
        while write(&mut producer, &[IoSlice::new(begins)]).is_ok() && withdraw(&mut producer).is_ok() {
            written += 1;
        }
        assert!(written > 20, "{written} starts");
        // When: it is read, for as little as may be
        let (mut polls, mut copied, mut idle) = (0, 0, 0);
        while frames.take(&mut consumer, 1).expect("an honest peer") == Taken::Some {
            assert!(frames.next_message().expect("no frame is wrong").is_none());
            (polls, copied) = (polls + 1, copied + frames.copied());
            assert!(frames.copied() <= RECORDS_PER_POLL * begins.len());
            idle += frames.take_idle();
        }
        // Then: every copied byte, and every record, is accounted for
        assert!(polls * RECORDS_PER_POLL >= 2 * written, "{polls} polls of {written} starts");
        assert!(copied >= written * begins.len());
        assert!(idle >= 2 * written * RECORD_WORK + written * begins.len(), "{idle}");
        assert_eq!(frames.take_idle(), 0);
    }

    #[test]
    fn withdrawn_parts_do_not_extend_a_poll() {
        // Given: starts of frames of half a poll each, all of them withdrawn
        let terms = Terms { capacity_max: Capacity::MAX, ..Terms::default() };
        let make = || Region::create(capacity(2 << 20), BellKind::Futex).expect("a region");
        let ((left, left_offer), (right, right_offer)) = (make(), make());
        let (mut producer, _) = left.connect(right_offer, &terms).expect("an honest offer");
        let (_, mut consumer) = right.connect(left_offer, &terms).expect("an honest offer");
        let begins = &frame(1 << 20)[..ENOUGH_MIN / 2];
        for _ in 0..8 {
            write(&mut producer, &[IoSlice::new(begins)]).expect("there is room");
            withdraw(&mut producer).expect("there is room");
        }
        // When, then
        let mut frames = RingFrames::new(1 << 20);
        for poll in 0..4 {
            assert_eq!(frames.take(&mut consumer, 1).expect("an honest peer"), Taken::Some);
            assert_eq!(frames.copied(), ENOUGH_MIN, "poll {poll}");
        }
    }

    #[test]
    fn consecutive_long_frames_keep_their_lengths() {
        // Given: a writer that is ahead as far as there is room.
        const LENGTH: usize = 1_500_000;
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(LENGTH));
        let long = frame(LENGTH);
        let (mut left, mut written, mut received) = (&long[..], 0, Vec::new());
        while received.len() < 4 {
            while let Ok(count) = write(&mut producer, &[IoSlice::new(left)]) {
                left = &left[count..];
                if left.is_empty() {
                    written += 1;
                    left = if written < 4 { &long } else { break };
                }
            }
            // When: it is read.
            assert_eq!(frames.take(&mut consumer, usize::MAX).expect("an honest peer"), Taken::Some);
            while let Some(message) = frames.next_message().expect("a frame") {
                received.push(message.payload);
            }
        }
        // Then:
        for payload in received {
            let mut memory = payload.try_into_mut().expect("no other holder exists");
            memory.clear();
            assert!(!memory.try_reclaim(2 * LENGTH), "it keeps twice its length");
        }
    }

    #[test]
    fn empty_record_withdraws_only_the_started_frame() {
        let (whole, begun) = (frame(100), frame(1_000));
        for part in [1, 7, 8, HEADER_LEN, HEADER_LEN + 999] {
            // given
            let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(4_096));
            for bytes in [&whole, &whole, &begun[..part].to_vec()] {
                producer.send(bytes).expect("there is room");
            }
            // when
            withdraw(&mut producer).expect("there is room");
            withdraw(&mut producer).expect("there is room");
            producer.send(&whole).expect("there is room");
            // then
            assert_eq!(frames.take(&mut consumer, usize::MAX).expect("an honest peer"), Taken::Some);
            for _ in 0..3 {
                assert_eq!(frames.next_message().expect("a frame").expect("a frame").payload.len(), 100);
            }
            assert!(frames.next_message().expect("nothing wrong").is_none(), "{part} bytes had been written");
        }
    }
}
