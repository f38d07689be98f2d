//! A connection between nodes: its bytes as they are, or sealed in the records of TLS.
//!
//! ```text
//!  outlet ── any thread ──► seal ──► socket            Open: neither seals nor opens
//!  reader ◄── one task ──── open ◄── socket
//! ```
//!
//! Both directions of a sealed connection share rustls' state and so a mutex: whoever writes holds it for as long as a piece of a frame
//! takes to be sealed, some 30 us for the longest one. Who reads holds it until something was opened for him, and never longer than
//! [`SILENT_MAX`] take to be opened: a peer that sends more in which there is nothing is refused.

use std::{
    io::{self, IoSlice, Read, Write},
    net::Shutdown,
    sync::{Arc, Mutex},
    task::{Context, Poll},
};

use bytes::{BufMut, BytesMut};
use rustls::Connection;
use socket2::SockRef;
use tokio::{io::Interest, net::TcpStream};

use crate::{outlet::Socket, security::words, stores::lock};

/// Bytes that are sealed before the socket has taken them, at most.
const SEALED_MAX: usize = 128 << 10;
/// Bytes that a record counts as in a turn at least: to open it costs as much, however little is in it.
const RECORD_WORK: usize = 1 << 10;
/// Bytes of records that come, beyond what was opened of them for the reader, at most. Of an honest peer's these are a record that is not whole
/// yet, and what was opened last: twice 16 KiB, and little more.
const SILENT_MAX: usize = 64 << 10;
/// What a record is longer than what is in it, 22 bytes, and two more. Those two pay for the new keys that an honest peer makes now and then:
/// after millions of records.
const RECORD_EXTRA: usize = 24;
/// Tickets for another connection that a peer may send. A node sends none; other software for TLS sends a few if it is not told otherwise.
const TICKETS_MAX: u32 = 8;

/// Bytes that one read takes from the socket at first. rustls itself asks for as many at a time.
const READ_FIRST: usize = 4 << 10;
/// Bytes that one read takes from a socket that had more than that: two records, so that a long message does not cost a system call for each
/// quarter of one. Only connections that carry such have the memory.
const READ_LONG: usize = 32 << 10;

/// What is said of who sends more tickets.
const TICKETS_WORDS: &str = "the other end sends tickets of TLS on and on, and a node sends none: it may be no node, or a fault of its software";
/// What is said of who sends more records for nobody.
const SILENT_WORDS: &str = "the other end sends records of TLS on and on in which there is nothing for this node, and a node sends none: it may be no node, \
     or a fault of its software";

/// What one read came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Got {
    /// Bytes for the reader; 0 at the end of the connection.
    pub(super) count: usize,
    /// Bytes that this counts as in the reader's turn: what came for it, where records are short or carry nothing.
    pub(super) work: usize,
}

/// A connection, which any thread may write to and one task reads.
#[derive(Clone, Debug)]
pub(crate) struct Transport {
    socket: Arc<TcpStream>,
    /// `None`: it is open.
    records: Option<Arc<Mutex<Records>>>,
}

impl Transport {
    /// Whose bytes go as they are.
    pub(crate) fn open(socket: TcpStream) -> Self {
        Self { socket: Arc::new(socket), records: None }
    }

    /// The same connection, whose handshake is over.
    pub(super) fn sealed(self, mut tls: Connection) -> Self {
        tls.set_buffer_limit(Some(SEALED_MAX));
        let records =
            Records { tls, sealed: Unopened::default(), is_one_untold: false, silent: 0, refused: None };
        Self { records: Some(Arc::new(Mutex::new(records))), ..self }
    }

    /// The same connection, by another descriptor of its socket.
    pub(super) fn with_socket(&self, socket: TcpStream) -> Self {
        Self { socket: Arc::new(socket), records: self.records.clone() }
    }

    pub(super) fn socket(&self) -> &TcpStream {
        &self.socket
    }

    /// Shuts the socket, which others may still hold.
    pub(super) fn shut(&self, how: Shutdown) {
        // It fails if the peer was faster, and then there is nothing left to shut.
        let _ = SockRef::from(&*self.socket).shutdown(how);
    }

    /// Writes all of `bytes`, in as many turns as that takes.
    ///
    /// # Errors
    /// The connection is over.
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

    /// Appends to `buffer` what has come, `room` bytes at most; waits until there is something.
    ///
    /// # Errors
    /// The connection is over. [`io::ErrorKind::InvalidData`]: what came is not what the peer has sealed, or is on and on nothing for the
    /// reader, or it says that it does not take this node; in words.
    pub(super) async fn take_in(&self, buffer: &mut BytesMut, room: usize) -> io::Result<Got> {
        loop {
            let read = match &self.records {
                None => {
                    self.socket.readable().await?;
                    self.read_open(buffer, room).map(|count| Got { count, work: count })
                }
                Some(records) => {
                    // What came before is no news of the socket's.
                    let opened = lock(records).open(&self.socket, false, buffer, room);
                    if !matches!(&opened, Err(error) if error.kind() == io::ErrorKind::WouldBlock) {
                        return opened;
                    }
                    self.socket.readable().await?;
                    lock(records).open(&self.socket, true, buffer, room)
                }
            };
            match read {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return read,
            }
        }
    }

    /// The same for who has no turns: how many bytes it were.
    #[cfg(test)]
    pub(super) async fn read(&self, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
        self.take_in(buffer, room).await.map(|got| got.count)
    }

