//! What is read of a sealed connection, and what is not.

use std::{net, thread, time::Duration};

use rustls::{ServerConfig, ServerConnection, server::ServerSessionMemoryCache};
use tokio::time::timeout;

use super::*;
use crate::security::tests::ground::{Authority, Wire, heard, written};

/// Nothing takes longer, on a busy machine either.
const PATIENCE: Duration = Duration::from_secs(60);
/// More than comes.
const ROOM: usize = 4_096;

/// Who was dialled over a sealed connection, by hand: what he seals goes out when he is told to send it.
pub(in crate::gncl) struct Dialled {
    tls: ServerConnection,
    socket: net::TcpStream,
}

impl Dialled {
    /// Seals each byte in a record of its own.
    pub(in crate::gncl) fn seal_each(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.tls.writer().write_all(&[*byte]).unwrap());
    }

    fn make_new_keys(&mut self, times: usize) {
        (0..times).for_each(|_| self.tls.refresh_traffic_keys().unwrap());
    }

    /// Sends all that is sealed, in one piece if there is room for it, and hangs up. Who is refused before that is not heard to the end.
    pub(in crate::gncl) fn send(mut self) -> thread::JoinHandle<()> {
        let sealed = written(&mut self.tls);
        thread::spawn(move || drop(self.socket.write_all(&sealed)))
    }
}

/// A sealed connection as who has dialled has it, and the other end, which is as `set` makes it.
pub(in crate::gncl) async fn sealed_pair(set: impl FnOnce(&mut ServerConfig)) -> (Transport, Dialled) {
    let walker = Authority::new("walker");
    let mut config = ServerConfig::clone(&walker.tls("knee", 2).server());
    set(&mut config);
    let Wire { mut client, mut server } = Wire::new(walker.tls("hip", 1).client(), Arc::new(config));
    // What the other end says when it has proven who is there is still to be sent.
    heard(&mut server, &written(&mut client)).unwrap();
    heard(&mut client, &written(&mut server)).unwrap();
    heard(&mut server, &written(&mut client)).unwrap();
    assert!(!client.is_handshaking() && !server.is_handshaking(), "the handshake is over");
    server.set_buffer_limit(None);
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let socket = net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (ours, _) = listener.accept().await.unwrap();
    (Transport::open(ours).sealed(client.into()), Dialled { tls: server, socket })
}

/// Reads until the end, or until so much has come; what that was, and why it ended.
async fn read_all(transport: Transport, most: usize) -> (usize, Option<io::Error>) {
    let mut buffer = BytesMut::new();
    let reading = async {
        while buffer.len() < most {
            match transport.take_in(&mut buffer, ROOM).await {
                Ok(Got { count: 0, .. }) => break,
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
async fn records_of_one_byte_are_opened_as_many_at_once_as_there_is_room_for_and_each_counts_as_more() {
    let (transport, mut peer) = sealed_pair(|_| {}).await;
    peer.seal_each(&[7; 100]);
    let sending = peer.send();
    let mut buffer = BytesMut::new();
    for count in [60, 40] {
        let read = timeout(PATIENCE, transport.take_in(&mut buffer, 60)).await;
        let got = read.expect("it has come").expect("an honest peer");
        assert_eq!(got, Got { count, work: count * RECORD_WORK });
    }
    assert_eq!(buffer[..], [7; 100]);
    sending.join().unwrap();
}

#[tokio::test]
async fn a_long_message_comes_whole_in_whatever_pieces_it_is_read() {
    let (transport, mut peer) = sealed_pair(|_| {}).await;
    let message: Vec<u8> = (0..1_000_000_u32).map(|at| (at % 251) as u8).collect();
    peer.tls.writer().write_all(&message).unwrap();
    let sending = peer.send();
    let mut buffer = BytesMut::new();
    for room in [1, 100, 5_000, 20_000, 70_000].into_iter().cycle() {
        let got = timeout(PATIENCE, transport.take_in(&mut buffer, room)).await;
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
async fn who_sends_tickets_on_and_on_is_refused_in_words() {
    let (transport, peer) = sealed_pair(|config| {
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
async fn who_sends_records_on_and_on_with_next_to_nothing_in_them_is_refused_in_words() {
    // Given: as many new keys in a row as rustls takes, and a byte, again and again
    const TIMES: usize = 100;
    let (transport, mut peer) = sealed_pair(|_| {}).await;
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
async fn new_keys_are_taken_more_often_than_an_honest_peer_makes_them() {
    const TIMES: usize = 1_000;
    let (transport, mut peer) = sealed_pair(|_| {}).await;
    for _ in 0..TIMES {
        peer.make_new_keys(1);
        peer.seal_each(b"abc");
    }
    let sending = peer.send();
    let (read, refused) = read_all(transport, 3 * TIMES).await;
    assert_eq!((read, refused.map(|error| error.to_string())), (3 * TIMES, None));
    sending.join().unwrap();
}
