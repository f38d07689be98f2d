//! An address for a process of the cast.

use std::{
    thread,
    time::{Duration, Instant},
};

use sinew::{
    AppAddress, Endpoint, NodeApi, Registration,
    client::{ApiError, Transport},
};

use crate::DEADLINE;

/// The environment's word for what carries messages: `socket`, `ring`, or `direct` (rings, and direct links); else what is usual.
const TRANSPORT: &str = "SINEW_TEST_TRANSPORT";

/// The fixed address number `index`.
pub(super) fn address(index: u16) -> AppAddress {
    AppAddress::fixed(u32::from(index)).expect("the range is wide")
}

/// What every process of the cast asks for, if it asks for nothing else. Its stall timeout is long: where there are more threads
/// than processors, a node that is not run for a second hangs as little as its clients do.
pub(super) fn wishes() -> Registration {
    let registration = Registration::new().stall_timeout(DEADLINE);
    match std::env::var(TRANSPORT).as_deref() {
        Ok("socket") => registration.transport(Transport::Socket),
        Ok("ring") => registration.transport(Transport::Ring),
        Ok("direct") => registration.transport(Transport::Ring).direct(true),
        Ok(other) => panic!("{TRANSPORT} is {other:?}: none of socket, ring, direct"),
        Err(_) => registration,
    }
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
