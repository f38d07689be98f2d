//! An address for a process of the cast.

use std::{
    thread,
    time::{Duration, Instant},
};

use sinew::{ApiError, AppAddress, Endpoint, NodeApi, Registration};

use crate::DEADLINE;

/// The fixed address number `index`.
pub(super) fn address(index: u16) -> AppAddress {
    AppAddress::fixed(u32::from(index)).expect("the range is wide")
}

/// Registers; an address that a killed life has is there for this one when the node has seen that death.
///
/// # Panics
/// If it is not there in time.
pub(super) fn register(api: &NodeApi, registration: &Registration) -> Endpoint {
    let until = Instant::now() + DEADLINE;
    loop {
        match api.register_transport_address(registration.clone()) {
            Ok(endpoint) => return endpoint,
            Err(ApiError::Refused(_)) if Instant::now() < until => {
                thread::sleep(Duration::from_millis(1));
            }
            Err(error) => panic!("no address for {registration:?}: {error}"),
        }
    }
}
