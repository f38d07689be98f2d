//! An outlet on a wire that accepts as many bytes as the test allows, and on real sockets.

use std::{
    io::IoSlice,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    task::{Context, Poll, Waker},
    time::Duration,
};

use bytes::{Bytes, BytesMut};
use futures_util::FutureExt;
use sinew_runtime::{
    mailbox::About,
    outcome::{Receipt, ReceiptSink},
    router::MessageSink,
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Checksum, Class, Flags, FrameCodec, Header, Kind},
};
use tokio::net::UnixStream;
use tokio_util::codec::Decoder;

use super::*;

mod accounts;
mod audits;
mod blocked_write;
mod bursts;
mod connections;
mod epochs;
mod holding;
mod many_held;
mod outcomes;
mod read_progress;
mod requests;
mod room;
mod shares;

/// A wire that accepts `room` more bytes and keeps them.
#[derive(Default)]
struct Wire {
    room: AtomicUsize,
    bytes: Mutex<Vec<u8>>,
    fails: std::sync::atomic::AtomicBool,
}

impl Socket for Arc<Wire> {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        if self.fails.load(Ordering::Relaxed) {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        let all: Vec<u8> = parts.iter().flat_map(|part| part.to_vec()).collect();
        let taken = all.len().min(self.room.load(Ordering::Relaxed));
        if taken == 0 {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        self.room.fetch_sub(taken, Ordering::Relaxed);
        self.bytes.lock().unwrap().extend_from_slice(&all[..taken]);
        Ok(taken)
    }

    fn poll_writable(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.room.load(Ordering::Relaxed) > 0 { Poll::Ready(Ok(())) } else { Poll::Pending }
    }
}

#[derive(Default)]
struct OutcomeLog(Mutex<Vec<(u64, Outcome)>>);

impl ReceiptSink for OutcomeLog {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.0.lock().unwrap().push((ticket.correlation, outcome));
    }
}

impl OutcomeLog {
    fn take(&self) -> Vec<(u64, Outcome)> {
        std::mem::take(&mut self.0.lock().unwrap())
    }
}

struct Bench {
    outlet: SocketWriter<Arc<Wire>>,
    wire: Arc<Wire>,
    link: LinkNumber,
    outcome_log: Arc<OutcomeLog>,
}

const LIMITS: OutletLimits =
    OutletLimits { queue_capacity: 4, queue_bytes: 4_000, unconfirmed_max: 4, payload_max: 1_000 };
const PLENTY: usize = 1 << 30;

impl Bench {
    /// An outlet with a wire that has `room` bytes.
    fn new(room: usize) -> Self {
        let (outlet, wire) = (SocketWriter::new(LIMITS), Arc::new(Wire::default()));
        wire.room.store(room, Ordering::Relaxed);
        let link = outlet.connect(wire.clone(), usize::MAX, None);
        Self { outlet, wire, link, outcome_log: Arc::default() }
    }

    /// The next connection, on a fresh wire with `room` bytes.
    fn reconnect(&mut self, room: usize) {
        self.wire = Arc::default();
        self.wire.room.store(room, Ordering::Relaxed);
        self.link = self.outlet.connect(self.wire.clone(), usize::MAX, None);
        self.drain();
    }

    /// Lets the wire accept `room` bytes more, and runs the drainer.
    fn make_room(&self, room: usize) {
        self.wire.room.store(room, Ordering::Relaxed);
        self.drain();
    }

    /// Lets the drainer run until it waits; returns why it ended, if it did.
    fn drain(&self) -> Option<io::Error> {
        // The drainer yields after a number of frames: often enough for every test here.
        (0..16).find_map(|_| self.outlet.drain(self.link).now_or_never())
    }

    fn submit(&self, message: Message) {
        self.outlet.submit(message).unwrap();
    }

    fn confirmed(&self, correlation: u64) -> Message {
        let mut message = message(Class::Control, correlation as u8);
        message.header.correlation = correlation;
        let (source, destination) = (message.header.source, message.header.destination);
        let ticket = Ticket { source, destination, correlation };
        message.receipt = Some(Receipt::new(self.outcome_log.clone(), ticket));
        message
    }

