//! The outcomes that one client is owed: none is dropped while the client is there, and they have a bound all the same.
//!
//! An outcome that finds no room in the client's queue waits ahead of it. So that these are few, the client's own messages are:
//! those of which others have not said what became of them are so many at most, and while outcomes wait nothing more is read of the
//! client.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use sinew_runtime::{
    outcome::{MemberReport, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::Outlet,
    wire::Message,
};

use super::ClientOutlet;

/// Times what its queue holds of a class, so many of a client's messages may be without an outcome.
const PENDING_QUEUES: usize = 8;
/// Time until it is looked again whether a client that is owed too much has taken something.
const LOOK_AGAIN: Duration = Duration::from_millis(2);

/// What one client is owed. Any thread settles its messages, and writes to its link itself.
pub(super) struct Outcomes {
    outlet: Arc<ClientOutlet>,
    /// Its messages that others have.
    pending: AtomicUsize,
    pending_max: usize,
    /// Outcomes that wait ahead of its queue while it is read.
    waiting_max: usize,
    payload_max: usize,
    /// Whether some may: to count them takes a lock, which others hold while they write to the client.
    may_wait: AtomicBool,
}

impl Outcomes {
    /// The outcomes for a client. Its queue holds `queue_capacity` messages of each class, with payloads of at most `payload_max` bytes.
    pub(super) fn new(outlet: Arc<ClientOutlet>, queue_capacity: usize, payload_max: usize) -> Arc<Self> {
        let pending_max = PENDING_QUEUES * queue_capacity;
        let (pending, may_wait) = (AtomicUsize::new(0), AtomicBool::new(false));
        let waiting_max = queue_capacity;
        Arc::new(Self { outlet, pending, pending_max, waiting_max, payload_max, may_wait })
    }

    /// The receipt of a message of the client's; `None` if too many are without an outcome, which is told to it.
    pub(super) fn receipt(self: &Arc<Self>, ticket: Ticket) -> Option<Receipt> {
        // Only the one who reads the client adds to them.
        if self.pending.load(Ordering::Relaxed) >= self.pending_max {
            self.tell(ticket, Outcome::Rejected(Rejection::QueueFull));
            return None;
        }
        self.pending.fetch_add(1, Ordering::Relaxed);
        Some(Receipt::new(self.clone(), ticket))
    }

    /// Tells the client what became of a message.
    pub(super) fn tell(&self, ticket: Ticket, outcome: Outcome) {
        self.answer(Message::outcome(ticket, outcome));
    }

    /// Gives the client an answer that it waits for.
    // spec: LNCL-16
    pub(super) fn answer(&self, answer: Message) {
        let Err(refused) = self.outlet.submit(answer) else { return };
        if refused.why == Rejection::QueueFull {
            // All that is pending, and what the frame that was read last has added.
            let most = self.pending_max + 2 * self.waiting_max;
            // Not taken: its connection has ended.
            let _ = self.outlet.submit_urgent(refused.message, most);
            // SYNC: Release, for `may_come`: who sees this sees what waits.
            self.may_wait.store(true, Ordering::Release);
        }
    }

    /// Resolves when so few answers wait that the client may be read.
    pub(super) async fn may_come(&self) {
        if !self.may_wait.load(Ordering::Relaxed) {
            return;
        }
        // SYNC: Acquire, with the Release in `answer`: what waits by now is counted below, and what comes later says so again.
        self.may_wait.swap(false, Ordering::Acquire);
        loop {
            let left = self.outlet.urgent_left();
            if left < self.waiting_max {
                if left > 0 {
                    self.may_wait.store(true, Ordering::Relaxed);
                }
                return;
            }
            // Its end is noticed by who writes to it.
            tokio::time::sleep(LOOK_AGAIN).await;
        }
    }
}

impl ReceiptSink for Outcomes {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.pending.fetch_sub(1, Ordering::Relaxed);
        self.tell(ticket, outcome);
    }

    // spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        Message::members(ticket, reports, self.payload_max).for_each(|frame| self.answer(frame));
    }
}
