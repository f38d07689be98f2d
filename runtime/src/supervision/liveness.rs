//! The liveness state of one incarnation of an actor, written by its thread and read by others, and its fence.
//!
//! The thread writes plain atomics: a turn costs three stores. It reads a clock for them only while the watchdog
//! checks rarely. An observer reads the state twice to measure the duration of a turn.

use std::{
    cell::RefCell,
    fmt,
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use crate::{
    lock,
    mailbox::{Backlog, Mailbox},
    outcome::{Outcome, Receipt},
    tid::Tid,
    time::Time,
    wire::Kind,
};

/// The activity of an actor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Activity {
    /// The actor is created, or its `started` runs.
    Start,
    /// The handler of a message of this kind runs.
    Message(Kind),
    /// The action of a timer or of an input watchdog runs.
    Timer,
    /// A future or a stream of the actor runs.
    Task,
    /// The actor's `stopping` or `stopped` runs.
    Stop,
    /// The actor is dropped.
    Drop,
    /// The actor panicked: the panic hook runs, which may resolve a whole backtrace, and then destructors.
    Panic,
}

impl Activity {
    /// Returns the code of the activity; the lower half is the kind.
    const fn code(self) -> u64 {
        match self {
            Self::Message(kind) => kind.bits() as u64,
            Self::Start => 1 << 32,
            Self::Timer => 2 << 32,
            Self::Task => 3 << 32,
            Self::Stop => 4 << 32,
            Self::Drop => 5 << 32,
            Self::Panic => 6 << 32,
        }
    }

    const fn from_code(code: u64) -> Self {
        match code >> 32 {
            0 => Self::Message(Kind::from_bits(code as u32)),
            1 => Self::Start,
            2 => Self::Timer,
            4 => Self::Stop,
            5 => Self::Drop,
            6 => Self::Panic,
            _ => Self::Task,
        }
    }
}

/// A snapshot of an actor's activity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ActivitySnapshot {
    /// The number of the turn, different for each turn; odd while the turn is in progress.
    pub(super) turn: u64,
    pub(super) activity: Activity,
    /// When the turn began, if the actor recorded it.
    pub(super) begun: Option<Time>,
}

impl ActivitySnapshot {
    pub(super) const fn is_busy(&self) -> bool {
        self.turn % 2 == 1
    }
}

/// A snapshot of the other actors on a thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Neighbours {
    /// Whether one of them has a turn in progress.
    pub(super) are_busy: bool,
    /// The sum of their turn numbers: it changes if any of them has had a turn.
    pub(super) turns: u64,
}

/// The inbox of an application.
struct Inbox {
    mailbox: Arc<Mailbox>,
    /// The reader number of this incarnation at the mailbox.
    epoch: u64,
    kinds: Arc<[(Kind, &'static str)]>,
}

/// The liveness state of one incarnation of an actor.
pub(crate) struct Liveness {
    name: String,
    /// The address of the actor, if it is an application.
    tid: Option<Tid>,
    /// Written by the actor's thread only.
    turn: AtomicU64,
    activity: AtomicU64,
    /// When the turn began, in nanoseconds; 0: unknown.
    begun: AtomicU64,
    /// Whether the start of each turn is recorded. Written by the watchdog only.
    records_begin: AtomicBool,
    /// Whether this incarnation is fenced: it must do nothing any more.
    fenced: AtomicBool,
    ready: AtomicBool,
    stopping: AtomicBool,
    /// Whether the incarnation has ended and was dropped.
    ended: AtomicBool,
    /// The receipt of the message that the actor is handling.
    receipt: Mutex<Option<Receipt>>,
    inbox: OnceLock<Inbox>,
    /// A further action at the fence, independent of the actor's thread.
    at_fence: Mutex<Option<AtFence>>,
}

type AtFence = Box<dyn FnOnce() + Send>;

impl fmt::Debug for Liveness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Liveness({} {:?})", self.name, self.snapshot())
    }
}

thread_local! {
    /// The incarnation that has its turn on this thread.
    static CURRENT: RefCell<Option<Arc<Liveness>>> = const { RefCell::new(None) };
}

