//! Injection of faults: a wrapper around each armed actor, without a change of the actor itself.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::{Context, Poll, Waker},
    time::Duration,
};

use super::{Fault, FaultError, FaultKind, FaultMoment};
use crate::{
    lock,
    supervision::{Launch, ReadyGate, Reason, RunningActor},
    time::Time,
};

/// Maximum number of pending faults of one actor; further ones are refused.
pub const INJECTED_MAX: usize = 1_024;

/// The fault points of one node: one for each of its actors, by name.
#[derive(Clone, Debug, Default)]
pub struct FaultPoints(Arc<Mutex<BTreeMap<String, Arc<FaultPoint>>>>);

impl FaultPoints {
    /// Returns a launch function that creates the same actor with its fault point.
    #[must_use]
    pub fn arm(&self, name: &str, launch: Launch) -> Launch {
        let point = self.point(name);
        point.is_there.store(true, Ordering::Relaxed);
        Arc::new(move |ready| {
            let _entered = Entered::new(&point);
            point.record_start();
            let ready_point = point.clone();
            let ready = ReadyGate::new(move || {
                ready_point.record_ready();
                ready.reached();
            });
            Box::new(FaultyActor { inner: launch(ready), point: point.clone() })
        })
    }

    /// Plans a fault for the actor called `name`, whether it is armed already or not.
    ///
    /// # Errors
    /// Too many faults are pending for it.
    pub fn plan(&self, name: &str, fault: Fault) -> Result<(), FaultError> {
        self.point(name).plan(fault).map_err(|fault| {
            let why = format!("{INJECTED_MAX} faults wait for it already");
            FaultError::new(format_args!("{name}:{fault}"), why)
        })
    }

    /// Injects a fault into the actor called `name`. [`FaultMoment::Now`]: at its next turn, which follows at once.
    ///
    /// # Errors
    /// No actor of this name was armed, or too many faults are pending for it.
    pub fn inject(&self, name: &str, fault: Fault) -> Result<(), FaultError> {
        if self.names().iter().any(|known| known == name) {
            return self.plan(name, fault);
        }
        let why = format!("no actor has this name; there are {}", self.names().join(", "));
        Err(FaultError::new(format_args!("{name}:{fault}"), why))
    }

    /// Returns the history of the actor called `name`, if it was armed.
    #[must_use]
    pub fn lives(&self, name: &str) -> Option<Lives> {
        let point = lock(&self.0).get(name).cloned();
        point.filter(|point| point.is_there.load(Ordering::Relaxed)).map(|point| lock(&point.inner).lives)
    }

    /// Returns the names of the armed actors, in order.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        let points = lock(&self.0);
        let there = points.iter().filter(|(_, point)| point.is_there.load(Ordering::Relaxed));
        there.map(|(name, _)| name.clone()).collect()
    }

    fn point(&self, name: &str) -> Arc<FaultPoint> {
        lock(&self.0).entry(name.to_owned()).or_default().clone()
    }
}

/// The history of an armed actor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lives {
    /// The number of starts.
    pub starts: u64,
    /// How often the actor became ready.
    pub readies: u64,
    /// When the last fault was injected.
    pub struck: Option<Time>,
    /// When the actor last became ready.
    pub ready: Option<Time>,
}

/// The pending faults of one actor, through all its incarnations.
#[derive(Debug, Default)]
struct FaultPoint {
    /// Whether the actor exists; a plan may name an actor that does not exist, or not yet.
    is_there: AtomicBool,
    events: AtomicU64,
    /// Whether any fault is pending: an actor without a fault has only the cost of this load.
    is_armed: AtomicBool,
    /// Whether a stop became due within a turn; it follows at the end of the turn.
    stops: AtomicBool,
    inner: Mutex<Waiting>,
}

#[derive(Debug, Default)]
struct Waiting {
    faults: Vec<Planned>,
    lives: Lives,
    waker: Option<Waker>,
}

#[derive(Debug)]
struct Planned {
    fault: Fault,
    /// The counts at the time of the plan.
    events_before: u64,
    starts_before: u64,
}

impl FaultPoint {
    fn plan(&self, fault: Fault) -> Result<(), Fault> {
        let waker = {
            let mut inner = lock(&self.inner);
            if inner.faults.len() >= INJECTED_MAX {
                return Err(fault);
            }
            let events_before = self.events.load(Ordering::Relaxed);
            let starts_before = inner.lives.starts;
            inner.faults.push(Planned { fault, events_before, starts_before });
            // SYNC: Relaxed; a reader that sees it takes the lock before it reads further.
            self.is_armed.store(true, Ordering::Relaxed);
            inner.waker.take()
        };
        if let Some(waker) = waker {
            waker.wake();
        }
        Ok(())
    }

