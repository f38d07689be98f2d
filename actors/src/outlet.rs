//! The writing half of a connection, which any thread submits messages to.
//!
//! The sender's own thread writes to the socket when nothing is queued before it: handing a message over to another
//! thread costs more than the network does. What the socket does not take goes to a bounded queue, and a drainer on
//! the layer's thread goes on when the socket is writable again.
//!
//! ```text
//!  submit ──── nothing waits ───────────────────────────► socket
//!     └─ else ► queue (Control, Stream, Bulk) ► drainer ──►─┘
//! ```
//!
//! Messages that come faster than a write each would carry them wait, too: the drainer writes many at once (`batch.rs`).
//!
//! All of it stands under one mutex, but for what waits for its outcome (`outstanding.rs`): whoever writes holds it for as long as the system
//! lets him, and who hears of outcomes may carry Control. Receipts are never settled and nobody is woken with it in hand, because whoever is
//! told may submit to this very outlet.

mod account;
mod after;
mod batch;
mod draining;
mod expiry;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod half;
mod held;
mod outcomes;
mod outstanding;
mod partial;
mod resume;
#[cfg_attr(not(target_os = "linux"), path = "outlet/rouser_elsewhere.rs")]
mod rouser;
#[cfg(test)]
mod tests;
mod waiting;

use std::{
    future::poll_fn,
    io::{self, IoSlice},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, TryLockError,
        atomic::{AtomicU32, AtomicU64, Ordering},
    },
    task::{Context, Poll, Waker},
};

use sinew_runtime::{
    mailbox::Budget,
    outcome::{Outcome, Rejection, Ticket},
    router::{Outlet, Refused},
    time::Time,
    wire::{Checksum, Message},
};
use tokio::net::UnixStream;

use crate::session::{Ack, Sent};

pub(crate) use account::{OutletAccount, Taking};
use after::After;
pub(crate) use batch::Gathering;
use draining::Drained;
use expiry::OUTCOME_GRACE;
use half::{Bound, Half, Step};
pub(crate) use held::{destination_of, line_of};
pub(crate) use outcomes::{OUTCOMES_MAX, read as read_outcomes};
use outstanding::Open;
pub(crate) use resume::Session;

/// A non-blocking socket, or what is like one, that can be written to from any thread.
pub(crate) trait Socket: Send + 'static {
    /// What its frames have for a checksum.
    fn checksum(&self) -> Checksum {
        Checksum::Crc
    }

    /// Bytes of a payload that are written at once, with the outlet locked: whoever else needs it waits that long.
    fn piece_max(&self) -> usize {
        usize::MAX
    }

    /// Writes what the socket takes at once, from the first byte of `parts` on.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if it takes nothing now; anything else ends the connection.
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize>;

    /// Bytes that were ever written, as [`account`](Self::account) counts them: cheap, the peer's count is not looked at.
    fn written(&self) -> u64 {
        0
    }

    /// Bytes that were ever written and bytes that the peer has taken, in one count, where that can be known.
    fn account(&mut self) -> Account {
        Account { written: 0, taken: u64::MAX }
    }

    /// Whether it gathers frames, to write many at once.
    fn gathers(&self) -> bool {
        false
    }

    /// Keeps a copy of a whole frame, to be written behind what was gathered before. Returns whether there was room.
    fn gather(&mut self, parts: &[IoSlice<'_>]) -> bool {
        let _ = parts;
        false
    }

    /// Gathered bytes that are not written. While there are any, nothing else is written.
    fn gathered(&self) -> usize {
        0
    }

    /// Writes of what was gathered what the socket takes at once.
    ///
    /// # Errors
    /// As [`try_write_vectored`](Self::try_write_vectored).
    fn write_gathered(&mut self) -> io::Result<usize> {
        Ok(0)
    }

    /// Has the drainer woken in a moment, with what else has come by then. Returns whether it will be; if not, it is to be woken now.
    fn rouse_later(&mut self) -> bool {
        false
    }

    /// The drainer is awake, and is to be woken when [`rouse_later`](Self::rouse_later) says so.
    fn poll_roused(&mut self, cx: &mut Context<'_>) {
        let _ = cx;
    }

    /// Ready when the socket may take something. For one task only: the drainer.
    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>>;
}

/// How far the peer has come with what was written. A frame that was written before `taken` may have been handled; one
/// after it was not.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Account {
    pub(crate) written: u64,
    pub(crate) taken: u64,
}

impl Socket for Arc<UnixStream> {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        UnixStream::try_write_vectored(self, parts)
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.poll_write_ready(cx)
    }
}

