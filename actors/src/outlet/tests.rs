//! An outlet on a wire that takes as many bytes as the test says, and on real sockets.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    task::Waker,
    time::Duration,
};

use bytes::{Bytes, BytesMut};
use futures_util::FutureExt;
use sinew_runtime::{
    mailbox::About,
    outcome::{Receipt, ReceiptSink},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Flags, FrameCodec, Header, Kind},
};
use tokio_util::codec::Decoder;

use super::*;

mod accounts;
mod anew;
mod audits;
mod beside;
mod floods;
mod holding;
mod many_held;
mod outcomes;
mod requests;
mod room;
mod shares;
mod taking;

/// A wire that takes `room` more bytes and keeps them.
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
struct Ledger(Mutex<Vec<(u64, Outcome)>>);

impl ReceiptSink for Ledger {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.0.lock().unwrap().push((ticket.correlation, outcome));
    }
}

impl Ledger {
    fn take(&self) -> Vec<(u64, Outcome)> {
        std::mem::take(&mut self.0.lock().unwrap())
    }
}

struct Bench {
    outlet: StreamOutlet<Arc<Wire>>,
    wire: Arc<Wire>,
    link: LinkNumber,
    ledger: Arc<Ledger>,
}

const LIMITS: OutletLimits =
    OutletLimits { queue_capacity: 4, queue_bytes: 4_000, unconfirmed_max: 4, payload_max: 1_000 };
const PLENTY: usize = 1 << 30;

impl Bench {
    /// An outlet whose wire takes `room` bytes.
    fn new(room: usize) -> Self {
        let (outlet, wire) = (StreamOutlet::new(LIMITS), Arc::new(Wire::default()));
        wire.room.store(room, Ordering::Relaxed);
        let link = outlet.connect(wire.clone(), usize::MAX, None);
        Self { outlet, wire, link, ledger: Arc::default() }
    }

    /// The next connection, on a fresh wire that takes `room` bytes.
    fn reconnect(&mut self, room: usize) {
        self.wire = Arc::default();
        self.wire.room.store(room, Ordering::Relaxed);
        self.link = self.outlet.connect(self.wire.clone(), usize::MAX, None);
        self.drain();
    }

    /// Lets the wire take `room` bytes more, and the drainer run.
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
        message.receipt = Some(Receipt::new(self.ledger.clone(), ticket));
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
fn a_message_is_on_the_wire_before_submit_returns_when_nothing_waits() {
    let bench = Bench::new(PLENTY);
    bench.submit(message(Class::Bulk, 7));
    assert_eq!(bench.seen(), [7]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, ..OutletCounts::default() });
}

#[test]
fn who_answers_an_audit_leaves_the_writing_to_the_drainer() {
    let bench = Bench::new(PLENTY);
    let mut answer = message(Class::Bulk, 7);
    answer.header.kind = Kind::SYNC_AUDIT;
    bench.submit(answer);
    assert!(bench.seen().is_empty(), "a nice thread would hold the lock while it writes");
    bench.drain();
    assert_eq!(bench.seen(), [7]);
}

#[test]
fn control_overtakes_waiting_stream_and_both_overtake_waiting_bulk() {
    let bench = Bench::new(0);
    for (class, value) in [(Class::Bulk, 1), (Class::Bulk, 2), (Class::Stream, 3), (Class::Control, 4)] {
        bench.submit(message(class, value));
    }
    bench.submit(message(Class::Control, 5));
    bench.make_room(PLENTY);
    assert_eq!(bench.seen(), [4, 5, 3, 1, 2]);
}