    /// Injects faults at a turn of the actor.
    fn record_turn(&self, waker: &Waker) {
        let due = {
            let mut inner = lock(&self.inner);
            if inner.waker.as_ref().is_none_or(|former| !former.will_wake(waker)) {
                inner.waker = Some(waker.clone());
            }
            self.take(&mut inner, |planned, _, _| planned.fault.moment == FaultMoment::Now)
        };
        self.strike(&due, "its turn");
    }

    /// Injects faults at a start of the actor.
    fn record_start(&self) {
        let due = {
            let mut inner = lock(&self.inner);
            inner.lives.starts += 1;
            self.take(&mut inner, |planned, _, starts| {
                planned.fault.moment.strikes_start(starts - planned.starts_before)
            })
        };
        self.strike(&due, "its start");
    }

    fn record_ready(&self) {
        let mut inner = lock(&self.inner);
        inner.lives.readies += 1;
        inner.lives.ready = Some(Time::now());
    }

    /// Injects faults at an event that the actor handles.
    fn event(&self) {
        self.events.fetch_add(1, Ordering::Relaxed);
        if !self.is_armed.load(Ordering::Relaxed) {
            return;
        }
        let due = self.take(&mut lock(&self.inner), |planned, events, _| {
            planned.fault.moment.strikes_event(events - planned.events_before)
        });
        self.strike(&due, "an event");
    }

    /// Returns the due faults, and removes faults that can never be due again.
    fn take(&self, inner: &mut Waiting, is_due: impl Fn(&Planned, u64, u64) -> bool) -> Vec<FaultKind> {
        let (events, starts) = (self.events.load(Ordering::Relaxed), inner.lives.starts);
        let mut due = Vec::new();
        inner.faults.retain(|planned| {
            let strikes = is_due(planned, events, starts);
            if strikes {
                due.push(planned.fault.kind);
            }
            let is_once = matches!(planned.fault.moment, FaultMoment::Now);
            let (events, starts) = (events - planned.events_before, starts - planned.starts_before);
            if is_once { !strikes } else { !planned.fault.moment.is_over(events, starts) }
        });
        self.is_armed.store(!inner.faults.is_empty(), Ordering::Relaxed);
        if !due.is_empty() {
            inner.lives.struck = Some(Time::now());
        }
        due
    }

    /// Blocks first, then ends: several faults may be due at once.
    fn strike(&self, due: &[FaultKind], at: &str) {
        for fault in due {
            match fault {
                FaultKind::Hang(None) => hang_for_ever(),
                FaultKind::Hang(Some(time)) | FaultKind::Slow(time) => std::thread::sleep(*time),
                FaultKind::Stop => self.stops.store(true, Ordering::Relaxed),
                FaultKind::Panic => {}
            }
        }
        assert!(!due.contains(&FaultKind::Panic), "a fault was planned for {at}");
    }
}

fn hang_for_ever() -> ! {
    loop {
        std::thread::sleep(Duration::from_secs(3_600));
    }
}

thread_local! {
    /// The fault point of the actor that has its turn on this thread.
    static CURRENT: RefCell<Option<Arc<FaultPoint>>> = const { RefCell::new(None) };
}

/// Injects faults after the actor on this thread took an event out of its queue.
pub(crate) fn strike() {
    if let Some(point) = CURRENT.with_borrow(Clone::clone) {
        point.event();
    }
}

/// Injects faults while the application on this thread handles a message. Returns whether the application
/// must stop after it.
pub(crate) fn strike_message() -> bool {
    CURRENT.with_borrow(Clone::clone).is_some_and(|point| {
        point.event();
        point.stops.swap(false, Ordering::Relaxed)
    })
}

/// Sets the fault point of this thread, until it is dropped, also by a panic.
struct Entered(Option<Arc<FaultPoint>>);

impl Entered {
    fn new(point: &Arc<FaultPoint>) -> Self {
        Self(CURRENT.replace(Some(point.clone())))
    }
}

impl Drop for Entered {
    fn drop(&mut self) {
        CURRENT.set(self.0.take());
    }
}

/// An actor wrapped with its fault point.
struct FaultyActor {
    inner: Box<dyn RunningActor>,
    point: Arc<FaultPoint>,
}

impl RunningActor for FaultyActor {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        let _entered = Entered::new(&self.point);
        self.point.record_turn(cx.waker());
        let polled = self.inner.poll(cx);
        if polled.is_pending() && self.point.stops.swap(false, Ordering::Relaxed) {
            self.inner.stop();
            return self.inner.poll(cx);
        }
        polled
    }

    fn stop(&mut self) {
        self.inner.stop();
    }

    fn terminate(&mut self) {
        self.inner.terminate();
    }
}