/// The bounds of an outlet.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OutletLimits {
    /// Messages that wait at most, each class by itself. When full: refused with [`Rejection::QueueFull`].
    pub(crate) queue_capacity: usize,
    /// Bytes of their payloads at most, each class by itself; one message waits however long it is. When full: likewise.
    pub(crate) queue_bytes: usize,
    /// Confirmed messages at most whose outcome is not known yet, waiting or sent; with a [`Session`] those of one destination that were sent, and
    /// fewer where its peer has little room for outcomes. When full: refused likewise.
    pub(crate) unconfirmed_max: usize,
    /// Longest payload in bytes. Longer ones are refused with [`Rejection::TooLong`].
    pub(crate) payload_max: usize,
}

/// What became of the messages that an outlet was given.
///
/// Nothing leaks: submitted = sent + superseded + expired + lost + refused + waiting.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutletCounts {
    /// Written to a socket to their last byte.
    pub sent: u64,
    /// Stream messages whose place a newer one took.
    pub superseded: u64,
    /// Their time to live ran out before they were sent.
    pub expired: u64,
    /// They waited when the outlet was closed.
    pub lost: u64,
    /// Handed back to their sender.
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

/// Which of an outlet's connections, one after the other, something is about.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct LinkNumber(u64);

impl LinkNumber {
    /// The n-th, from 1.
    pub(crate) const fn number(self) -> u64 {
        self.0
    }
}

/// Who is left at the other end of a connection that is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Left {
    /// Nobody takes anything any more: what was taken is [`Outcome::Failed`], and what lay in memory undelivered was not handled.
    Nobody,
    /// A program that may take what lies in its memory yet, and handle it: all that was sent is [`Outcome::Unknown`].
    Somebody,
}

/// The writing half of a connection, and the messages that wait for it. It outlives the connection: while there is
/// none, messages wait.
pub(crate) struct StreamOutlet<S> {
    half: Mutex<Half<S>>,
    /// What waits for its outcome, without that lock.
    open: Arc<Open>,
    /// No waiting message expires before this, in nanoseconds, as was known when the lock was free last.
    next_expiry: AtomicU64,
    /// How often in a row the lock was not free when it was looked for what has expired.
    passed_by: AtomicU32,
}

/// So often in a row it is not waited for somebody who writes when it is looked for what has expired. The next time it is.
const PASSED_BY_MAX: u32 = 2;

impl<S: Socket> StreamOutlet<S> {
    /// An outlet without a connection.
    pub(crate) fn new(limits: OutletLimits) -> Self {
        Self::of(Half::new(limits, None))
    }

    /// An outlet without a connection, whose waiting messages count in a budget that it shares with others.
    pub(crate) fn sharing(limits: OutletLimits, budget: Arc<Budget>) -> Self {
        let mut half = Half::new(limits, None);
        half.share(budget);
        Self::of(half)
    }

    /// An outlet whose messages arrive once and in order, however many connections it takes.
    pub(crate) fn with_session(limits: OutletLimits, session: Session) -> Self {
        Self::of(Half::new(limits, Some(session)))
    }

    fn of(half: Half<S>) -> Self {
        let open = half.receipts.clone();
        let next_expiry = AtomicU64::new(half.next_expiry.as_nanos());
        Self { half: Mutex::new(half), open, next_expiry, passed_by: AtomicU32::new(0) }
    }

    /// The epoch in which it counts what it sends; 0 without a session.
    pub(crate) fn epoch(&self) -> u64 {
        self.lock().epoch()
    }

    /// The peer has said on `link` what it takes next; with a session, nothing goes out on a connection before this.
    /// Returns whether an epoch has begun with it: then nothing goes out before the peer is told so, by [`acknowledge`](Self::acknowledge).
    pub(crate) fn heard(&self, link: LinkNumber, ack: &Ack, now: Time) -> bool {
        self.with(|half, after| half.heard(link, ack, now, after))
    }

    /// Writes to `socket` from now on: `preface` first, then all that waits. Needs a drainer: [`drain`](Self::drain).
    ///
    /// The peer takes payloads of `payload_max` bytes at most.
    pub(crate) fn connect(&self, socket: S, payload_max: usize, preface: Option<Message>) -> LinkNumber {
        self.with(|half, after| half.connect(socket, payload_max, preface, after))
    }

    /// Whether there is a connection now.
    pub(crate) fn is_connected(&self) -> bool {
        self.lock().is_connected()
    }

