//! A connection between nodes: its bytes are plain, or encrypted in TLS records.
//!
//! ```text
//!  outlet ── any thread ──► encrypt ──► socket         Plain: neither encrypts nor decrypts
//!  reader ◄── one task ──── decrypt ◄── socket
//! ```
//!
//! Both directions of an encrypted connection share rustls' state and therefore a mutex. A writer holds it
//! for the encryption of one piece of a frame, some 30 us for the longest one. The reader holds it until it
//! has some decrypted data, and never longer than the decryption of [`SURPLUS_BYTES_MAX`] bytes takes. A peer that
//! sends more records without data is refused.

use std::{
    future::poll_fn,
    io::{self, IoSlice, Read, Write},
    net::Shutdown,
    sync::{Arc, Mutex},
    task::{Context, Poll},
};

use bytes::{BufMut, BytesMut};
use rustls::Connection;
use sinew_runtime::lock;
use sinew_session::outlet::Socket;
use socket2::SockRef;
use tokio::{io::Interest, net::TcpStream};

use sinew_security::words;

/// Maximum number of bytes that are encrypted before the socket has accepted them.
const ENCRYPTED_MAX: usize = 128 << 10;
/// Minimum number of bytes that a record counts in a turn: its decryption costs as much, however little it contains.
const RECORD_WORK: usize = 1 << 10;
/// Maximum number of received record bytes beyond those decrypted for the reader. For a correct peer these
/// are an incomplete record and the last decrypted one: twice 16 KiB, and little more.
const SURPLUS_BYTES_MAX: usize = 64 << 10;
/// Overhead of a record, 22 bytes, and two more. These two allow for the key updates of a correct peer after
/// millions of records.
const RECORD_OVERHEAD: usize = 24;
/// Maximum number of session tickets from a peer. A node sends none; other TLS software sends a few by default.
const TICKETS_MAX: u32 = 8;

/// Bytes of a first read from the socket, as many as rustls itself requests at a time.
const READ_FIRST: usize = 4 << 10;
/// Bytes of a read from a socket that had more than [`READ_FIRST`]: two records. A long message then does not
/// cost a system call per quarter of a record. Only connections with such messages have the memory.
const READ_LONG: usize = 32 << 10;

/// The error for a peer that sends more tickets.
const TICKETS_ERROR: &str = "the other end sends tickets of TLS on and on, and a node sends none: it may be no node, or a fault of its software";
/// The error for a peer that sends more empty records.
const EMPTY_RECORDS_ERROR: &str = "the other end sends records of TLS on and on in which there is nothing for this node, and a node sends none: it may be no node, \
     or a fault of its software";

/// The result of one read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct ReadResult {
    /// Bytes for the reader; 0 at the end of the connection.
    pub(super) count: usize,
    /// Bytes that this counts in the reader's turn: the received bytes, if records are short or carry nothing.
    pub(super) work: usize,
}

/// A connection that any thread may write to and one task reads.
#[derive(Clone, Debug)]
pub struct Transport {
    socket: Arc<TcpStream>,
    /// The TLS state; `None`: the connection is plain.
    records: Option<Arc<Mutex<Records>>>,
}

impl Transport {
    /// Creates a plain connection.
    pub fn plain(socket: TcpStream) -> Self {
        Self { socket: Arc::new(socket), records: None }
    }

    /// Returns the same connection, encrypted after its handshake.
    pub(super) fn encrypted(self, mut tls: Connection) -> Self {
        tls.set_buffer_limit(Some(ENCRYPTED_MAX));
        let records = Records {
            tls,
            encrypted: EncryptedBuffer::default(),
            has_unreported_byte: false,
            surplus_bytes: 0,
            refused: None,
        };
        Self { records: Some(Arc::new(Mutex::new(records))), ..self }
    }

    /// Returns the same connection, with another descriptor of its socket.
    pub(super) fn with_socket(&self, socket: TcpStream) -> Self {
        Self { socket: Arc::new(socket), records: self.records.clone() }
    }

    pub(super) fn socket(&self) -> &TcpStream {
        &self.socket
    }

    /// Shuts the socket down, even if other threads still hold it.
    pub(super) fn shut(&self, how: Shutdown) {
        // This fails if the peer was faster; then there is nothing left to shut down.
        let _ = SockRef::from(&*self.socket).shutdown(how);
    }

