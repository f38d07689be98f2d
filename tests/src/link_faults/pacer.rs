//! The thread that sends, a batch each millisecond: Bulk, Control, Stream, some of them confirmed.

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::{Context, Poll, Waker},
    time::{Duration, Instant},
};

use sinew::{
    Class,
    message::{Confirmation, SendError, Sender},
    prelude::*,
};

use super::clerk::Clerk;
use crate::{
    DEADLINE,
    history::{Note, Station},
};

const TICK: Duration = Duration::from_millis(1);
/// Of so many messages one is confirmed Control, one unconfirmed Control, one Stream; the others are Bulk.
const SHARE: u64 = 20;
/// How many of all messages are of this class, as a part of 1.
pub(super) const fn share(class: Class) -> f64 {
    let of_each = match class {
        Class::Control => 2,
        Class::Stream => 1,
        Class::Bulk => SHARE - 3,
    };
    of_each as f64 / SHARE as f64
}

/// Confirmed messages under way at most.
const WAITS_MAX: usize = 1_000;
/// The time to live of what is confirmed: more than a run takes, so that each outcome is somebody's word and not the end of a wait.
const OUTCOME_WITHIN: Duration = Duration::from_secs(3_600);
/// What could not be sent for longer than this is not made up for.
const DEBT: Duration = Duration::from_millis(100);
/// Longest filling of a message, in bytes.
pub(super) const FILLING_MAX: usize = 64 << 10;

payload!("link.bulk", Bulk => #[derive(Debug)] pub(super) struct Bulk {
    pub(super) life: u32,
    pub(super) number: u64,
    #[serde(with = "serde_bytes")]
    pub(super) filling: Vec<u8>,
});
payload!("link.control", Control => #[derive(Debug)] pub(super) struct Control {
    pub(super) life: u32,
    pub(super) number: u64,
    /// Whether its sender waits for its outcome.
    pub(super) asked: bool,
    #[serde(with = "serde_bytes")]
    pub(super) filling: Vec<u8>,
});
payload!("link.stream", Stream => #[derive(Debug)] pub(super) struct Stream {
    pub(super) life: u32,
    pub(super) number: u64,
    #[serde(with = "serde_bytes")]
    pub(super) filling: Vec<u8>,
});

/// Bytes of which a part fills each message, another one for each number.
pub(super) fn pattern() -> Vec<u8> {
    crate::dice::Dice::new(1).bytes(FILLING_MAX + 256)
}

/// What fills this message.
pub(super) fn filling(pattern: &[u8], number: u64, length: usize) -> &[u8] {
    let from = number as usize % 256;
    &pattern[from..from + length]
}

/// The name of the application at a station.
pub(super) fn name(station: Station) -> String {
    format!("party-{station}")
}

/// What the pacer and the application share.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    /// The last numbers of Control, Stream, Bulk that were handed over, or are just being.
    tried: [AtomicU64; 3],
    /// Messages a second.
    pub(super) rate: AtomicU64,
    /// No more is to be sent.
    pub(super) quiet: AtomicBool,
}

impl Numbers {
    pub(super) fn tried(&self) -> [u64; 3] {
        [0, 1, 2].map(|class: usize| self.tried[class].load(Ordering::SeqCst))
    }
}

/// Sends until it is told to be quiet, and returns when the last confirmed message has its outcome.
pub(super) struct Pacer {
    pub(super) sender: Sender,
    pub(super) clerk: Clerk,
    pub(super) numbers: Arc<Numbers>,
    pub(super) to: Station,
    pub(super) life: u32,
    pub(super) length: usize,
}

impl Pacer {
    pub(super) fn run(self) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        let runtime = runtime.expect("a reactor with nothing but a timer");
        let _entered = runtime.enter();
        let name = name(self.to);
        Work { pacer: self, name, pattern: pattern(), last: [0; 3], waiting: VecDeque::new() }.run();
    }
}

struct Work {
    pacer: Pacer,
    name: String,
    pattern: Vec<u8>,
    /// The last numbers that were taken: of Control, Stream, Bulk.
    last: [u64; 3],
    waiting: VecDeque<(u64, Confirmation)>,
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
        // One that still waits then is written down as one without an outcome.
        while !self.waiting.is_empty() && Instant::now() < until {
            self.look();
            std::thread::sleep(TICK);
        }
    }

    /// Sends the next message; `false` if it was not taken and is to be sent again later, with the same number.
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
        let Pacer { sender, life, length, .. } = &self.pacer;
        let (life, filling) = (*life, filling(&self.pattern, number, *length).to_vec());
        let name = &*self.name;
        match class {
            Class::Bulk => sender.send(name, &Bulk { life, number, filling }),
            Class::Stream => sender.send(name, &Stream { life, number, filling }),
            Class::Control if asked => {
                if self.waiting.len() >= WAITS_MAX {
                    return Err(SendError::TooManyWaits);
                }
                let control = Control { life, number, asked, filling };
                let confirmation = sender.message(name, &control).confirmed(OUTCOME_WITHIN)?;
                self.waiting.push_back((number, confirmation));
                Ok(())
            }
            Class::Control => sender.send(name, &Control { life, number, asked, filling }),
        }
    }

    /// Takes the outcomes that have come, and says what was written down.
    fn look(&mut self) {
        let mut context = Context::from_waker(Waker::noop());
        for _ in 0..self.waiting.len() {
            let Some((number, mut confirmation)) = self.waiting.pop_front() else { break };
            match Pin::new(&mut confirmation).poll(&mut context) {
                Poll::Ready(outcome) => {
                    let (to, class) = (self.pacer.to, Class::Control);
                    self.pacer.clerk.note(Note::Ended { to, class, number, outcome });
                }
                Poll::Pending => self.waiting.push_back((number, confirmation)),
            }
        }
        self.pacer.clerk.say();
    }
}
