//! Every interleaving, and every value that a processor may show meanwhile, of the ring's atomics.
//!
//! `RUSTFLAGS="--cfg loom" cargo test --release -p sinew-shm --lib --target-dir target/loom core::loom`

use std::sync::{Arc, atomic::Ordering};

use loom::{
    sync::{Condvar, Mutex, atomic::AtomicU32},
    thread,
};

use super::model::{Receiver, Sender, fill, read, ring};
use crate::{layout::Capacity, wait::Armed};

/// What a futex does, and a descriptor: rung after it was listened to, a sleep ends. The lock is the system's.
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

    fn sleep(&self, heard: u32) {
        let sleepers = self.sleepers.lock().unwrap();
        if self.word.load(Ordering::Relaxed) == heard {
            drop(self.woken.wait(sleepers).unwrap());
        }
    }
}

fn send(sender: &mut Sender, bytes: usize, number: u64) -> bool {
    let reserved = sender.reserve(bytes).expect("the model leaves room");
    fill(sender, reserved, number);
    sender.publish()
}

/// Takes one message if there is any: its words, and whether the sender has to be woken.
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
        let heard = bell.listen();
        if receiver.arm().expect("an honest peer") == Armed::Sleep {
            bell.sleep(heard);
            receiver.disarm();
        }
    }
}

#[test]
fn a_message_that_is_seen_is_seen_whole() {
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
fn memory_that_is_used_again_is_no_longer_read() {
    loom::model(|| {
        // 32 bytes: two messages of 8. The third takes the place of the first, as soon as that is released.
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
fn a_consumer_that_sleeps_is_woken_for_every_message() {
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
fn a_producer_that_sleeps_is_woken_for_room() {
    loom::model(|| {
        let (mut sender, mut receiver) = ring(Capacity::tiny(32));
        send(&mut sender, 8, 1);
        send(&mut sender, 8, 2);
        let bell = Bell::new();
        let button = Arc::clone(&bell);
        let receiving = thread::spawn(move || {
            let (words, owed) = take(&mut receiver).expect("it was published before");
            assert_eq!(words, [1]);
            if owed {
                button.ring();
            }
            receiver
        });
        while sender.reserve(8).is_err() {
            let heard = bell.listen();
            if sender.arm(8).expect("an honest peer") == Armed::Sleep {
                bell.sleep(heard);
                sender.disarm();
            }
        }
        let reserved = sender.reserved().expect("just reserved");
        fill(&sender, reserved, 3);
        sender.publish();
        let mut receiver = receiving.join().unwrap();
        assert_eq!(take(&mut receiver).expect("the second").0, [2]);
        assert_eq!(take(&mut receiver).expect("the third").0, [3]);
    });
}

#[test]
fn a_loan_that_is_given_back_is_never_seen() {
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

/// What a sleeper on several futexes sleeps on: it is woken by any of them that rings after it was listened to.
struct Bells {
    words: [AtomicU32; 2],
    sleepers: Mutex<()>,
    woken: Condvar,
}

impl Bells {
    fn ring(&self, index: usize) {
        self.words[index].fetch_add(1, Ordering::Release);
        let sleepers = self.sleepers.lock().unwrap();
        self.woken.notify_one();
        drop(sleepers);
    }

    fn listen(&self) -> [u32; 2] {
        [self.words[0].load(Ordering::Acquire), self.words[1].load(Ordering::Acquire)]
    }

    fn sleep(&self, heard: [u32; 2]) {
        let sleepers = self.sleepers.lock().unwrap();
        if (0..2).all(|index| self.words[index].load(Ordering::Relaxed) == heard[index]) {
            drop(self.woken.wait(sleepers).unwrap());
        }
    }
}

/// The order of steps of `any.rs`: listen to all, announce to all, sleep, withdraw from all.
fn take_sleeping_any(receivers: &mut [Receiver; 2], bells: &Bells) -> Vec<u64> {
    loop {
        for receiver in receivers.iter_mut() {
            if let Some((words, _)) = take(receiver) {
                return words;
            }
        }
        let heard = bells.listen();
        let ready = receivers.iter_mut().position(|receiver| receiver.arm().unwrap() == Armed::Ready);
        if ready.is_none() {
            bells.sleep(heard);
        }
        for receiver in receivers.iter_mut().take(ready.unwrap_or(2)) {
            receiver.disarm();
        }
    }
}

#[test]
fn who_sleeps_at_two_rings_is_woken_for_every_message_of_either() {
    loom::model(|| {
        let (mut first, first_end) = ring(Capacity::tiny(64));
        let (mut second, second_end) = ring(Capacity::tiny(64));
        let words = [AtomicU32::new(0), AtomicU32::new(0)];
        let bells = Arc::new(Bells { words, sleepers: Mutex::new(()), woken: Condvar::new() });
        let buttons = Arc::clone(&bells);
        let sending = thread::spawn(move || {
            if send(&mut second, 8, 2) {
                buttons.ring(1);
            }
            if send(&mut first, 8, 1) {
                buttons.ring(0);
            }
        });
        let mut receivers = [first_end, second_end];
        // A lost wake is a deadlock, which loom reports.
        let mut taken =
            vec![take_sleeping_any(&mut receivers, &bells), take_sleeping_any(&mut receivers, &bells)];
        taken.sort();
        assert_eq!(taken, [[1], [2]]);
        sending.join().unwrap();
    });
}
