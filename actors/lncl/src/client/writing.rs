//! Writing frames to a client's socket, beside its outlet.

use std::io::ErrorKind;

use bytes::{Buf, BytesMut};
use sinew_runtime::wire::{Message, encode_frame};
use tokio::net::UnixStream;

use super::{HANDSHAKE, end::ConnectionEnd};

pub(super) fn encoded(message: &Message) -> BytesMut {
    let mut bytes = BytesMut::new();
    encode_frame(&message.header, &message.payload, &mut bytes);
    bytes
}

/// Writes the final frame, if the socket has room for it.
pub(super) fn write_now(stream: &UnixStream, message: &Message) -> Result<(), ConnectionEnd> {
    let mut bytes = encoded(message);
    write_some(stream, &mut bytes)?;
    if bytes.is_empty() { Ok(()) } else { Err(ConnectionEnd::HungUp(None)) }
}

/// Writes as much as the socket takes now; the rest remains in `bytes`.
pub(super) fn write_some(stream: &UnixStream, bytes: &mut BytesMut) -> Result<(), ConnectionEnd> {
    while !bytes.is_empty() {
        match stream.try_write(bytes) {
            Ok(count) => bytes.advance(count),
            Err(cause) if cause.kind() == ErrorKind::WouldBlock => break,
            Err(cause) => return Err(ConnectionEnd::HungUp(Some(cause))),
        }
    }
    Ok(())
}

/// Writes all of `bytes`. The peer has [`HANDSHAKE`] to read them.
pub(super) async fn write_soon(stream: &UnixStream, mut bytes: BytesMut) -> Result<(), ConnectionEnd> {
    let write = async {
        loop {
            write_some(stream, &mut bytes)?;
            if bytes.is_empty() {
                return Ok(());
            }
            stream.writable().await.map_err(|cause| ConnectionEnd::HungUp(Some(cause)))?;
        }
    };
    tokio::time::timeout(HANDSHAKE, write).await.unwrap_or(Err(ConnectionEnd::HungUp(None)))
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn frame_without_room_arrives_whole_when_the_peer_reads() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            // Given: a peer that does not read, and more data than its socket holds.
            let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
            ours.set_nonblocking(true).expect("it is ours");
            let ours = UnixStream::from_std(ours).expect("it is a socket");
            let whole: Vec<u8> = (0..2_000_000_u32).map(|index| (index % 251) as u8).collect();
            let mut rest = BytesMut::from(&whole[..]);
            ours.writable().await.expect("it takes something");
            assert!(write_some(&ours, &mut rest).is_ok());
            assert!(!rest.is_empty() && rest.len() < whole.len(), "{} bytes are left", rest.len());
            // When: it reads.
            let reading = std::thread::spawn(move || {
                let mut read = Vec::new();
                theirs.read_to_end(&mut read).map(|_| read)
            });
            assert!(write_soon(&ours, rest).await.is_ok());
            drop(ours);
            // Then:
            assert!(reading.join().expect("no panic").expect("it reads") == whole);
        });
    }
}
