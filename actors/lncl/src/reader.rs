//! The reading half of a Unix connection: decodes frames.

use std::{
    io::{self, IoSliceMut},
    os::fd::AsFd,
};

use bytes::{BufMut as _, BytesMut};
use rustix::{
    io::Errno,
    net::{RecvAncillaryBuffer, RecvFlags, ReturnFlags, recv, recvmsg},
};
use sinew_runtime::wire::{FrameCodec, FrameError, Message};
use sinew_shm::Descriptors;
use tokio::{io::Interest, net::UnixStream};
use tokio_util::codec::Decoder;

/// Bytes read at once.
const READ_CHUNK: usize = 16 * 1024;
/// Frames read from one peer before other tasks of the thread run.
const FRAMES_PER_TURN: usize = 64;
/// Bytes read from one peer before that, for frames of any length. It is also the maximum of one read of a long frame.
const BYTES_PER_TURN: usize = 64 * 1024;

/// Reads without a frame before other tasks run. A peer that sends byte by byte costs a wake for each.
const READS_PER_TURN: usize = 64;
/// Cost of a read in bytes, in addition to its frame.
pub(super) const READ_WORK: usize = 4 * 1024;

/// Result of a read.
#[derive(Debug)]
pub(crate) enum Received {
    /// A frame.
    Frame(Message),
    /// No complete frame yet; other tasks must run now.
    Yield,
    /// The peer has closed the connection.
    End,
}

/// The reading half of a connection.
pub struct Reader {
    buffer: BytesMut,
    codec: FrameCodec,
    guard: Guard,
    turn: ReadTurn,
    /// Reads since the last frame or the last yield.
    reads: usize,
    /// Work without a frame, in bytes.
    idle: usize,
}

/// Work since other tasks ran.
#[derive(Clone, Copy, Debug, Default)]
struct ReadTurn {
    frames: usize,
    bytes: usize,
}

impl ReadTurn {
    const fn is_over(self) -> bool {
        self.frames >= FRAMES_PER_TURN || self.bytes >= BYTES_PER_TURN
    }
}

/// The party that keeps descriptors in the socket unread. A descriptor that is read must be closed by its reader, which
/// may block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Guard {
    /// Nothing was read yet.
    Unknown,
    /// The kernel refuses new descriptors; data that arrived before is checked by [`peek`].
    Soon,
    /// The kernel refuses descriptors, and all earlier data has been read.
    System,
    /// The reader checks before each read, since the kernel cannot refuse descriptors.
    Peek,
}

impl Reader {
    /// Creates a reader of payloads of at most `payload_max` bytes.
    pub fn new(payload_max: usize) -> Self {
        Self {
            buffer: BytesMut::new(),
            codec: FrameCodec::new(payload_max),
            guard: Guard::Unknown,
            turn: ReadTurn::default(),
            reads: 0,
            idle: 0,
        }
    }

    /// Returns the work without a frame since the last call, in bytes.
    pub(super) fn take_idle(&mut self) -> usize {
        std::mem::take(&mut self.idle)
    }

    /// Accepts payloads of at most `payload_max` bytes from now on.
    pub fn set_payload_max(&mut self, payload_max: usize) {
        self.codec.set_payload_max(payload_max);
    }

