//! Messages that arrive faster than one write for each could send them.

use std::thread;

use super::*;
use crate::Window;

/// Counts the writes to a wire.
struct Counting {
    wire: Arc<Wire>,
    writes: Arc<AtomicUsize>,
}

impl Socket for Counting {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        self.writes.fetch_add(1, Ordering::Relaxed);
        self.wire.try_write_vectored(parts)
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.wire.poll_writable(cx)
    }
}

struct Burst {
    outlet: Arc<SocketWriter<Gathering<Counting>>>,
    wire: Arc<Wire>,
    writes: Arc<AtomicUsize>,
    link: LinkNumber,
}

impl Burst {
    fn new(room: usize) -> Self {
        let limits = OutletLimits { queue_capacity: 200, ..LIMITS };
        let (outlet, wire, writes) =
            (Arc::new(SocketWriter::new(limits)), Arc::new(Wire::default()), Arc::default());
        wire.room.store(room, Ordering::Relaxed);
        let socket = Counting { wire: Arc::clone(&wire), writes: Arc::clone(&writes) };
        let link = outlet.connect(Gathering::new(socket, Checksum::Crc), usize::MAX, None);
        Self { outlet, wire, writes, link }
    }

    /// Submits all at the same moment, before the clock that reports the end of a write.
    fn submit(&self, values: std::ops::Range<u8>) {
        for value in values {
            let mut message = message(Class::Bulk, value);
            message.header.sent = Time::from_nanos(1_000_000);
            self.outlet.submit(message).unwrap();
        }
    }

    fn drain(&self) {
        assert!((0..16).find_map(|_| self.outlet.drain(self.link).now_or_never()).is_none());
    }

