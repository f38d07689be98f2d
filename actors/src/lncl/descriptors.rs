//! Descriptors of the node's process: room for as many as its clients may cost, as far as the system allows it.
//!
//! The usual limit of 1,024 is one for programs that call `select`, and the hard limit above it is there to be used: with all
//! clients that the default configuration admits a node needs more.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use sinew_shm::Offer;

use super::worker::WAITING_MAX;
use crate::config::LnclConfig;

/// Of a client: its socket, its process, and the node's two bells. Until it is offered them the node has its memory and their other ends
/// besides: three. Of a task, its own two bells come in place of those; a thread has them in memory.
///
/// One that has gone leaves six at most: the socket; of rings that were made four bells; of an exchange that was refused the node's two, and
/// the three of the client's offer.
const PER_CLIENT: usize = 7;
/// What waits to be given back behind a descriptor that does not close, of those whose places others have by now: as many things as may.
/// None has more than an offer: a producer and a consumer have two each, what was not made both bells, a socket is one.
const LEFT: usize = WAITING_MAX * Offer::DESCRIPTORS_MAX;
/// The node's own, introductions that are not answered, and what the applications in its process may open.
const OWN: usize = 256;

/// Raises this process's limit to what the clients may cost, if it is lower and the system lets it.
pub(super) fn make_room(lncl: &LnclConfig) {
    let needed = needed(lncl);
    let limit = getrlimit(Resource::Nofile);
    let Some(raised) = raised(limit, needed) else { return };
    if let Err(cause) = setrlimit(Resource::Nofile, raised) {
        crate::log::warn!(%cause, needed, found = ?limit, "the limit of descriptors cannot be raised: with many clients there may be none left");
    }
}

fn needed(lncl: &LnclConfig) -> u64 {
    // A stranger is a client with its next frame, when others have left: no connection more is taken before that is given back.
    let needed = PER_CLIENT * (lncl.clients_max + lncl.strangers_max) + LEFT + OWN;
    u64::try_from(needed).unwrap_or(u64::MAX)
}

/// The limit that is to be set, if another one is.
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
    fn a_limit_is_raised_as_far_as_it_must_and_may_be_and_never_lowered() {
        let (few, many) = (Some(1_024), Some(500_000));
        assert_eq!(raised(limit(few, many), 2_000), Some(limit(Some(2_000), many)));
        assert_eq!(raised(limit(few, None), 2_000), Some(limit(Some(2_000), None)));
        assert_eq!(raised(limit(few, Some(1_500)), 2_000), Some(limit(Some(1_500), Some(1_500))));
        assert_eq!(raised(limit(few, few), 2_000), None, "it may not");
        assert_eq!(raised(limit(many, many), 2_000), None);
        assert_eq!(raised(limit(None, None), 2_000), None);
    }
}