    /// The connection has ended. What was sent and not confirmed has the outcome [`Outcome::Unknown`]; what was not
    /// sent waits for the next connection. Returns whether the last frame was written whole.
    pub(crate) fn disconnect(&self, link: LinkNumber) -> bool {
        self.with(|half, after| half.disconnect(link, after))
    }

    /// Like [`disconnect`](Self::disconnect), whichever connection it is.
    pub(crate) fn cut(&self) {
        self.with(|half, after| half.cut(after));
    }

    /// There will be no further connection: what waits has the outcome [`Outcome::PeerLost`], and what is submitted
    /// from now on is refused because of `why`.
    pub(crate) fn close(&self, why: Rejection) {
        self.with(|half, after| half.close(why, after));
    }

    /// The connection is over, and nothing takes its place: what was sent ends by who is `left` at the other end; what waits, and what is
    /// submitted from now on, is refused as [`Rejection::Closed`].
    pub(crate) fn end(&self, left: Left) {
        self.with(|half, after| half.end(left, after));
    }

    /// Writes what waits whenever the socket takes it. Resolves when this connection cannot be written to any more,
    /// with the reason. To be run by one task, on the thread whose reactor the socket belongs to.
    pub(crate) async fn drain(&self, link: LinkNumber) -> io::Error {
        self.drain_by_turns(link, || ()).await
    }

    /// The same; calls `end_turn` before it goes on with what it could write at once, without a lock in hand.
    pub(crate) async fn drain_by_turns(&self, link: LinkNumber, end_turn: impl Fn()) -> io::Error {
        loop {
            match poll_fn(|cx| self.with(|half, after| half.poll_drain(link, cx, after))).await {
                Drained::Over(error) => return error,
                // Others of this thread have their turn, and what has come meanwhile is looked at.
                Drained::Enough => {
                    end_turn();
                    tokio::task::yield_now().await;
                }
            }
        }
    }

    /// Sends `last` when nothing waits any more, and takes nothing from now on: [`Rejection::Closed`].
    pub(crate) fn finish(&self, last: Message) {
        self.with(|half, after| half.finish(last, after));
    }

    /// As `submit`, whatever the bounds: for frames whose place behind all that was taken before counts, and of which the
    /// caller sees to it that they are few.
    ///
    /// # Errors
    /// The frame: there will be no further connection.
    pub(crate) fn submit_beyond(&self, message: Message) -> Result<(), Refused> {
        self.submit_outcome(message, usize::MAX)
    }

    /// The same of an outcome, as long as fewer than `waiting_max` outcomes wait, whatever else does; then the bounds hold.
    ///
    /// # Errors
    /// The frame: too many wait, or there will be no further connection.
    pub(crate) fn submit_outcome(&self, message: Message, waiting_max: usize) -> Result<(), Refused> {
        let step = self.with(|half, after| {
            let is_waived = half.queue.outcomes() < waiting_max;
            half.submit(message, if is_waived { Bound::Waived } else { Bound::Kept }, after)
        })?;
        if step == Step::More {
            self.with(Half::hand_to_drainer);
        }
        Ok(())
    }

    /// Takes a frame that goes ahead of all that waits, behind those taken so before it. At most `waiting_max` wait.
    ///
    /// # Errors
    /// The frame: there is no connection, or too many wait.
    pub(crate) fn submit_urgent(&self, message: Message, waiting_max: usize) -> Result<(), Refused> {
        self.with(|half, after| half.submit_urgent(message, waiting_max, after))
    }

    /// As [`submit_urgent`](Self::submit_urgent), for whoever is behind this connection and nobody after it.
    ///
    /// # Errors
    /// The frame: that connection has ended, or too many wait.
    pub(crate) fn submit_urgent_on(
        &self,
        link: LinkNumber,
        message: Message,
        waiting_max: usize,
    ) -> Result<(), Refused> {
        self.with(|half, after| {
            // Under the lock, so that no other connection takes its place in between.
            if half.is_present(link) {
                half.submit_urgent(message, waiting_max, after)
            } else {
                Err(Refused::new(message, Rejection::Closed))
            }
        })
    }

    /// Says what was taken, ahead of all that waits: `ack` names `epoch` as that in which this outlet counts. Returns whether it does; if a
    /// later one has begun since, `ack` is not said. Nor is it if the n-th connection, `link`, is not the present one: each begins with
    /// another, and to one that is older than what the peer has heard it would say that all was forgotten.
    pub(crate) fn acknowledge(&self, ack: Message, link: u64, epoch: u64) -> bool {
        self.with(|half, after| half.acknowledge(ack, LinkNumber(link), epoch, after))
    }

