//! One thread that waits for several consumers, over real sealed memory.
#![cfg(target_os = "linux")]

use std::{
    os::{fd::AsFd, unix::net::UnixStream},
    thread,
    time::{Duration, Instant},
};

use sinew_shm::{
    Any, AnyError, Bell, BellKind, Capacity, Consumer, ENDS_MAX, Ends, HangUp, Producer, Region, Spin, Terms,
    WaitSet, Waiter,
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

/// The same in a set.
fn sides_of(set: &WaitSet, count: usize) -> (Sides, Vec<Peer>) {
    let (sides, peers): (Vec<_>, _) = (0..count).map(|_| pair(Bell::Set(set.clone()))).unzip();
    sides.iter().for_each(|side| set.set_open(&side.consumer, true));
    (Sides(sides), peers)
}

fn in_time() -> Instant {
    Instant::now() + WATCHDOG
}

#[test]
fn each_message_of_each_peer_wakes_the_sleeper() {
    let looks = Spin::Adaptive { max: Duration::from_micros(50) };
    for (is_set, count, spin) in [
        (false, 1, Spin::Off),
        (false, 3, Spin::Off),
        (false, 3, looks),
        (true, 1, Spin::Off),
        (true, 70, Spin::Off),
        (true, 3, looks),
    ] {
        // given
        let set = is_set.then(|| WaitSet::create().expect("pages"));
        let (mut ends, mut peers) = set.as_ref().map_or_else(|| sides(count), |set| sides_of(set, count));
        let (tell, told) = std::sync::mpsc::sync_channel::<usize>(1);
        let sending = thread::spawn(move || {
            while let Ok(index) = told.recv() {
                peers[index].producer.send(&[index as u8]).expect("room");
            }
            peers
        });
        let mut waiter = match &set {
            Some(set) => Waiter::new(spin).of_set(set.clone()),
            None => Waiter::new(spin),
        };
        for number in 0..2_000 {
            // when
            let index = number * 7 % count;
            tell.send(index).expect("the sender lives");
            // then
            let woken = waiter.wait(&mut ends, in_time()).expect("honest peers");
            match &set {
                None => assert_eq!(woken, Any::Message(index)),
                Some(set) => {
                    assert_eq!(woken, Any::Ready);
                    // A thread that spins may take a message before its report, which it finds later.
                    while spin != Spin::Off && !ends.consumer_mut(index).is_ready().expect("honest") {
                        (0..count).for_each(|ring| set.was_emptied(ends.consumer(ring)));
                        assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest peers"), Any::Ready);
                    }
                    let ready: Vec<_> = set.ready().map(Some).collect();
                    assert!(spin != Spin::Off || ready == [ends.consumer(index).slot()], "{ready:?}");
                }
            }
            let lent = ends.consumer_mut(index).receive().expect("honest").expect("it is ready");
            assert_eq!(lent.to_vec(), [index as u8]);
            drop(lent);
            if let Some(set) = &set {
                set.was_emptied(ends.consumer(index));
            }
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

#[test]
fn place_of_an_ended_ring_is_given_again() {
    let set = WaitSet::create().expect("pages");
    let (mut all, peers) = sides_of(&set, 128);
    let places: std::collections::BTreeSet<_> = all.0.iter().map(|side| side.consumer.slot()).collect();
    assert_eq!(places.len(), 128);
    assert!(matches!(
        Region::create(Capacity::MIN, Bell::Set(set.clone())),
        Err(sinew_shm::CreateError::SetFull)
    ));
    // When: one ends, with a message
    let gone = all.0.remove(7).consumer.slot();
    let mut peers = peers;
    peers[7].producer.send(b"late").expect("room");
    // Then: the next ring has its place, and the late message makes it no more than an empty look
    let (next, _peer) = pair(Bell::Set(set.clone()));
    assert_eq!(next.consumer.slot(), gone);
    set.set_open(&next.consumer, true);
    all.0.push(next);
    assert!(set.look());
    let last = all.consumer_mut(127);
    assert!(last.receive().expect("honest").is_none());
    set.was_emptied(all.consumer(127));
    assert!(!set.look());
}

#[test]
fn end_of_peer_in_set_is_reported_after_messages() {
    let set = WaitSet::create().expect("pages");
    let (mut ends, mut peers) = sides_of(&set, 3);
    let mut second = peers.remove(1);
    second.producer.send(b"last words").expect("room");
    drop(second);
    let mut waiter = Waiter::new(Spin::Off).of_set(set.clone());
    assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest"), Any::Ready);
    drop(ends.consumer_mut(1).receive());
    set.was_emptied(ends.consumer(1));
    assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest"), Any::HungUp(1));
    assert_eq!(waiter.wait(&mut Sides(Vec::new()), Instant::now()).expect("honest"), Any::TimedOut);
}

#[test]
fn ring_that_is_not_read_ends_no_wait() {
    // Given: a closed ring with a message
    let set = WaitSet::create().expect("pages");
    let (mut ends, mut peers) = sides_of(&set, 2);
    set.set_open(&ends.0[1].consumer, false);
    peers[1].producer.send(b"early").expect("room");
    let mut waiter = Waiter::new(Spin::Off).of_set(set.clone());
    let soon = Instant::now() + Duration::from_millis(30);
    assert_eq!(waiter.wait(&mut Sides(vec![ends.0.remove(0)]), soon).expect("honest"), Any::TimedOut);
    // When: it is read. Then: the message is there
    set.set_open(&ends.0[0].consumer, true);
    assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest"), Any::Ready);
}

#[test]
fn other_thread_ends_this_wait_or_the_next() {
    const WAKES: u32 = 1_000;
    let set = WaitSet::create().expect("pages");
    let (mut ends, _peers) = sides_of(&set, 2);
    let mut waiter = Waiter::new(Spin::Off).of_set(set.clone());
    let (taken, next) = std::sync::mpsc::sync_channel(0);
    thread::scope(|scope| {
        let waking = set.clone();
        scope.spawn(move || {
            for _ in 0..WAKES {
                waking.wake();
                next.recv_timeout(WATCHDOG).expect("the owner takes each");
            }
        });
        for _ in 0..WAKES {
            while !set.take_wake() {
                assert_eq!(waiter.wait(&mut ends, in_time()).expect("honest"), Any::Ready);
            }
            taken.send(()).expect("the other thread waits for it");
        }
    });
    assert!(!set.take_wake());
    assert_eq!(waiter.wait(&mut ends, Instant::now()).expect("honest"), Any::TimedOut);
}
