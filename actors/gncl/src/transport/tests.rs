//! Reads of an encrypted connection, with accepted and refused input.

use std::{net, thread, time::Duration};

use rustls::{ServerConfig, ServerConnection, server::ServerSessionMemoryCache};
use sinew_security::testing::{Authority, Wire, deliver, written};
use tokio::time::timeout;

use super::*;

/// No operation takes longer, even on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
/// More than arrives.
const ROOM: usize = 4_096;

/// The dialled end of an encrypted connection, written by hand: its encrypted bytes are sent on request.
pub(crate) struct Dialled {
    tls: ServerConnection,
    socket: net::TcpStream,
}

impl Dialled {
    /// Seals each byte in a record of its own.
    pub(crate) fn seal_each(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.tls.writer().write_all(&[*byte]).unwrap());
    }

    fn make_new_keys(&mut self, times: usize) {
        (0..times).for_each(|_| self.tls.refresh_traffic_keys().unwrap());
    }

    /// Sends all encrypted bytes, in one piece if there is room for it, and hangs up. If the reader refuses them,
    /// the rest is not read.
    pub(crate) fn send(mut self) -> thread::JoinHandle<()> {
        let encrypted = written(&mut self.tls);
        thread::spawn(move || drop(self.socket.write_all(&encrypted)))
    }
}

/// Returns an encrypted connection at the dialling end, and the other end, as configured by `set`.
pub(crate) async fn encrypted_pair(set: impl FnOnce(&mut ServerConfig)) -> (Transport, Dialled) {
    let walker = Authority::new("walker");
    let mut config = ServerConfig::clone(&walker.tls("knee", 2).server());
    set(&mut config);
    let Wire { mut client, mut server } = Wire::new(walker.tls("hip", 1).client(), Arc::new(config));
    // The remaining bytes of the other end's handshake are still to be sent.
    deliver(&mut server, &written(&mut client)).unwrap();
    deliver(&mut client, &written(&mut server)).unwrap();
    deliver(&mut server, &written(&mut client)).unwrap();
    assert!(!client.is_handshaking() && !server.is_handshaking(), "the handshake is over");
    server.set_buffer_limit(None);
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let socket = net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (ours, _) = listener.accept().await.unwrap();
    (Transport::plain(ours).encrypted(client.into()), Dialled { tls: server, socket })
}

/// Reads until the end, or until this many bytes. Returns their number, and the reason of the end.
async fn read_all(transport: Transport, most: usize) -> (usize, Option<io::Error>) {
    let mut buffer = BytesMut::new();
    let reading = async {
        while buffer.len() < most {
            match transport.receive(&mut buffer, ROOM).await {
                Ok(ReadResult { count: 0, .. }) => break,
                Ok(_) => {}
                Err(error) => return Some(error),
            }
        }
        None
    };
    let error = timeout(PATIENCE, reading).await.expect("it ends");
    (buffer.len(), error)
}

#[tokio::test]
async fn one_byte_records_are_decrypted_in_batches() {
    let (transport, mut peer) = encrypted_pair(|_| {}).await;
    peer.seal_each(&[7; 100]);
    let sending = peer.send();
    let mut buffer = BytesMut::new();
    for count in [60, 40] {
        let read = timeout(PATIENCE, transport.receive(&mut buffer, 60)).await;
        let got = read.expect("it has come").expect("an honest peer");
        assert_eq!(got, ReadResult { count, work: count * RECORD_WORK });
    }
    assert_eq!(buffer[..], [7; 100]);
    sending.join().unwrap();
}

#[tokio::test]
async fn long_message_arrives_whole_in_any_pieces() {
    let (transport, mut peer) = encrypted_pair(|_| {}).await;
    let message: Vec<u8> = (0..1_000_000_u32).map(|at| (at % 251) as u8).collect();
    peer.tls.writer().write_all(&message).unwrap();
    let sending = peer.send();
    let mut buffer = BytesMut::new();
    for room in [1, 100, 5_000, 20_000, 70_000].into_iter().cycle() {
        let got = timeout(PATIENCE, transport.receive(&mut buffer, room)).await;
        let got = got.expect("it has come").expect("an honest peer");
        assert!(got.count <= room, "{got:?} of {room}");
        if got.count == 0 {
            break;
        }
    }
    assert!(buffer[..] == message, "{} bytes came", buffer.len());
    sending.join().unwrap();
}

// spec: GNCL-18
#[tokio::test]
async fn endless_tickets_are_refused_with_a_reason() {
    let (transport, peer) = encrypted_pair(|config| {
        config.session_storage = ServerSessionMemoryCache::new(16);
        config.send_tls13_tickets = 2_000;
    })
    .await;
    let sending = peer.send();
    let (_, refused) = read_all(transport, 1).await;
    let refused = refused.expect("an error");
    assert_eq!(refused.kind(), io::ErrorKind::InvalidData);
    assert!(refused.to_string().contains("tickets"), "{refused}");
    sending.join().unwrap();
}

// spec: GNCL-18
#[tokio::test]
async fn endless_tiny_records_are_refused_with_a_reason() {
    // Given: the maximum number of new keys in a row that rustls accepts, and a byte, repeatedly
    const TIMES: usize = 100;
    let (transport, mut peer) = encrypted_pair(|_| {}).await;
    for _ in 0..TIMES {
        peer.make_new_keys(30);
        peer.seal_each(b"x");
    }
    // When
    let sending = peer.send();
    let (read, refused) = read_all(transport, TIMES).await;
    // Then
    let refused = refused.unwrap_or_else(|| panic!("{read} bytes came of {TIMES}"));
    assert_eq!(refused.kind(), io::ErrorKind::InvalidData);
    assert!(refused.to_string().contains("nothing for this node"), "{refused}");
    sending.join().unwrap();
}

#[tokio::test]
async fn honest_peers_rate_of_new_keys_is_accepted() {
    const TIMES: usize = 1_000;
    let (transport, mut peer) = encrypted_pair(|_| {}).await;
    for _ in 0..TIMES {
        peer.make_new_keys(1);
        peer.seal_each(b"abc");
    }
    let sending = peer.send();
    let (read, refused) = read_all(transport, 3 * TIMES).await;
    assert_eq!((read, refused.map(|error| error.to_string())), (3 * TIMES, None));
    sending.join().unwrap();
}