    /// Urgent frames that the socket has not taken to their last byte. They end with the connection.
    pub(crate) fn urgent_left(&self) -> usize {
        self.lock().urgent_left()
    }

    /// Settles what has expired by `now` while it waited. Returns whether anything is left that can expire.
    pub(crate) fn expire(&self, now: Time) -> bool {
        let mut after = After::default();
        self.open.give_up_overdue(now, OUTCOME_GRACE, &mut after);
        after.run();
        // SYNC: Relaxed; what was put there since is found the next time.
        if self.open.len() > 0 && now.as_nanos() <= self.next_expiry.load(Ordering::Relaxed) {
            return true;
        }
        let half = match self.half.try_lock() {
            Ok(half) => half,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            // SYNC: Relaxed; one thread looks.
            Err(TryLockError::WouldBlock)
                if self.passed_by.fetch_add(1, Ordering::Relaxed) < PASSED_BY_MAX =>
            {
                return true;
            }
            Err(TryLockError::WouldBlock) => self.lock(),
        };
        self.passed_by.store(0, Ordering::Relaxed);
        self.step(half, |half, after| half.expire(now, after))
    }

    /// The peer says what became of the message that `ticket` names. Returns whether that message was waited for.
    pub(crate) fn confirm(&self, ticket: Ticket, outcome: Outcome) -> bool {
        let mut after = After::default();
        let is_waited_for = self.open.confirm(ticket, outcome, &mut after);
        after.run();
        is_waited_for
    }

    /// The same of several, in one go; those that were not waited for are left.
    pub(crate) fn confirm_all(&self, outcomes: &mut Vec<(Ticket, Outcome)>) {
        if !outcomes.is_empty() {
            let mut after = After::default();
            self.open.confirm_all(outcomes, &mut after);
            after.run();
        }
    }

    /// What became of the messages so far.
    pub(crate) fn counts(&self) -> OutletCounts {
        self.lock().counts()
    }

    /// Where every message is that it has taken, and how far its session is, if it has one.
    pub(crate) fn account(&self) -> (OutletAccount, Option<Sent>) {
        self.lock().account()
    }

    /// How far the peer has come with what it was sent; `None` without a connection.
    pub(crate) fn taking(&self) -> Option<Taking> {
        self.lock().taking()
    }

    /// Messages that wait to be sent.
    pub(crate) fn waiting(&self) -> usize {
        let half = self.lock();
        half.waiting() + half.in_lines()
    }

    /// Messages that were taken and have not arrived, as far as is known here; only where there is a session.
    pub(crate) fn left(&self) -> usize {
        self.lock().left()
    }

    /// Those of applications among these.
    pub(crate) fn left_of_applications(&self) -> usize {
        self.lock().left_of_applications()
    }

    /// Messages that wait because their destinations take nothing.
    #[cfg(test)]
    pub(crate) fn in_lines(&self) -> usize {
        self.lock().in_lines()
    }

    /// Confirmed messages whose outcome is not known yet.
    pub(crate) fn unconfirmed(&self) -> usize {
        self.open.len()
    }

    /// Runs `step` under the lock, and what it puts off after it.
    fn with<R>(&self, step: impl FnOnce(&mut Half<S>, &mut After) -> R) -> R {
        self.step(self.lock(), step)
    }

    fn step<R>(
        &self,
        mut half: MutexGuard<'_, Half<S>>,
        step: impl FnOnce(&mut Half<S>, &mut After) -> R,
    ) -> R {
        let mut after = After::default();
        let result = step(&mut half, &mut after);
        if !half.said.is_empty() {
            after.settle(half.said.drain(..));
            half.receipts.fewer_are_open(&mut after);
        }
        // SYNC: Relaxed; see `expire`.
        self.next_expiry.store(half.next_expiry.as_nanos(), Ordering::Relaxed);
        drop(half);
        after.run();
        result
    }

    /// No section under this lock can panic half way: all of them leave it whole.
    fn lock(&self) -> MutexGuard<'_, Half<S>> {
        self.half.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<S: Socket> Outlet for StreamOutlet<S> {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        let mut step = self.with(|half, after| half.submit(message, Bound::Kept, after))?;
        while step == Step::More {
            step = self.with(|half, after| half.write_on(after));
        }
        Ok(())
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), Refused> {
        let result = self.submit(message);
        if let Err(Refused { message, why: Rejection::QueueFull }) = &result {
            self.with(|half, after| half.is_offered_again(message, room, after));
        }
        result
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        self.with(|half, after| half.cancel(ticket, after))
    }
}
