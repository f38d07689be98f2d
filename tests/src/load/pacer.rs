//! A thread that sends at a rate, a batch per millisecond: Bulk and Control, some of them confirmed.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use sinew::{
    Class, NodeAddress,
    message::{SendError, Sender},
};

use super::{
    PATIENCE,
    record::{CLASSES, Record},
};
use sinew_testkit::PendingOutcomes;
use sinew_testkit::scripted::reactor;
use sinew_testkit::{
    history::Note,
    scripted::{Job, Order},
};

const TICK: Duration = Duration::from_millis(1);
/// Of this many messages one is a confirmed Control message and one an unconfirmed one; the others are Bulk.
const SHARE: u64 = 10;
/// Maximum number of confirmed messages in flight; the node's own limit is slightly higher.
const WAITS_MAX: usize = 1_000;

/// A running pacer.
pub(super) struct Pacer {
    stop: Arc<AtomicBool>,
    upto: Arc<[AtomicU64; 2]>,
    thread: JoinHandle<Sent>,
}

/// The sent messages.
#[derive(Debug, Default)]
pub(super) struct Sent {
    /// The last numbers: of Bulk, of Control. Each class is numbered from 1.
    pub(super) upto: [u64; 2],
    /// Number of messages that found no room or no receiver, and were resent with the same number.
    pub(super) again: u64,
}

impl Pacer {
    pub(super) fn start(sender: Sender, rate: u64, (node, record): (NodeAddress, &Record)) -> Self {
        let (stop, upto) =
            (Arc::new(AtomicBool::new(false)), Arc::new([AtomicU64::new(0), AtomicU64::new(0)]));
        let (stopped, sent_upto, record) = (stop.clone(), upto.clone(), record.clone());
        let thread = std::thread::spawn(move || {
            let runtime = reactor();
            let _entered = runtime.enter();
            let (sent, notes, waiting) = (Sent::default(), Vec::new(), PendingOutcomes::default());
            Work { sender, node, record, notes, sent_upto, sent, waiting }.run(rate, &stopped)
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
    node: NodeAddress,
    record: Record,
    /// Sent messages and outcomes, in order, that are not yet in the record.
    notes: Vec<Note>,
    sent_upto: Arc<[AtomicU64; 2]>,
    sent: Sent,
    waiting: PendingOutcomes,
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

    /// Sends the next message; `false` if it was not accepted and must be resent later.
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
        self.notes.push(Record::sent(CLASSES[class], number, count.is_multiple_of(SHARE)));
        self.sent.upto[class] = number;
        self.sent_upto[class].store(number, Ordering::Relaxed);
        true
    }

    fn send_confirmed(&mut self, number: u64) -> Result<(), SendError> {
        if self.waiting.len() >= WAITS_MAX {
            return Err(SendError::TooManyWaits);
        }
        let confirmation = self.sender.message("sink", &Order { number }).confirmed(PATIENCE)?;
        self.waiting.push(number, confirmation);
        Ok(())
    }

    /// Records the sent messages, and the outcomes that have arrived.
    fn look(&mut self) {
        let ended = |(number, outcome)| Record::ended(Class::Control, number, outcome);
        self.notes.extend(self.waiting.poll().into_iter().map(ended));
        self.record.note(self.node, self.notes.drain(..));
    }
}
