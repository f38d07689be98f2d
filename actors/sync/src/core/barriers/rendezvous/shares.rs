//! The share of guests in the barriers of their node. The rest is reserved for the robot's own applications.
//!
//! A barrier counts if a guest visited it in its current life, also if other applications did. The order of
//! arrival therefore does not matter, and the remaining share never shrinks. A guest returns its share when
//! it ends.

use super::*;

/// Maximum number of barriers that one guest visits in its life.
const PER_GUEST_MAX: usize = 16;
/// Maximum number of barriers that guests of one user visit.
const PER_USER_MAX: usize = BARRIERS_MAX / 8;
/// Maximum number of barriers that guests visit.
const GUESTS_MAX: usize = BARRIERS_MAX / 4;
/// Maximum number of guests that wait at one barrier.
const GUESTS_WAITING_MAX: usize = ARRIVALS_MAX / 4;
/// Divisor of the frame size: barriers with guests may take this part of the frame.
const FRAME_SHARE_DIVISOR: usize = 4;

/// Numbers of visited barriers, without the requested one.
#[derive(Debug, Default)]
struct Visited {
    by_it: usize,
    by_its_user: usize,
    by_guests: usize,
}

impl Rendezvous {
    /// Checks that guests leave enough to others if the guest called `name` arrives at `key`. spec: SYNC-10
    ///
    /// # Errors
    /// Returns the description of the limit, and a remedy, if the share is exhausted.
    pub(super) fn check_share(
        &self,
        key: &BarrierKey,
        parties: &[Requirement],
        name: &str,
        (app, uid): (AppAddress, u32),
    ) -> Result<(), String> {
        let Visited { by_it, by_its_user, by_guests } = self.visited_beside(key, (app, uid));
        if by_it >= PER_GUEST_MAX {
            return Err(format!(
                "it has been at {PER_GUEST_MAX} barriers in its life, the limit on this node for an application of another user (uid {uid}); \
                 a barrier opens as often as one likes: use one name for all rounds"
            ));
        }
        if by_its_user >= PER_USER_MAX {
            return Err(format!(
                "applications of user {uid} are at {PER_USER_MAX} barriers, the limit on this node for one other user; end one of them, or \
                 let them use fewer names: a barrier opens as often as one likes"
            ));
        }
        if by_guests >= GUESTS_MAX {
            return Err(format!(
                "applications of other users are at {GUESTS_MAX} barriers, their limit on this node, which keeps the rest for its own user's; \
                 end one of them, or let them use fewer names"
            ));
        }
        self.check_waiting(key, app)?;
        let bytes = self.bytes_with(key, parties, name, |known| !known.guests.is_empty());
        let most = self.bytes_max / FRAME_SHARE_DIVISOR;
        if bytes > most {
            return Err(format!(
                "the barriers of applications of other users could take {bytes} bytes of this node's barrier frame, and their limit is {most}, \
                 a quarter of `node.payload_max`; use fewer barriers, patterns or counts in place of long lists of names, or raise it"
            ));
        }
        Ok(())
    }

    fn check_waiting(&self, key: &BarrierKey, app: AppAddress) -> Result<(), String> {
        let Some(known) = self.barriers.get(key).filter(|known| !known.waiting.contains_key(&app)) else {
            return Ok(());
        };
        if known.waiting.keys().filter(|other| known.guests.contains_key(*other)).count() < GUESTS_WAITING_MAX
        {
            return Ok(());
        }
        Err(format!(
            "{GUESTS_WAITING_MAX} applications of other users wait there already, their limit on this node; retry when some have passed"
        ))
    }

    fn visited_beside(&self, key: &BarrierKey, (app, uid): (AppAddress, u32)) -> Visited {
        let mut visited = Visited::default();
        for (_, known) in
            self.barriers.iter().filter(|(other, known)| *other != key && !known.guests.is_empty())
        {
            visited.by_guests += 1;
            visited.by_its_user += usize::from(known.guests.values().any(|user| *user == uid));
            visited.by_it += usize::from(known.guests.contains_key(&app));
        }
        visited
    }
}