    /// Expires until this number of frames is there, from any writer.
    async fn await_frames(&self, frames: usize) {
        let await_frames = async {
            while self.seen().len() < frames {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(60), await_frames).await.expect("all frames within 60 s");
    }

    fn seen(&self) -> Vec<u8> {
        frames(&self.wire.bytes.lock().unwrap()).iter().map(|message| message.payload[0]).collect()
    }

    fn writes(&self) -> usize {
        self.writes.load(Ordering::Relaxed)
    }
}

#[test]
fn burst_is_batched_after_its_first_messages() {
    let burst = Burst::new(PLENTY);
    burst.submit(0..24);
    assert_eq!((burst.seen(), burst.writes(), burst.outlet.waiting()), (vec![0, 1, 2, 3], 4, 20));
    burst.drain();
    assert_eq!((burst.seen(), burst.writes(), burst.outlet.waiting()), ((0..24).collect(), 5, 0));
    assert_eq!(burst.outlet.counts(), OutletCounts { sent: 24, ..OutletCounts::default() });
}

#[test]
fn expired_message_of_a_burst_is_not_sent() {
    let burst = Burst::new(PLENTY);
    burst.submit(0..8);
    let mut late = message(Class::Bulk, 42);
    (late.header.sent, late.header.time_to_live_us) = (Time::from_nanos(1_000_000), 1);
    burst.outlet.submit(late).unwrap();
    assert_eq!(burst.outlet.waiting(), 5, "it is checked when it is taken out");
    burst.submit(8..12);
    burst.drain();
    assert_eq!(burst.seen(), (0..12).collect::<Vec<u8>>());
    assert_eq!(burst.outlet.counts(), OutletCounts { sent: 12, expired: 1, ..OutletCounts::default() });
}

#[test]
fn expired_value_of_a_burst_supersedes_none() {
    let burst = Burst::new(PLENTY);
    burst.submit(0..8);
    let value = |value, time_to_live_us| {
        let mut message = message(Class::Stream, value);
        (message.header.sent, message.header.time_to_live_us) =
            (Time::from_nanos(1_000_000), time_to_live_us);
        message
    };
    burst.outlet.submit(value(41, 0)).unwrap();
    burst.outlet.submit(value(42, 1)).unwrap();
    burst.drain();
    let OutletCounts { sent, superseded, expired, .. } = burst.outlet.counts();
    assert_eq!((sent, superseded, expired), (9, 0, 1));
    assert!(burst.seen().contains(&41));
}

#[test]
fn bursting_sender_writes_if_drainer_falls_behind() {
    let burst = Burst::new(PLENTY);
    burst.submit(0..132);
    assert_eq!((burst.seen(), burst.writes(), burst.outlet.waiting()), ((0..132).collect(), 5, 0));
}

#[test]
fn partial_writes_keep_frames_whole_and_ordered() {
    for bytes in [1, 7, 50, 81, 82, 83, 1_000] {
        let burst = Burst::new(0);
        burst.submit(0..100);
        for _ in 0..100_000 {
            if burst.outlet.waiting() == 0 {
                break;
            }
            burst.wire.room.store(bytes, Ordering::Relaxed);
            burst.drain();
        }
        assert_eq!(burst.seen(), (0..100).collect::<Vec<u8>>(), "{bytes} at a time");
    }
}

#[test]
fn new_message_follows_gathered_ones() {
    let burst = Burst::new(PLENTY);
    burst.submit(0..20);
    burst.wire.room.store(100, Ordering::Relaxed);
    burst.drain();
    assert!(burst.outlet.waiting() > 0, "the wire has taken a part of what was gathered");
    burst.wire.room.store(PLENTY, Ordering::Relaxed);
    let mut later = message(Class::Control, 42);
    later.header.sent = Time::from_nanos(1_000_000_000);
    burst.outlet.submit(later).unwrap();
    burst.drain();
    assert_eq!(burst.seen(), (0..20).chain([42]).collect::<Vec<u8>>());
}

#[test]
fn end_with_gathered_frames_is_not_at_frame_boundary() {
    let burst = Burst::new(PLENTY);
    burst.submit(0..20);
    burst.wire.room.store(100, Ordering::Relaxed);
    burst.drain();
    assert!(!burst.outlet.disconnect(burst.link));
}

#[cfg(target_os = "linux")]
#[tokio::test(flavor = "current_thread")]
async fn remainder_of_burst_is_sent_by_delayed_wake() {
    let burst = Burst::new(PLENTY);
    let (outlet, link) = (burst.outlet.clone(), burst.link);
    let drainer = tokio::spawn(async move { outlet.drain(link).await });
    // The first burst has the timer made.
    burst.submit(0..20);
    burst.await_frames(20).await;
    thread::scope(|scope| scope.spawn(|| burst.submit(20..40)).join().unwrap());
    let is_asleep = burst.outlet.lock().connection.is_drainer_asleep();
    assert!(is_asleep && burst.outlet.waiting() > 0);
    burst.await_frames(40).await;
    assert_eq!(burst.seen(), (0..40).collect::<Vec<u8>>());
    drainer.abort();
}

#[test]
fn gathered_urgent_message_counts_until_its_last_byte() {
    // Given: the wire accepts nothing, and an urgent message follows a burst.
    let burst = Burst::new(0);
    burst.submit(0..8);
    let mut ping = message(Class::Control, 100);
    ping.header.kind = Kind::GNCL_PING;
    burst.outlet.submit_urgent(ping, usize::MAX).expect("it is the first");
    let has_arrived = || burst.seen().contains(&100);
    // When: the wire accepts a few bytes at a time.
    for _ in 0..1_000 {
        if has_arrived() {
            break;
        }
        // Then
        assert_ne!(burst.outlet.urgent_left(), 0);
        burst.wire.room.store(7, Ordering::Relaxed);
        burst.drain();
    }
    assert!(has_arrived());
    burst.wire.room.store(PLENTY, Ordering::Relaxed);
    burst.drain();
    assert_eq!(burst.outlet.urgent_left(), 0);
}

#[test]
fn acknowledgement_wakes_the_drainer_only_for_a_message() {
    // Given: a window of one message, which is written, and a drain task that waits.
    let window = Window { messages: 1, bytes: PLENTY };
    let void = message(Class::Control, 0).header;
    let outlet = SocketWriter::with_session(LIMITS, Session::new(1, window, void, None));
    let wire = Arc::new(Wire::default());
    wire.room.store(PLENTY, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
    let receive_ack = |next| {
        let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next, change: 0, held: vec![], room: None };
        bench.outlet.on_ack(link, &ack, Time::now());
    };
    let is_asleep = || bench.outlet.lock().connection.is_drainer_asleep();
    bench.drain();
    receive_ack(1);
    assert!(!is_asleep(), "the first one begins the connection");
    bench.drain();
    bench.submit(message(Class::Control, 1));
    // When: nothing waits, then a message waits for the window.
    receive_ack(2);
    assert!(is_asleep(), "there is nothing to write");
    bench.submit(message(Class::Control, 2));
    bench.submit(message(Class::Control, 3));
    assert!(is_asleep(), "there is no room to write");
    receive_ack(2);
    assert!(is_asleep(), "there still is none");
    receive_ack(3);
    // Then
    assert!(!is_asleep());
    bench.drain();
    assert_eq!(bench.seen(), [1, 2, 3]);
}

// spec: SESSION-1, SESSION-3
#[test]
fn gathered_messages_are_numbered_and_sent_again() {
    let window = Window { messages: 64, bytes: PLENTY };
    let void = Header::new(Kind::GNCL_VOID, tid(0), tid(1));
    let limits = OutletLimits { queue_capacity: 200, ..LIMITS };
    let outlet = SocketWriter::with_session(limits, Session::new(1, window, void, None));
    // Connects to a peer that expects this number, and returns the wire.
    let connect = |next| {
        let wire = Arc::new(Wire::default());
        wire.room.store(PLENTY, Ordering::Relaxed);
        let link = outlet.connect(Gathering::new(wire.clone(), Checksum::Crc), usize::MAX, None);
        let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next, change: 0, held: vec![], room: None };
        outlet.on_ack(link, &ack, Time::now());
        (wire, link)
    };
    let drain = |link| assert!((0..16).find_map(|_| outlet.drain(link).now_or_never()).is_none());
    let seen = |wire: &Wire| {
        let frames = frames(&wire.bytes.lock().unwrap());
        frames.iter().map(|message| (message.header.number, message.payload[0])).collect::<Vec<_>>()
    };
    let expected =
        |values: std::ops::Range<u8>| values.map(|value| (u16::from(value) + 1, value)).collect::<Vec<_>>();
    // Given: a burst, of which some messages are written one by one and the others together
    let (wire, link) = connect(1);
    for value in 0..40 {
        let mut message = message(Class::Bulk, value);
        message.header.sent = Time::from_nanos(1_000_000);
        outlet.submit(message).unwrap();
    }
    drain(link);
    assert_eq!(seen(&wire), expected(0..40));
    // When: ten have arrived, and the connection ends
    outlet.disconnect(link);
    let (wire, link) = connect(11);
    drain(link);
    // Then
    assert_eq!(seen(&wire), expected(10..40));
    assert_eq!(outlet.counts().sent, 40);
}

