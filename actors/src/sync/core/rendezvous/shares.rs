//! What guests may have of the barriers of their node: the rest is there for the robot's own applications, whatever guests do.
//!
//! Counted is each barrier at which a guest was in its present life, also where others are, too: so it does not matter who came first, and
//! what is left never becomes less. A guest that ends gives back what it has.

use super::*;

/// Barriers at which one guest is in its life, at most.
const PER_GUEST_MAX: usize = 16;
/// Barriers at which guests of one user are, at most.
const PER_USER_MAX: usize = BARRIERS_MAX / 8;
/// Barriers at which guests are, at most.
const GUESTS_MAX: usize = BARRIERS_MAX / 4;
/// Guests that wait at one barrier, at most.
const GUESTS_WAITING_MAX: usize = ARRIVALS_MAX / 4;
/// Which part of our word barriers at which guests are may take: one in so many.
const PART_OF_WORD: usize = 4;

/// At how many barriers some are, beside the one that is asked for.
#[derive(Debug, Default)]
struct Visited {
    by_it: usize,
    by_its_user: usize,
    by_guests: usize,
}

impl Rendezvous {
    /// Whether guests leave enough to others if this one, called `name`, arrives at `key`. spec: SYNC-10
    ///
    /// # Errors
    /// What it may have, in words, and what it can do.
    pub(super) fn check_share(
        &self,
        key: &Key,
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
        let most = self.bytes_max / PART_OF_WORD;
        if bytes > most {
            return Err(format!(
                "what this node says of barriers at which applications of other users are could take {bytes} bytes; it has {most} for \
                 them, a quarter of `node.payload_max`; use fewer barriers, patterns or counts in place of long lists of names, or raise it"
            ));
        }
        Ok(())
    }

    fn check_waiting(&self, key: &Key, app: AppAddress) -> Result<(), String> {
        let Some(known) = self.known.get(key).filter(|known| !known.waiting.contains_key(&app)) else {
            return Ok(());
        };
        if known.waiting.keys().filter(|other| known.guests.contains_key(*other)).count() < GUESTS_WAITING_MAX
        {
            return Ok(());
        }
        Err(format!(
            "{GUESTS_WAITING_MAX} applications of other users wait there already, their limit on this node; come back when some have passed"
        ))
    }

    fn visited_beside(&self, key: &Key, (app, uid): (AppAddress, u32)) -> Visited {
        let mut visited = Visited::default();
        for (_, known) in self.known.iter().filter(|(other, known)| *other != key && !known.guests.is_empty())
        {
            visited.by_guests += 1;
            visited.by_its_user += usize::from(known.guests.values().any(|user| *user == uid));
            visited.by_it += usize::from(known.guests.contains_key(&app));
        }
        visited
    }
}