    /// First payload bytes of the whole frames on the wire.
    fn seen(&self) -> Vec<u8> {
        frames(&self.wire.bytes.lock().unwrap()).iter().map(|message| message.payload[0]).collect()
    }
}

fn frames(bytes: &[u8]) -> Vec<Message> {
    let mut buffer = BytesMut::from(bytes);
    std::iter::from_fn(|| FrameCodec::new(10_000).decode(&mut buffer).unwrap()).collect()
}

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(1), AppAddress::new(0x1000 + app))
}

fn message(class: Class, value: u8) -> Message {
    let mut header = Header::new(Kind::named("test"), tid(0), tid(1));
    header.class = class;
    Message::new(header, Bytes::copy_from_slice(&[value; 10]))
}

fn expiring(class: Class, value: u8) -> Message {
    let mut message = message(class, value);
    message.header.sent = Time::now();
    message.header.time_to_live_us = 60_000_000;
    message
}

#[test]
fn idle_outlet_writes_before_submit_returns() {
    let bench = Bench::new(PLENTY);
    bench.submit(message(Class::Bulk, 7));
    assert_eq!(bench.seen(), [7]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, ..OutletCounts::default() });
}

#[test]
fn audit_answer_is_written_by_the_drainer() {
    let bench = Bench::new(PLENTY);
    let mut answer = message(Class::Bulk, 7);
    answer.header.kind = Kind::SYNC_AUDIT;
    bench.submit(answer);
    assert!(bench.seen().is_empty(), "a nice thread would hold the lock while it writes");
    bench.drain();
    assert_eq!(bench.seen(), [7]);
}

#[test]
fn control_overtakes_stream_and_stream_overtakes_bulk() {
    let bench = Bench::new(0);
    for (class, value) in [(Class::Bulk, 1), (Class::Bulk, 2), (Class::Stream, 3), (Class::Control, 4)] {
        bench.submit(message(class, value));
    }
    bench.submit(message(Class::Control, 5));
    bench.make_room(PLENTY);
    assert_eq!(bench.seen(), [4, 5, 3, 1, 2]);
}

#[test]
fn newer_stream_value_supersedes_per_destination() {
    let bench = Bench::new(0);
    let mut elsewhere = message(Class::Stream, 9);
    elsewhere.header.destination = tid(2);
    bench.submit(message(Class::Stream, 1));
    bench.submit(elsewhere);
    bench.submit(message(Class::Stream, 2));
    bench.make_room(PLENTY);
    let mut seen = bench.seen();
    seen.sort_unstable();
    assert_eq!(seen, [2, 9]);
    assert_eq!(bench.outlet.counts().superseded, 1);
}

#[test]
fn full_class_leaves_room_for_other_classes() {
    let bench = Bench::new(0);
    for value in 0..4 {
        bench.submit(message(Class::Bulk, value));
    }
    let refused = bench.outlet.submit(message(Class::Bulk, 42)).unwrap_err();
    assert_eq!((refused.why, refused.message.payload[0]), (Rejection::QueueFull, 42));
    bench.submit(message(Class::Control, 5));
    assert_eq!(bench.outlet.waiting(), 5);
}

#[test]
fn unconfirmable_or_oversized_message_is_refused() {
    let bench = Bench::new(PLENTY);
    let mut stream = bench.confirmed(1);
    stream.header.class = Class::Stream;
    assert_eq!(bench.outlet.submit(stream).unwrap_err().why, Rejection::Unsupported);
    let long = Message::new(message(Class::Bulk, 0).header, vec![0; 1_001].into());
    assert_eq!(bench.outlet.submit(long).unwrap_err().why, Rejection::TooLong);
    bench.outlet.connect(bench.wire.clone(), 5, None);
    let too_long_for_them = bench.outlet.submit(message(Class::Bulk, 0)).unwrap_err();
    assert_eq!(too_long_for_them.why, Rejection::TooLong, "the peer takes five bytes");
}

