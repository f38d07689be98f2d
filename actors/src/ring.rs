//! Frames through rings in shared memory: what both ends of a link do, the node's and the client's.
//!
//! What goes through a ring is the byte stream that would go through the socket: the records' bytes one after the other
//! are frames, without checksums. A frame that fits into half the ring is one record, so that it can be written in place
//! and is read in one go; a longer one comes in pieces. A record without bytes takes back the frame that began before it.

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

/// Records that one look takes at most: a peer may cut its frames as small as it likes.
const RECORDS_A_LOOK: usize = 64;
/// Bytes that a record counts as, beside those of its frame: to take one costs some 50 ns, however short it is.
const RECORD_WORK: usize = 256;
/// What a ring has before each record, in bytes.
const MARK_BYTES: usize = 8;
/// Bytes that one look takes at least, if they are there: or half a ring, in the pieces in which long frames come, if that is less.
const ENOUGH_MIN: usize = 128 * 1024;

/// Why two ends did not come together. The caller falls back to the socket, or ends the link.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ExchangeError {
    /// The environment's fault.
    #[error("no shared memory: {0}")]
    Create(#[from] CreateError),
    /// The peer's fault or its end.
    #[error("no offer of shared memory: {0}")]
    Pass(#[from] PassError),
    /// The peer's fault.
    #[error("the peer's offer of shared memory is refused: {0}")]
    Refused(#[from] RefusedOffer),
    /// The peer's fault: it says that it has offered something.
    #[error("the peer has offered no shared memory")]
    Missing,
    /// The peer's fault.
    #[error("the peer has sent more than its offer")]
    Stray,
    /// Our own fault.
    #[error(
        "the thread that maps shared memory has panicked or has too much to do, which is a fault of this node's; connect again"
    )]
    Fault,
    /// Other rings have all that there may be.
    #[error("the rings of this process's direct links have their most in bytes")]
    Budget,
}

