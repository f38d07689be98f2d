//! Descriptors of the node's process: raises the limit to the number that its clients may need, as far as the system
//! allows it.
//!
//! The usual soft limit of 1,024 exists for programs that call `select`; the higher hard limit is meant to be used.
//! With the maximum number of clients of the default configuration a node needs more.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use sinew_model::config::LnclConfig;
use sinew_shm::Offer;

use super::worker::WAITING_MAX;

/// Descriptors per client: its socket, its process, and the node's two bells. Until these are offered, the node also
/// has its memory and the bells' other ends: three. A client that is a task has two bells of its own in place of those;
/// a thread has its bells in memory.
///
/// A client that is gone leaves six at most: the socket, and either the four bells of its rings, or those of a refused
/// exchange. The latter are the node's two, and the three of the client's offer.
const PER_CLIENT: usize = 7;
/// Descriptors that wait to be closed behind one that does not close, while new clients use their slots: the maximum
/// number of tasks. No task has more than an offer: a producer and a consumer have two each, an unfinished exchange has
/// both bells, a socket is one.
const LEFT: usize = WAITING_MAX * Offer::DESCRIPTORS_MAX;
/// Descriptors of the node itself, of unanswered link requests, and of the applications in its process.
const OWN: usize = 256;

/// Raises this process's limit to the number that the clients may need, if it is lower and the system allows it.
pub(super) fn make_room(lncl: &LnclConfig) {
    let needed = needed(lncl);
    let limit = getrlimit(Resource::Nofile);
    let Some(raised) = raised(limit, needed) else { return };
    if let Err(cause) = setrlimit(Resource::Nofile, raised) {
        sinew_runtime::log::warn!(%cause, needed, found = ?limit, "the limit of descriptors cannot be raised: with many clients there may be none left");
    }
}

fn needed(lncl: &LnclConfig) -> u64 {
    // An unregistered connection counts as a client, since its next frame may make it one. No more connections are
    // accepted before earlier ones are cleaned up.
    let needed = PER_CLIENT * (lncl.clients_max + lncl.strangers_max) + LEFT + OWN;
    u64::try_from(needed).unwrap_or(u64::MAX)
}

/// Returns the limit to set, if it differs from the current one.
fn raised(limit: Rlimit, needed: u64) -> Option<Rlimit> {
    let current = limit.current?;
    let within = limit.maximum.map_or(needed, |maximum| needed.min(maximum));
    (current < within).then_some(Rlimit { current: Some(within), maximum: limit.maximum })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limit(current: Option<u64>, maximum: Option<u64>) -> Rlimit {
        Rlimit { current, maximum }
    }

    #[test]
    fn limit_is_raised_only_as_needed_and_allowed() {
        let (few, many) = (Some(1_024), Some(500_000));
        assert_eq!(raised(limit(few, many), 2_000), Some(limit(Some(2_000), many)));
        assert_eq!(raised(limit(few, None), 2_000), Some(limit(Some(2_000), None)));
        assert_eq!(raised(limit(few, Some(1_500)), 2_000), Some(limit(Some(1_500), Some(1_500))));
        assert_eq!(raised(limit(few, few), 2_000), None, "it may not");
        assert_eq!(raised(limit(many, many), 2_000), None);
        assert_eq!(raised(limit(None, None), 2_000), None);
    }
}
