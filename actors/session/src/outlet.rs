//! The writing half of a connection. Any thread can submit messages to it.
//!
//! The sender's thread writes directly to the socket if the queue is empty, because a hand-over to another
//! thread costs more than the network does. Bytes that the socket does not accept go to a bounded queue. A
//! drain task on the layer's thread continues when the socket is writable again.
//!
//! ```text
//!  submit ──── nothing waits ───────────────────────────► socket
//!     └─ else ► queue (Control, Stream, Bulk) ► drainer ──►─┘
//! ```
//!
//! Messages that arrive faster than single writes can send them are queued, too: the drain task writes many
//! at once (`batch.rs`).
//!
//! One mutex protects the whole state, except messages that await an outcome (`outstanding.rs`). A writer
//! holds the mutex until the system call returns, and the thread that receives outcomes may carry Control.
//! Receipts are never settled and no waker is called under the mutex, because the notified code may submit to
//! the same outlet.

mod account;
mod batch;
mod connection;
mod connections;
mod deferred;
#[cfg_attr(not(target_os = "linux"), path = "outlet/delayed_wake_unsupported.rs")]
mod delayed_wake;
mod draining;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod link_frames;
mod numbering;
mod outcome_run;
mod outcomes;
mod outstanding;
mod partial;
mod progress;
mod queue;
mod sink;
mod socket;
#[cfg(test)]
mod tests;
mod unsent;
mod writer_state;

use std::{
    future::poll_fn,
    io,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, TryLockError,
        atomic::{AtomicU32, AtomicU64, Ordering},
    },
};

use sinew_runtime::{
    mailbox::Budget,
    outcome::{Outcome, Rejection, Ticket},
    router::SubmitError,
    time::Time,
    wire::Message,
};

use crate::{Ack, SendPosition};

pub use account::OutletAccount;
pub use batch::Gathering;
use deferred::DeferredActions;
use draining::Drained;
pub use numbering::Session;
pub use outcome_run::OutcomeRun;
pub use outcomes::{OUTCOMES_MAX, read as read_outcomes};
use outstanding::{OUTCOME_GRACE, Open};
pub use progress::Taking;
pub use socket::{Account, Socket};
pub use unsent::{backlog_key, destination_of};
use writer_state::{Step, WriterState};

/// The bounds of an outlet.
#[derive(Clone, Copy, Debug)]
pub struct OutletLimits {
    /// Maximum number of queued messages, per class. If full, a message is refused with
    /// [`Rejection::QueueFull`].
    pub queue_capacity: usize,
    /// Maximum number of queued payload bytes, per class. A single message of any length may wait. If full, a
    /// message is refused likewise.
    pub queue_bytes: usize,
    /// Maximum number of confirmed messages without a known outcome, queued or sent. With a [`Session`] it
    /// bounds the sent messages of one destination, and is lower if the peer has little room for outcomes. If
    /// full, a message is refused likewise.
    pub unconfirmed_max: usize,
    /// Longest payload in bytes. Longer ones are refused with [`Rejection::TooLong`].
    pub payload_max: usize,
}

/// Counters of the messages submitted to an outlet.
///
/// No message is missing: submitted = sent + superseded + expired + lost + refused + waiting.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutletCounts {
    /// Messages written to a socket up to their last byte.
    pub sent: u64,
    /// Stream messages replaced by a newer one.
    pub superseded: u64,
    /// Messages with a time to live that ended before they were sent.
    pub expired: u64,
    /// Messages that were queued when the outlet was closed.
    pub lost: u64,
    /// Messages returned to their sender.
    pub refused: u64,
}

impl std::ops::Add for OutletCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            sent: self.sent + other.sent,
            superseded: self.superseded + other.superseded,
            expired: self.expired + other.expired,
            lost: self.lost + other.lost,
            refused: self.refused + other.refused,
        }
    }
}

/// The sequence number of one of an outlet's successive connections.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkNumber(u64);

impl LinkNumber {
    /// Returns the number, from 1.
    pub const fn number(self) -> u64 {
        self.0
    }
}

/// The peer's reading half of a connection that has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PeerReadHalf {
    /// No process takes messages any more. The outcome of taken messages is [`Outcome::Failed`]; messages
    /// left in memory were not handled.
    Closed,
    /// A program may still take messages from its memory and handle them. The outcome of all sent
    /// messages is [`Outcome::Unknown`].
    MayBeOpen,
}

