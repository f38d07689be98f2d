//! The extension module of the Python package `sinew`.
//!
//! It has the parts that Python cannot do: the client, the conversion of payloads, and the files of recordings. All
//! that a user calls is in `python/sinew`, which documents it. `docs/decisions/0055-python.md` has the reasons.
//!
//! | file | contents |
//! | --- | --- |
//! | `endpoint.rs` | an endpoint: each call begins one operation |
//! | `lease.rs` | an endpoint that one operation has |
//! | `registration.rs` | the registration of an endpoint |
//! | `operation.rs` | an operation: a future that Python polls |
//! | `parameters.rs` | parameters that the program serves |
//! | `received.rs` | received messages, and their memory for numpy |
//! | `guard.rs` | guards of outputs for protected payloads |
//! | `fork.rs` | copies in the child of a fork |
//! | `codec.rs` | MessagePack to and from values of Python |
//! | `schema.rs` | structures of payload types |
//! | `bag.rs` | files of recordings |
//! | `errors.rs` | errors as the exceptions of `sinew.errors` |

mod bag;
mod codec;
mod endpoint;
mod errors;
mod fork;
mod guard;
mod lease;
mod operation;
mod parameters;
mod received;
mod registration;
mod schema;

use std::time::Duration;

use pyo3::{exceptions::PyValueError, prelude::*};
use sinew_runtime::{outcome::Outcome, tid::Tid, time::Time, wire::Kind};

/// Returns a time that Python states in seconds.
fn seconds(name: &str, value: f64) -> PyResult<Duration> {
    if value == f64::INFINITY {
        return Ok(Duration::MAX);
    }
    Duration::try_from_secs_f64(value)
        .map_err(|_| PyValueError::new_err(format!("{name} is {value}: give seconds, 0.0 or more")))
}

/// Returns the id of the type of this name.
#[pyfunction]
fn kind_of(name: &str) -> u32 {
    Kind::named(name).bits()
}

/// Returns the bits of a TID in its text form.
#[pyfunction]
fn tid_of(text: &str) -> PyResult<u64> {
    text.parse::<Tid>().map(Tid::bits).map_err(|why| PyValueError::new_err(why.to_string()))
}

/// Returns the text form of a TID.
#[pyfunction]
fn tid_text(bits: u64) -> String {
    Tid::from_bits(bits).to_string()
}

/// Returns the bits of the TID of a group.
#[pyfunction]
fn group_tid(name: &str) -> u64 {
    Tid::group(name).bits()
}

/// Returns a sentence about an outcome: for a rejection its cause and its remedy.
#[pyfunction]
fn outcome_text(code: u8) -> String {
    match Outcome::from_code(code) {
        Some(Outcome::Rejected(why)) => why.to_string(),
        Some(outcome) => format!("{outcome:?}"),
        None => format!("no outcome has the code {code}"),
    }
}

/// Returns the time of the clock by which ages are measured, in seconds.
#[pyfunction]
fn now() -> f64 {
    Time::now().since(Time::ZERO).as_secs_f64()
}

/// The native part of `sinew`.
#[pymodule]
mod _sinew {
    #[pymodule_export]
    use super::{
        bag::BagReader,
        codec::{decode, encode},
        endpoint::Core,
        fork::forked,
        group_tid,
        guard::OutputGuard,
        kind_of, now,
        operation::Operation,
        outcome_text,
        parameters::{ParameterDeclarations, ParameterSet},
        received::{Memory, Received},
        registration::register,
        schema::{make_schema, parse_schema},
        tid_of, tid_text,
    };
}
