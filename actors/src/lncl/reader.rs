//! The reading half of a unix connection: frames out of bytes.

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

/// Bytes that are read at once.
const READ_CHUNK: usize = 16 * 1024;
/// Frames that are taken of one peer before other tasks of the thread have their turn.
const FRAMES_A_TURN: usize = 64;
/// Bytes that are read of it before that, however long its frames are; of a long frame so many are read at once at most.
const BYTES_A_TURN: usize = 64 * 1024;

/// Reads without a frame before others are told to have their turn: who sends byte by byte costs a wake for each.
const READS_A_TURN: usize = 64;
/// Bytes that a read counts as, beside those of its frame.
pub(super) const READ_WORK: usize = 4 * 1024;

/// What comes of a connection.
#[derive(Debug)]
pub(crate) enum Heard {
    /// A frame.
    Frame(Message),
    /// Nothing that is whole, and others are to have their turn now.
    Turn,
    /// The peer has closed.
    End,
}

/// The reading half of a connection.
pub(crate) struct Reader {
    buffer: BytesMut,
    codec: FrameCodec,
    guard: Guard,
    turn: Turn,
    /// Since the last frame, or the last turn.
    reads: usize,
    /// Bytes' worth of work beside the frames that came.
    idle: usize,
}

/// What was taken since others had their turn.
#[derive(Clone, Copy, Debug, Default)]
struct Turn {
    frames: usize,
    bytes: usize,
}

impl Turn {
    const fn is_over(self) -> bool {
        self.frames >= FRAMES_A_TURN || self.bytes >= BYTES_A_TURN
    }
}

/// Who sees to it that no descriptor is taken from the socket: the one who reads closes it, for as long as that takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Guard {
    /// Nothing was read yet.
    Unknown,
    /// The system lets none come any more; what has come before is looked at.
    Soon,
    /// The system: what has come before is read.
    System,
    /// Whoever reads looks first: the system does not know how to let none come.
    Look,
}

impl Reader {
    /// Takes payloads of at most `payload_max` bytes.
    pub(crate) fn new(payload_max: usize) -> Self {
        Self {
            buffer: BytesMut::new(),
            codec: FrameCodec::new(payload_max),
            guard: Guard::Unknown,
            turn: Turn::default(),
            reads: 0,
            idle: 0,
        }
    }

    /// Bytes' worth of work since the last call that no frame came of.
    pub(super) fn take_idle(&mut self) -> usize {
        std::mem::take(&mut self.idle)
    }

    /// Takes payloads of at most `payload_max` bytes from now on.
    pub(crate) fn set_payload_max(&mut self, payload_max: usize) {
        self.codec.set_payload_max(payload_max);
    }

    /// The next frame that is there already; `None` if there is none and none will come, the process at the other end
    /// being dead.
    pub(crate) fn next_of_the_dead(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        loop {
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                return Ok(Some(message));
            }
            match self.read_guarded(stream) {
                Ok(0) => return Ok(None),
                Ok(_) => {}
                // A reset says that it died with words of ours unread. It comes after its last words.
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::ConnectionReset) =>
                {
                    return Ok(None);
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// The next frame; `None` when the peer has closed. May be dropped at any time without losing a byte.
    ///
    /// Who writes on and on has a turn of the thread like everybody else. The socket alone would not see to that: as long as something is in
    /// it nothing here ever waits.
    pub(crate) async fn next(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        loop {
            match self.hear(stream).await? {
                Heard::Frame(message) => return Ok(Some(message)),
                Heard::Turn => tokio::task::yield_now().await,
                Heard::End => return Ok(None),
            }
        }
    }

    /// The same for who has more to do in the turns of others than to let them have these.
    pub(super) async fn hear(&mut self, stream: &UnixStream) -> Result<Heard, FrameError> {
        loop {
            // Before a frame is taken. spec: LNCL-16
            if self.turn.is_over() || self.reads >= READS_A_TURN {
                (self.turn, self.reads) = (Turn::default(), 0);
                return Ok(Heard::Turn);
            }
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                self.turn.frames += 1;
                self.reads = 0;
                return Ok(Heard::Frame(message));
            }
            stream.readable().await?;
            // Of whom nobody asks for it, it stays.
            (self.reads, self.idle) = (self.reads + 1, self.idle.saturating_add(READ_WORK));
            let read = match self.guard(stream) {
                Guard::System => {
                    self.buffer.reserve(FrameCodec::room(&self.buffer, READ_CHUNK));
                    stream.try_read_buf(&mut (&mut self.buffer).limit(BYTES_A_TURN))
                }
                Guard::Unknown | Guard::Soon | Guard::Look => {
                    stream.try_io(Interest::READABLE, || self.read_guarded(stream))
                }
            };
            match read {
                Ok(0) => return Ok(Heard::End),
                Ok(count) => self.turn.bytes += count,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    // It waits now, while others have their turn.
                    self.turn = Turn::default();
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
            self.guard = if refused.is_ok() { Guard::Soon } else { Guard::Look };
        }
        self.guard
    }

    /// Reads what is there, unless a descriptor is beside it: that stays where it is.
    fn read_guarded(&mut self, stream: &UnixStream) -> io::Result<usize> {
        let mut chunk = [0; READ_CHUNK];
        let room = FrameCodec::room(&self.buffer, READ_CHUNK);
        let Seen { count, beside } = look(stream, &mut chunk[..room])?;
        // spec: LNCL-18
        if beside {
            return Err(io::Error::new(io::ErrorKind::InvalidData, STRAY_DESCRIPTORS));
        }
        // Nobody else reads, so these are the bytes that were looked at.
        let (_, count) = retried(|| recv(stream, &mut chunk[..count], RecvFlags::DONTWAIT))?;
        self.buffer.extend_from_slice(&chunk[..count]);
        Ok(count)
    }
}

/// What is said to who passes them.
const STRAY_DESCRIPTORS: &str = "descriptors came beside its bytes, and nobody has asked for any; pass them with the offer of shared memory only";

/// What comes next on a socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Seen {
    /// Bytes; 0 when the peer has closed.
    pub(super) count: usize,
    /// Descriptors are beside them.
    pub(super) beside: bool,
}

/// Looks at what comes next, which all stays where it is. Does not wait.
pub(super) fn look(stream: impl AsFd, bytes: &mut [u8]) -> io::Result<Seen> {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    let got = retried(|| {
        // Without room for descriptors: that they are there is said, and none is made ours.
        let mut none = RecvAncillaryBuffer::default();
        recvmsg(&stream, &mut [IoSliceMut::new(bytes)], &mut none, flags)
    })?;
    Ok(Seen { count: got.bytes, beside: got.flags.contains(ReturnFlags::CTRUNC) })
}

/// A signal is no reason to give up.
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