#[test]
fn a_waiting_stream_value_is_superseded_by_a_newer_one_for_the_same_destination_only() {
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
fn a_full_class_hands_the_message_back_and_leaves_the_other_classes_room() {
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
fn what_cannot_be_confirmed_or_carried_is_refused() {
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
fn confirmed_messages_are_marked_bounded_and_settled_by_the_peers_word() {
    let bench = Bench::new(PLENTY);
    for correlation in 1..=4 {
        bench.submit(bench.confirmed(correlation));
    }
    let fifth = bench.outlet.submit(bench.confirmed(5)).unwrap_err();
    assert_eq!(fifth.why, Rejection::QueueFull);
    drop(fifth);
    bench.ledger.take();
    let written = frames(&bench.wire.bytes.lock().unwrap());
    assert!(written.iter().all(|message| message.header.flags.has(Flags::CONFIRM)));

    let ticket = Ticket { source: tid(0), destination: tid(1), correlation: 2 };
    assert!(bench.outlet.confirm(ticket, Outcome::Delivered));
    assert!(!bench.outlet.confirm(ticket, Outcome::Delivered), "it is settled once");
    assert!(
        !bench.outlet.confirm(Ticket { destination: tid(9), correlation: 3, ..ticket }, Outcome::Delivered)
    );
    assert_eq!(bench.ledger.take(), [(2, Outcome::Delivered)]);
    assert_eq!(bench.outlet.unconfirmed(), 3);
}

#[test]
fn a_flag_without_a_receipt_asks_for_nothing() {
    let bench = Bench::new(PLENTY);
    let mut message = message(Class::Control, 1);
    message.header.flags = Flags::CONFIRM.with(Flags::ASK);
    bench.submit(message);
    let written = frames(&bench.wire.bytes.lock().unwrap());
    assert_eq!(written[0].header.flags, Flags::ASK);
}

#[test]
fn at_the_end_of_a_connection_sent_is_unknown_and_unsent_goes_out_on_the_next_in_order() {
    let mut bench = Bench::new(74 + 30);
    for correlation in 1..=4 {
        bench.submit(bench.confirmed(correlation));
    }
    assert!(!bench.outlet.disconnect(bench.link), "the second frame was cut");
    assert_eq!(bench.ledger.take(), [(1, Outcome::Unknown)]);
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [2, 3, 4], "the frame that was cut goes first, whole");
    assert_eq!(bench.outlet.unconfirmed(), 3);
}

#[test]
fn a_stream_value_that_was_cut_gives_way_to_a_newer_one_that_waits() {
    let mut bench = Bench::new(30);
    bench.submit(message(Class::Stream, 1));
    bench.submit(message(Class::Stream, 2));
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [2]);
    assert_eq!(bench.outlet.counts().superseded, 1);
}

#[test]
fn a_preface_is_the_first_frame_of_its_connection_and_of_no_other() {
    let mut bench = Bench::new(0);
    bench.submit(message(Class::Control, 1));
    let preface = |value| Some(message(Class::Control, value));
    bench.wire.room.store(10, Ordering::Relaxed);
    bench.link = bench.outlet.connect(bench.wire.clone(), usize::MAX, preface(100));
    bench.drain();
    bench.wire = Arc::default();
    bench.wire.room.store(PLENTY, Ordering::Relaxed);
    bench.link = bench.outlet.connect(bench.wire.clone(), usize::MAX, preface(200));
    bench.drain();
    assert_eq!(bench.seen(), [200, 1]);
}

#[test]
fn the_last_frame_goes_behind_all_that_waits_and_nothing_is_taken_after_it() {
    let bench = Bench::new(0);
    for (class, value) in [(Class::Bulk, 3), (Class::Control, 1), (Class::Stream, 2)] {
        bench.submit(message(class, value));
    }
    bench.outlet.finish(message(Class::Control, 100));
    assert_eq!(bench.outlet.submit(message(Class::Control, 4)).unwrap_err().why, Rejection::Closed);
    bench.make_room(PLENTY);
    assert_eq!(bench.seen(), [1, 2, 3, 100]);
    let idle = Bench::new(PLENTY);
    idle.outlet.finish(message(Class::Control, 100));
    assert_eq!(idle.seen(), [100], "at once, if nothing waits");
}

#[test]
fn the_last_frame_is_said_again_where_its_connection_has_ended() {
    let mut bench = Bench::new(PLENTY);
    bench.outlet.finish(message(Class::Control, 100));
    assert_eq!(bench.seen(), [100]);
    bench.wire = Arc::default();
    bench.wire.room.store(PLENTY, Ordering::Relaxed);
    bench.link = bench.outlet.connect(bench.wire.clone(), usize::MAX, None);
    bench.drain();
    assert_eq!(bench.seen(), [100]);
    bench.drain();
    assert_eq!(bench.seen(), [100], "and once on each");
}

#[test]
fn a_closed_outlet_says_that_what_waited_was_not_handled_and_refuses_the_rest() {
    let bench = Bench::new(74 + 30);
    for correlation in 1..=3 {
        bench.submit(bench.confirmed(correlation));
    }
    bench.submit(message(Class::Stream, 4));
    bench.outlet.close(Rejection::NoSuchNode);
    let mut settled = bench.ledger.take();
    settled.sort_by_key(|(correlation, _)| *correlation);
    assert_eq!(settled, [(1, Outcome::Unknown), (2, Outcome::PeerLost), (3, Outcome::PeerLost)]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, lost: 3, ..OutletCounts::default() });
    assert_eq!(bench.outlet.submit(message(Class::Bulk, 1)).unwrap_err().why, Rejection::NoSuchNode);
    assert!(bench.drain().is_some(), "there is nothing to drain any more");
}

