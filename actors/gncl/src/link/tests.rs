//! Fairness while one connection has much to read, and the source address of a dial.

use std::{net::SocketAddr, pin::pin};

use futures_util::poll;

use super::*;
use crate::transport::tests::encrypted_pair;

fn reading(mode: Mode) -> ReaderConfig {
    ReaderConfig {
        mode: Arc::new(Mutex::new(mode)),
        last_received: LastReceived::default(),
        payload_max: HANDSHAKE_PAYLOAD_MAX,
        give_up: Duration::from_secs(5),
        authenticator: None,
    }
}

#[tokio::test]
async fn other_tasks_run_between_few_records_of_any_size() {
    // Given: as many records of one byte as frames in two turns
    let (transport, mut peer) = encrypted_pair(|_| {}).await;
    peer.seal_each(&[0; 2 * FRAMES_PER_WAKE]);
    let sending = peer.send();
    let mut reader = Reader::new(transport, reading(Mode::Handshake));
    let next = NextRead { length: HANDSHAKE_PAYLOAD_MAX, is_refused: false };
    reader.fill(next).await.unwrap();
    assert_eq!(reader.buffer.len(), 2 * FRAMES_PER_WAKE);
    assert!(reader.turn >= BYTES_PER_TURN, "a turn of {}", reader.turn);
    // When: the reader continues
    let is_pending = poll!(pin!(reader.fill(next))).is_pending();
    // Then: others have their turn first
    assert!(is_pending);
    assert_eq!(reader.turn, 0);
    sending.join().unwrap();
}

#[tokio::test]
async fn refused_flood_is_read_with_growing_pauses() {
    const POURED: usize = 10 * BYTES_PER_TURN;
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut stranger = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
    let (socket, _) = listener.accept().await.unwrap();
    let mut reader = Reader::new(Transport::plain(socket), reading(Mode::Discard));
    let began = tokio::time::Instant::now();
    let pouring = async {
        tokio::io::AsyncWriteExt::write_all(&mut stranger, &vec![7; POURED]).await.unwrap();
        drop(stranger);
    };
    let (end, ()) = tokio::join!(reader.next(), pouring);
    assert!(end.is_none() && reader.buffer.is_empty());
    // A slow machine makes it longer, and never shorter.
    let pauses = 0..POURED / BYTES_PER_TURN - 1;
    let least: Duration = pauses.map(|pause| (REFUSED_PAUSE * (1 << pause)).min(REFUSED_PAUSE_MAX)).sum();
    assert!(began.elapsed() >= least, "{POURED} bytes within {:?}", began.elapsed());
}

#[test]
fn dial_uses_the_announced_address_of_the_same_network() {
    let paths = ["10.0.0.1:7", "[fe80::1%3]:7", "[fd00::1]:7", "[2001:db8:0:1::1]:7"];
    let paths: Vec<SocketAddr> = paths.iter().map(|path| path.parse().unwrap()).collect();
    let from = |to: &str| DialAddresses::select(to.parse().unwrap(), &paths).from.map(|ip| ip.to_string());
    assert_eq!(from("[fd00::2]:9").as_deref(), Some("fd00::1"));
    assert_eq!(from("[2001:db8:0:1::2]:9").as_deref(), Some("2001:db8:0:1::1"));
    for elsewhere in ["[2001:db8:0:2::2]:9", "[fe80::2%3]:9", "10.0.0.2:9", "[::1]:9"] {
        assert_eq!(from(elsewhere), None, "{elsewhere}");
    }
}