    /// How many turns another task of the thread has had while so many frames were read that were all there from the beginning.
    fn turns_of_others(guard: Guard, frames: usize, length: usize) -> usize {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            // Given: somebody who has said all at once, and another task.
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
    fn other_tasks_have_a_turn_between_the_frames_of_who_has_written_very_many() {
        const FRAMES: usize = 16 * FRAMES_A_TURN;
        for guard in [Guard::Look, Guard::System] {
            let turns = turns_of_others(guard, FRAMES, 0);
            assert!(turns >= FRAMES / FRAMES_A_TURN - 1, "{turns} turns for {FRAMES} frames: {guard:?}");
        }
    }

    // spec: LNCL-16
    #[test]
    fn who_sends_byte_by_byte_has_a_turn_for_some_of_them_and_each_is_work() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
            ours.set_nonblocking(true).expect("it is ours");
            let ours = UnixStream::from_std(ours).expect("it is a socket");
            let (mut reader, mut bytes) = (Reader::new(4_096), BytesMut::new());
            let header = Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST);
            encode_frame(&header, &[7; 4_000], &mut bytes);
            // When: each byte is sent when the one before was read
            let (mut turns, mut sent) = (0, 0);
            let heard = loop {
                tokio::select! {
                    biased;
                    heard = reader.hear(&ours) => match heard.expect("bytes of a frame") {
                        Heard::Turn => turns += 1,
                        heard @ (Heard::Frame(_) | Heard::End) => break heard,
                    },
                    () = std::future::ready(()) => {
                        theirs.write_all(&bytes[sent..=sent]).expect("there is room");
                        sent += 1;
                        // Whoever is polled next finds it.
                        tokio::task::yield_now().await;
                    }
                }
            };
            // Then
            assert!(matches!(heard, Heard::Frame(_)) && sent == bytes.len());
            assert!(turns >= sent / READS_A_TURN / 2, "{turns} turns for {sent} bytes");
            assert!(reader.take_idle() >= READ_WORK * sent / 2);
        });
    }

    // spec: LNCL-16
    #[test]
    fn other_tasks_have_a_turn_between_the_bytes_of_who_has_written_very_much() {
        const FRAMES: usize = FRAMES_A_TURN / 2;
        const LENGTH: usize = 4 * 1024;
        const { assert!(FRAMES * (LENGTH + HEADER_LEN) > 2 * BYTES_A_TURN, "so much is more than two turns") };
        for guard in [Guard::Look, Guard::System] {
            let turns = turns_of_others(guard, FRAMES, LENGTH);
            assert!(turns >= 1, "none for {FRAMES} frames of {LENGTH} bytes: {guard:?}");
        }
    }

    #[test]
    fn long_frames_right_behind_each_other_keep_their_own_length_each_however_it_is_read() {
        const LENGTH: usize = 1_500_000;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        for guard in [Guard::Look, Guard::System] {
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
