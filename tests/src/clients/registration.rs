//! Addresses for the processes of the scenario.

use std::{
    thread,
    time::{Duration, Instant},
};

use sinew::{
    AppAddress, Endpoint, NodeApi, Registration,
    client::{ApiError, DirectLinks, Transport},
};

use sinew_testkit::DEADLINE;

/// The environment variable that selects the transport: `socket`, `ring` (without direct links), `direct` (with a
/// link to each peer), or `automatic` (with links to frequent peers). Without it the default applies.
const TRANSPORT: &str = "SINEW_TEST_TRANSPORT";

/// The fixed address number `index`.
pub(super) fn address(index: u16) -> AppAddress {
    AppAddress::fixed(u32::from(index)).expect("the range is wide")
}

/// The common registration of all processes of the scenario. The stall timeout is long: with more
/// threads than CPUs, a node that is not scheduled for a second is not hung, and neither are its clients.
pub(super) fn wishes() -> Registration {
    let registration = Registration::new().stall_timeout(DEADLINE);
    match std::env::var(TRANSPORT).as_deref() {
        Ok("socket") => registration.transport(Transport::Socket),
        Ok("ring") => registration.transport(Transport::Ring).direct(DirectLinks::Never),
        Ok("direct") => registration.transport(Transport::Ring).direct(DirectLinks::Always),
        Ok("automatic") => registration.transport(Transport::Ring).direct(DirectLinks::Automatic),
        Ok(other) => panic!("{TRANSPORT} is {other:?}: none of socket, ring, direct, automatic"),
        Err(_) => registration,
    }
}

/// Registers. An address held by a killed incarnation becomes free once the node has noticed the death.
///
/// # Panics
/// If it does not become free in time.
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
