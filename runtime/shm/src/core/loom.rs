//! Checks every interleaving of the ring's atomics, and every value that a processor may show meanwhile.
//!
//! `RUSTFLAGS="--cfg loom" cargo test --release -p sinew-shm --lib --target-dir target/loom core::loom`

use std::sync::{Arc, atomic::Ordering};

use loom::{
    sync::{Condvar, Mutex, atomic::AtomicU32},
    thread,
};

use super::{
    model::{Receiver, Sender, Set, fill, read, ring, ring_in},
    sleep::{WakePlace, asleep_after, awake_after, fence_before_recheck},
};
use crate::{
    layout::{Capacity, Word},
    memory::{Peer, fence},
    wait::Armed,
};

/// A model of a futex or a descriptor: a ring after the call of `listen` ends the sleep. The lock is the
/// system's.
struct Bell {
    word: AtomicU32,
    sleepers: Mutex<()>,
    woken: Condvar,
}

impl Bell {
    fn new() -> Arc<Self> {
        Arc::new(Self { word: AtomicU32::new(0), sleepers: Mutex::new(()), woken: Condvar::new() })
    }

    fn ring(&self) {
        self.word.fetch_add(1, Ordering::Release);
        let sleepers = self.sleepers.lock().unwrap();
        self.woken.notify_one();
        drop(sleepers);
    }

    fn listen(&self) -> u32 {
        self.word.load(Ordering::Acquire)
    }

    fn sleep(&self, seen: u32) {
        let sleepers = self.sleepers.lock().unwrap();
        if self.word.load(Ordering::Relaxed) == seen {
            drop(self.woken.wait(sleepers).unwrap());
        }
    }
}

fn send(sender: &mut Sender, bytes: usize, number: u64) -> bool {
    let reserved = sender.reserve(bytes).expect("the model leaves room");
    fill(sender, reserved, number);
    sender.publish()
}

/// Receives one message if there is any: returns its words, and whether the sender must be woken.
fn take(receiver: &mut Receiver) -> Option<(Vec<u64>, bool)> {
    let record = receiver.next().expect("an honest peer")?;
    let words = read(receiver, record);
    Some((words, receiver.release(record)))
}

fn take_sleeping(receiver: &mut Receiver, bell: &Bell) -> (Vec<u64>, bool) {
    loop {
        if let Some(taken) = take(receiver) {
            return taken;
        }
        let seen = bell.listen();
        if receiver.arm().expect("an honest peer") == Armed::Sleep {
            bell.sleep(seen);
            receiver.disarm();
        }
    }
}

fn reserve_sleeping(sender: &mut Sender, bell: &Bell) {
    while sender.reserve(8).is_err() {
        let seen = bell.listen();
        if sender.arm(8).expect("an honest peer") == Armed::Sleep {
            bell.sleep(seen);
            sender.disarm();
        }
    }
}

#[test]
fn visible_message_is_complete() {
    loom::model(|| {
        let (mut sender, mut receiver) = ring(Capacity::tiny(64));
        let sending = thread::spawn(move || {
            send(&mut sender, 16, 7);
            send(&mut sender, 8, 8);
        });
        let mut seen = Vec::new();
        for _ in 0..2 {
            if let Some((words, _)) = take(&mut receiver) {
                seen.push(words);
            }
        }
        let sent = [vec![7, 7], vec![8]];
        assert_eq!(seen, sent[..seen.len()]);
        sending.join().unwrap();
    });
}

#[test]
fn reused_memory_is_no_longer_read() {
    loom::model(|| {
        // 32 bytes: two messages of 8. The third reuses the memory of the first, as soon as that is released.
        let (mut sender, mut receiver) = ring(Capacity::tiny(32));
        send(&mut sender, 8, 1);
        send(&mut sender, 8, 2);
        let sending = thread::spawn(move || {
            if let Ok(reserved) = sender.reserve(8) {
                fill(&sender, reserved, 3);
                sender.publish();
            }
        });
        let first = take(&mut receiver).expect("it was published before");
        let second = take(&mut receiver).expect("it was published before");
        assert_eq!((first.0, second.0), (vec![1], vec![2]));
        sending.join().unwrap();
        if let Some((third, _)) = take(&mut receiver) {
            assert_eq!(third, [3]);
        }
    });
}

