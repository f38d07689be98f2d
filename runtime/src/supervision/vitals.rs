//! Signs of life of one incarnation of an actor: what its thread writes as it goes, what others read, and its fence.
//!
//! The thread writes plain atomics and never reads a clock for it: a turn costs three stores. Whoever looks finds out
//! how long a turn lasts by looking twice.

use std::{
    cell::RefCell,
    fmt,
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use crate::{
    mailbox::Mailbox,
    outcome::{Outcome, Receipt},
    post::lock,
    tid::Tid,
    time::Time,
    wire::Kind,
};

/// What an actor is in the middle of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Doing {
    /// It is made, or its `started` runs.
    Start,
    /// Its handler of a message of this kind runs.
    Message(Kind),
    /// A timer's action or an input watchdog's runs.
    Timer,
    /// A future or a stream of its own runs.
    Task,
    /// Its `stopping` or `stopped` runs.
    Stop,
    /// It is dropped.
    Drop,
    /// It panicked: the panic hook runs, which may look up a whole backtrace, and then destructors.
    Panic,
}

impl Doing {
    /// A number for each; the lower half is the kind.
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

/// What somebody saw who looked at an actor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sight {
    /// Odd while the actor has a turn; another number for each turn.
    pub(super) turn: u64,
    pub(super) doing: Doing,
    /// When the turn began, if the actor knew.
    pub(super) begun: Option<Time>,
}

impl Sight {
    pub(super) const fn is_busy(&self) -> bool {
        self.turn % 2 == 1
    }
}

/// What somebody saw who looked at the others of a thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Neighbours {
    /// One of them is in the middle of a turn.
    pub(super) are_busy: bool,
    /// The sum of the numbers of their turns: another one if any of them had its turn meanwhile.
    pub(super) turns: u64,
}

/// Where an application's messages wait.
struct Inbox {
    mailbox: Arc<Mailbox>,
    /// Which reader of the mailbox this incarnation is.
    epoch: u64,
    kinds: Arc<[(Kind, &'static str)]>,
}

/// The signs of life of one incarnation of an actor.
pub(crate) struct Vitals {
    name: String,
    /// Its address, if it is an application.
    tid: Option<Tid>,
    /// Written by the actor's thread only.
    turn: AtomicU64,
    doing: AtomicU64,
    /// When the turn began, in nanoseconds; 0: not known.
    begun: AtomicU64,
    /// This incarnation is to do nothing any more.
    over: AtomicBool,
    ready: AtomicBool,
    stopping: AtomicBool,
    /// It is gone: nothing of it is left.
    gone: AtomicBool,
    /// Says what became of the message in the actor's hand.
    hand: Mutex<Option<Receipt>>,
    inbox: OnceLock<Inbox>,
    /// What else ends with it at its fence, whatever its thread does.
    at_fence: Mutex<Option<AtFence>>,
}

type AtFence = Box<dyn FnOnce() + Send>;

impl fmt::Debug for Vitals {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Vitals({} {:?})", self.name, self.sight())
    }
}

thread_local! {
    /// The incarnation that has its turn on this thread.
    static PRESENT: RefCell<Option<Arc<Vitals>>> = const { RefCell::new(None) };
}

impl Vitals {
    /// Signs of life of the actor called `name`, before it is made.
    #[must_use]
    pub(crate) fn new(name: impl Into<String>) -> Arc<Self> {
        Self::of(name, None)
    }

    /// The same of an actor that has this address.
    #[must_use]
    pub(crate) fn of(name: impl Into<String>, tid: Option<Tid>) -> Arc<Self> {
        Arc::new(Self {
            name: name.into(),
            tid,
            turn: AtomicU64::new(0),
            doing: AtomicU64::new(Doing::Start.code()),
            begun: AtomicU64::new(0),
            over: AtomicBool::new(false),
            ready: AtomicBool::new(false),
            stopping: AtomicBool::new(false),
            gone: AtomicBool::new(false),
            hand: Mutex::new(None),
            inbox: OnceLock::new(),
            at_fence: Mutex::new(None),
        })
    }

    /// The incarnation that has its turn on the calling thread.
    #[must_use]
    pub(crate) fn present() -> Option<Arc<Self>> {
        PRESENT.try_with(|present| present.borrow().clone()).ok().flatten()
    }

    /// Whether the calling thread is that of an incarnation that is to do nothing any more.
    #[must_use]
    pub(crate) fn is_present_over() -> bool {
        PRESENT.try_with(|present| present.borrow().as_ref().is_some_and(|vitals| vitals.is_over()))
            == Ok(true)
    }