#[test]
fn confirmed_messages_are_bounded_and_settled_by_peer() {
    let bench = Bench::new(PLENTY);
    for correlation in 1..=4 {
        bench.submit(bench.confirmed(correlation));
    }
    let fifth = bench.outlet.submit(bench.confirmed(5)).unwrap_err();
    assert_eq!(fifth.why, Rejection::QueueFull);
    drop(fifth);
    bench.outcome_log.take();
    let written = frames(&bench.wire.bytes.lock().unwrap());
    assert!(written.iter().all(|message| message.header.flags.has(Flags::CONFIRM)));

    let ticket = Ticket { source: tid(0), destination: tid(1), correlation: 2 };
    assert!(bench.outlet.confirm(ticket, Outcome::Delivered));
    assert!(!bench.outlet.confirm(ticket, Outcome::Delivered), "it is settled once");
    assert!(
        !bench.outlet.confirm(Ticket { destination: tid(9), correlation: 3, ..ticket }, Outcome::Delivered)
    );
    assert_eq!(bench.outcome_log.take(), [(2, Outcome::Delivered)]);
    assert_eq!(bench.outlet.unconfirmed(), 3);
}

#[test]
fn confirm_flag_without_receipt_is_ignored() {
    let bench = Bench::new(PLENTY);
    let mut message = message(Class::Control, 1);
    message.header.flags = Flags::CONFIRM.with(Flags::ASK);
    bench.submit(message);
    let written = frames(&bench.wire.bytes.lock().unwrap());
    assert_eq!(written[0].header.flags, Flags::ASK);
}

#[test]
fn waiting_message_that_expires_is_not_sent() {
    let mut bench = Bench::new(0);
    bench.outlet.disconnect(bench.link);
    let mut confirmed = bench.confirmed(1);
    confirmed.header.sent = Time::now();
    confirmed.header.time_to_live_us = 60_000_000;
    bench.submit(confirmed);
    bench.submit(expiring(Class::Stream, 2));
    bench.submit(message(Class::Bulk, 3));
    bench.outlet.expire(Time::now());
    assert_eq!(bench.outcome_log.take(), [], "their time is not over");
    bench.outlet.expire(Time::now() + Duration::from_secs(61));
    assert_eq!(bench.outcome_log.take(), [(1, Outcome::Expired)]);
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [3]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, expired: 2, ..OutletCounts::default() });
}

#[test]
fn node_end_event_stays_behind_its_messages() {
    let mut bench = Bench::new(0);
    bench.outlet.disconnect(bench.link);
    let (here, gone) = (NodeAddress::new(1), NodeAddress::new(2));
    let mut last = message(Class::Bulk, 1);
    last.header.source.node = gone;
    let mut end = message(Class::Control, 2);
    end.header.source = Tid::new(here, AppAddress::NDL);
    end.header.destination.node = here;
    About::End(gone).write(&mut end.header);
    bench.submit(last);
    bench.submit(end);
    bench.submit(expiring(Class::Stream, 3));
    bench.outlet.expire(Time::now() + Duration::from_secs(61));
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [1, 2]);
}

#[test]
fn message_expired_before_submit_is_not_sent() {
    let bench = Bench::new(PLENTY);
    let mut late = bench.confirmed(1);
    late.header.time_to_live_us = 1;
    bench.submit(late);
    assert_eq!((bench.seen(), bench.outcome_log.take()), (vec![], vec![(1, Outcome::Expired)]));
}

#[test]
fn each_turn_of_writing_checks_expiry_anew() {
    // Given: a turn has looked at the clock.
    let bench = Bench::new(0);
    bench.submit(expiring(Class::Control, 1));
    bench.make_room(PLENTY);
    assert_eq!(bench.seen(), [1]);
    // When: the time of a message ends while it waits.
    bench.wire.room.store(0, Ordering::Relaxed);
    let mut short = expiring(Class::Control, 2);
    short.header.time_to_live_us = 20_000;
    let expiry = short.header.expiry();
    bench.submit(short);
    while Time::now() <= expiry {
        std::thread::yield_now();
    }
    bench.make_room(PLENTY);
    // Then
    assert_eq!(bench.seen(), [1]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, expired: 1, ..OutletCounts::default() });
}