#[test]
fn sleeping_consumer_is_woken_for_every_message() {
    loom::model(|| {
        let (mut sender, mut receiver) = ring(Capacity::tiny(64));
        let bell = Bell::new();
        let button = Arc::clone(&bell);
        let sending = thread::spawn(move || {
            for number in 1..=2 {
                if send(&mut sender, 8, number) {
                    button.ring();
                }
            }
        });
        // A lost wake is a deadlock, which loom reports.
        assert_eq!(take_sleeping(&mut receiver, &bell).0, [1]);
        assert_eq!(take_sleeping(&mut receiver, &bell).0, [2]);
        sending.join().unwrap();
    });
}

#[test]
fn sleeping_producer_is_woken_for_room() {
    loom::model(|| {
        let (mut sender, mut receiver) = ring(Capacity::tiny(32));
        send(&mut sender, 8, 1);
        send(&mut sender, 8, 2);
        let bell = Bell::new();
        let button = Arc::clone(&bell);
        let receiving = thread::spawn(move || {
            let (words, needs_ring) = take(&mut receiver).expect("it was published before");
            assert_eq!(words, [1]);
            if needs_ring {
                button.ring();
            }
            receiver
        });
        reserve_sleeping(&mut sender, &bell);
        let reserved = sender.reserved().expect("just reserved");
        fill(&sender, reserved, 3);
        sender.publish();
        let mut receiver = receiving.join().unwrap();
        assert_eq!(take(&mut receiver).expect("the second").0, [2]);
        assert_eq!(take(&mut receiver).expect("the third").0, [3]);
    });
}

#[test]
fn sleeping_producer_is_woken_for_kept_messages() {
    loom::model(|| {
        let (mut sender, mut receiver) = ring(Capacity::tiny(32));
        send(&mut sender, 8, 1);
        send(&mut sender, 8, 2);
        let bell = Bell::new();
        let button = Arc::clone(&bell);
        let receiving = thread::spawn(move || {
            for number in 1..=2 {
                let record = receiver.next().expect("an honest peer").expect("it was published before");
                assert_eq!(read(&receiver, record), [number]);
                receiver.keep(record);
            }
            if receiver.give_back() {
                button.ring();
            }
        });
        reserve_sleeping(&mut sender, &bell);
        receiving.join().unwrap();
    });
}

#[test]
fn returned_loan_is_never_visible() {
    loom::model(|| {
        let (mut sender, mut receiver) = ring(Capacity::tiny(64));
        let sending = thread::spawn(move || {
            let reserved = sender.reserve(16).expect("an empty ring");
            fill(&sender, reserved, 666);
            sender.give_back();
            send(&mut sender, 8, 1);
        });
        if let Some((words, _)) = take(&mut receiver) {
            assert_eq!(words, [1]);
        }
        sending.join().unwrap();
        if let Some((words, _)) = take(&mut receiver) {
            assert_eq!(words, [1]);
        }
    });
}

/// The sleeping place for the rings of a set: one bell that all ring, or the words of the wakers' own regions. The
/// lock is the system's.
struct Place {
    set: Arc<Set>,
    bell: AtomicU32,
    sleepers: Mutex<()>,
    woken: Condvar,
}

/// The owner of a set.
struct Owner<const N: usize> {
    place: Arc<Place>,
    receivers: [Receiver; N],
    /// Rings that were reported and not read empty.
    ready: u32,
    sleep: u32,
}

impl Place {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            set: Arc::new(Set { reports: AtomicU32::new(0), sleep: AtomicU32::new(0) }),
            bell: AtomicU32::new(0),
            sleepers: Mutex::new(()),
            woken: Condvar::new(),
        })
    }

    fn ring<const N: usize>(self: &Arc<Self>) -> ([Sender; N], Owner<N>) {
        let ring = |index: usize| ring_in(Some((Arc::clone(&self.set), 1 << index)), Capacity::tiny(64));
        let (mut senders, mut receivers) = (Vec::new(), Vec::new());
        (0..N).map(ring).for_each(|(sender, receiver)| {
            senders.push(sender);
            receivers.push(receiver);
        });
        let (senders, receivers) = (senders.try_into().unwrap(), receivers.try_into().unwrap());
        (senders, Owner { place: Arc::clone(self), receivers, ready: 0, sleep: 0 })
    }

    fn wake(&self) {
        let sleepers = self.sleepers.lock().unwrap();
        self.woken.notify_one();
        drop(sleepers);
    }

    /// Like `Producer::publish`.
    fn send(&self, sender: &mut Sender, number: u64) {
        if !send(sender, 8, number) {
            return;
        }
        match sender.wake_place() {
            WakePlace::Bell => {
                self.bell.fetch_add(1, Ordering::Release);
                self.wake();
                sender.report_ring();
            }
            WakePlace::Own => {
                sender.report_ring();
                self.wake();
            }
        }
    }
}

