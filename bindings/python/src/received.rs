//! Received messages, and the memory of their payloads.

use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use pyo3::{
    exceptions::PyValueError,
    prelude::*,
    types::{PyBytes, PyDict},
};
use sinew_runtime::{outcome::Outcome, time::Time, wire::Class};

use crate::{errors, fork::Owner, seconds};

/// A received message. It settles as delivered when it is dropped.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct Received {
    /// `None` after the settlement. Shared with a reply that is under way.
    message: Mutex<Option<Arc<sinew_client::Received>>>,
    payload: Bytes,
    facts: Facts,
    owner: Owner,
}

/// The header of a message, also after its settlement.
struct Facts {
    kind: u32,
    source: u64,
    destination: u64,
    class: Class,
    sequence: u64,
    sent: Option<Time>,
    age_error: Option<f64>,
    wants_reply: bool,
    is_retained: bool,
}

impl Received {
    pub(crate) fn new(message: Arc<sinew_client::Received>) -> Self {
        let facts = Facts {
            kind: message.kind().bits(),
            source: message.source().bits(),
            destination: message.destination().bits(),
            class: message.class(),
            sequence: message.sequence(),
            sent: message.sent(),
            age_error: message.age_error().map(|error| error.as_secs_f64()),
            wants_reply: message.wants_reply(),
            is_retained: message.is_retained(),
        };
        let payload = message.payload();
        Self { message: Mutex::new(Some(message)), payload, facts, owner: Owner::this_process() }
    }

    /// Returns the message for a reply; `None` after its settlement.
    pub(crate) fn request(&self) -> Option<Arc<sinew_client::Received>> {
        self.message.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Drop for Received {
    fn drop(&mut self) {
        // The parent settles it.
        if self.owner.is_parent() {
            std::mem::forget(self.message.get_mut().unwrap_or_else(PoisonError::into_inner).take());
        }
    }
}

#[pymethods]
impl Received {
    #[getter]
    fn kind(&self) -> u32 {
        self.facts.kind
    }

    #[getter]
    fn source(&self) -> u64 {
        self.facts.source
    }

    #[getter]
    fn destination(&self) -> u64 {
        self.facts.destination
    }

    /// 0: Control, 1: Stream, 2: Bulk.
    #[getter]
    fn message_class(&self) -> u8 {
        match self.facts.class {
            Class::Control => 0,
            Class::Stream => 1,
            Class::Bulk => 2,
        }
    }

    #[getter]
    fn sequence(&self) -> u64 {
        self.facts.sequence
    }

    #[getter]
    fn wants_reply(&self) -> bool {
        self.facts.wants_reply
    }

    #[getter]
    fn is_retained(&self) -> bool {
        self.facts.is_retained
    }

    /// Seconds from the sending until now; `None` if unknown.
    #[getter]
    fn age(&self) -> Option<f64> {
        self.facts.sent.map(|sent| Time::now().since(sent).as_secs_f64())
    }

    /// Maximum error of the age in seconds; `None` if the age is unknown.
    #[getter]
    fn age_error(&self) -> Option<f64> {
        self.facts.age_error
    }

    /// Returns whether the message may be older than this many seconds. An unknown age counts as too old.
    fn is_older_than(&self, limit: f64) -> PyResult<bool> {
        let limit = seconds("limit", limit)?;
        let Facts { sent: Some(sent), age_error: Some(error), .. } = self.facts else { return Ok(true) };
        Ok(Time::now().since(sent).as_secs_f64() + error > limit.as_secs_f64())
    }

    /// The payload, as a copy.
    #[getter]
    fn data<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.payload)
    }

    /// The value of the payload.
    fn value(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        crate::codec::decode(py, &self.payload)
    }

    /// The memory of the payload, without a copy.
    fn memory(&self) -> Memory {
        Memory(self.payload.clone())
    }

    fn __len__(&self) -> usize {
        self.payload.len()
    }

    /// Reports the outcome with this code, if the sender wants it and it was not reported yet.
    fn settle(&self, py: Python<'_>, code: u8) -> PyResult<()> {
        let outcome = Outcome::from_code(code)
            .ok_or_else(|| PyValueError::new_err(format!("no outcome has the code {code}")))?;
        if self.owner.is_parent() {
            let text = "the message belongs to the process that this one was forked from, which settles it";
            return Err(errors::named(py, "ForkedError", text));
        }
        py.detach(|| {
            let message = self.message.lock().unwrap_or_else(PoisonError::into_inner).take();
            // A reply that is under way settles it.
            if let Some(message) = message.and_then(Arc::into_inner) {
                message.settle(outcome);
            }
        });
        Ok(())
    }
}

/// The memory of a payload, as numpy reads it: `numpy.asarray(memory)` is an array of bytes that keeps it alive.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct Memory(Bytes);

#[pymethods]
impl Memory {
    fn __len__(&self) -> usize {
        self.0.len()
    }

    /// Version 3 of numpy's array interface: bytes that cannot be written.
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let interface = PyDict::new(py);
        interface.set_item("version", 3)?;
        interface.set_item("shape", (self.0.len(),))?;
        interface.set_item("typestr", "|u1")?;
        interface.set_item("data", (self.0.as_ptr().addr(), true))?;
        Ok(interface)
    }
}