    /// The address of the application that this is, if it is one.
    #[must_use]
    pub(crate) const fn tid(&self) -> Option<Tid> {
        self.tid
    }

    /// The actor's name.
    #[must_use]
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Runs one turn of the actor. `own` is empty meanwhile: this costs no count of references. `run` must not panic.
    pub(super) fn turn<R>(own: &mut Option<Arc<Self>>, doing: Doing, run: impl FnOnce() -> R) -> R {
        if let Some(vitals) = own {
            vitals.begins(doing, None);
        }
        let former = PRESENT.replace(own.take());
        let result = run();
        *own = PRESENT.replace(former);
        if let Some(vitals) = own {
            vitals.rests();
        }
        result
    }

    /// A turn begins, or the next thing in it. On the actor's thread only.
    pub(crate) fn begins(&self, doing: Doing, now: Option<Time>) {
        let next = (self.turn.load(Ordering::Relaxed) + 1) | 1;
        // SYNC: the former turn's begin goes before the number comes, and the number before what is done: whoever sees this
        // number twice sees nothing of the former turn between; pairs with `sight`.
        self.begun.store(0, Ordering::Relaxed);
        self.turn.store(next, Ordering::Release);
        self.doing.store(doing.code(), Ordering::Release);
        self.begun.store(now.map_or(0, Time::as_nanos), Ordering::Release);
    }

    /// It stops by itself. Of a future of its own nobody hears when it has ended: what comes then in this turn is its `stopping`.
    pub(crate) fn stops(&self) {
        if self.sight().doing == Doing::Task {
            self.begins(Doing::Stop, None);
        }
    }

    /// The turn is over.
    fn rests(&self) {
        let next = (self.turn.load(Ordering::Relaxed) + 2) & !1;
        self.turn.store(next, Ordering::Release);
    }

    /// What the actor does now.
    pub(super) fn sight(&self) -> Sight {
        // SYNC: its number before and after: the same number makes what is read between true of that turn; pairs with `begins`.
        let before = self.turn.load(Ordering::Acquire);
        let doing = Doing::from_code(self.doing.load(Ordering::Acquire));
        let begun = self.begun.load(Ordering::Acquire);
        let turn = self.turn.load(Ordering::Acquire);
        let is_known = before == turn && begun > 0;
        Sight { turn, doing, begun: is_known.then(|| Time::from_nanos(begun)) }
    }

    /// What it does, in words.
    pub(super) fn words(&self, doing: Doing) -> String {
        match doing {
            Doing::Start => "in its `started`".to_owned(),
            Doing::Message(kind) => {
                let kinds = self.inbox.get().map_or(&[][..], |inbox| &inbox.kinds);
                match kinds.iter().find(|(known, _)| *known == kind) {
                    Some((_, name)) => format!("in its handler of `{name}`"),
                    None => format!("in its handler of messages of kind {kind}"),
                }
            }
            Doing::Timer => "in a timer".to_owned(),
            Doing::Task => "in a future or stream of its own".to_owned(),
            Doing::Stop => "in its `stopping` or `stopped`".to_owned(),
            Doing::Drop => "in its `drop`".to_owned(),
            Doing::Panic => "in a panic of its own".to_owned(),
        }
    }