/// A receiver of an outcome that sends on the same outlet.
struct ReentrantSink(Arc<SocketWriter<Arc<Wire>>>);

impl ReceiptSink for ReentrantSink {
    fn settle(&self, _: Ticket, _: Outcome) {
        self.0.submit(message(Class::Control, 77)).unwrap();
    }
}

#[test]
fn outcome_sink_may_send_at_once() {
    let bench = Bench::new(PLENTY);
    let outlet = Arc::new(bench.outlet);
    let mut confirmed = message(Class::Control, 1);
    let ticket = Ticket { source: tid(0), destination: tid(1), correlation: 0 };
    confirmed.receipt = Some(Receipt::new(Arc::new(ReentrantSink(outlet.clone())), ticket));
    outlet.submit(confirmed).unwrap();
    assert!(outlet.confirm(ticket, Outcome::Delivered));
    assert_eq!(outlet.counts().sent, 2);
}

#[test]
fn concurrent_senders_keep_order_without_loss() {
    const THREADS: u32 = 4;
    const EACH: u64 = 400;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let (ours, theirs) = UnixStream::pair().unwrap();
        socket2::SockRef::from(&ours).set_send_buffer_size(4_096).unwrap();
        let limits = OutletLimits {
            queue_capacity: 2_000,
            queue_bytes: 20_000_000,
            unconfirmed_max: 1,
            payload_max: 10_000,
        };
        let outlet = Arc::new(SocketWriter::new(limits));
        let link = outlet.connect(Arc::new(ours), usize::MAX, None);
        let senders: Vec<_> = (0..THREADS)
            .map(|thread| {
                let outlet = outlet.clone();
                std::thread::spawn(move || {
                    for sequence in 0..EACH {
                        let mut header = Header::new(Kind::named("test"), tid(thread), tid(99));
                        header.sequence = sequence;
                        outlet.submit(Message::new(header, vec![1; 700].into())).unwrap();
                    }
                })
            })
            .collect();
        let mut next = [0; THREADS as usize];
        let reading = async {
            let mut buffer = BytesMut::new();
            while next.iter().sum::<u64>() < u64::from(THREADS) * EACH {
                theirs.readable().await.unwrap();
                match theirs.try_read_buf(&mut buffer) {
                    Ok(read) => assert!(read > 0, "the outlet closed the socket"),
                    Err(error) => assert_eq!(error.kind(), io::ErrorKind::WouldBlock),
                }
                while let Some(message) = FrameCodec::new(10_000).decode(&mut buffer).unwrap() {
                    let sender = (message.header.source.app.bits() - 0x1000) as usize;
                    assert_eq!(message.header.sequence, next[sender]);
                    next[sender] += 1;
                }
            }
        };
        let deadline = tokio::time::timeout(Duration::from_secs(60), reading);
        tokio::select! {
            read = deadline => read.expect("waited for all frames"),
            end = outlet.drain(link) => panic!("the drainer ended: {end}"),
        }
        senders.into_iter().for_each(|sender| sender.join().unwrap());
        assert_eq!(outlet.counts().sent, u64::from(THREADS) * EACH);
    });
}

#[test]
fn queued_message_wakes_waiting_drainer() {
    struct WakeCounter(AtomicUsize);
    impl std::task::Wake for WakeCounter {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    let bench = Bench::new(0);
    let woken = Arc::new(WakeCounter(AtomicUsize::new(0)));
    let waker = Waker::from(woken.clone());
    let mut drainer = Box::pin(bench.outlet.drain(bench.link));
    assert!(drainer.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    bench.submit(message(Class::Bulk, 1));
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
}