impl Liveness {
    /// Creates the state of the actor called `name`, before the actor is created.
    #[must_use]
    pub(crate) fn new(name: impl Into<String>) -> Arc<Self> {
        Self::of(name, None)
    }

    /// Same as [`new`](Self::new), for an actor with this address.
    #[must_use]
    pub(crate) fn of(name: impl Into<String>, tid: Option<Tid>) -> Arc<Self> {
        Arc::new(Self {
            name: name.into(),
            tid,
            turn: AtomicU64::new(0),
            activity: AtomicU64::new(Activity::Start.code()),
            begun: AtomicU64::new(0),
            records_begin: AtomicBool::new(false),
            fenced: AtomicBool::new(false),
            ready: AtomicBool::new(false),
            stopping: AtomicBool::new(false),
            ended: AtomicBool::new(false),
            receipt: Mutex::new(None),
            inbox: OnceLock::new(),
            at_fence: Mutex::new(None),
        })
    }

    /// Returns the incarnation that has its turn on the calling thread.
    #[must_use]
    pub(crate) fn current() -> Option<Arc<Self>> {
        CURRENT.try_with(|current| current.borrow().clone()).ok().flatten()
    }

    /// Returns whether the incarnation on the calling thread is fenced.
    #[must_use]
    pub(crate) fn is_current_fenced() -> bool {
        CURRENT.try_with(|current| current.borrow().as_ref().is_some_and(|liveness| liveness.is_fenced()))
            == Ok(true)
    }

    /// Returns the address of the actor, if it is an application.
    #[must_use]
    pub(crate) const fn tid(&self) -> Option<Tid> {
        self.tid
    }

    /// Returns the name of the actor.
    #[must_use]
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Runs one turn of the actor. `own` is moved out meanwhile, which saves a reference count. `run` must not panic.
    pub(super) fn turn<R>(own: &mut Option<Arc<Self>>, activity: Activity, run: impl FnOnce() -> R) -> R {
        if let Some(liveness) = own {
            liveness.begin(activity, None);
        }
        let former = CURRENT.replace(own.take());
        let result = run();
        *own = CURRENT.replace(former);
        if let Some(liveness) = own {
            liveness.end_turn();
        }
        result
    }

    /// Records the start of a turn, or of the next step in it. On the actor's thread only.
    #[inline]
    pub(crate) fn begin(&self, activity: Activity, now: Option<Time>) {
        let next = (self.turn.load(Ordering::Relaxed) + 1) | 1;
        // SYNC: the previous `begun` is cleared before the new number is stored, and the number before the
        // activity. A reader that sees this number twice sees no value of the previous turn between; pairs
        // with `snapshot`.
        self.begun.store(0, Ordering::Relaxed);
        self.turn.store(next, Ordering::Release);
        self.activity.store(activity.code(), Ordering::Release);
        let begun = match now {
            Some(now) => now.as_nanos(),
            // SYNC: Relaxed; see `set_records`.
            None if self.records_begin.load(Ordering::Relaxed) => Time::now().as_nanos(),
            None => 0,
        };
        self.begun.store(begun, Ordering::Release);
    }

    /// Records that the actor stops itself. The end of its own future is not visible here, so the rest of
    /// this turn counts as its `stopping`.
    pub(crate) fn record_stop(&self) {
        if self.snapshot().activity == Activity::Task {
            self.begin(Activity::Stop, None);
        }
    }

    /// Records the end of the turn.
    fn end_turn(&self) {
        let next = (self.turn.load(Ordering::Relaxed) + 2) & !1;
        self.turn.store(next, Ordering::Release);
    }

    /// Returns the current activity of the actor.
    pub(super) fn snapshot(&self) -> ActivitySnapshot {
        // SYNC: the number is read before and after. Equal numbers mean that the values between belong to
        // that turn; pairs with `begin`.
        let before = self.turn.load(Ordering::Acquire);
        let activity = Activity::from_code(self.activity.load(Ordering::Acquire));
        let begun = self.begun.load(Ordering::Acquire);
        let turn = self.turn.load(Ordering::Acquire);
        let is_known = before == turn && begun > 0;
        ActivitySnapshot { turn, activity, begun: is_known.then(|| Time::from_nanos(begun)) }
    }