    /// From now on this incarnation reads `mailbox` as its reader number `epoch`.
    pub(crate) fn reads(&self, mailbox: Arc<Mailbox>, epoch: u64, kinds: Arc<[(Kind, &'static str)]>) {
        // Only the first counts: an incarnation has one mailbox.
        let _ = self.inbox.set(Inbox { mailbox, epoch, kinds });
    }

    /// Messages that wait for it, and how many were taken out so far; `None` if it has no mailbox, or somebody is in it.
    pub(super) fn backlog(&self) -> Option<(usize, u64)> {
        self.inbox.get()?.mailbox.backlog()
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

    /// Whether it should take messages: it is ready and was not told to stop.
    pub(super) fn should_take(&self) -> bool {
        self.ready.load(Ordering::Relaxed) && !self.stopping.load(Ordering::Relaxed)
    }

    pub(super) fn set_gone(&self) {
        self.gone.store(true, Ordering::Release);
    }

    /// Whether it is on its way out, for which it has more time than to do anything else: it panics, or is gone and its supervisor
    /// has not heard of it.
    pub(super) fn is_leaving(&self) -> bool {
        let sight = self.sight();
        self.is_gone() || (sight.is_busy() && sight.doing == Doing::Panic)
    }

    /// Whether nothing of it is left.
    pub(super) fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Acquire)
    }

    /// Takes the receipt of the message that goes into the actor's hand.
    pub(crate) fn hold(&self, receipt: Receipt) {
        *lock(&self.hand) = Some(receipt);
    }

    /// Says what became of the message in the actor's hand, unless that was said.
    pub(crate) fn settle(&self, outcome: Outcome) {
        let receipt = lock(&self.hand).take();
        if let Some(receipt) = receipt {
            receipt.settle(outcome);
        }
    }

    /// Whether this incarnation is to do nothing any more.
    #[must_use]
    pub(crate) fn is_over(&self) -> bool {
        // SYNC: Relaxed; what was taken from it is under locks of its own.
        self.over.load(Ordering::Relaxed)
    }

    /// From now on it does nothing any more: it sends nothing, takes nothing, and no timer of its fires.
    pub(super) fn fence(&self) {
        self.over.store(true, Ordering::SeqCst);
        let action = lock(&self.at_fence).take();
        if let Some(action) = action {
            action();
        }
    }

    /// Does this at the fence, on the thread that fences: at once if that was before. `action` is short and never panics.
    fn do_at_fence(&self, action: AtFence) {
        *lock(&self.at_fence) = Some(action);
        // The fence may have come between.
        if self.is_over()
            && let Some(action) = lock(&self.at_fence).take()
        {
            action();
        }
    }

    /// Takes what it has in its hand and its place at the mailbox. After the fence; whoever waits is told `Failed`.
    pub(super) fn empty_hands(&self) {
        if let Some(inbox) = self.inbox.get() {
            inbox.mailbox.detach(inbox.epoch);
        }
        self.settle(Outcome::Failed);
    }

    /// Ends the turn here: a hung handler that comes back after all gets no further than its own end. On the actor's thread,
    /// within its turn only; its guard catches it.
    pub(crate) fn leave(&self) -> ! {
        debug_assert!(self.is_over(), "{} may go on", self.name);
        // No panic hook is called: nothing went wrong that has not been said.
        std::panic::resume_unwind(Box::new(Over))
    }
}

/// Does this when the incarnation that has its turn on the calling thread is fenced: its life was taken, and whoever took it
/// does not wait for its thread. Replaces what was to be done before; without an incarnation it is never done. `action` is
/// short and does not panic; it runs on the thread that takes the life.
pub fn at_fence(action: impl FnOnce() + Send + 'static) {
    if let Some(vitals) = Vitals::present() {
        vitals.do_at_fence(Box::new(action));
    }
}

/// Whether the incarnation that has its turn on the calling thread was fenced: it has a successor, or will have one.
#[must_use]
pub fn is_fenced() -> bool {
    Vitals::is_present_over()
}

/// What ends the turn of an incarnation that is to do nothing any more.
pub(super) struct Over;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_turn_has_another_number_that_is_odd_while_it_lasts() {
        let vitals = Vitals::new("test");
        let mut own = Some(vitals.clone());
        assert!(!vitals.sight().is_busy());
        let first = Vitals::turn(&mut own, Doing::Task, || vitals.sight());
        assert!(first.is_busy() && !vitals.sight().is_busy());
        let (second, third) = Vitals::turn(&mut own, Doing::Task, || {
            let second = vitals.sight();
            vitals.begins(Doing::Message(Kind::named("test")), Some(Time::from_nanos(7)));
            (second, vitals.sight())
        });
        assert!(first.turn < second.turn && second.turn < third.turn && third.is_busy());
        assert_eq!(third.doing, Doing::Message(Kind::named("test")));
        assert_eq!((second.begun, third.begun), (None, Some(Time::from_nanos(7))));
    }

    #[test]
    fn every_doing_is_read_as_it_was_written() {
        let message = Doing::Message(Kind::from_bits(u32::MAX));
        let others = [Doing::Start, Doing::Timer, Doing::Task, Doing::Stop, Doing::Drop, Doing::Panic];
        for doing in others.into_iter().chain([message]) {
            assert_eq!(Doing::from_code(doing.code()), doing);
        }
    }

    #[test]
    fn the_present_incarnation_is_known_within_its_turn_only() {
        let vitals = Vitals::new("test");
        let mut own = Some(vitals);
        let seen = Vitals::turn(&mut own, Doing::Start, || Vitals::present().map(|v| v.name().to_owned()));
        assert_eq!(seen.as_deref(), Some("test"));
        assert!(Vitals::present().is_none() && own.is_some());
    }
}