#[test]
fn full_buffer_is_written_without_a_frame_behind() {
    // Given: many messages of a burst, of which one more than the buffer has room for would be written alone
    let limits = OutletLimits { queue_capacity: 200, queue_bytes: 1 << 20, ..LIMITS };
    let (outlet, wire, writes) = (SocketWriter::new(limits), Arc::new(Wire::default()), Arc::default());
    let socket = Counting { wire: Arc::clone(&wire), writes: Arc::clone(&writes) };
    let link = outlet.connect(Gathering::new(socket, Checksum::Crc), usize::MAX, None);
    for value in 0..180 {
        let header = Header { sent: Time::from_nanos(1_000_000), ..message(Class::Bulk, value).header };
        outlet.submit(Message::new(header, vec![value; 1_000].into())).unwrap();
    }
    // When: the wire accepts everything
    wire.room.store(PLENTY, Ordering::Relaxed);
    let before = writes.load(Ordering::Relaxed);
    assert!((0..16).find_map(|_| outlet.drain(link).now_or_never()).is_none());
    // Then: 180 frames of 1064 bytes are four writes
    let frames = frames(&wire.bytes.lock().unwrap());
    assert_eq!(frames.len(), 180);
    assert_eq!(writes.load(Ordering::Relaxed) - before, 4);
}
