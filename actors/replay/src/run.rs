//! The thread of a replay: it runs all applications until they are idle, then moves the clock.

use std::{
    iter::Peekable,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    task::{Context, Poll, Wake, Waker},
    time::Duration,
};

use sinew_runtime::{
    clock::VirtualTime,
    supervision::{Launch, PolledActor, ReadyGate, Reason},
    tid::Tid,
    time::Time,
};

use crate::{RunError, TimedMessage, world::World};

/// Maximum number of turns of all applications at one virtual time.
const ROUNDS_MAX: usize = 2_000;
/// Maximum virtual time for which a check runs on behind its end while messages are missing. The timers of a recorded
/// run were late by some microseconds each, those of a replay are not. So its last message may come after the end.
const BEHIND_END: Duration = Duration::from_secs(1);
/// The index in [`Progress`] while no application has its turn.
const NO_APP: usize = usize::MAX;

/// An application that is ready to be started.
pub(crate) struct Prepared {
    pub(crate) name: String,
    pub(crate) tid: Tid,
    pub(crate) launch: Launch,
}

/// The progress of a replay, for the thread that waits for it.
#[derive(Debug)]
pub(crate) struct Progress {
    /// The number of turns so far.
    turns: AtomicU64,
    /// The index of the application that has its turn.
    app: AtomicUsize,
}

impl Default for Progress {
    fn default() -> Self {
        Self { turns: AtomicU64::new(0), app: AtomicUsize::new(NO_APP) }
    }
}

impl Progress {
    fn begin(&self, app: usize) {
        self.app.store(app, Ordering::Relaxed);
    }

    fn end(&self) {
        self.app.store(NO_APP, Ordering::Relaxed);
        self.turns.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the number of turns that have ended, and the application that has its turn.
    pub(crate) fn read(&self) -> (u64, Option<usize>) {
        let app = self.app.load(Ordering::Relaxed);
        (self.turns.load(Ordering::Relaxed), (app != NO_APP).then_some(app))
    }
}

/// Whether an application has work.
#[derive(Default)]
struct HasWork(AtomicBool);

impl Wake for HasWork {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // SYNC: Release, with the Acquire in `settle`: the turn sees the cause of its wake.
        self.0.store(true, Ordering::Release);
    }
}

struct App {
    name: String,
    actor: PolledActor,
    has_work: Arc<HasWork>,
    waker: Waker,
}

/// A replay on its thread, inside of an actix system.
pub(crate) struct Run {
    pub(crate) time: VirtualTime,
    pub(crate) world: Arc<World>,
    pub(crate) progress: Arc<Progress>,
    pub(crate) ends_at: Option<Time>,
}

impl Run {
    /// Runs the applications on these inputs, to the end.
    pub(crate) async fn all<I>(self, prepared: Vec<Prepared>, inputs: Peekable<I>) -> Result<(), RunError>
    where
        I: Iterator<Item = TimedMessage>,
    {
        let mut apps = Vec::with_capacity(prepared.len());
        for (index, Prepared { name, tid, launch }) in prepared.into_iter().enumerate() {
            self.progress.begin(index);
            let actor = PolledActor::start(&launch, ReadyGate::new(|| {}), &name, tid);
            self.progress.end();
            let has_work = Arc::new(HasWork(AtomicBool::new(true)));
            apps.push(App { name, actor, waker: has_work.clone().into(), has_work });
        }
        let result = self.replay(&mut apps, inputs).await;
        // Messages of destructors are no outputs.
        self.world.end();
        result
    }

    async fn replay<I>(&self, apps: &mut [App], mut inputs: Peekable<I>) -> Result<(), RunError>
    where
        I: Iterator<Item = TimedMessage>,
    {
        self.settle(apps).await?;
        let (mut number, mut before, mut stuck) = (0, Time::ZERO, 0);
        loop {
            let input_at = inputs.peek().map(|input| input.at);
            if input_at.is_none() && self.ends_at.is_none() {
                return Ok(());
            }
            let next =
                [self.time.next_wake(), self.world.next_arrival(), input_at].into_iter().flatten().min();
            let Some(next) = next.filter(|next| self.is_before_end(*next)) else {
                return Ok(());
            };
            stuck = if next > self.time.now() || input_at == Some(next) { 0 } else { stuck + 1 };
            if stuck > ROUNDS_MAX {
                return Err(never_idle(apps.first()));
            }
            self.time.advance_to(next);
            self.settle(apps).await?;
            while self.world.deliver_next() {
                self.settle(apps).await?;
            }
            while let Some(input) = inputs.next_if(|input| input.at <= self.time.now()) {
                number += 1;
                if input.at < before {
                    return Err(RunError::Unordered { number, at: input.at, before });
                }
                before = input.at;
                self.world.deliver(input);
                self.settle(apps).await?;
            }
        }
    }

    /// Returns whether something at this time is part of the run.
    fn is_before_end(&self, at: Time) -> bool {
        self.ends_at.is_none_or(|end| at <= end || (at <= end + BEHIND_END && self.world.lacks_messages()))
    }

    /// Runs the applications, in their order, until none has work.
    async fn settle(&self, apps: &mut [App]) -> Result<(), RunError> {
        let mut last = None;
        for _ in 0..ROUNDS_MAX {
            let mut has_run = false;
            for (index, app) in apps.iter_mut().enumerate() {
                // SYNC: Acquire, with the Release in `HasWork::wake`.
                if !app.has_work.0.swap(false, Ordering::AcqRel) {
                    continue;
                }
                (has_run, last) = (true, Some(index));
                self.progress.begin(index);
                let polled = app.actor.poll(&mut Context::from_waker(&app.waker));
                self.progress.end();
                if let Poll::Ready(reason) = polled {
                    return Err(ended(&app.name, reason));
                }
            }
            if !has_run {
                return Ok(());
            }
            // Tasks that an application has started beside its actor have their turn.
            tokio::task::yield_now().await;
        }
        Err(never_idle(last.and_then(|last| apps.get(last))))
    }
}

fn never_idle(app: Option<&App>) -> RunError {
    let app = app.map_or_else(|| "an application".to_owned(), |app| app.name.clone());
    RunError::NeverIdle { app, rounds: ROUNDS_MAX }
}

fn ended(app: &str, reason: Reason) -> RunError {
    let app = app.to_owned();
    if let Reason::Panic(message) = reason {
        return RunError::Panicked { app, message };
    }
    RunError::Ended { app, why: reason.to_string() }
}
