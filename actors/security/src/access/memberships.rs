//! Limits the group memberships of guest processes, so that room is left for the robot's own processes. Pure.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::{outcome::Rejection, tid::AppAddress};

use super::client::ClientAccessError;

/// Maximum number of memberships of all applications of one guest user.
pub(super) const OF_USER_MAX: usize = 512;
/// Maximum number of memberships of all guest users together.
pub(super) const OF_ALL_MAX: usize = 4_096;

/// The reason why a process does not become a member of a group.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum JoinGroupError {
    /// The list does not allow the membership. The process or the list is at fault.
    #[error(transparent)]
    NotAllowed(#[from] ClientAccessError),
    /// The user's limit is reached. The user is at fault.
    #[error(
        "user {0} has {OF_USER_MAX} memberships of groups with all its applications here, which is the most; leave groups first"
    )]
    UserFull(u32),
    /// The limit of all guest users together is reached. The guest users are at fault.
    #[error(
        "users that a [[client]] admits have {OF_ALL_MAX} memberships of groups, which is the most for all of them together; leave groups first"
    )]
    GuestsFull,
    /// The node's limit is reached. No single application is at fault.
    #[error(
        "the node's applications have {limit} memberships of groups, from which on other processes get none; leave groups first"
    )]
    NodeFull {
        /// The limit.
        limit: usize,
    },
    /// The registration of the process has ended. No application is at fault.
    #[error("its address is not its own any more: the node's LNCL was replaced; connect again")]
    Gone,
}

impl JoinGroupError {
    /// Returns the rejection for the process, which is one byte.
    pub const fn why(&self) -> Rejection {
        match self {
            Self::NotAllowed(_) => Rejection::NotAllowed,
            Self::Gone => Rejection::NoSuchApplication,
            Self::UserFull(_) | Self::GuestsFull | Self::NodeFull { .. } => Rejection::QueueFull,
        }
    }
}

/// The memberships of guests. A guest is a user other than the node's own user and root, admitted by a rule.
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
    /// Registers a guest at this address. The registration limit bounds the table: half of `lncl.clients_max` for all
    /// guests.
    pub(super) fn add_guest(&mut self, app: AppAddress, uid: u32) {
        self.remove(app);
        self.guests.insert(app, Guest { uid, memberships: 0 });
    }

    /// Removes the application at this address and all its memberships.
    pub(super) fn remove(&mut self, app: AppAddress) {
        if let Some(Guest { uid, memberships }) = self.guests.remove(&app) {
            self.subtract(uid, memberships);
        }
    }

    /// Counts one more membership of the application. An application that is not a guest's is always allowed.
    pub(super) fn join(&mut self, app: AppAddress) -> Result<(), JoinGroupError> {
        let Some(guest) = self.guests.get_mut(&app) else { return Ok(()) };
        let of_user = self.of_user.get(&guest.uid).copied().unwrap_or(0);
        if of_user >= OF_USER_MAX {
            return Err(JoinGroupError::UserFull(guest.uid));
        }
        if self.of_all >= OF_ALL_MAX {
            return Err(JoinGroupError::GuestsFull);
        }
        guest.memberships += 1;
        self.of_user.insert(guest.uid, of_user + 1);
        self.of_all += 1;
        Ok(())
    }

    /// Counts one membership less of the application.
    pub(super) fn leave(&mut self, app: AppAddress) {
        if let Some(guest) = self.guests.get_mut(&app).filter(|guest| guest.memberships > 0) {
            guest.memberships -= 1;
            let uid = guest.uid;
            self.subtract(uid, 1);
        }
    }

    /// Returns whether the application at this address is a guest's.
    pub(super) fn is_guest(&self, app: AppAddress) -> bool {
        self.guests.contains_key(&app)
    }

    /// Returns the applications of guests.
    pub(super) fn guests(&self) -> BTreeSet<AppAddress> {
        self.guests.keys().copied().collect()
    }

    /// Subtracts memberships of a user. The entry of a user without memberships is removed.
    fn subtract(&mut self, uid: u32, memberships: usize) {
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

    /// Joins groups until there is no room. Returns the number of joins and the reason for the refusal.
    fn join_all(memberships: &mut Memberships, app: AppAddress) -> (usize, JoinGroupError) {
        let mut joined = 0;
        loop {
            match memberships.join(app) {
                Ok(()) => joined += 1,
                Err(why) => return (joined, why),
            }
        }
    }

    #[test]
    fn applications_of_one_user_share_one_membership_quota() {
        let mut memberships = Memberships::default();
        [(0, 1_001), (1, 1_001), (2, 1_002)]
            .into_iter()
            .for_each(|(number, uid)| memberships.add_guest(app(number), uid));
        (0..OF_USER_MAX / 2).for_each(|_| assert_eq!(memberships.join(app(0)), Ok(())));
        let (joined, why) = join_all(&mut memberships, app(1));
        assert_eq!((joined, why.clone()), (OF_USER_MAX / 2, JoinGroupError::UserFull(1_001)));
        assert!(why.to_string().contains("1001") && why.why() == Rejection::QueueFull, "{why}");
        assert_eq!(memberships.join(app(2)), Ok(()), "another user");
        assert_eq!(memberships.join(app(9)), Ok(()), "one of the robot's own");
        // A leave, or the end of the application, frees its room.
        memberships.leave(app(0));
        assert_eq!(join_all(&mut memberships, app(1)).0, 1);
        memberships.remove(app(0));
        assert_eq!(join_all(&mut memberships, app(1)).0, OF_USER_MAX / 2 - 1);
        assert_eq!(memberships.guests(), BTreeSet::from([app(1), app(2)]));
    }

    #[test]
    fn all_users_share_a_bound_and_leave_no_entries() {
        let mut memberships = Memberships::default();
        let users = (OF_ALL_MAX / OF_USER_MAX) as u32;
        for number in 0..=users {
            memberships.add_guest(app(number), number);
            let (joined, why) = join_all(&mut memberships, app(number));
            let expected = if number < users {
                (OF_USER_MAX, JoinGroupError::UserFull(number))
            } else {
                (0, JoinGroupError::GuestsFull)
            };
            assert_eq!((joined, why), expected);
        }
        (0..=users).for_each(|number| memberships.remove(app(number)));
        // The end of an application without memberships frees nothing.
        memberships.leave(app(0));
        assert!(memberships.guests.is_empty() && memberships.of_user.is_empty() && memberships.of_all == 0);
    }
}
