//! One thread that waits for several consumers, over real sealed memory.
#![cfg(target_os = "linux")]

use std::{
    os::{fd::AsFd, unix::net::UnixStream},
    thread,
    time::{Duration, Instant},
};

use sinew_shm::{
    Any, AnyError, Bell, BellKind, Capacity, CommonBell, Consumer, ENDS_MAX, Ends, HangUp, Producer, Region,
    Spin, Terms, Waiter,
};

/// Longer than any test takes.
const WATCHDOG: Duration = Duration::from_secs(20);

struct Side {
    consumer: Consumer,
    socket: UnixStream,
}

struct Sides(Vec<Side>);

impl Ends for Sides {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn consumer(&self, index: usize) -> &Consumer {
        &self.0[index].consumer
    }

    fn consumer_mut(&mut self, index: usize) -> &mut Consumer {
        &mut self.0[index].consumer
    }

    fn hang_up(&self, index: usize) -> Option<HangUp<'_>> {
        Some(HangUp::Socket(self.0[index].socket.as_fd()))
    }
}

/// The other end of a side; dropping it ends the peer.
struct Peer {
    producer: Producer,
    _socket: UnixStream,
    _rest: (Consumer, Producer),
}

fn pair(bell: impl Into<Bell>) -> (Side, Peer) {
    let (left, left_offer) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
    let (right, right_offer) = Region::create(Capacity::MIN, bell).expect("a region");
    let (producer, left_consumer) = left.connect(right_offer, &Terms::default()).expect("an honest offer");
    let (right_producer, consumer) = right.connect(left_offer, &Terms::default()).expect("an honest offer");
    let (socket, theirs) = UnixStream::pair().expect("sockets");
    (Side { consumer, socket }, Peer { producer, _socket: theirs, _rest: (left_consumer, right_producer) })
}

fn sides(count: usize) -> (Sides, Vec<Peer>) {
    let (sides, peers) = (0..count).map(|_| pair(BellKind::Futex)).unzip();
    (Sides(sides), peers)
}

/// The same, with one bell that all peers ring.
fn sides_with_one_bell(count: usize) -> (Sides, Vec<Peer>) {
    let bell = CommonBell::create().expect("a page");
    let (sides, peers) = (0..count).map(|_| pair(Bell::Common(bell.clone()))).unzip();
    (Sides(sides), peers)
}

fn in_time() -> Instant {
    Instant::now() + WATCHDOG
}

#[test]
fn each_message_of_each_peer_wakes_the_sleeper() {
    let looks = Spin::Adaptive { max: Duration::from_micros(50) };
    for (make, count, spin) in [
        (sides as fn(usize) -> (Sides, Vec<Peer>), 1, Spin::Off),
        (sides, 3, Spin::Off),
        (sides, 3, looks),
        (sides_with_one_bell, 1, Spin::Off),
        (sides_with_one_bell, 70, Spin::Off),
        (sides_with_one_bell, 3, looks),
    ] {
        // given
        let (mut ends, mut peers) = make(count);
        let (tell, told) = std::sync::mpsc::sync_channel::<usize>(1);
        let sending = thread::spawn(move || {
            while let Ok(index) = told.recv() {
                peers[index].producer.send(&[index as u8]).expect("room");
            }
            peers
        });
        let mut waiter = Waiter::new(spin);
        for number in 0..2_000 {
            // when
            let index = number * 7 % count;
            tell.send(index).expect("the sender lives");
            // then
            let woken = waiter.wait(&mut ends, in_time()).expect("honest peers");
            assert_eq!(woken, Any::Message(index));
            let lent = ends.consumer_mut(index).receive().expect("honest").expect("it is ready");
            assert_eq!(lent.to_vec(), [index as u8]);
        }
        drop(tell);
        sending.join().expect("no panic");
    }
}

#[test]
fn end_of_a_peer_is_reported_after_its_messages() {
    // given: the second of three sends a message and leaves
    let (mut ends, mut peers) = sides(3);
    let mut second = peers.remove(1);
    second.producer.send(b"last words").expect("room");
    drop(second);
    let mut waiter = Waiter::new(Spin::Off);
    // then
    assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest"), Any::Message(1));
    drop(ends.consumer_mut(1).receive());
    assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest"), Any::HungUp(1));
}

#[test]
fn ring_without_message_reveals_the_end_at_once() {
    let (mut ends, mut peers) = sides(2);
    let gone = peers.remove(0);
    let waiting =
        thread::spawn(move || (Waiter::new(Spin::Off).wait(&mut ends, in_time()).expect("honest"), ends));
    gone._socket.shutdown(std::net::Shutdown::Both).expect("it is open");
    gone.producer.ring();
    assert_eq!(waiting.join().expect("no panic").0, Any::HungUp(0));
}

#[test]
fn wait_times_out_and_past_deadline_only_checks() {
    let (mut ends, mut peers) = sides(2);
    let mut waiter = Waiter::new(Spin::For(Duration::from_micros(10)));
    let started = Instant::now();
    let ended = waiter.wait(&mut ends, started + Duration::from_millis(30)).expect("honest");
    assert_eq!((ended, started.elapsed() >= Duration::from_millis(30)), (Any::TimedOut, true));
    assert_eq!(waiter.wait(&mut ends, Instant::now()).expect("honest"), Any::TimedOut);
    peers[1].producer.send(b"x").expect("room");
    assert_eq!(waiter.wait(&mut ends, Instant::now()).expect("honest"), Any::Message(1));
}

#[test]
fn invalid_combination_of_consumers_is_rejected() {
    let (odd, _peer) = pair(BellKind::Socket);
    let error = Waiter::new(Spin::Off).wait(&mut Sides(vec![odd]), in_time()).expect_err("no futex");
    assert!(matches!(error, AnyError::System(_)), "{error}");
    let (mut too_many, _peers) = sides(ENDS_MAX + 1);
    let error =
        Waiter::new(Spin::Off).wait(&mut too_many, in_time()).expect_err("more than the system takes");
    assert!(matches!(error, AnyError::System(_)), "{error}");
    let (mut all, mut peers) = sides(ENDS_MAX);
    peers[ENDS_MAX - 1].producer.send(b"x").expect("room");
    assert_eq!(Waiter::new(Spin::Off).wait(&mut all, in_time()).expect("honest"), Any::Message(ENDS_MAX - 1));
}
