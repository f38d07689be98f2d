//! The pending outcomes of one client. None is dropped while the client is connected, and their number is bounded.
//!
//! An outcome that finds the client's queue full waits ahead of it. Two limits bound these outcomes. The number of the
//! client's own messages without an outcome is bounded. While too many outcomes wait, the client is not read.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use sinew_runtime::{
    outcome::{self, MemberReport, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::MessageSink,
    wire::Message,
};

use super::ClientOutlet;

/// Maximum number of a client's messages without an outcome, as a multiple of its queue's capacity per class.
const PENDING_QUEUES: usize = 8;
/// Interval of the check whether a client with too many waiting outcomes has read some.
const CHECK_INTERVAL: Duration = Duration::from_millis(2);

/// The outcomes of one client. Any thread settles its messages, and writes to its link itself.
pub(super) struct Outcomes {
    outlet: Arc<ClientOutlet>,
    /// Messages of the client without an outcome.
    pending: AtomicUsize,
    pending_max: usize,
    /// While fewer outcomes than this wait ahead of its queue, the client is read.
    waiting_max: usize,
    payload_max: usize,
    /// Whether outcomes may wait. Counting them takes a lock that other threads hold while they write to the client.
    may_wait: AtomicBool,
}

impl Outcomes {
    /// Creates the outcomes of a client. Its queue holds `queue_capacity` messages of each class, with payloads of at
    /// most `payload_max` bytes.
    pub(super) fn new(outlet: Arc<ClientOutlet>, queue_capacity: usize, payload_max: usize) -> Arc<Self> {
        let pending_max = PENDING_QUEUES * queue_capacity;
        let (pending, may_wait) = (AtomicUsize::new(0), AtomicBool::new(false));
        let waiting_max = queue_capacity;
        Arc::new(Self { outlet, pending, pending_max, waiting_max, payload_max, may_wait })
    }

    /// Returns the receipt of a message of the client. If too many are without an outcome, notifies the client and
    /// returns `None`.
    pub(super) fn receipt(self: &Arc<Self>, ticket: Ticket) -> Option<Receipt> {
        if !self.take_place() {
            self.send(ticket, Outcome::Rejected(Rejection::QueueFull));
            return None;
        }
        Some(Receipt::new(self.clone(), ticket))
    }

    /// Same as [`receipt`](Self::receipt), for a question that is no message: no observer gets its outcome.
    pub(super) fn question_receipt(self: &Arc<Self>, ticket: Ticket) -> Option<Receipt> {
        if !self.take_place() {
            self.answer(Message::outcome(ticket, Outcome::Rejected(Rejection::QueueFull)));
            return None;
        }
        Some(Receipt::new(Arc::new(Questions(self.clone())), ticket))
    }

    /// Counts one more message without an outcome, if there is room.
    fn take_place(&self) -> bool {
        // Only the reader of the client adds to them.
        let has_room = self.pending.load(Ordering::Relaxed) < self.pending_max;
        if has_room {
            self.pending.fetch_add(1, Ordering::Relaxed);
        }
        has_room
    }

    /// Notifies the client of the outcome of a message.
    pub(super) fn send(&self, ticket: Ticket, outcome: Outcome) {
        outcome::show(ticket, outcome);
        self.answer(Message::outcome(ticket, outcome));
    }

    /// Sends the client an answer that it waits for.
    // spec: LNCL-16
    pub(super) fn answer(&self, answer: Message) {
        let Err(refused) = self.outlet.submit(answer) else { return };
        if refused.why == Rejection::QueueFull {
            // All pending outcomes, and those that the last frame added.
            let most = self.pending_max + 2 * self.waiting_max;
            // An error means that the connection has ended.
            let _ = self.outlet.submit_urgent(refused.message, most);
            // SYNC: Release, for `may_come`: a thread that reads this flag also sees the waiting outcomes.
            self.may_wait.store(true, Ordering::Release);
        }
    }

    /// Resolves when few enough answers wait for the client to be read.
    pub(super) async fn wait_for_room(&self) {
        if !self.may_wait.load(Ordering::Relaxed) {
            return;
        }
        // SYNC: Acquire, with the Release in `answer`: outcomes that wait now are counted below, and later ones set the
        // flag again.
        self.may_wait.swap(false, Ordering::Acquire);
        loop {
            let left = self.outlet.urgent_left();
            if left < self.waiting_max {
                if left > 0 {
                    self.may_wait.store(true, Ordering::Relaxed);
                }
                return;
            }
            // The writer notices the end of the connection.
            tokio::time::sleep(CHECK_INTERVAL).await;
        }
    }
}

impl ReceiptSink for Outcomes {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.pending.fetch_sub(1, Ordering::Relaxed);
        self.send(ticket, outcome);
    }

    // spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        outcome::show_members(ticket, reports);
        Message::members(ticket, reports, self.payload_max).for_each(|frame| self.answer(frame));
    }
}

/// The sink of questions of a client that are no messages.
struct Questions(Arc<Outcomes>);

impl ReceiptSink for Questions {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.0.pending.fetch_sub(1, Ordering::Relaxed);
        self.0.answer(Message::outcome(ticket, outcome));
    }
}