    fn read_open(&self, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
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

/// Says that a socket has been read empty, so that the next read waits for the kernel's word instead of asking in vain: a read
/// that fills its room only in part has left nothing, and what comes afterwards is told anew. A system call less for each
/// message.
fn expect_more(socket: &TcpStream) {
    // What is refused here is the very attempt.
    let _ = socket.try_io(Interest::READABLE, || Err::<(), _>(io::ErrorKind::WouldBlock.into()));
}

/// The records of a connection, both ways.
#[derive(Debug)]
struct Records {
    tls: Connection,
    /// What has come of the peer's and rustls has not been given.
    sealed: Unopened,
    /// The last byte that was taken to be sealed was not told as written, for the socket has not taken all that was sealed: whoever
    /// writes comes again with it, and has the rest go out.
    is_one_untold: bool,
    /// Bytes that have come, less what was opened of them for the reader, and less what each record was longer.
    silent: usize,
    /// Why nothing more of the peer's is opened.
    refused: Option<&'static str>,
}

impl Records {
    /// Seals what `parts` begin with, and has the socket take it. Returns how many bytes of them need not come again.
    fn write(&mut self, socket: &TcpStream, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        self.flush(socket)?;
        let (told, taken) = if std::mem::take(&mut self.is_one_untold) {
            let first = parts.iter().find(|part| !part.is_empty()).map_or(&[][..], |part| &part[1..]);
            (1, self.tls.writer().write(first)?)
        } else {
            (0, self.tls.writer().write_vectored(parts)?)
        };
        match self.flush(socket) {
            Ok(()) => Ok(told + taken),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock && taken == 0 => Ok(told),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                self.is_one_untold = true;
                match told + taken - 1 {
                    0 => Err(error),
                    written => Ok(written),
                }
            }
            Err(error) => Err(error),
        }
    }

    /// Has the socket take all that is sealed.
    fn flush(&mut self, socket: &TcpStream) -> io::Result<()> {
        while self.tls.wants_write() {
            if self.tls.write_tls(&mut AtOnce(socket))? == 0 {
                return Err(io::ErrorKind::WriteZero.into());
            }
        }
        Ok(())
    }

    /// Opens what has been read of the socket, and, where it is `is_readable`, what is in it still, until there is something for the reader, or
    /// nothing is left, or the peer is refused.
    fn open(
        &mut self,
        socket: &TcpStream,
        is_readable: bool,
        buffer: &mut BytesMut,
        room: usize,
    ) -> io::Result<Got> {
        let mut came = 0;
        loop {
            match self.take(buffer, room) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                taken => return taken.map(|got| Got { work: got.work.max(came), ..got }),
            }
            if self.sealed.is_empty() {
                if !is_readable {
                    return Err(io::ErrorKind::WouldBlock.into());
                }
                if self.sealed.fill(socket)? == 0 {
                    return Ok(Got::default());
                }
            }
            let count = self.tls.read_tls(&mut self.sealed)?;
            // The peer has closed in order before that.
            if count == 0 {
                return Ok(Got::default());
            }
            came += count;
            self.silent += count;
            let opened = self.tls.process_new_packets();
            // An answer to what came, or why it is not taken: a socket that is full loses it with the connection, or it goes with what is
            // written next.
            let _ = self.flush(socket);
            opened.map_err(|error| io::Error::new(io::ErrorKind::InvalidData, words(&error)))?;
            self.refused = self.excess();
        }
    }

    /// What the peer sends that is for nobody and without end. TLS itself bounds new keys in a row and records without bytes, not tickets.
    // spec: GNCL-18
    fn excess(&self) -> Option<&'static str> {
        match &self.tls {
            Connection::Client(client) if client.tls13_tickets_received() > TICKETS_MAX => {
                Some(TICKETS_WORDS)
            }
            Connection::Client(_) | Connection::Server(_) => {
                (self.silent > SILENT_MAX).then_some(SILENT_WORDS)
            }
        }
    }

    /// What is open already, of as many records as there is room for.
    fn take(&mut self, buffer: &mut BytesMut, room: usize) -> io::Result<Got> {
        if let Some(why) = self.refused {
            return Err(io::Error::new(io::ErrorKind::InvalidData, why));
        }
        let mut reader = self.tls.reader();
        let mut got = Got::default();
        while got.count < room {
            let opened = match io::BufRead::fill_buf(&mut reader) {
                Ok(opened) => opened,
                // Said again when it is asked for more.
                Err(_) if got.count > 0 => break,
                Err(error) => return Err(error),
            };
            // The peer has closed in order.
            if opened.is_empty() {
                break;
            }
            let part = opened.len().min(room - got.count);
            let is_whole = part == opened.len();
            buffer.put_slice(&opened[..part]);
            io::BufRead::consume(&mut reader, part);
            got.count += part;
            got.work += part.max(RECORD_WORK);
            let paid = if is_whole { part + RECORD_EXTRA } else { part };
            self.silent = self.silent.saturating_sub(paid);
        }
        Ok(got)
    }
}

/// Bytes that one read took from a socket, in the order in which they came; it is filled again when all were taken out.
#[derive(Debug, Default)]
struct Unopened {
    /// As long as a read may be.
    room: Vec<u8>,
    taken: usize,
    filled: usize,
}

impl Unopened {
    const fn is_empty(&self) -> bool {
        self.taken == self.filled
    }

    /// Reads once from the socket; what was there of before has been taken out. Returns how many bytes came; 0 at the end of the connection.
    fn fill(&mut self, socket: &TcpStream) -> io::Result<usize> {
        // The last read had left something.
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

impl Read for Unopened {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let rest = &self.room[self.taken..self.filled];
        let count = rest.len().min(buffer.len());
        buffer[..count].copy_from_slice(&rest[..count]);
        self.taken += count;
        Ok(count)
    }
}

/// A socket that is written at once or not at all.
struct AtOnce<'a>(&'a TcpStream);

impl Write for AtOnce<'_> {
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
