//! A hand-written, possibly malicious connection to a node: any bytes, in any order.

use std::{
    io::{self, IoSlice, Read, Write},
    mem::MaybeUninit,
    os::{
        fd::{AsFd, BorrowedFd, OwnedFd},
        unix::net::UnixStream,
    },
    path::Path,
    time::Duration,
};

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
use sinew::{AppAddress, NodeAddress, Tid, message::Kind};
use sinew_runtime::wire::{Header, encode};

/// Timeout of all waits: short, so that the attack goes on.
const TIMEOUT: Duration = Duration::from_millis(300);
const HEADER_BYTES: usize = 64;
/// Maximum number of descriptors in one message: SCM_MAX_FD of the kernel.
pub(super) const DESCRIPTORS_MAX: usize = 253;

/// A frame that may be invalid.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) header: [u8; HEADER_BYTES],
    pub(super) payload: Vec<u8>,
}

impl Frame {
    pub(super) fn new(header: &Header, payload: Vec<u8>) -> Self {
        Self { header: header.encode(&payload), payload }
    }

    /// An LNCL control frame.
    pub(super) fn of_lncl<P: sinew::Payload>(kind: Kind, source: Tid, payload: &P) -> Self {
        let lncl = Tid::new(NodeAddress::HERE, AppAddress::LNCL);
        Self::new(&Header::new(kind, source, lncl), encode(payload).to_vec())
    }

    /// Sets a valid checksum, even if other fields are invalid.
    pub(super) fn sealed(mut self) -> Self {
        let mut crc = crc32fast::Hasher::new();
        crc.update(&self.header[..60]);
        crc.update(&self.payload);
        self.header[60..].copy_from_slice(&crc.finalize().to_le_bytes());
        self
    }

    pub(super) fn bytes(&self) -> Vec<u8> {
        [&self.header[..], &self.payload].concat()
    }
}

/// A frame from the node.
#[derive(Debug)]
pub(super) struct NodeFrame {
    pub(super) kind: Kind,
    pub(super) source: u64,
    pub(super) correlation: u64,
    pub(super) payload: Vec<u8>,
}

impl NodeFrame {
    /// The first frame in these bytes, and its length; `None` while it is incomplete.
    pub(super) fn first_of(bytes: &[u8]) -> Option<(Self, usize)> {
        let (frame, length) = Self::of_head(bytes.first_chunk()?);
        let whole = HEADER_BYTES + length;
        let payload = bytes.get(HEADER_BYTES..whole)?.to_vec();
        Some((Self { payload, ..frame }, whole))
    }

    /// The fields of a header, and the length of the payload that follows.
    fn of_head(header: &[u8; HEADER_BYTES]) -> (Self, usize) {
        let number = |at: usize, bytes: usize| {
            header[at..at + bytes].iter().rev().fold(0, |number: u64, byte| number << 8 | u64::from(*byte))
        };
        let kind = Kind::from_bits(number(8, 4) as u32);
        let source = if kind == Kind::LNCL_REGISTERED { number(24, 8) } else { number(16, 8) };
        (Self { kind, source, correlation: number(40, 8), payload: Vec::new() }, number(4, 4) as usize)
    }
}

/// A connection.
#[derive(Debug)]
pub(super) struct RawConnection {
    pub(super) stream: UnixStream,
    pub(super) tid: Tid,
}

impl RawConnection {
    /// Connects, and sends nothing.
    pub(super) fn connect(socket: &Path) -> io::Result<Self> {
        let stream = UnixStream::connect(socket)?;
        stream.set_read_timeout(Some(TIMEOUT))?;
        stream.set_write_timeout(Some(TIMEOUT))?;
        Ok(Self { stream, tid: Tid::NONE })
    }

    /// Connects and registers any address, as an honest client does. `None` if the node has no free address.
    pub(super) fn register(socket: &Path) -> io::Result<Option<Self>> {
        let mut connection = Self::connect(socket)?;
        let lncl = Tid::new(NodeAddress::HERE, AppAddress::LNCL);
        let header = Header::new(Kind::LNCL_REGISTER, Tid::NONE, lncl);
        connection.write(&Frame::new(&header, vec![0x80]).bytes())?;
        let Some(answer) = connection.read()? else { return Ok(None) };
        // The destination of its first frame is the assigned address.
        connection.tid = Tid::from_bits(answer.source);
        Ok((answer.kind == Kind::LNCL_REGISTERED).then_some(connection))
    }

    pub(super) fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.stream.write_all(bytes)
    }

    /// Writes the bytes together with descriptors.
    pub(super) fn pass(&self, bytes: &[u8], descriptors: &[OwnedFd]) -> io::Result<()> {
        pass(&self.stream, bytes, descriptors)
    }

    /// Reads the next frame; `None` at the end of the connection.
    pub(super) fn read(&mut self) -> io::Result<Option<NodeFrame>> {
        let mut header = [0; HEADER_BYTES];
        match self.stream.read_exact(&mut header) {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(None),
            result => result?,
        }
        let (frame, length) = NodeFrame::of_head(&header);
        let mut payload = vec![0; length];
        self.stream.read_exact(&mut payload)?;
        Ok(Some(NodeFrame { payload, ..frame }))
    }
}

/// Writes the bytes to a socket together with descriptors.
pub(super) fn pass(socket: &UnixStream, bytes: &[u8], descriptors: &[OwnedFd]) -> io::Result<()> {
    pass_by(SendFlags::empty(), socket, bytes, descriptors)
}

/// The same; with [`SendFlags::OOB`] the last byte is urgent data.
pub(super) fn pass_by(
    flags: SendFlags,
    socket: &UnixStream,
    bytes: &[u8],
    descriptors: &[OwnedFd],
) -> io::Result<()> {
    let descriptors: Vec<BorrowedFd<'_>> =
        descriptors.iter().take(DESCRIPTORS_MAX).map(AsFd::as_fd).collect();
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(DESCRIPTORS_MAX))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)), "the space is for as many");
    sendmsg(socket, &[IoSlice::new(bytes)], &mut control, flags | SendFlags::NOSIGNAL)?;
    Ok(())
}
