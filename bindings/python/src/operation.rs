//! An operation of an endpoint: a future that the waiting thread of Python polls.

use std::{
    os::fd::{AsFd as _, AsRawFd as _},
    pin::Pin,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    task::Poll,
    time::Duration,
};

use pyo3::{IntoPyObjectExt as _, prelude::*};
use sinew_client::{ApiError, BarrierError, EventLoop, SetTogetherError};
use sinew_runtime::{
    outcome::{MemberOutcome, Outcome},
    parameters::{PartOutcome, TransactionReport},
    tid::Tid,
    time::Time,
};

use crate::{
    endpoint::Core, errors, fork::Owner, guard::check_callback, parameters::Registered, received::Received,
    seconds,
};

/// Longest sleep of a blocking call: a signal may interrupt another thread than the one that executes its handler.
const SIGNAL_CHECK: Duration = Duration::from_millis(250);

/// The result of an operation.
pub(crate) enum Done {
    Nothing,
    Outcome(Outcome),
    Members(Vec<MemberOutcome>),
    Received(Arc<sinew_client::Received>),
    Resolved(Option<Tid>),
    Generation(u64),
    Together(TransactionReport),
    Registered(Box<Registered>),
}

/// Why an operation has failed.
pub(crate) enum Failure {
    Api(ApiError),
    Barrier(BarrierError),
    Together(SetTogetherError),
    /// The endpoint was unregistered.
    Gone,
}

impl From<ApiError> for Failure {
    fn from(error: ApiError) -> Self {
        Self::Api(error)
    }
}

pub(crate) type Ended = Result<Done, Failure>;
pub(crate) type Running<'e> = Pin<Box<dyn Future<Output = Ended> + Send + 'e>>;

/// An operation in progress. Dropping it cancels it.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct Operation {
    future: Mutex<Option<Running<'static>>>,
    events: EventLoop,
    /// Whether events are to be taken before the next poll: not before the first one, and not after a blocking wait.
    has_events: AtomicBool,
    owner: Owner,
}

impl Operation {
    pub(crate) fn new(future: Running<'static>, events: EventLoop) -> Self {
        Self {
            future: Mutex::new(Some(future)),
            events,
            has_events: AtomicBool::new(false),
            owner: Owner::this_process(),
        }
    }

    /// Polls the future, without the GIL: a safe function of Python may have to run meanwhile.
    fn step(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
        // A received message may be for the guard of the output that this thread uses.
        check_callback(py)?;
        if self.owner.is_parent() {
            let text =
                "this operation belongs to the process that this one was forked from; begin another one here";
            return Err(errors::named(py, "ForkedError", text));
        }
        let polled = py.detach(|| {
            let mut future = self.future.lock().unwrap_or_else(PoisonError::into_inner);
            let running = future.as_mut()?.as_mut();
            // SYNC: Relaxed; the lock of the future orders it.
            let polled = match self.has_events.swap(true, Ordering::Relaxed) {
                true => self.events.poll(running),
                false => self.events.poll_first(running),
            };
            if polled.is_ready() {
                *future = None;
            }
            Some(polled)
        });
        match polled {
            None => Err(errors::named(py, "SinewError", "this operation has ended; begin another one")),
            Some(Poll::Pending) => Ok(None),
            Some(Poll::Ready(Ok(done))) => self.value(py, done).map(Some),
            Some(Poll::Ready(Err(Failure::Api(error)))) => Err(errors::api(py, &error)),
            Some(Poll::Ready(Err(Failure::Barrier(error)))) => Err(errors::barrier(py, &error)),
            Some(Poll::Ready(Err(Failure::Together(error)))) => Err(errors::together(py, &error)),
            Some(Poll::Ready(Err(Failure::Gone))) => Err(gone(py)),
        }
    }