impl<const N: usize> Owner<N> {
    /// Like `WaitSet::look`.
    fn look(&mut self) -> bool {
        if self.place.set.reports.load(Ordering::Relaxed) != 0 {
            self.ready |= self.place.set.reports.swap(0, Ordering::Acquire);
            fence(Ordering::SeqCst);
        }
        self.ready != 0
    }

    fn words(&self, wake_place: WakePlace) -> [u32; N] {
        std::array::from_fn(|index| match wake_place {
            WakePlace::Bell => self.place.bell.load(Ordering::Relaxed),
            WakePlace::Own => self.receivers[index].peer.load(Word::Rung),
        })
    }

    /// Takes the message of a ring that is to be read.
    fn take_ready(&mut self) -> Option<Vec<u64>> {
        while self.look() {
            let index = self.ready.trailing_zeros();
            match take(&mut self.receivers[index as usize]) {
                Some((words, _)) => return Some(words),
                None => self.ready &= !(1 << index),
            }
        }
        None
    }

    /// The steps of `any.rs` in their order: look, listen, announce, fence, look, sleep, withdraw.
    fn take(&mut self, wake_places: &mut impl Iterator<Item = WakePlace>) -> Vec<u64> {
        loop {
            if let Some(words) = self.take_ready() {
                return words;
            }
            let wake_place = wake_places.next().unwrap();
            let seen = self.words(wake_place);
            fence(Ordering::Acquire);
            self.sleep = asleep_after(self.sleep, wake_place);
            self.place.set.sleep.store(self.sleep, Ordering::Relaxed);
            fence_before_recheck();
            if !self.look() {
                let place = Arc::clone(&self.place);
                let sleepers = place.sleepers.lock().unwrap();
                if self.words(wake_place) == seen {
                    drop(place.woken.wait(sleepers).unwrap());
                }
            }
            self.place.set.sleep.store(awake_after(self.sleep), Ordering::Relaxed);
        }
    }
}

fn sleeper_for_two_rings_takes_both_messages(wake_places: [WakePlace; 2]) {
    loom::model(move || {
        let place = Place::new();
        let ([mut first, mut second], mut owner) = place.ring();
        let sending = thread::spawn(move || {
            place.send(&mut second, 2);
            place.send(&mut first, 1);
        });
        let mut wake_places = wake_places.into_iter().cycle();
        // A lost wake is a deadlock, which loom reports.
        let mut taken = vec![owner.take(&mut wake_places), owner.take(&mut wake_places)];
        taken.sort();
        assert_eq!(taken, [[1], [2]]);
        sending.join().unwrap();
    });
}

#[test]
fn sleeper_at_the_set_bell_wakes_by_either_ring() {
    sleeper_for_two_rings_takes_both_messages([WakePlace::Bell; 2]);
}

#[test]
fn sleeper_at_wakers_words_is_woken_by_either_ring() {
    sleeper_for_two_rings_takes_both_messages([WakePlace::Own; 2]);
}

#[test]
fn sleeper_that_changes_its_place_is_woken() {
    for wake_places in [[WakePlace::Bell, WakePlace::Own], [WakePlace::Own, WakePlace::Bell]] {
        loom::model(move || {
            let place = Place::new();
            let ([mut sender], mut owner) = place.ring();
            let sending = thread::spawn(move || (1..=2).for_each(|number| place.send(&mut sender, number)));
            let mut wake_places = wake_places.into_iter().cycle();
            assert_eq!(owner.take(&mut wake_places), [1]);
            assert_eq!(owner.take(&mut wake_places), [2]);
            sending.join().unwrap();
        });
    }
}

#[test]
fn message_after_a_report_is_found_without_another_one() {
    loom::model(|| {
        // Given: a message that was reported
        let place = Place::new();
        let ([mut sender], mut owner) = place.ring();
        place.send(&mut sender, 1);
        let sending = thread::spawn(move || place.send(&mut sender, 2));
        // Then: the next one is found, whether its sender finds its bit still set or not
        let mut wake_places = std::iter::repeat(WakePlace::Bell);
        assert_eq!(owner.take(&mut wake_places), [1]);
        assert_eq!(owner.take(&mut wake_places), [2]);
        sending.join().unwrap();
    });
}
