//! Errors of the client as exceptions of `sinew.errors`, with the same text.

use std::io;

use pyo3::{
    Py, PyAny, PyErr, PyResult, Python,
    types::{PyAnyMethods, PyModule},
};
use sinew_bag::BagError;
use sinew_client::{ApiError, BarrierError, SetTogetherError};
use sinew_runtime::{outcome::Outcome, protection::ArmError};

/// The values of an exception beside its text.
type Details<'a> = &'a [(&'a str, Py<PyAny>)];

/// Returns an exception of `sinew.errors`.
pub(crate) fn named(py: Python<'_>, class: &str, text: &str) -> PyErr {
    with_details(py, class, text, &[])
}

fn with_details(py: Python<'_>, class: &str, text: &str, details: Details<'_>) -> PyErr {
    let made = || -> PyResult<PyErr> {
        let made = PyModule::import(py, "sinew.errors")?.getattr(class)?.call1((text,))?;
        for (name, value) in details {
            made.setattr(*name, value)?;
        }
        Ok(PyErr::from_value(made))
    };
    made().unwrap_or_else(|error| error)
}

/// Returns a value for an exception. One that cannot be made is left out.
fn value<'py>(py: Python<'py>, value: impl pyo3::IntoPyObject<'py>) -> Py<PyAny> {
    use pyo3::IntoPyObjectExt as _;
    value.into_py_any(py).unwrap_or_else(|_| py.None())
}

/// Returns the exception for an error of the client.
pub(crate) fn api(py: Python<'_>, error: &ApiError) -> PyErr {
    let text = error.to_string();
    let of = |class: &str| named(py, class, &text);
    match error {
        ApiError::NoNode { .. } | ApiError::NotAPath { .. } => of("NoNodeError"),
        ApiError::BadName { .. } => of("BadNameError"),
        ApiError::Refused(_) => of("RefusedError"),
        ApiError::Waiting { missing, .. } => {
            with_details(py, "WaitingError", &text, &[("missing", value(py, missing.clone()))])
        }
        ApiError::NoAnswer(_) => of("NoAnswerError"),
        ApiError::Closed(_) | ApiError::Frame(_) => of("ClosedError"),
        ApiError::Disconnected(_) => of("DisconnectedError"),
        ApiError::Stalled(_) => of("StalledError"),
        ApiError::LoanActive => of("BusyError"),
        ApiError::TooLong { .. } => of("TooLongError"),
        ApiError::NotYours(_) | ApiError::ToMany(_) | ApiError::NotSealed(_) => of("SendError"),
        ApiError::UnknownName { name, nearest } => {
            let details = [("name", value(py, name)), ("nearest", value(py, nearest.clone()))];
            with_details(py, "UnknownNameError", &text, &details)
        }
        ApiError::Ended(outcome) => ended(py, *outcome, &text),
        ApiError::TooManyGroups => of("TooManyGroupsError"),
        ApiError::NoReply(_) => of("NoReplyError"),
        ApiError::NotAsked | ApiError::OthersRequest(_) => of("NotAskedError"),
        ApiError::Malformed(_) => of("MalformedError"),
    }
}

fn ended(py: Python<'_>, outcome: Outcome, text: &str) -> PyErr {
    with_details(py, "NotHandledError", text, &[("code", value(py, outcome.code()))])
}

/// Returns the exception for a wait at a barrier that has failed.
pub(crate) fn barrier(py: Python<'_>, error: &BarrierError) -> PyErr {
    let text = error.to_string();
    match error {
        BarrierError::TimedOut { missing, .. } => {
            with_details(py, "NotMetError", &text, &[("missing", value(py, missing.clone()))])
        }
        BarrierError::Lost { missing, .. } => {
            with_details(py, "PartyLostError", &text, &[("missing", value(py, missing.clone()))])
        }
        BarrierError::Api(error) => api(py, error),
        BarrierError::Refused(_) | BarrierError::Send(_) | BarrierError::Ask(_) => {
            named(py, "BarrierError", &text)
        }
    }
}

/// Returns the exception for a transaction of parameters that did not begin.
pub(crate) fn together(py: Python<'_>, error: &SetTogetherError) -> PyErr {
    match error {
        SetTogetherError::Api(error) => api(py, error),
        SetTogetherError::Transaction(error) => named(py, "ParameterError", &error.to_string()),
    }
}

/// Returns the exception for a guard that cannot be made.
pub(crate) fn guard(py: Python<'_>, error: &io::Error) -> PyErr {
    named(py, "GuardError", &error.to_string())
}

/// Returns the exception for an output that cannot be armed.
pub(crate) fn arm(py: Python<'_>, error: &ArmError) -> PyErr {
    named(py, "NotGoodError", &error.to_string())
}

/// Returns the exception for a recording that cannot be read.
pub(crate) fn bag(py: Python<'_>, error: &BagError) -> PyErr {
    named(py, "BagError", &error.to_string())
}