    fn value(&self, py: Python<'_>, done: Done) -> PyResult<Py<PyAny>> {
        match done {
            Done::Nothing => Ok(py.None()),
            Done::Outcome(outcome) => outcome.code().into_py_any(py),
            Done::Members(members) => {
                let pairs: Vec<_> =
                    members.iter().map(|member| (member.tid.bits(), member.outcome.code())).collect();
                pairs.into_py_any(py)
            }
            Done::Received(received) => Received::new(received).into_py_any(py),
            Done::Resolved(tid) => tid.map(Tid::bits).into_py_any(py),
            Done::Generation(generation) => generation.into_py_any(py),
            Done::Together(report) => {
                let parts = report.parts.into_iter().map(|part| (part.app, in_words(part.outcome)));
                (format!("{:?}", report.verdict), parts.collect::<Vec<_>>()).into_py_any(py)
            }
            Done::Registered(registered) => Core::new(*registered, self.events.clone()).into_py_any(py),
        }
    }

    fn drop_future(&self, py: Python<'_>) {
        if self.owner.is_parent() {
            // The drop of this object leaves the copy as it is.
            return;
        }
        let future = py.detach(|| self.future.lock().unwrap_or_else(PoisonError::into_inner).take());
        py.detach(|| drop(future));
    }
}

/// Returns the outcome of an application in a transaction: a word, and the tick or the reason.
fn in_words(outcome: PartOutcome) -> (&'static str, u64, String) {
    match outcome {
        PartOutcome::Applied { tick, .. } => ("Applied", tick, String::new()),
        PartOutcome::Repaired { tick, .. } => ("Repaired", tick, String::new()),
        PartOutcome::Agreed => ("Agreed", 0, String::new()),
        PartOutcome::Refused(why) => ("Refused", 0, why),
        PartOutcome::Unknown(why) => ("Unknown", 0, why),
    }
}

/// Returns the exception for an endpoint that was unregistered.
pub(crate) fn gone(py: Python<'_>) -> PyErr {
    errors::named(py, "ClosedError", "this endpoint is unregistered; register a new one")
}

impl Drop for Operation {
    fn drop(&mut self) {
        let mut future = self.future.get_mut().unwrap_or_else(PoisonError::into_inner).take();
        if self.owner.is_parent() {
            // The end of a copy would withdraw the request of the parent, and its wait in the memory of the ring.
            std::mem::forget(future);
        } else if future.is_some() {
            // Without the GIL, as each end of an endpoint: an `unregister` has it.
            let _ = Python::try_attach(|py| py.detach(|| drop(future.take())));
        }
    }
}

#[pymethods]
impl Operation {
    /// Continues the operation. Returns `None` if it has to wait, else a tuple with its result.
    fn poll(&self, py: Python<'_>) -> PyResult<Option<(Py<PyAny>,)>> {
        Ok(self.step(py)?.map(|value| (value,)))
    }

    /// Returns the descriptor that is readable when `poll` may continue.
    fn fileno(&self) -> i32 {
        self.events.as_fd().as_raw_fd()
    }

    /// Returns the seconds until the next `poll` at the latest; `None`: only the descriptor says when.
    fn wake_in(&self) -> Option<f64> {
        self.events.wake_in().map(|left| left.as_secs_f64())
    }

    /// Ends the operation without a result. Nothing is lost by that.
    fn cancel(&self, py: Python<'_>) {
        self.drop_future(py);
    }

    /// Continues the operation to its end, and blocks meanwhile without the GIL. Returns `None` if it has not ended
    /// within `timeout` seconds; then it is cancelled. Signal handlers of Python run.
    #[pyo3(signature = (timeout=None))]
    pub(crate) fn run(&self, py: Python<'_>, timeout: Option<f64>) -> PyResult<Option<(Py<PyAny>,)>> {
        let within = timeout.map(|timeout| seconds("within", timeout)).transpose()?;
        let deadline = within.map_or(Time::MAX, |within| Time::now() + within);
        loop {
            if let Some(value) = self.step(py)? {
                return Ok(Some((value,)));
            }
            let now = Time::now();
            if now >= deadline {
                self.drop_future(py);
                return Ok(None);
            }
            let left = self.events.wake_in().unwrap_or(Duration::MAX).min(deadline.since(now));
            py.detach(|| self.events.take_events(left.min(SIGNAL_CHECK)))?;
            self.has_events.store(false, Ordering::Relaxed);
            if let Err(interrupted) = py.check_signals() {
                self.drop_future(py);
                return Err(interrupted);
            }
        }
    }
}