    /// Writes all of `bytes`, in as many turns as needed.
    ///
    /// # Errors
    /// The connection has ended.
    pub(super) async fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut rest = bytes;
        while !rest.is_empty() {
            match self.try_write_vectored(&[IoSlice::new(rest)]) {
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => self.socket.writable().await?,
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Appends at most `room` received bytes to `buffer`; waits until there are some.
    ///
    /// # Errors
    /// The connection has ended. [`io::ErrorKind::InvalidData`], with the reason: the bytes were not
    /// encrypted by the peer, the peer keeps sending empty records, or it does not accept this node.
    pub(super) async fn receive(&self, buffer: &mut BytesMut, room: usize) -> io::Result<ReadResult> {
        loop {
            let read = match &self.records {
                None => {
                    self.readable().await?;
                    self.read_plain(buffer, room).map(|count| ReadResult { count, work: count })
                }
                Some(records) => {
                    // Bytes received before do not make the socket ready again.
                    let opened = lock(records).decrypt(&self.socket, false, buffer, room);
                    if !matches!(&opened, Err(error) if error.kind() == io::ErrorKind::WouldBlock) {
                        return opened;
                    }
                    self.readable().await?;
                    lock(records).decrypt(&self.socket, true, buffer, room)
                }
            };
            match read {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return read,
            }
        }
    }

    /// Waits until the socket may have bytes. One task reads at a time, so that the reactor's place for one
    /// reader is enough: unlike its list of waiters, it takes no lock when the bytes are there.
    async fn readable(&self) -> io::Result<()> {
        poll_fn(|cx| self.socket.poll_read_ready(cx)).await
    }

    /// Same as [`receive`](Self::receive), without the work: returns the number of bytes.
    #[cfg(test)]
    pub(super) async fn read(&self, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
        self.receive(buffer, room).await.map(|got| got.count)
    }

    fn read_plain(&self, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
        let count = self.socket.try_read_buf(&mut (&mut *buffer).limit(room))?;
        if count > 0 && count < room {
            expect_more(&self.socket);
        }
        Ok(count)
    }
}

impl Socket for Transport {
    fn piece_max(&self) -> usize {
        // About 20 us of copying.
        64 << 10
    }

    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        match &self.records {
            None => self.socket.try_write_vectored(parts),
            Some(records) => lock(records).write(&self.socket, parts),
        }
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.socket.poll_write_ready(cx)
    }
}

/// Marks a socket as read empty, so that the next read waits for readiness instead of failing first. A partly
/// filled read has left nothing, and later bytes cause a new notification. This saves a system call per
/// message.
fn expect_more(socket: &TcpStream) {
    // The closure fails without a system call, which clears the readiness.
    let _ = socket.try_io(Interest::READABLE, || Err::<(), _>(io::ErrorKind::WouldBlock.into()));
}

/// The TLS records of a connection, both directions.
#[derive(Debug)]
struct Records {
    tls: Connection,
    /// Received bytes that were not passed to rustls yet.
    encrypted: EncryptedBuffer,
    /// Whether the last encrypted byte was not reported as written, because the socket has not accepted all
    /// encrypted bytes. The writer then calls again with this byte, which sends the rest.
    has_unreported_byte: bool,
    /// Received bytes, less those decrypted for the reader, and less the overhead of each record.
    surplus_bytes: usize,
    /// The reason why no more of the peer's bytes are decrypted.
    refused: Option<&'static str>,
}

impl Records {
    /// Encrypts the beginning of `parts` and writes it to the socket. Returns how many of the bytes need not
    /// be passed again.
    fn write(&mut self, socket: &TcpStream, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        self.flush(socket)?;
        let (reported, taken) = if std::mem::take(&mut self.has_unreported_byte) {
            let first = parts.iter().find(|part| !part.is_empty()).map_or(&[][..], |part| &part[1..]);
            (1, self.tls.writer().write(first)?)
        } else {
            (0, self.tls.writer().write_vectored(parts)?)
        };
        match self.flush(socket) {
            Ok(()) => Ok(reported + taken),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock && taken == 0 => Ok(reported),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                self.has_unreported_byte = true;
                match reported + taken - 1 {
                    0 => Err(error),
                    written => Ok(written),
                }
            }
            Err(error) => Err(error),
        }
    }

    /// Writes all encrypted bytes to the socket.
    fn flush(&mut self, socket: &TcpStream) -> io::Result<()> {
        while self.tls.wants_write() {
            if self.tls.write_tls(&mut WriteAtOnce(socket))? == 0 {
                return Err(io::ErrorKind::WriteZero.into());
            }
        }
        Ok(())
    }

