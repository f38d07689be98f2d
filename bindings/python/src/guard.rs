//! Guards of outputs: Python's side of protected payloads.

use std::{
    cell::Cell,
    collections::BTreeSet,
    sync::{Mutex, PoisonError},
    time::Duration,
};

use pyo3::{exceptions::PyValueError, prelude::*};
use sinew_runtime::{
    protection::{
        Cause, Guard, Protection, State,
        raw::{NotSafeError, Protected, Reads},
    },
    wire::{Class, Kind},
};

use crate::{
    endpoint::class_of,
    errors,
    fork::{Owner, may_guard},
    seconds,
};

/// Maximum number of names of protected types in a process: each is kept until it ends.
const NAMES_MAX: usize = 1_024;

/// A type of protected payloads, as Python describes it.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct ProtectedType {
    name: String,
    /// Bytes of each payload; 0: any number.
    length: usize,
    within: f64,
    age_max: f64,
    lost_max: u64,
    bad_max: u32,
    good_min: u32,
    message_class: u8,
}

impl ProtectedType {
    pub(crate) fn read(&self) -> PyResult<(Protected, Class)> {
        let protection = Protection {
            within: seconds("within", self.within)?,
            age_max: seconds("age_max", self.age_max)?,
            lost_max: self.lost_max,
            bad_max: self.bad_max,
            good_min: self.good_min,
        };
        let invalid = |text: &str| Err(PyValueError::new_err(text.to_owned()));
        if self.name.is_empty() {
            return invalid("the name of a protected type is empty");
        }
        if protection.within == Duration::ZERO || protection.echo_period().is_zero() {
            return invalid(
                "within or age_max is 0, so each message is late; take some periods of the sender",
            );
        }
        if protection.good_min == 0 {
            return invalid("good_min is 0: an output is armed by good messages; take 1 at least");
        }
        let reads = if self.length == 0 { Reads::Any } else { Reads::OfLength(self.length) };
        let (kind, name) = (Kind::named(&self.name), kept(&self.name)?);
        Ok((Protected { name, kind, protection, reads }, class_of(self.message_class)?))
    }
}

/// Returns a name that stays until the process ends: data IDs refer to it.
fn kept(name: &str) -> PyResult<&'static str> {
    static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(kept) = names.get(name) {
        return Ok(kept);
    }
    if names.len() >= NAMES_MAX {
        let text = format!("this process has {NAMES_MAX} names of protected types, the maximum");
        return Err(PyValueError::new_err(text));
    }
    let kept: &'static str = Box::leak(name.into());
    names.insert(kept);
    Ok(kept)
}

thread_local! {
    /// Whether this thread uses an output now, and so holds the lock of its guard.
    static IS_IN_CALLBACK: Cell<bool> = const { Cell::new(false) };
}

fn in_callback<R>(callback: impl FnOnce() -> R) -> R {
    let before = IS_IN_CALLBACK.replace(true);
    let result = callback();
    IS_IN_CALLBACK.set(before);
    result
}

/// Checks that this thread uses no output: it would wait for itself.
pub(crate) fn check_callback(py: Python<'_>) -> PyResult<()> {
    if !IS_IN_CALLBACK.get() {
        return Ok(());
    }
    let text = "while a command or a safe function uses an output, its thread may call only trip and release of guards; call others afterwards";
    Err(errors::named(py, "BusyError", text))
}

/// Checks that this thread may make a guard.
pub(crate) fn check_may_guard(py: Python<'_>) -> PyResult<()> {
    check_callback(py)?;
    if may_guard() {
        return Ok(());
    }
    let text = "the process that this one was forked from has guards, and the thread that makes outputs safe is not in this one; start this program with subprocess, or with the method \"spawn\" of multiprocessing";
    Err(errors::named(py, "ForkedError", text))
}

/// Returns the safe function of a guard: it calls Python, and has failed if that raises an exception.
pub(crate) fn safe_function(
    safe: Py<PyAny>,
) -> impl FnMut(&mut (), Cause) -> Result<(), NotSafeError> + Send + 'static {
    move |(): &mut (), cause| {
        let called = Python::try_attach(|py| {
            let called = in_callback(|| safe.call1(py, (cause.to_string(),)));
            called.map_err(|error| error.write_unraisable(py, None)).is_ok()
        });
        // Without an interpreter nothing has made it safe.
        if called == Some(true) { Ok(()) } else { Err(NotSafeError) }
    }
}