/// The writing half of a connection, and its queued messages. It outlives the connection: without one,
/// messages are queued.
pub struct SocketWriter<S> {
    state: Mutex<WriterState<S>>,
    /// Messages that await their outcome, outside that lock.
    open: Arc<Open>,
    /// A lower bound of the queued messages' expiry, in nanoseconds, updated when the lock was last released.
    next_expiry: AtomicU64,
    /// Consecutive expiry checks that found the lock held.
    passed_by: AtomicU32,
}

/// Maximum number of consecutive expiry checks that skip a held lock. The next check waits for the lock.
const PASSED_BY_MAX: u32 = 2;

impl<S: Socket> SocketWriter<S> {
    /// Creates an outlet without a connection.
    pub fn new(limits: OutletLimits) -> Self {
        Self::of(WriterState::new(limits, None, None))
    }

    /// Creates an outlet without a connection. Its queued messages count in a budget that it shares with
    /// other outlets.
    pub fn sharing(limits: OutletLimits, budget: Arc<Budget>) -> Self {
        Self::of(WriterState::new(limits, None, Some(budget)))
    }

    /// Creates an outlet with a session: each message arrives once and in order, over any number of
    /// connections.
    pub fn with_session(limits: OutletLimits, session: Session) -> Self {
        Self::of(WriterState::new(limits, Some(session), None))
    }

    fn of(state: WriterState<S>) -> Self {
        let open = state.receipts.clone();
        let next_expiry = AtomicU64::new(state.unsent.next_expiry().as_nanos());
        Self { state: Mutex::new(state), open, next_expiry, passed_by: AtomicU32::new(0) }
    }

    /// Returns the epoch of the numbers of sent messages; 0 without a session.
    pub fn epoch(&self) -> u64 {
        self.lock().numbering.epoch()
    }

    /// Processes the peer's ACK on `link`, which names the next message that the peer expects. With a
    /// session, nothing is sent on a connection before this. Returns whether a new epoch has begun. Then
    /// nothing is sent before [`acknowledge`](Self::acknowledge) announces the epoch to the peer.
    pub fn on_ack(&self, link: LinkNumber, ack: &Ack, now: Time) -> bool {
        self.with(|state, deferred| state.on_ack(link, ack, now, deferred))
    }

    /// Writes to `socket` from now on: `preface` first, then all queued messages. Requires a drain task:
    /// [`drain`](Self::drain).
    ///
    /// The peer accepts payloads of at most `payload_max` bytes.
    pub fn connect(&self, socket: S, payload_max: usize, preface: Option<Message>) -> LinkNumber {
        self.with(|state, deferred| state.connect(socket, payload_max, preface, deferred))
    }

    /// Whether there is a connection now.
    pub fn is_connected(&self) -> bool {
        self.lock().connection.is_up()
    }

    /// Processes the end of the connection. Messages that were sent and not confirmed get
    /// [`Outcome::Unknown`]; messages that were not sent wait for the next connection. Returns whether the
    /// last frame was written whole.
    pub fn disconnect(&self, link: LinkNumber) -> bool {
        self.with(|state, deferred| state.disconnect(link, deferred))
    }

    /// Same as [`disconnect`](Self::disconnect), for the current connection.
    pub fn cut(&self) {
        self.with(|state, deferred| state.cut(deferred));
    }

    /// Closes the outlet; there will be no further connection. Queued messages get [`Outcome::PeerLost`], and
    /// later submissions are refused with `why`.
    pub fn close(&self, why: Rejection) {
        self.with(|state, deferred| state.close(why, deferred));
    }

    /// Ends the connection without a successor. `peer` determines the outcome of sent messages. Queued
    /// messages and later submissions are refused with [`Rejection::Closed`].
    pub fn end(&self, peer: PeerReadHalf) {
        self.with(|state, deferred| state.end(peer, deferred));
    }

    /// Writes queued messages whenever the socket is writable. Resolves with the reason when this connection
    /// cannot be written to any more. Only one task may run this, on the thread with the socket's reactor.
    pub async fn drain(&self, link: LinkNumber) -> io::Error {
        self.drain_by_turns(link, || ()).await
    }

    /// Same as [`drain`](Self::drain). Calls `end_turn`, without the lock, before it continues with bytes
    /// that it could write at once.
    pub async fn drain_by_turns(&self, link: LinkNumber, end_turn: impl Fn()) -> io::Error {
        loop {
            match poll_fn(|cx| self.with(|state, deferred| state.poll_drain(link, cx, deferred))).await {
                Drained::Over(error) => return error,
                // Other tasks of this thread run now, then newly queued messages are checked.
                Drained::Enough => {
                    end_turn();
                    tokio::task::yield_now().await;
                }
            }
        }
    }

