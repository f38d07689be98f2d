//! The thread that sends, a batch per millisecond: Bulk, Control, Stream, some of them confirmed.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use sinew::{
    Class,
    message::{SendError, Sender},
    prelude::*,
};

use super::clerk::Clerk;
use sinew_testkit::PendingOutcomes;
use sinew_testkit::scripted::reactor;
use sinew_testkit::{
    DEADLINE,
    history::{Note, Station},
};

const TICK: Duration = Duration::from_millis(1);
/// Of this many messages one is confirmed Control, one unconfirmed Control, one Stream; the others are Bulk.
const SHARE: u64 = 20;
/// The fraction of messages of this class.
pub(super) const fn share(class: Class) -> f64 {
    let of_each = match class {
        Class::Control => 2,
        Class::Stream => 1,
        Class::Bulk => SHARE - 3,
    };
    of_each as f64 / SHARE as f64
}

/// Maximum number of confirmed messages in flight.
const WAITS_MAX: usize = 1_000;
/// The time to live of confirmed messages: longer than a run, so that each outcome is a report and not a
/// timeout.
const OUTCOME_WITHIN: Duration = Duration::from_secs(3_600);
/// Messages that could not be sent for longer than this are not caught up on.
const DEBT: Duration = Duration::from_millis(100);
/// Maximum filler of a message, in bytes.
pub(super) const FILLING_MAX: usize = 64 << 10;

payload!("link.bulk", Bulk => #[derive(Debug)] pub(super) struct Bulk {
    pub(super) incarnation: u32,
    pub(super) number: u64,
    #[serde(with = "serde_bytes")]
    pub(super) filling: Vec<u8>,
});
payload!("link.control", Control => #[derive(Debug)] pub(super) struct Control {
    pub(super) incarnation: u32,
    pub(super) number: u64,
    /// Whether the sender waits for its outcome.
    pub(super) asked: bool,
    #[serde(with = "serde_bytes")]
    pub(super) filling: Vec<u8>,
});
payload!("link.stream", Stream => #[derive(Debug)] pub(super) struct Stream {
    pub(super) incarnation: u32,
    pub(super) number: u64,
    #[serde(with = "serde_bytes")]
    pub(super) filling: Vec<u8>,
});

/// The pattern from which each message takes a part as filler, depending on its number.
pub(super) fn pattern() -> Vec<u8> {
    sinew_testkit::random::SeededRandom::new(1).bytes(FILLING_MAX + 256)
}

/// The filler of this message.
pub(super) fn filling(pattern: &[u8], number: u64, length: usize) -> &[u8] {
    let from = number as usize % 256;
    &pattern[from..from + length]
}

/// The name of the application at a station.
pub(super) fn name(station: Station) -> String {
    format!("party-{station}")
}

/// State shared by the pacer and the application.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    /// The last numbers of Control, Stream, Bulk that were or are being handed over.
    tried: [AtomicU64; 3],
    /// Messages per second.
    pub(super) rate: AtomicU64,
    /// Stops sending.
    pub(super) quiet: AtomicBool,
}

impl Numbers {
    pub(super) fn tried(&self) -> [u64; 3] {
        [0, 1, 2].map(|class: usize| self.tried[class].load(Ordering::SeqCst))
    }
}

/// Sends until it is told to stop, and returns when the last confirmed message has its outcome.
pub(super) struct Pacer {
    pub(super) sender: Sender,
    pub(super) clerk: Clerk,
    pub(super) numbers: Arc<Numbers>,
    pub(super) to: Station,
    pub(super) incarnation: u32,
    pub(super) length: usize,
}

impl Pacer {
    pub(super) fn run(self) {
        let runtime = reactor();
        let _entered = runtime.enter();
        let name = name(self.to);
        Work { pacer: self, name, pattern: pattern(), last: [0; 3], waiting: PendingOutcomes::default() }
            .run();
    }
}

struct Work {
    pacer: Pacer,
    name: String,
    pattern: Vec<u8>,
    /// The last numbers that were accepted: of Control, Stream, Bulk.
    last: [u64; 3],
    waiting: PendingOutcomes,
}

impl Work {
    fn run(mut self) {
        let numbers = self.pacer.numbers.clone();
        let (mut count, mut due, mut looked) = (0, 0.0, Instant::now());
        while !numbers.quiet.load(Ordering::Relaxed) {
            let rate = numbers.rate.load(Ordering::Relaxed) as f64;
            due += rate * looked.elapsed().as_secs_f64();
            due = due.min(rate * DEBT.as_secs_f64());
            looked = Instant::now();
            while due >= 1.0 && self.send(count) {
                (count, due) = (count + 1, due - 1.0);
            }
            self.look();
            std::thread::sleep(TICK);
        }
        let until = Instant::now() + DEADLINE;
        // A message that is still pending then is noted without an outcome.
        while !self.waiting.is_empty() && Instant::now() < until {
            self.look();
            std::thread::sleep(TICK);
        }
    }

    /// Sends the next message; `false` if it was not accepted and must be resent later with the same number.
    fn send(&mut self, count: u64) -> bool {
        let (class, asked) = match count % SHARE {
            0 => (Class::Control, true),
            5 => (Class::Control, false),
            10 => (Class::Stream, false),
            _ => (Class::Bulk, false),
        };
        let at = class as usize;
        let number = self.last[at] + 1;
        self.pacer.numbers.tried[at].store(number, Ordering::SeqCst);
        if self.hand_over(class, number, asked).is_err() {
            return false;
        }
        self.last[at] = number;
        self.pacer.clerk.sent(self.pacer.to, class, number, asked);
        true
    }

    fn hand_over(&mut self, class: Class, number: u64, asked: bool) -> Result<(), SendError> {
        let Pacer { sender, incarnation, length, .. } = &self.pacer;
        let (incarnation, filling) = (*incarnation, filling(&self.pattern, number, *length).to_vec());
        let name = &*self.name;
        match class {
            Class::Bulk => sender.send(name, &Bulk { incarnation, number, filling }),
            Class::Stream => sender.send(name, &Stream { incarnation, number, filling }),
            Class::Control if asked => {
                if self.waiting.len() >= WAITS_MAX {
                    return Err(SendError::TooManyWaits);
                }
                let control = Control { incarnation, number, asked, filling };
                let confirmation = sender.message(name, &control).confirmed(OUTCOME_WITHIN)?;
                self.waiting.push(number, confirmation);
                Ok(())
            }
            Class::Control => sender.send(name, &Control { incarnation, number, asked, filling }),
        }
    }

    /// Records the outcomes that have arrived, and prints the notes.
    fn look(&mut self) {
        let (to, class) = (self.pacer.to, Class::Control);
        for (number, outcome) in self.waiting.poll() {
            self.pacer.clerk.note(Note::Ended { to, class, number, outcome });
        }
        self.pacer.clerk.report();
    }
}