    /// Decrypts bytes read before, and those in the socket if it is `is_readable`. Ends when there is data
    /// for the reader, nothing is left, or the peer is refused.
    fn decrypt(
        &mut self,
        socket: &TcpStream,
        is_readable: bool,
        buffer: &mut BytesMut,
        room: usize,
    ) -> io::Result<ReadResult> {
        let mut received_bytes = 0;
        loop {
            match self.take(buffer, room) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                taken => return taken.map(|got| ReadResult { work: got.work.max(received_bytes), ..got }),
            }
            if self.encrypted.is_empty() {
                if !is_readable {
                    return Err(io::ErrorKind::WouldBlock.into());
                }
                if self.encrypted.fill(socket)? == 0 {
                    return Ok(ReadResult::default());
                }
            }
            let count = self.tls.read_tls(&mut self.encrypted)?;
            // The peer has closed the connection in order before.
            if count == 0 {
                return Ok(ReadResult::default());
            }
            received_bytes += count;
            self.surplus_bytes += count;
            let opened = self.tls.process_new_packets();
            // This sends an answer or an alert. If the socket is full, it is lost with the connection, or
            // sent with the next write.
            let _ = self.flush(socket);
            opened.map_err(|error| io::Error::new(io::ErrorKind::InvalidData, words(&error)))?;
            self.refused = self.excess();
        }
    }

    /// Returns the reason to refuse a peer that sends endless records without data. TLS itself bounds
    /// consecutive key updates and empty records, but not tickets.
    // spec: GNCL-18
    fn excess(&self) -> Option<&'static str> {
        match &self.tls {
            Connection::Client(client) if client.tls13_tickets_received() > TICKETS_MAX => {
                Some(TICKETS_ERROR)
            }
            Connection::Client(_) | Connection::Server(_) => {
                (self.surplus_bytes > SURPLUS_BYTES_MAX).then_some(EMPTY_RECORDS_ERROR)
            }
        }
    }

    /// Takes the decrypted data of as many records as there is room for.
    fn take(&mut self, buffer: &mut BytesMut, room: usize) -> io::Result<ReadResult> {
        if let Some(why) = self.refused {
            return Err(io::Error::new(io::ErrorKind::InvalidData, why));
        }
        let mut reader = self.tls.reader();
        let mut got = ReadResult::default();
        while got.count < room {
            let opened = match io::BufRead::fill_buf(&mut reader) {
                Ok(opened) => opened,
                // The error is returned again by the next call.
                Err(_) if got.count > 0 => break,
                Err(error) => return Err(error),
            };
            // The peer has closed the connection in order.
            if opened.is_empty() {
                break;
            }
            let part = opened.len().min(room - got.count);
            let is_whole = part == opened.len();
            buffer.put_slice(&opened[..part]);
            io::BufRead::consume(&mut reader, part);
            got.count += part;
            got.work += part.max(RECORD_WORK);
            let paid = if is_whole { part + RECORD_OVERHEAD } else { part };
            self.surplus_bytes = self.surplus_bytes.saturating_sub(paid);
        }
        Ok(got)
    }
}

/// Bytes of one read from a socket, in the order of arrival; refilled when all were taken.
#[derive(Debug, Default)]
struct EncryptedBuffer {
    /// The buffer, as long as the longest read so far.
    room: Vec<u8>,
    taken: usize,
    filled: usize,
}

impl EncryptedBuffer {
    const fn is_empty(&self) -> bool {
        self.taken == self.filled
    }

    /// Reads once from the socket, after all earlier bytes were taken. Returns the number of bytes; 0 at the
    /// end of the connection.
    fn fill(&mut self, socket: &TcpStream) -> io::Result<usize> {
        // The last read had filled the buffer.
        let wanted = if self.filled == READ_FIRST { READ_LONG } else { READ_FIRST };
        if self.room.len() < wanted {
            self.room.resize(wanted, 0);
        }
        (self.taken, self.filled) = (0, 0);
        self.filled = socket.try_read(&mut self.room)?;
        if self.filled > 0 && self.filled < self.room.len() {
            expect_more(socket);
        }
        Ok(self.filled)
    }
}

impl Read for EncryptedBuffer {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let rest = &self.room[self.taken..self.filled];
        let count = rest.len().min(buffer.len());
        buffer[..count].copy_from_slice(&rest[..count]);
        self.taken += count;
        Ok(count)
    }
}

/// A socket with writes that either succeed at once or fail.
struct WriteAtOnce<'a>(&'a TcpStream);

impl Write for WriteAtOnce<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.try_write(bytes)
    }

    fn write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        self.0.try_write_vectored(parts)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
pub(super) mod tests;
