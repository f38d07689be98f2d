//! Messages that come faster than a write each would carry them.

use std::thread;

use super::*;

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

struct Flood {
    outlet: Arc<StreamOutlet<Gathering<Counting>>>,
    wire: Arc<Wire>,
    writes: Arc<AtomicUsize>,
    link: LinkNumber,
}

impl Flood {
    fn new(room: usize) -> Self {
        let limits = OutletLimits { queue_capacity: 200, ..LIMITS };
        let (outlet, wire, writes) =
            (Arc::new(StreamOutlet::new(limits)), Arc::new(Wire::default()), Arc::default());
        wire.room.store(room, Ordering::Relaxed);
        let socket = Counting { wire: Arc::clone(&wire), writes: Arc::clone(&writes) };
        let link = outlet.connect(Gathering::new(socket, Checksum::Crc), usize::MAX, None);
        Self { outlet, wire, writes, link }
    }

    /// All in the same moment, before the clock that tells when a write has ended.
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

    /// Waits until so many frames are there, whoever writes them.
    async fn come(&self, frames: usize) {
        let come = async {
            while self.seen().len() < frames {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(60), come).await.expect("all frames within 60 s");
    }

    fn seen(&self) -> Vec<u8> {
        frames(&self.wire.bytes.lock().unwrap()).iter().map(|message| message.payload[0]).collect()
    }

    fn writes(&self) -> usize {
        self.writes.load(Ordering::Relaxed)
    }
}

#[test]
fn the_first_messages_of_a_flood_are_written_at_once_and_the_others_together() {
    let flood = Flood::new(PLENTY);
    flood.submit(0..24);
    assert_eq!((flood.seen(), flood.writes(), flood.outlet.waiting()), (vec![0, 1, 2, 3], 4, 20));
    flood.drain();
    assert_eq!((flood.seen(), flood.writes(), flood.outlet.waiting()), ((0..24).collect(), 5, 0));
    assert_eq!(flood.outlet.counts(), OutletCounts { sent: 24, ..OutletCounts::default() });
}

#[test]
fn who_floods_writes_himself_when_the_drainer_does_not_keep_up() {
    let flood = Flood::new(PLENTY);
    flood.submit(0..132);
    assert_eq!((flood.seen(), flood.writes(), flood.outlet.waiting()), ((0..132).collect(), 5, 0));
}

#[test]
fn a_wire_that_takes_a_few_bytes_at_a_time_gets_every_frame_whole_and_in_order() {
    for bytes in [1, 7, 50, 81, 82, 83, 1_000] {
        let flood = Flood::new(0);
        flood.submit(0..100);
        for _ in 0..100_000 {
            if flood.outlet.waiting() == 0 {
                break;
            }
            flood.wire.room.store(bytes, Ordering::Relaxed);
            flood.drain();
        }
        assert_eq!(flood.seen(), (0..100).collect::<Vec<u8>>(), "{bytes} at a time");
    }
}

#[test]
fn a_message_that_comes_while_gathered_ones_wait_goes_behind_them() {
    let flood = Flood::new(PLENTY);
    flood.submit(0..20);
    flood.wire.room.store(100, Ordering::Relaxed);
    flood.drain();
    assert!(flood.outlet.waiting() > 0, "the wire has taken a part of what was gathered");
    flood.wire.room.store(PLENTY, Ordering::Relaxed);
    let mut later = message(Class::Control, 42);
    later.header.sent = Time::from_nanos(1_000_000_000);
    flood.outlet.submit(later).unwrap();
    flood.drain();
    assert_eq!(flood.seen(), (0..20).chain([42]).collect::<Vec<u8>>());
}

#[test]
fn a_connection_that_ends_with_gathered_frames_has_not_ended_behind_a_whole_one() {
    let flood = Flood::new(PLENTY);
    flood.submit(0..20);
    flood.wire.room.store(100, Ordering::Relaxed);
    flood.drain();
    assert!(!flood.outlet.disconnect(flood.link));
}

#[cfg(target_os = "linux")]
#[tokio::test(flavor = "current_thread")]
async fn what_the_end_of_another_threads_flood_leaves_goes_out_in_a_moment_and_nobody_is_woken_at_once() {
    let flood = Flood::new(PLENTY);
    let (outlet, link) = (flood.outlet.clone(), flood.link);
    let drainer = tokio::spawn(async move { outlet.drain(link).await });
    // The first flood has the timer made.
    flood.submit(0..20);
    flood.come(20).await;
    thread::scope(|scope| scope.spawn(|| flood.submit(20..40)).join().unwrap());
    let is_asleep = flood.outlet.lock().drainer.is_some();
    assert!(is_asleep && flood.outlet.waiting() > 0);
    flood.come(40).await;
    assert_eq!(flood.seen(), (0..40).collect::<Vec<u8>>());
    drainer.abort();
}

#[test]
fn what_is_urgent_is_left_until_its_last_byte_is_taken_also_where_it_is_gathered_with_others() {
    // Given: the wire takes nothing, and an urgent word comes behind a flood.
    let flood = Flood::new(0);
    flood.submit(0..8);
    let mut word = message(Class::Control, 100);
    word.header.kind = Kind::GNCL_PING;
    flood.outlet.submit_urgent(word, usize::MAX).expect("it is the first");
    let has_come = || flood.seen().contains(&100);
    // When: the wire takes a few bytes at a time.
    for _ in 0..1_000 {
        if has_come() {
            break;
        }
        // Then
        assert_ne!(flood.outlet.urgent_left(), 0);
        flood.wire.room.store(7, Ordering::Relaxed);
        flood.drain();
    }
    assert!(has_come());
    flood.wire.room.store(PLENTY, Ordering::Relaxed);
    flood.drain();
    assert_eq!(flood.outlet.urgent_left(), 0);
}
