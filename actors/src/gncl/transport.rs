//! A connection between nodes: its bytes as they are, or sealed in the records of TLS.
//!
//! ```text
//!  outlet ── any thread ──► seal ──► socket            Open: neither seals nor opens
//!  reader ◄── one task ──── open ◄── socket
//! ```
//!
//! Both directions of a sealed connection share rustls' state and so a mutex: whoever writes holds it for as long as a piece of a frame
//! takes to be sealed, some 30 us for the longest one.

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
        let records = Records { tls, is_one_untold: false };
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

    /// Appends to `buffer` what has come, `room` bytes at most; waits until there is something. Returns how much it was, which is 0 at the
    /// end of the connection.
    ///
    /// # Errors
    /// The connection is over. [`io::ErrorKind::InvalidData`]: what came is not what the peer has sealed, or it says that it does not take
    /// this node; in words.
    pub(super) async fn read(&self, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
        loop {
            let read = match &self.records {
                None => {
                    self.socket.readable().await?;
                    self.read_open(buffer, room)
                }
                Some(records) => {
                    // What was opened before is no news of the socket's.
                    let opened = lock(records).take(buffer, room);
                    if !matches!(&opened, Err(error) if error.kind() == io::ErrorKind::WouldBlock) {
                        return opened;
                    }
                    self.socket.readable().await?;
                    lock(records).read(&self.socket, buffer, room)
                }
            };
            match read {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return read,
            }
        }
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
    /// The last byte that was taken to be sealed was not told as written, for the socket has not taken all that was sealed: whoever
    /// writes comes again with it, and has the rest go out.
    is_one_untold: bool,
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
            if self.tls.write_tls(&mut AtOnce::new(socket))? == 0 {
                return Err(io::ErrorKind::WriteZero.into());
            }
        }
        Ok(())
    }

    fn read(&mut self, socket: &TcpStream, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
        loop {
            let mut reading = AtOnce::new(socket);
            let came = self.tls.read_tls(&mut reading)?;
            if reading.is_emptied {
                expect_more(socket);
            }
            if came == 0 {
                return Ok(0);
            }
            let opened = self.tls.process_new_packets();
            // An answer to what came, or why it is not taken: a socket that is full loses it with the connection, or it goes with what is
            // written next.
            let _ = self.flush(socket);
            opened.map_err(|error| io::Error::new(io::ErrorKind::InvalidData, words(&error)))?;
            match self.take(buffer, room) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                taken => return taken,
            }
        }
    }

    /// What is open already.
    fn take(&mut self, buffer: &mut BytesMut, room: usize) -> io::Result<usize> {
        let mut reader = self.tls.reader();
        let opened = io::BufRead::fill_buf(&mut reader)?;
        let count = opened.len().min(room);
        buffer.put_slice(&opened[..count]);
        io::BufRead::consume(&mut reader, count);
        Ok(count)
    }
}

/// A socket that is read and written at once or not at all.
struct AtOnce<'a> {
    socket: &'a TcpStream,
    /// The last read has left nothing.
    is_emptied: bool,
}

impl<'a> AtOnce<'a> {
    const fn new(socket: &'a TcpStream) -> Self {
        Self { socket, is_emptied: false }
    }
}

impl Read for AtOnce<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.socket.try_read(buffer)?;
        self.is_emptied = count > 0 && count < buffer.len();
        Ok(count)
    }
}

impl Write for AtOnce<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.socket.try_write(bytes)
    }

    fn write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        self.socket.try_write_vectored(parts)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