impl ExchangeError {
    /// Whether the peer has nothing to do with it: this side had no descriptor or no memory left, or has a fault.
    pub(crate) const fn is_of_this_side(&self) -> bool {
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

/// The exchange of offers over a socket, on which nothing else comes meanwhile. Both ends do the same, in any order.
#[derive(Debug)]
pub(crate) struct Exchange {
    region: Region,
    terms: Terms,
}

impl Exchange {
    /// Makes this side's memory, and what is to be sent to the peer of it: once that is on its way, this side has two descriptors, its bells,
    /// or none where they are futexes. The peer's ring may be as large as this side's.
    pub(crate) fn prepare(capacity: Capacity, bell: impl Into<Bell>) -> Result<(Self, Offer), ExchangeError> {
        Self::prepare_for(capacity, bell, capacity)
    }

    /// As [`prepare`](Self::prepare), for a peer's ring of at most `theirs`.
    pub(crate) fn prepare_for(
        capacity: Capacity,
        bell: impl Into<Bell>,
        theirs: Capacity,
    ) -> Result<(Self, Offer), ExchangeError> {
        let (region, offer) = Region::create(capacity, bell)?;
        Ok((Self { region, terms: Terms { capacity_max: theirs, ..Terms::default() } }, offer))
    }

    /// Takes the peer's offer from a socket that does not block; `None` if it is not there yet.
    pub(crate) fn receive(socket: impl AsFd) -> Result<Option<Offer>, ExchangeError> {
        match Offer::receive(socket) {
            Ok(offer) => Ok(Some(offer?)),
            Err(PassError::System(cause)) if cause.kind() == io::ErrorKind::WouldBlock => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Takes what is there, of which nothing is closed or judged yet.
    pub(crate) fn take(socket: impl AsFd) -> Result<Received, ExchangeError> {
        Ok(Received::receive(socket)?)
    }

    /// Maps what the peer has offered. If it is refused, this side's bells are still there: it may have passed something in them that takes
    /// for ever to close.
    pub(crate) fn accept(&self, theirs: Offer) -> Result<Accepted, ExchangeError> {
        Ok(self.region.accept(theirs, &self.terms)?)
    }

    /// Both rings.
    pub(crate) fn join(self, theirs: Accepted) -> (Producer, Consumer) {
        self.region.join(theirs)
    }

    /// The descriptors of this side's bells, if they have some.
    pub(crate) fn bells(&self) -> [Option<BorrowedFd<'_>>; 2] {
        self.region.bells()
    }
}

/// A ring's capacity for messages around `bytes`: the next power of two within the limits.
pub(crate) fn capacity(bytes: usize) -> Capacity {
    let wanted = u64::try_from(bytes).unwrap_or(u64::MAX);
    let bytes = wanted.clamp(Capacity::MIN.bytes().into(), Capacity::MAX.bytes().into());
    Capacity::new(bytes.next_power_of_two()).expect("a power of two within the limits")
}

/// How much of `total` bytes goes into one record.
pub(crate) const fn piece(producer: &Producer, total: usize) -> usize {
    let most = producer.payload_max();
    // A quarter of the ring with its mark, so that four fill it: one side writes while the other reads.
    if total <= most { total } else { most / 2 - MARK_BYTES / 2 }
}

/// Writes one record from the beginning of `parts`; how many bytes that was.
///
/// # Errors
/// [`LoanError::Full`] when there is no room for it now.
pub(crate) fn write(producer: &mut Producer, parts: &[IoSlice<'_>]) -> Result<usize, LoanError> {
    let total = parts.iter().map(|part| part.len()).sum();
    let length = piece(producer, total);
    let mut loan = producer.loan(length)?;
    gather(parts, &mut loan);
    loan.publish();
    Ok(length)
}

/// Takes back the frame of which only a part is written: the reader forgets that part.
///
/// # Errors
/// [`LoanError::Full`] when there is no room for it now.
pub(crate) fn withdraw(producer: &mut Producer) -> Result<(), LoanError> {
    producer.loan(0)?.publish();
    Ok(())
}

/// Fills `target` from the beginning of `parts`, which are at least as long.
pub(crate) fn gather(parts: &[IoSlice<'_>], mut target: &mut [u8]) {
    for part in parts {
        let count = part.len().min(target.len());
        target[..count].copy_from_slice(&part[..count]);
        target = &mut target[count..];
    }
}

/// Why a ring cannot be read any more. The peer's fault.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RingError {
    #[error("shared memory holds what it cannot: {0}")]
    Corrupt(#[from] Corrupt),
    #[error(transparent)]
    Frame(#[from] FrameError),
}

/// What a look at a ring found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Taken {
    /// Bytes; there may be more.
    Some,
    /// Nothing.
    Nothing,
}

/// Frames out of a ring.
#[derive(Debug)]
pub(crate) struct RingFrames {
    codec: FrameCodec,
    buffer: BytesMut,
    /// Bytes of `buffer` that are known to be whole frames: where a record without bytes came, it was looked for their end.
    whole: usize,
    /// Bytes that the last look copied.
    copied: usize,
    /// Bytes' worth of work beside the frames that came: of each record, and what was taken back.
    idle: usize,
}

impl RingFrames {
    /// Takes payloads of at most `payload_max` bytes.
    pub(crate) fn new(payload_max: usize) -> Self {
        Self {
            codec: FrameCodec::in_memory(payload_max),
            buffer: BytesMut::new(),
            whole: 0,
            copied: 0,
            idle: 0,
        }
    }

    /// The next frame of what was taken.
    pub(crate) fn next(&mut self) -> Result<Option<Message>, FrameError> {
        let before = self.buffer.len();
        let next = self.codec.decode(&mut self.buffer);
        self.whole = self.whole.saturating_sub(before - self.buffer.len());
        next
    }

    /// Whether [`next`](Self::next) has something to say: a frame, or that there is none to be had.
    pub(crate) fn has_frame(&self) -> bool {
        let Some(head) = self.buffer.first_chunk() else { return false };
        Header::payload_len(head).map_or(true, |length| self.buffer.len() >= HEADER_LEN + length as usize)
    }

    /// Takes records, without waiting, until there are about `enough` bytes, or half a ring's, or the long frame that comes is whole.
    /// Each byte is read once. The peer gets their room back together: one that waits for it is woken once, and not for each.
    pub(crate) fn take(&mut self, consumer: &mut Consumer, enough: usize) -> Result<Taken, Corrupt> {
        let half = consumer.payload_max() - MARK_BYTES;
        let enough = enough.max(half.min(ENOUGH_MIN));
        let mut taken = Taken::Nothing;
        self.copied = 0;
        for _ in 0..RECORDS_A_LOOK {
            let Some(lent) = consumer.receive()? else { break };
            if lent.is_empty() {
                self.forget_part();
            }
            let start = self.buffer.len();
            self.buffer.resize(start + lent.len(), 0);
            lent.copy_to(&mut self.buffer[start..]);
            // What was copied counts, not what is left of it: a part may be taken back again and again.
            self.copied += lent.len();
            // Only a node asks for it, and of its guests alone.
            self.idle = self.idle.saturating_add(RECORD_WORK);
            lent.keep();
            taken = Taken::Some;
            if self.copied >= enough || self.has_filled() {
                break;
            }
        }
        consumer.give_back();
        Ok(taken)
    }

    /// Bytes that the last look copied.
    pub(crate) const fn copied(&self) -> usize {
        self.copied
    }

    /// Bytes' worth of work since the last call that no frame came of.
    pub(crate) fn take_idle(&mut self) -> usize {
        std::mem::take(&mut self.idle)
    }

    /// Whether a frame is whole that has a buffer of its own: with what comes behind it that would grow, and each payload in it keep
    /// all of it.
    fn has_filled(&self) -> bool {
        self.buffer.capacity() > FrameCodec::BUFFER_KEPT && self.has_frame()
    }

    /// Forgets the frame that has begun and is not whole.
    fn forget_part(&mut self) {
        while let Some(head) = self.buffer.get(self.whole..).and_then(<[u8]>::first_chunk) {
            // What is no frame is said by `next`.
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
    fn four_pieces_of_a_long_frame_fill_a_ring_and_one_look_takes_half_of_them() {
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
        let taken = Capacity::MIN.bytes() - producer.untaken().expect("an honest peer");
        assert_eq!(taken, Capacity::MIN.bytes() / 2);
    }

    #[test]
    fn a_frame_that_is_begun_and_taken_back_again_and_again_is_work_and_a_look_at_it_ends() {
        // Given: a ring full of beginnings of a long frame, each with the record that takes it back
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(1 << 20));
        let (begins, mut written) = (&frame(1 << 20)[..64], 0);
        while write(&mut producer, &[IoSlice::new(begins)]).is_ok() && withdraw(&mut producer).is_ok() {
            written += 1;
        }
        assert!(written > 20, "{written} beginnings");
        // When: it is read, for as little as may be
        let (mut looks, mut copied, mut idle) = (0, 0, 0);
        while frames.take(&mut consumer, 1).expect("an honest peer") == Taken::Some {
            assert!(frames.next().expect("no frame is wrong").is_none());
            (looks, copied) = (looks + 1, copied + frames.copied());
            assert!(frames.copied() <= RECORDS_A_LOOK * begins.len());
            idle += frames.take_idle();
        }
        // Then: each byte that was copied, and each record, is in what it came to
        assert!(looks * RECORDS_A_LOOK >= 2 * written, "{looks} looks at {written} beginnings");
        assert!(copied >= written * begins.len());
        assert!(idle >= 2 * written * RECORD_WORK + written * begins.len(), "{idle}");
        assert_eq!(frames.take_idle(), 0);
    }

    #[test]
    fn a_look_takes_no_more_than_is_enough_though_parts_are_taken_back() {
        // Given: beginnings of half a look each, all of them taken back
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
        for look in 0..4 {
            assert_eq!(frames.take(&mut consumer, 1).expect("an honest peer"), Taken::Some);
            assert_eq!(frames.copied(), ENOUGH_MIN, "look {look}");
        }
    }

    #[test]
    fn long_frames_right_behind_each_other_keep_their_own_length_each() {
        // Given: a writer that is ahead as far as there is room.
        const LENGTH: usize = 1_500_000;
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(LENGTH));
        let long = frame(LENGTH);
        let (mut left, mut written, mut came) = (&long[..], 0, Vec::new());
        while came.len() < 4 {
            while let Ok(count) = write(&mut producer, &[IoSlice::new(left)]) {
                left = &left[count..];
                if left.is_empty() {
                    written += 1;
                    left = if written < 4 { &long } else { break };
                }
            }
            // When: it is read.
            assert_eq!(frames.take(&mut consumer, usize::MAX).expect("an honest peer"), Taken::Some);
            while let Some(message) = frames.next().expect("a frame") {
                came.push(message.payload);
            }
        }
        // Then:
        for payload in came {
            let mut memory = payload.try_into_mut().expect("nobody else has it");
            memory.clear();
            assert!(!memory.try_reclaim(2 * LENGTH), "it keeps twice its length");
        }
    }

    #[test]
    fn a_record_without_bytes_takes_back_the_frame_that_has_begun_and_no_other() {
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
                assert_eq!(frames.next().expect("a frame").expect("a frame").payload.len(), 100);
            }
            assert!(frames.next().expect("nothing wrong").is_none(), "{part} bytes had been written");
        }
    }
}
