//! A thread that sends at a rate, a batch each millisecond: Bulk and Control, some of them confirmed.

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::{Context, Poll, Waker},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use sinew::{
    Outcome,
    message::{Confirmation, SendError, Sender},
};

use super::PATIENCE;
use crate::puppet::{Job, Order};

const TICK: Duration = Duration::from_millis(1);
/// Of so many messages one is a confirmed Control message and one an unconfirmed; the others are Bulk.
const SHARE: u64 = 10;
/// Confirmed messages under way at most; the node's own limit is a little higher.
const WAITS_MAX: usize = 1_000;

/// A running pacer.
pub(super) struct Pacer {
    stop: Arc<AtomicBool>,
    upto: Arc<[AtomicU64; 2]>,
    thread: JoinHandle<Sent>,
}

/// What was sent, and what became of it.
#[derive(Debug, Default)]
pub(super) struct Sent {
    /// The last numbers: of Bulk, of Control. Each class is numbered from 1.
    pub(super) upto: [u64; 2],
    /// The outcome of each confirmed Control message.
    pub(super) outcomes: Vec<(u64, Outcome)>,
    /// How often a message found no room, or nobody, and was sent again with the same number.
    pub(super) again: u64,
}

impl Pacer {
    pub(super) fn start(sender: Sender, rate: u64) -> Self {
        let (stop, upto) =
            (Arc::new(AtomicBool::new(false)), Arc::new([AtomicU64::new(0), AtomicU64::new(0)]));
        let (stopped, told) = (stop.clone(), upto.clone());
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
            let runtime = runtime.expect("a reactor with nothing but a timer");
            let _entered = runtime.enter();
            Work { sender, told, sent: Sent::default(), waiting: VecDeque::new() }.run(rate, &stopped)
        });
        Self { stop, upto, thread }
    }

    /// The last numbers so far.
    pub(super) fn sent_so_far(&self) -> [u64; 2] {
        [0, 1].map(|class| self.upto[class].load(Ordering::Relaxed))
    }

    pub(super) fn finish(self) -> Sent {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the pacer does not fail")
    }
}

struct Work {
    sender: Sender,
    told: Arc<[AtomicU64; 2]>,
    sent: Sent,
    waiting: VecDeque<(u64, Confirmation)>,
}

impl Work {
    fn run(mut self, rate: u64, stopped: &AtomicBool) -> Sent {
        let began = Instant::now();
        let mut count = 0;
        while !stopped.load(Ordering::Relaxed) {
            let due = rate * u64::try_from(began.elapsed().as_micros()).unwrap_or(u64::MAX) / 1_000_000;
            while count < due && self.send(count) {
                count += 1;
            }
            self.look();
            std::thread::sleep(TICK);
        }
        let until = Instant::now() + PATIENCE;
        while !self.waiting.is_empty() {
            assert!(Instant::now() < until, "{} confirmations have no outcome", self.waiting.len());
            self.look();
            std::thread::sleep(TICK);
        }
        self.sent
    }

    /// Sends the next message; `false` if it was not taken and is to be sent again later.
    fn send(&mut self, count: u64) -> bool {
        let class = usize::from(count.is_multiple_of(SHARE / 2));
        let number = self.sent.upto[class] + 1;
        let taken = if class == 0 {
            self.sender.send("sink", &Job { number })
        } else if count.is_multiple_of(SHARE) {
            self.send_confirmed(number)
        } else {
            self.sender.send("sink", &Order { number })
        };
        if taken.is_err() {
            self.sent.again += 1;
            return false;
        }
        self.sent.upto[class] = number;
        self.told[class].store(number, Ordering::Relaxed);
        true
    }

    fn send_confirmed(&mut self, number: u64) -> Result<(), SendError> {
        if self.waiting.len() >= WAITS_MAX {
            return Err(SendError::TooManyWaits);
        }
        let confirmation = self.sender.message("sink", &Order { number }).confirmed(PATIENCE)?;
        self.waiting.push_back((number, confirmation));
        Ok(())
    }

    /// Takes the outcomes that have come.
    fn look(&mut self) {
        let mut context = Context::from_waker(Waker::noop());
        for _ in 0..self.waiting.len() {
            let Some((number, mut confirmation)) = self.waiting.pop_front() else { return };
            match Pin::new(&mut confirmation).poll(&mut context) {
                Poll::Ready(outcome) => self.sent.outcomes.push((number, outcome)),
                Poll::Pending => self.waiting.push_back((number, confirmation)),
            }
        }
    }
}