    /// Returns the next frame that has already arrived, from a peer with a dead process. Returns `None` if there is
    /// none.
    pub fn next_buffered(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        loop {
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                return Ok(Some(message));
            }
            match self.read_guarded(stream) {
                Ok(0) => return Ok(None),
                Ok(_) => {}
                // A reset means that the peer died before it read all of our data. It follows the peer's last data.
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::ConnectionReset) =>
                {
                    return Ok(None);
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Returns the next frame, or `None` if the peer has closed. This future may be dropped at any time without losing
    /// a byte.
    ///
    /// Yields to other tasks of the thread, even for a peer that writes without pause. The socket alone would not:
    /// while it holds data, reads never wait.
    pub async fn next(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        loop {
            match self.receive(stream).await? {
                Received::Frame(message) => return Ok(Some(message)),
                Received::Yield => tokio::task::yield_now().await,
                Received::End => return Ok(None),
            }
        }
    }

    /// Same as [`Self::next`], for callers that do work of their own at each yield.
    pub(super) async fn receive(&mut self, stream: &UnixStream) -> Result<Received, FrameError> {
        loop {
            // Checked before a frame is taken. spec: LNCL-16
            if self.turn.is_over() || self.reads >= READS_PER_TURN {
                (self.turn, self.reads) = (ReadTurn::default(), 0);
                return Ok(Received::Yield);
            }
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                self.turn.frames += 1;
                self.reads = 0;
                return Ok(Received::Frame(message));
            }
            stream.readable().await?;
            // Accumulates for a peer if its idle work is never queried.
            (self.reads, self.idle) = (self.reads + 1, self.idle.saturating_add(READ_WORK));
            let read = match self.guard(stream) {
                Guard::System => {
                    self.buffer.reserve(FrameCodec::room(&self.buffer, READ_CHUNK));
                    stream.try_read_buf(&mut (&mut self.buffer).limit(BYTES_PER_TURN))
                }
                Guard::Unknown | Guard::Soon | Guard::Peek => {
                    stream.try_io(Interest::READABLE, || self.read_guarded(stream))
                }
            };
            match read {
                Ok(0) => return Ok(Received::End),
                Ok(count) => self.turn.bytes += count,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    // The task waits now, so others run.
                    self.turn = ReadTurn::default();
                    if self.guard == Guard::Soon {
                        self.guard = Guard::System;
                    }
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    fn guard(&mut self, stream: &UnixStream) -> Guard {
        if self.guard == Guard::Unknown {
            let refused = sinew_shm::set_descriptors(stream, Descriptors::Refused);
            self.guard = if refused.is_ok() { Guard::Soon } else { Guard::Peek };
        }
        self.guard
    }

    /// Reads the available data. Fails if a descriptor accompanies it; the descriptor stays in the socket.
    fn read_guarded(&mut self, stream: &UnixStream) -> io::Result<usize> {
        let mut chunk = [0; READ_CHUNK];
        let room = FrameCodec::room(&self.buffer, READ_CHUNK);
        let Peeked { count, has_descriptors } = peek(stream, &mut chunk[..room])?;
        // spec: LNCL-18
        if has_descriptors {
            return Err(io::Error::new(io::ErrorKind::InvalidData, STRAY_DESCRIPTORS));
        }
        // No one else reads, so these are the bytes that `peek` saw.
        let (_, count) = retried(|| recv(stream, &mut chunk[..count], RecvFlags::DONTWAIT))?;
        self.buffer.extend_from_slice(&chunk[..count]);
        Ok(count)
    }
}

/// The error for a peer that passes descriptors.
const STRAY_DESCRIPTORS: &str = "descriptors came beside its bytes, and nobody has asked for any; pass them with the offer of shared memory only";

/// The next data of a socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Peeked {
    /// Bytes; 0 if the peer has closed.
    pub(super) count: usize,
    /// Whether descriptors accompany them.
    pub(super) has_descriptors: bool,
}

/// Peeks at the next data, which stays in the socket. Does not wait.
pub(super) fn peek(stream: impl AsFd, bytes: &mut [u8]) -> io::Result<Peeked> {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    let got = retried(|| {
        // Without a buffer for descriptors, the kernel reports them, and this process receives none.
        let mut none = RecvAncillaryBuffer::default();
        recvmsg(&stream, &mut [IoSliceMut::new(bytes)], &mut none, flags)
    })?;
    Ok(Peeked { count: got.bytes, has_descriptors: got.flags.contains(ReturnFlags::CTRUNC) })
}

/// Retries `call` after a signal.
fn retried<T>(mut call: impl FnMut() -> Result<T, Errno>) -> io::Result<T> {
    loop {
        match call() {
            Err(Errno::INTR) => {}
            other => return other.map_err(io::Error::from),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io::Write,
        sync::{
            Arc,
            atomic::{AtomicUsize, Ordering},
        },
    };

    use sinew_runtime::{
        tid::Tid,
        wire::{HEADER_LEN, Header, Kind, encode_frame},
    };

    use super::*;

    /// Returns the turns of another task of the thread while this many frames are read that are all present from the
    /// beginning.
    fn turns_of_others(guard: Guard, frames: usize, length: usize) -> usize {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            // Given: a peer that has sent everything at once, and another task.
            let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
            ours.set_nonblocking(true).expect("it is ours");
            let ours = UnixStream::from_std(ours).expect("it is a socket");
            let mut bytes = BytesMut::new();
            for _ in 0..frames {
                let header = Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST);
                encode_frame(&header, &vec![7; length], &mut bytes);
            }
            theirs.write_all(&bytes).expect("the socket has room for so much");
            let turns = Arc::new(AtomicUsize::new(0));
            let counting = turns.clone();
            tokio::spawn(async move {
                loop {
                    counting.fetch_add(1, Ordering::Relaxed);
                    tokio::task::yield_now().await;
                }
            });
            // When: it is read; the first frame is waited for in any case.
            let mut reader = Reader { guard, ..Reader::new(length) };
            reader.next(&ours).await.expect("a frame").expect("it is open");
            let before = turns.load(Ordering::Relaxed);
            for _ in 1..frames {
                reader.next(&ours).await.expect("a frame").expect("it is open");
            }
            turns.load(Ordering::Relaxed) - before
        })
    }

    // spec: LNCL-16
    #[test]
    fn other_tasks_run_between_the_frames_of_a_flood() {
        const FRAMES: usize = 16 * FRAMES_PER_TURN;
        for guard in [Guard::Peek, Guard::System] {
            let turns = turns_of_others(guard, FRAMES, 0);
            assert!(turns >= FRAMES / FRAMES_PER_TURN - 1, "{turns} turns for {FRAMES} frames: {guard:?}");
        }
    }

    // spec: LNCL-16
    #[test]
    fn byte_by_byte_sender_gets_few_turns() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
            ours.set_nonblocking(true).expect("it is ours");
            let ours = UnixStream::from_std(ours).expect("it is a socket");
            let (mut reader, mut bytes) = (Reader::new(4_096), BytesMut::new());
            let header = Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST);
            encode_frame(&header, &[7; 4_000], &mut bytes);
            // When: each byte is sent after the read of the previous one
            let (mut turns, mut sent) = (0, 0);
            let received = loop {
                tokio::select! {
                    biased;
                    received = reader.receive(&ours) => match received.expect("bytes of a frame") {
                        Received::Yield => turns += 1,
                        received @ (Received::Frame(_) | Received::End) => break received,
                    },
                    () = std::future::ready(()) => {
                        theirs.write_all(&bytes[sent..=sent]).expect("there is room");
                        sent += 1;
                        // The next poll finds it.
                        tokio::task::yield_now().await;
                    }
                }
            };
            // Then
            assert!(matches!(received, Received::Frame(_)) && sent == bytes.len());
            assert!(turns >= sent / READS_PER_TURN / 2, "{turns} turns for {sent} bytes");
            assert!(reader.take_idle() >= READ_WORK * sent / 2);
        });
    }

    // spec: LNCL-16
    #[test]
    fn other_tasks_run_between_the_bytes_of_a_flood() {
        const FRAMES: usize = FRAMES_PER_TURN / 2;
        const LENGTH: usize = 4 * 1024;
        const { assert!(FRAMES * (LENGTH + HEADER_LEN) > 2 * BYTES_PER_TURN, "so much is more than two turns") };
        for guard in [Guard::Peek, Guard::System] {
            let turns = turns_of_others(guard, FRAMES, LENGTH);
            assert!(turns >= 1, "none for {FRAMES} frames of {LENGTH} bytes: {guard:?}");
        }
    }

    #[test]
    fn consecutive_long_frames_keep_their_lengths_with_any_reads() {
        const LENGTH: usize = 1_500_000;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        for guard in [Guard::Peek, Guard::System] {
            runtime.block_on(async {
                // Given: a writer that is ahead as far as there is room.
                let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
                ours.set_nonblocking(true).expect("it is ours");
                let ours = UnixStream::from_std(ours).expect("it is a socket");
                let mut bytes = BytesMut::new();
                for _ in 0..4 {
                    let header = Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST);
                    encode_frame(&header, &[7; LENGTH], &mut bytes);
                }
                let writing = std::thread::spawn(move || theirs.write_all(&bytes));
                // When: it is read.
                let mut reader = Reader { guard, ..Reader::new(LENGTH) };
                let mut came = Vec::new();
                while let Some(message) = reader.next(&ours).await.expect("frames") {
                    came.push(message.payload);
                }
                writing.join().expect("no panic").expect("it is read");
                // Then:
                assert_eq!(came.len(), 4);
                for payload in came {
                    let mut memory = payload.try_into_mut().expect("nobody else has it");
                    memory.clear();
                    assert!(!memory.try_reclaim(2 * LENGTH), "it keeps twice its length: {guard:?}");
                }
            });
        }
    }
}