    /// Wakes the task that runs [`drain`](Self::drain), also if nothing is queued.
    pub fn wake_drain(&self) {
        self.with(|state, deferred| state.connection.wake_drainer(deferred));
    }

    /// Sends `last` when the queue is empty. Later submissions are refused with [`Rejection::Closed`].
    pub fn finish(&self, last: Message) {
        self.with(|state, deferred| state.finish(last, deferred));
    }

    /// Same as `submit`, without the bounds. For frames that must be ordered behind all earlier messages; the
    /// caller ensures that they are few.
    ///
    /// # Errors
    /// Returns the frame if there will be no further connection.
    pub fn submit_beyond(&self, message: Message) -> Result<(), SubmitError> {
        self.submit_outcome(message, usize::MAX)
    }

    /// Submits an outcome. The bounds do not apply while fewer than `waiting_max` outcomes are queued.
    ///
    /// # Errors
    /// Returns the frame if too many are queued, or if there will be no further connection.
    pub fn submit_outcome(&self, message: Message, waiting_max: usize) -> Result<(), SubmitError> {
        self.report(|state, deferred| state.submit_outcome(message, waiting_max, deferred))
    }

    /// Reports the outcome of the peer's message of `ticket`. Same as [`submit_outcome`](Self::submit_outcome) of an
    /// outcome sent now. An outcome that continues the last one of the queue is added to that: no message is made
    /// for it, and no clock is read.
    ///
    /// # Errors
    /// Those of `submit_outcome`.
    pub fn report_outcome(
        &self,
        ticket: Ticket,
        outcome: Outcome,
        waiting_max: usize,
    ) -> Result<(), SubmitError> {
        self.report(|state, deferred| {
            if state.extend_outcome(ticket, outcome, deferred) {
                return Ok(Step::Done);
            }
            let mut message = Message::outcome(ticket, outcome);
            message.header.sent = Time::now();
            state.submit_outcome(message, waiting_max, deferred)
        })
    }

    fn report(
        &self,
        submit: impl FnOnce(&mut WriterState<S>, &mut DeferredActions) -> Result<Step, SubmitError>,
    ) -> Result<(), SubmitError> {
        if self.with(submit)? == Step::More {
            self.with(WriterState::hand_to_drainer);
        }
        Ok(())
    }

    /// Submits a frame ahead of the queue, behind earlier urgent frames. At most `waiting_max` are pending.
    ///
    /// # Errors
    /// Returns the frame if there is no connection, or if too many are pending.
    pub fn submit_urgent(&self, message: Message, waiting_max: usize) -> Result<(), SubmitError> {
        self.with(|state, deferred| state.submit_urgent(message, waiting_max, deferred))
    }

    /// Same as [`submit_urgent`](Self::submit_urgent), only for the peer of this connection and not for a
    /// later one.
    ///
    /// # Errors
    /// Returns the frame if that connection has ended, or if too many are pending.
    pub fn submit_urgent_on(
        &self,
        link: LinkNumber,
        message: Message,
        waiting_max: usize,
    ) -> Result<(), SubmitError> {
        self.with(|state, deferred| {
            // The check runs under the lock, so that no other connection can replace this one in between.
            if state.connection.is_present(link) {
                state.submit_urgent(message, waiting_max, deferred)
            } else {
                Err(SubmitError::new(message, Rejection::Closed))
            }
        })
    }

    /// Sends an ACK ahead of all queued messages. `ack` names `epoch` as this outlet's epoch. Returns whether
    /// it does; if a later epoch has begun since, `ack` is not sent. `ack` is not sent either if `link` is
    /// not the number of the current connection, because each connection begins with its own ACK. A peer that
    /// has received a newer ACK would read the older one as a loss of all state.
    pub fn acknowledge(&self, ack: Message, link: u64, epoch: u64) -> bool {
        self.with(|state, deferred| state.acknowledge(ack, LinkNumber(link), epoch, deferred))
    }

    /// Returns the urgent frames that are not completely written. They are dropped with the connection.
    pub fn urgent_left(&self) -> usize {
        self.lock().urgent_left()
    }