    /// Returns the text for an activity.
    pub(super) fn describe(&self, activity: Activity) -> String {
        match activity {
            Activity::Start => "in its `started`".to_owned(),
            Activity::Message(kind) => {
                let kinds = self.inbox.get().map_or(&[][..], |inbox| &inbox.kinds);
                match kinds.iter().find(|(known, _)| *known == kind) {
                    Some((_, name)) => format!("in its handler of `{name}`"),
                    None => format!("in its handler of messages of kind {kind}"),
                }
            }
            Activity::Timer => "in a timer".to_owned(),
            Activity::Task => "in a future or stream of its own".to_owned(),
            Activity::Stop => "in its `stopping` or `stopped`".to_owned(),
            Activity::Drop => "in its `drop`".to_owned(),
            Activity::Panic => "in a panic of its own".to_owned(),
        }
    }

    /// Connects this incarnation to `mailbox` as reader number `epoch`.
    pub(crate) fn attach_mailbox(
        &self,
        mailbox: Arc<Mailbox>,
        epoch: u64,
        kinds: Arc<[(Kind, &'static str)]>,
    ) {
        // Only the first call has an effect: an incarnation has one mailbox.
        let _ = self.inbox.set(Inbox { mailbox, epoch, kinds });
    }

    /// Returns the messages that wait. Returns `None` without a mailbox, or if it is locked.
    pub(super) fn backlog(&self) -> Option<Backlog> {
        self.inbox.get()?.mailbox.backlog()
    }

    /// Sets whether the start of each turn is recorded, and since when messages wait. Called by the watchdog.
    pub(super) fn set_records(&self, records: bool) {
        // SYNC: Relaxed; the watchdog checks once more, some milliseconds later, before it relies on records. By then
        // the flag is visible, and so is a turn that began without seeing it.
        self.records_begin.store(records, Ordering::Relaxed);
        if let Some(inbox) = self.inbox.get() {
            inbox.mailbox.set_records_waits(records);
        }
    }

    /// Returns whether it can be recorded since when messages wait.
    pub(super) fn can_record(&self) -> bool {
        self.inbox.get().is_none_or(|inbox| inbox.mailbox.can_record_waits())
    }

    pub(super) fn set_ready(&self) {
        self.ready.store(true, Ordering::Relaxed);
    }

    pub(super) fn set_stopping(&self) {
        self.stopping.store(true, Ordering::Relaxed);
    }

    pub(super) fn is_ready(&self) -> bool {
        self.ready.load(Ordering::Relaxed)
    }

    /// Returns whether the actor should take messages: it is ready and was not ordered to stop.
    pub(super) fn should_take(&self) -> bool {
        self.ready.load(Ordering::Relaxed) && !self.stopping.load(Ordering::Relaxed)
    }

    pub(super) fn set_ended(&self) {
        self.ended.store(true, Ordering::Release);
    }

    /// Returns whether the actor is ending, for which it has more time than for a turn: it panics, or has
    /// ended and its report has not reached its supervisor.
    pub(super) fn is_ending(&self) -> bool {
        let snapshot = self.snapshot();
        self.has_ended() || (snapshot.is_busy() && snapshot.activity == Activity::Panic)
    }

    /// Returns whether the incarnation has ended and was dropped.
    pub(super) fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Acquire)
    }

    /// Stores the receipt of the message that the actor will handle.
    pub(crate) fn hold_receipt(&self, receipt: Receipt) {
        *lock(&self.receipt) = Some(receipt);
    }

    /// Settles the message that the actor is handling, unless it is settled.
    pub(crate) fn settle(&self, outcome: Outcome) {
        let receipt = lock(&self.receipt).take();
        if let Some(receipt) = receipt {
            receipt.settle(outcome);
        }
    }

    /// Returns whether this incarnation is fenced.
    #[must_use]
    pub(crate) fn is_fenced(&self) -> bool {
        // SYNC: Relaxed; the state that is taken away at the fence has its own locks.
        self.fenced.load(Ordering::Relaxed)
    }

