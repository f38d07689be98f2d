//! How many memberships of groups processes have that are let in by a rule alone, so that they leave room for the robot's own. Pure.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::{outcome::Rejection, tid::AppAddress};

use super::client::ClientRefusal;

/// Memberships of all applications of one such user at most.
pub(super) const OF_USER_MAX: usize = 512;
/// Memberships of all such users together at most.
pub(super) const OF_ALL_MAX: usize = 4_096;

/// Why a process does not become a member of a group.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum JoinRefusal {
    /// The list does not let it. It is at fault, or the list is.
    #[error(transparent)]
    NotAllowed(#[from] ClientRefusal),
    /// Its user is at fault.
    #[error(
        "user {0} has {OF_USER_MAX} memberships of groups with all its applications here, which is the most; leave groups first"
    )]
    UserFull(u32),
    /// Users whom a rule lets in are at fault, together.
    #[error(
        "users whom a [[client]] lets in have {OF_ALL_MAX} memberships of groups, which is the most for all of them together; leave groups first"
    )]
    GuestsFull,
    /// Nobody is at fault: there are too many.
    #[error(
        "the node's applications have {limit} memberships of groups, from which on other processes get none; leave groups first"
    )]
    NodeFull {
        /// The limit.
        limit: usize,
    },
    /// Nobody is at fault: its registration is over.
    #[error("its address is not its own any more: the node's LNCL was replaced; connect again")]
    Gone,
}

impl JoinRefusal {
    /// What the process is told, which is a byte.
    pub(crate) const fn why(&self) -> Rejection {
        match self {
            Self::NotAllowed(_) => Rejection::NotAllowed,
            Self::Gone => Rejection::NoSuchApplication,
            Self::UserFull(_) | Self::GuestsFull | Self::NodeFull { .. } => Rejection::QueueFull,
        }
    }
}

/// The memberships of guests: users beside the node's own and root, whom a rule lets in.
#[derive(Debug, Default)]
pub(super) struct Memberships {
    guests: BTreeMap<AppAddress, Guest>,
    of_user: BTreeMap<u32, usize>,
    of_all: usize,
}

#[derive(Debug)]
struct Guest {
    uid: u32,
    memberships: usize,
}

impl Memberships {
    /// A guest has this address. Bounded by who may be registered: half of `lncl.clients_max` for all of them.
    pub(super) fn came(&mut self, app: AppAddress, uid: u32) {
        self.gone(app);
        self.guests.insert(app, Guest { uid, memberships: 0 });
    }

    /// Whoever had this address has gone, and is in no group any more.
    pub(super) fn gone(&mut self, app: AppAddress) {
        if let Some(Guest { uid, memberships }) = self.guests.remove(&app) {
            self.take_back(uid, memberships);
        }
    }

    /// The application joins a group more. One that is no guest's may.
    pub(super) fn join(&mut self, app: AppAddress) -> Result<(), JoinRefusal> {
        let Some(guest) = self.guests.get_mut(&app) else { return Ok(()) };
        let of_user = self.of_user.get(&guest.uid).copied().unwrap_or(0);
        if of_user >= OF_USER_MAX {
            return Err(JoinRefusal::UserFull(guest.uid));
        }
        if self.of_all >= OF_ALL_MAX {
            return Err(JoinRefusal::GuestsFull);
        }
        guest.memberships += 1;
        self.of_user.insert(guest.uid, of_user + 1);
        self.of_all += 1;
        Ok(())
    }

    /// The application has left a group.
    pub(super) fn leave(&mut self, app: AppAddress) {
        if let Some(guest) = self.guests.get_mut(&app).filter(|guest| guest.memberships > 0) {
            guest.memberships -= 1;
            let uid = guest.uid;
            self.take_back(uid, 1);
        }
    }

    /// Which applications are guests'.
    pub(super) fn guests(&self) -> BTreeSet<AppAddress> {
        self.guests.keys().copied().collect()
    }

    /// Of a user who has none nothing is kept.
    fn take_back(&mut self, uid: u32, memberships: usize) {
        self.of_all -= memberships;
        let Some(of_user) = self.of_user.get_mut(&uid) else { return };
        *of_user -= memberships;
        if *of_user == 0 {
            self.of_user.remove(&uid);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn app(number: u32) -> AppAddress {
        AppAddress::new(0x8000_0000 + number)
    }

    /// Joins groups until there is no room, and says how many and why.
    fn join_all(memberships: &mut Memberships, app: AppAddress) -> (usize, JoinRefusal) {
        let mut joined = 0;
        loop {
            match memberships.join(app) {
                Ok(()) => joined += 1,
                Err(why) => return (joined, why),
            }
        }
    }

    #[test]
    fn a_user_has_a_share_with_all_its_applications_and_leaves_it_to_itself_alone() {
        let mut memberships = Memberships::default();
        [(0, 1_001), (1, 1_001), (2, 1_002)]
            .into_iter()
            .for_each(|(number, uid)| memberships.came(app(number), uid));
        (0..OF_USER_MAX / 2).for_each(|_| assert_eq!(memberships.join(app(0)), Ok(())));
        let (joined, why) = join_all(&mut memberships, app(1));
        assert_eq!((joined, why.clone()), (OF_USER_MAX / 2, JoinRefusal::UserFull(1_001)));
        assert!(why.to_string().contains("1001") && why.why() == Rejection::QueueFull, "{why}");
        assert_eq!(memberships.join(app(2)), Ok(()), "another user");
        assert_eq!(memberships.join(app(9)), Ok(()), "one of the robot's own");
        // When one leaves, or its application goes, there is room again.
        memberships.leave(app(0));
        assert_eq!(join_all(&mut memberships, app(1)).0, 1);
        memberships.gone(app(0));
        assert_eq!(join_all(&mut memberships, app(1)).0, OF_USER_MAX / 2 - 1);
        assert_eq!(memberships.guests(), BTreeSet::from([app(1), app(2)]));
    }

    #[test]
    fn many_users_have_a_bound_together_and_nothing_is_kept_of_who_has_gone() {
        let mut memberships = Memberships::default();
        let users = (OF_ALL_MAX / OF_USER_MAX) as u32;
        for number in 0..=users {
            memberships.came(app(number), number);
            let (joined, why) = join_all(&mut memberships, app(number));
            let expected = if number < users {
                (OF_USER_MAX, JoinRefusal::UserFull(number))
            } else {
                (0, JoinRefusal::GuestsFull)
            };
            assert_eq!((joined, why), expected);
        }
        (0..=users).for_each(|number| memberships.gone(app(number)));
        // Of one that was not in any group, and is not there, nothing can be taken back.
        memberships.leave(app(0));
        assert!(memberships.guests.is_empty() && memberships.of_user.is_empty() && memberships.of_all == 0);
    }
}