/// The guard of an output. Each call releases the GIL before it waits for the output: the thread that makes outputs
/// safe holds the output while it waits for the GIL.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct OutputGuard {
    /// `None` while it is dropped.
    guard: Option<Guard<()>>,
    owner: Owner,
}

impl OutputGuard {
    pub(crate) fn new(guard: Guard<()>) -> Self {
        Self { guard: Some(guard), owner: Owner::this_process() }
    }

    /// Calls a function with the guard, without the GIL.
    fn with<R: Send>(&self, py: Python<'_>, call: impl FnOnce(&Guard<()>) -> R + Send) -> PyResult<R> {
        check_callback(py)?;
        self.without_waiting(py, call)
    }

    /// The same for a function that does not wait for the output.
    fn without_waiting<R: Send>(
        &self,
        py: Python<'_>,
        call: impl FnOnce(&Guard<()>) -> R + Send,
    ) -> PyResult<R> {
        let guard = &self.guard;
        py.detach(|| guard.as_ref().map(call))
            .ok_or_else(|| errors::named(py, "GuardError", "this guard has ended; create another one"))
    }
}

impl Drop for OutputGuard {
    fn drop(&mut self) {
        let Some(guard) = self.guard.take() else { return };
        if self.owner.is_parent() {
            // The parent has the output, and the thread that makes it safe.
            std::mem::forget(guard);
            return;
        }
        if IS_IN_CALLBACK.get() {
            // Its end would wait for the output that this thread uses. The output is safe permanently without it.
            guard.release_later();
            std::mem::forget(guard);
            return;
        }
        // Without the GIL. If there is no interpreter any more, nothing waits for it.
        let mut guard = Some(guard);
        let _ = Python::try_attach(|py| py.detach(|| drop(guard.take())));
    }
}

#[pymethods]
impl OutputGuard {
    /// Lets commands reach the output.
    fn arm(&self, py: Python<'_>) -> PyResult<()> {
        self.with(py, Guard::arm)?.map_err(|error| errors::arm(py, &error))
    }

    /// Acknowledges a stop of the system that is released.
    fn acknowledge_stop(&self, py: Python<'_>) -> PyResult<()> {
        self.with(py, Guard::acknowledge_stop)?.map_err(|error| errors::arm(py, &error))
    }

    /// Calls a function if commands reach the output. Returns a tuple with its result, else `None`.
    fn apply(&self, py: Python<'_>, command: Py<PyAny>) -> PyResult<Option<(Py<PyAny>,)>> {
        let applied = self.with(py, |guard| {
            guard.apply(|(): &mut ()| Python::attach(|py| in_callback(|| command.call0(py))))
        })?;
        applied.ok().transpose().map(|value| value.map(|value| (value,)))
    }

    /// Makes the output safe.
    fn trip(&self, py: Python<'_>) -> PyResult<()> {
        self.without_waiting(py, Guard::trip)
    }

    /// Makes the output safe permanently.
    fn release(&self, py: Python<'_>) -> PyResult<()> {
        self.without_waiting(py, Guard::release_later)
    }

    /// Whether commands reach the output.
    #[getter]
    fn is_live(&self, py: Python<'_>) -> PyResult<bool> {
        Ok(self.with(py, Guard::state)? == State::Live)
    }

    /// The cause for which the output is safe; `None` if it is live.
    #[getter]
    fn cause(&self, py: Python<'_>) -> PyResult<Option<String>> {
        Ok(match self.with(py, Guard::state)? {
            State::Live => None,
            State::Safe(cause) => Some(cause.to_string()),
        })
    }

    /// The counters: good, bad and lost messages, and how often the output was made safe.
    fn tally(&self, py: Python<'_>) -> PyResult<(u64, u64, u64, u64)> {
        let tally = self.with(py, Guard::tally)?;
        let bad = [tally.corrupt, tally.too_old, tally.repeated, tally.backwards, tally.unreadable];
        Ok((tally.good, bad.iter().sum(), tally.lost, tally.trips))
    }
}
