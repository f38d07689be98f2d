//! Where faults strike: around each armed actor, with no word to the actor itself.

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
    post::lock,
    supervision::{Launch, Life, ReadyGate, Reason},
    time::Time,
};

/// Faults that wait to strike one actor at most; one more is refused.
pub const INJECTED_MAX: usize = 1_024;

/// The fault points of one node: one for each of its actors, by name.
#[derive(Clone, Debug, Default)]
pub struct FaultPoints(Arc<Mutex<BTreeMap<String, Arc<FaultPoint>>>>);

impl FaultPoints {
    /// A launch that makes the same actor with its fault point around it.
    #[must_use]
    pub fn arm(&self, name: &str, launch: Launch) -> Launch {
        let point = self.point(name);
        point.is_there.store(true, Ordering::Relaxed);
        Arc::new(move |ready| {
            let _entered = Entered::new(&point);
            point.starts();
            let told = point.clone();
            let ready = ReadyGate::new(move || {
                told.is_ready();
                ready.reached();
            });
            Box::new(FaultyLife { inner: launch(ready), point: point.clone() })
        })
    }

    /// Keeps a fault for the actor called `name`, whether it was armed yet or not.
    ///
    /// # Errors
    /// Too many faults wait for it already.
    pub fn plan(&self, name: &str, fault: Fault) -> Result<(), FaultError> {
        self.point(name).plan(fault).map_err(|fault| {
            let why = format!("{INJECTED_MAX} faults wait for it already");
            FaultError::new(format_args!("{name}:{fault}"), why)
        })
    }

    /// Lets a fault strike the actor called `name`. [`FaultMoment::Now`]: at its next turn, which comes at once.
    ///
    /// # Errors
    /// Nobody of this name was armed, or too many faults wait for it already.
    pub fn inject(&self, name: &str, fault: Fault) -> Result<(), FaultError> {
        if self.names().iter().any(|known| known == name) {
            return self.plan(name, fault);
        }
        let why = format!("nobody here is called that; there are {}", self.names().join(", "));
        Err(FaultError::new(format_args!("{name}:{fault}"), why))
    }

    /// What became of the actor called `name` so far, if it was armed.
    #[must_use]
    pub fn lives(&self, name: &str) -> Option<Lives> {
        let point = lock(&self.0).get(name).cloned();
        point.filter(|point| point.is_there.load(Ordering::Relaxed)).map(|point| lock(&point.inner).lives)
    }

    /// Who can be struck, in the order of their names.
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

/// The lives of an armed actor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lives {
    /// How often it was started.
    pub starts: u64,
    /// How often it said that it is ready.
    pub readies: u64,
    /// When a fault struck it last.
    pub struck: Option<Time>,
    /// When it said last that it is ready.
    pub ready: Option<Time>,
}

/// The faults that wait for one actor, through all its lives.
#[derive(Debug, Default)]
struct FaultPoint {
    /// Whether there is an actor around which it stands; a plan may name one that is not, or not yet.
    is_there: AtomicBool,
    events: AtomicU64,
    /// Whether there is anything to look for: an actor without a fault pays for this load alone.
    is_armed: AtomicBool,
    /// A stop was due in the middle of a turn; it follows at the end of it.
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
    /// What had been counted when it was planned.
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
            // SYNC: Relaxed; whoever sees it takes the lock before it looks further.
            self.is_armed.store(true, Ordering::Relaxed);
            inner.waker.take()
        };
        if let Some(waker) = waker {
            waker.wake();
        }
        Ok(())
    }

    /// The actor takes its turn.
    fn turns(&self, waker: &Waker) {
        let due = {
            let mut inner = lock(&self.inner);
            if inner.waker.as_ref().is_none_or(|former| !former.will_wake(waker)) {
                inner.waker = Some(waker.clone());
            }
            self.take(&mut inner, |planned, _, _| planned.fault.moment == FaultMoment::Now)
        };
        self.strike(&due, "its turn");
    }

    /// The actor is made again.
    fn starts(&self) {
        let due = {
            let mut inner = lock(&self.inner);
            inner.lives.starts += 1;
            self.take(&mut inner, |planned, _, starts| {
                planned.fault.moment.strikes_start(starts - planned.starts_before)
            })
        };
        self.strike(&due, "its start");
    }

    fn is_ready(&self) {
        let mut inner = lock(&self.inner);
        inner.lives.readies += 1;
        inner.lives.ready = Some(Time::now());
    }

    /// An event is in the actor's hand.
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

    /// What is due, and takes out what can never be due again.
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
    static PRESENT: RefCell<Option<Arc<FaultPoint>>> = const { RefCell::new(None) };
}

/// The actor whose turn it is has taken an event out of its post.
pub(crate) fn strike() {
    if let Some(point) = PRESENT.with_borrow(Clone::clone) {
        point.event();
    }
}

/// The application whose turn it is has a message in its hand. Returns whether it is to stop after it.
pub(crate) fn strike_message() -> bool {
    PRESENT.with_borrow(Clone::clone).is_some_and(|point| {
        point.event();
        point.stops.swap(false, Ordering::Relaxed)
    })
}

/// Makes a point the present one, until it is dropped, by a panic or not.
struct Entered(Option<Arc<FaultPoint>>);

impl Entered {
    fn new(point: &Arc<FaultPoint>) -> Self {
        Self(PRESENT.replace(Some(point.clone())))
    }
}

impl Drop for Entered {
    fn drop(&mut self) {
        PRESENT.set(self.0.take());
    }
}

/// An actor with its fault point around it.
struct FaultyLife {
    inner: Box<dyn Life>,
    point: Arc<FaultPoint>,
}

impl Life for FaultyLife {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        let _entered = Entered::new(&self.point);
        self.point.turns(cx.waker());
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