    /// Fences the incarnation: from now on it sends nothing, takes no message, and none of its timers fires.
    pub(super) fn fence(&self) {
        self.fenced.store(true, Ordering::SeqCst);
        let action = lock(&self.at_fence).take();
        if let Some(action) = action {
            action();
        }
    }

    /// Runs `action` at the fence, on the fencing thread, or at once if the fence was before. `action` must
    /// be short and must not panic.
    fn do_at_fence(&self, action: AtFence) {
        *lock(&self.at_fence) = Some(action);
        // The fence may have come between.
        if self.is_fenced()
            && let Some(action) = lock(&self.at_fence).take()
        {
            action();
        }
    }

    /// Takes its current message and its place at the mailbox, after the fence. The sender of that message
    /// gets `Failed`.
    pub(super) fn release_inbox(&self) {
        if let Some(inbox) = self.inbox.get() {
            inbox.mailbox.detach(inbox.epoch);
        }
        self.settle(Outcome::Failed);
    }

    /// Ends the turn here: a hung handler that returns cannot continue. On the actor's thread, within its
    /// turn only; its guard catches the unwind.
    pub(crate) fn unwind_turn(&self) -> ! {
        debug_assert!(self.is_fenced(), "{} may go on", self.name);
        // No panic hook is called: the fault was reported before.
        std::panic::resume_unwind(Box::new(FencedUnwind))
    }
}

/// Runs `action` when the incarnation on the calling thread is fenced: it was abandoned, and its thread is
/// not waited for. Replaces an earlier action; without an incarnation it never runs. `action` must be short
/// and must not panic; it runs on the fencing thread.
pub fn at_fence(action: impl FnOnce() + Send + 'static) {
    if let Some(liveness) = Liveness::current() {
        liveness.do_at_fence(Box::new(action));
    }
}

/// Returns whether the incarnation on the calling thread is fenced: it has a successor, or will have one.
#[must_use]
pub fn is_fenced() -> bool {
    Liveness::is_current_fenced()
}

/// The unwind payload that ends the turn of a fenced incarnation.
pub(super) struct FencedUnwind;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_turn_has_a_new_odd_number() {
        let liveness = Liveness::new("test");
        let mut own = Some(liveness.clone());
        assert!(!liveness.snapshot().is_busy());
        let first = Liveness::turn(&mut own, Activity::Task, || liveness.snapshot());
        assert!(first.is_busy() && !liveness.snapshot().is_busy());
        let (second, third) = Liveness::turn(&mut own, Activity::Task, || {
            let second = liveness.snapshot();
            liveness.begin(Activity::Message(Kind::named("test")), Some(Time::from_nanos(7)));
            (second, liveness.snapshot())
        });
        assert!(first.turn < second.turn && second.turn < third.turn && third.is_busy());
        assert_eq!(third.activity, Activity::Message(Kind::named("test")));
        assert_eq!((second.begun, third.begun), (None, Some(Time::from_nanos(7))));
    }

    #[test]
    fn start_of_each_turn_is_recorded_on_request() {
        let liveness = Liveness::new("test");
        let mut own = Some(liveness.clone());
        let mut begun = || Liveness::turn(&mut own, Activity::Task, || liveness.snapshot().begun);
        assert_eq!(begun(), None);
        liveness.set_records(true);
        let before = Time::now();
        assert!(begun().is_some_and(|begun| begun >= before));
        liveness.set_records(false);
        assert_eq!(begun(), None);
    }

    #[test]
    fn every_activity_round_trips() {
        let message = Activity::Message(Kind::from_bits(u32::MAX));
        let others = [
            Activity::Start,
            Activity::Timer,
            Activity::Task,
            Activity::Stop,
            Activity::Drop,
            Activity::Panic,
        ];
        for activity in others.into_iter().chain([message]) {
            assert_eq!(Activity::from_code(activity.code()), activity);
        }
    }

    #[test]
    fn present_incarnation_is_known_within_its_turn_only() {
        let liveness = Liveness::new("test");
        let mut own = Some(liveness);
        let seen =
            Liveness::turn(&mut own, Activity::Start, || Liveness::current().map(|v| v.name().to_owned()));
        assert_eq!(seen.as_deref(), Some("test"));
        assert!(Liveness::current().is_none() && own.is_some());
    }
}