    /// Settles queued messages that have expired by `now`. Returns whether any remaining message can expire.
    pub fn expire(&self, now: Time) -> bool {
        let mut deferred = DeferredActions::default();
        self.open.give_up_overdue(now, OUTCOME_GRACE, &mut deferred);
        deferred.run();
        // SYNC: Relaxed; the next call finds entries added since.
        if self.open.len() > 0 && now.as_nanos() <= self.next_expiry.load(Ordering::Relaxed) {
            return true;
        }
        let state = match self.state.try_lock() {
            Ok(state) => state,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            // SYNC: Relaxed; only one thread checks expiry.
            Err(TryLockError::WouldBlock)
                if self.passed_by.fetch_add(1, Ordering::Relaxed) < PASSED_BY_MAX =>
            {
                return true;
            }
            Err(TryLockError::WouldBlock) => self.lock(),
        };
        self.passed_by.store(0, Ordering::Relaxed);
        self.step(state, |state, deferred| state.expire(now, deferred))
    }

    /// Processes the peer's outcome of the message that `ticket` names. Returns whether that message was
    /// pending.
    pub fn confirm(&self, ticket: Ticket, outcome: Outcome) -> bool {
        let mut deferred = DeferredActions::default();
        let was_pending = self.open.confirm(ticket, outcome, &mut deferred);
        deferred.run();
        was_pending
    }

    /// Same as [`confirm`](Self::confirm), for several outcomes under one lock. Runs with messages that were not
    /// pending stay in `outcomes`.
    pub fn confirm_all(&self, outcomes: &mut Vec<OutcomeRun>) {
        if !outcomes.is_empty() {
            let mut deferred = DeferredActions::default();
            self.open.confirm_all(outcomes, &mut deferred);
            deferred.run();
        }
    }

    /// Returns the message counters.
    pub fn counts(&self) -> OutletCounts {
        self.lock().counts()
    }

    /// Returns where each submitted message is, and the position of the session, if there is one.
    pub fn account(&self) -> (OutletAccount, Option<SendPosition>) {
        self.lock().account()
    }

    /// Returns the peer's progress with the messages sent to it; `None` without a connection.
    pub fn taking(&self) -> Option<Taking> {
        self.lock().taking()
    }

    /// Returns the number of written bytes that the peer has not taken; `None` if the socket cannot report them, or
    /// without a connection.
    pub fn unread(&self) -> Option<u64> {
        self.lock().unread()
    }

    /// Returns the number of messages that wait to be sent.
    pub fn waiting(&self) -> usize {
        let state = self.lock();
        state.waiting() + state.unsent.in_backlog()
    }

    /// Returns the number of submitted messages that are not known to have arrived. Meaningful only with a
    /// session.
    pub fn left(&self) -> usize {
        self.lock().left()
    }

    /// Returns the number of application messages among [`left`](Self::left).
    pub fn left_of_applications(&self) -> usize {
        self.lock().left_of_applications()
    }

    /// Returns the number of messages that wait because their destinations accept nothing.
    pub fn in_backlog(&self) -> usize {
        self.lock().unsent.in_backlog()
    }

    /// Returns the number of confirmed messages without a known outcome.
    pub fn unconfirmed(&self) -> usize {
        self.open.len()
    }

    /// Runs `step` under the lock, and its deferred actions after the release.
    fn with<R>(&self, step: impl FnOnce(&mut WriterState<S>, &mut DeferredActions) -> R) -> R {
        self.step(self.lock(), step)
    }

    fn step<R>(
        &self,
        mut state: MutexGuard<'_, WriterState<S>>,
        step: impl FnOnce(&mut WriterState<S>, &mut DeferredActions) -> R,
    ) -> R {
        let mut deferred = DeferredActions::default();
        let result = step(&mut state, &mut deferred);
        self.end_step(state, deferred);
        result
    }

    /// Releases the lock after a step, and runs its deferred actions.
    #[inline]
    fn end_step(&self, mut state: MutexGuard<'_, WriterState<S>>, mut deferred: DeferredActions) {
        if !state.early_outcomes.is_empty() {
            deferred.settle(state.early_outcomes.drain(..));
            state.receipts.wake_if_fewer_open(&mut deferred);
        }
        // SYNC: Relaxed; see `expire`.
        self.next_expiry.store(state.unsent.next_expiry().as_nanos(), Ordering::Relaxed);
        drop(state);
        deferred.run();
    }

    /// Locks the state. No section under this lock can panic halfway, so the state is always consistent.
    fn lock(&self) -> MutexGuard<'_, WriterState<S>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