#[test]
fn what_expires_while_it_waits_says_so_and_is_not_sent() {
    let mut bench = Bench::new(0);
    bench.outlet.disconnect(bench.link);
    let mut confirmed = bench.confirmed(1);
    confirmed.header.sent = Time::now();
    confirmed.header.time_to_live_us = 60_000_000;
    bench.submit(confirmed);
    bench.submit(expiring(Class::Stream, 2));
    bench.submit(message(Class::Bulk, 3));
    bench.outlet.expire(Time::now());
    assert_eq!(bench.ledger.take(), [], "their time is not over");
    bench.outlet.expire(Time::now() + Duration::from_secs(61));
    assert_eq!(bench.ledger.take(), [(1, Outcome::Expired)]);
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [3]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, expired: 2, ..OutletCounts::default() });
}

#[test]
fn what_is_said_of_a_nodes_end_stays_behind_its_messages_when_something_else_expires() {
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
fn what_has_expired_before_it_is_submitted_is_not_sent() {
    let bench = Bench::new(PLENTY);
    let mut late = bench.confirmed(1);
    late.header.time_to_live_us = 1;
    bench.submit(late);
    assert_eq!((bench.seen(), bench.ledger.take()), (vec![], vec![(1, Outcome::Expired)]));
}

#[test]
fn a_write_that_fails_ends_the_connection_and_loses_nothing() {
    let mut bench = Bench::new(PLENTY);
    bench.wire.fails.store(true, Ordering::Relaxed);
    bench.submit(bench.confirmed(1));
    assert_eq!(bench.drain().map(|error| error.kind()), Some(io::ErrorKind::BrokenPipe));
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    assert_eq!((bench.seen(), bench.ledger.take()), (vec![1], vec![]));
}

#[test]
fn a_drainer_of_a_former_connection_ends() {
    let mut bench = Bench::new(PLENTY);
    let former = bench.link;
    bench.reconnect(PLENTY);
    assert!(bench.outlet.drain(former).now_or_never().is_some());
    assert!(bench.outlet.drain(bench.link).now_or_never().is_none());
}

/// Whoever is told of an outcome may send on the same outlet.
struct Chatter(Arc<StreamOutlet<Arc<Wire>>>);

impl ReceiptSink for Chatter {
    fn settle(&self, _: Ticket, _: Outcome) {
        self.0.submit(message(Class::Control, 77)).unwrap();
    }
}

#[test]
fn who_learns_of_an_outcome_may_send_at_once() {
    let bench = Bench::new(PLENTY);
    let outlet = Arc::new(bench.outlet);
    let mut confirmed = message(Class::Control, 1);
    let ticket = Ticket { source: tid(0), destination: tid(1), correlation: 0 };
    confirmed.receipt = Some(Receipt::new(Arc::new(Chatter(outlet.clone())), ticket));
    outlet.submit(confirmed).unwrap();
    assert!(outlet.confirm(ticket, Outcome::Delivered));
    assert_eq!(outlet.counts().sent, 2);
}

#[test]
fn threads_that_send_at_once_through_a_narrow_socket_keep_their_order_and_lose_nothing() {
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
        let outlet = Arc::new(StreamOutlet::new(limits));
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
fn a_waiting_drainer_is_woken_by_the_message_that_has_to_wait() {
    struct Flag(AtomicUsize);
    impl std::task::Wake for Flag {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    let bench = Bench::new(0);
    let woken = Arc::new(Flag(AtomicUsize::new(0)));
    let waker = Waker::from(woken.clone());
    let mut drainer = Box::pin(bench.outlet.drain(bench.link));
    assert!(drainer.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    bench.submit(message(Class::Bulk, 1));
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
}
