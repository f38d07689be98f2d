//! Limits on connections that are not registered yet: for one process, for one guest, and for all. Pure.
//!
//! A silent connection holds its slot until the handshake's deadline. Without a limit per process, one process could
//! hold all slots again and again, and lock out all others. A guest, a user that only the access list admits, could do
//! so with several processes. So one guest has at most a quarter of the slots, and all guests have half.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc};

use sinew_model::facts::User;

/// The bounds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    /// For all processes.
    pub(super) all: usize,
    /// For one process.
    pub(super) per_process: usize,
}

impl Bounds {
    /// For all guests.
    fn guests(self) -> usize {
        (self.all / 2).max(1)
    }

    /// For one guest.
    fn per_guest(self) -> usize {
        (self.all / 4).max(1)
    }
}

/// A connecting process.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unauthenticated {
    /// Its process; 0 if the kernel does not report it. Such connections count towards all, but not as one process.
    pub(super) pid: i32,
    pub(super) user: User,
}

/// The limit that refuses a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum LimitError {
    /// The process is at fault.
    #[error(
        "process {pid} has {limit} unregistered connections, which is the limit for one process; \
         send LNCL_REGISTER on them, or raise `lncl.strangers_per_process_max`"
    )]
    Process { pid: i32, limit: usize },
    /// The user is at fault.
    #[error(
        "user {uid} has {limit} unregistered connections, a quarter of `lncl.strangers_max`; send LNCL_REGISTER on \
         them, or raise it"
    )]
    Guest { uid: u32, limit: usize },
    /// Several guests together.
    #[error(
        "{limit} connections of users that only the access list admits are unregistered, half of `lncl.strangers_max`; connect \
         again, or raise it"
    )]
    Guests { limit: usize },
    /// Several processes together.
    #[error(
        "{limit} connections are unregistered, which is the limit; connect again, or raise `lncl.strangers_max`"
    )]
    All { limit: usize },
}

/// The connections that are not registered yet.
#[derive(Clone, Debug, Default)]
pub(super) struct UnauthenticatedLimits(Rc<RefCell<Counts>>);

#[derive(Debug, Default)]
struct Counts {
    processes: BTreeMap<i32, usize>,
    guests: BTreeMap<u32, usize>,
}

impl UnauthenticatedLimits {
    /// Reserves a slot for a connection.
    pub(super) fn admit(&self, peer: Unauthenticated, bounds: Bounds) -> Result<Slot, LimitError> {
        let Counts { processes, guests } = &mut *self.0.borrow_mut();
        let of_process = processes.get(&peer.pid).copied().unwrap_or_default();
        if peer.pid != 0 && of_process >= bounds.per_process {
            return Err(LimitError::Process { pid: peer.pid, limit: bounds.per_process });
        }
        if let User::Guest(uid) = peer.user {
            if guests.get(&uid).is_some_and(|count| *count >= bounds.per_guest()) {
                return Err(LimitError::Guest { uid, limit: bounds.per_guest() });
            }
            if guests.values().sum::<usize>() >= bounds.guests() {
                return Err(LimitError::Guests { limit: bounds.guests() });
            }
        }
        if processes.values().sum::<usize>() >= bounds.all {
            return Err(LimitError::All { limit: bounds.all });
        }
        *processes.entry(peer.pid).or_default() += 1;
        if let User::Guest(uid) = peer.user {
            *guests.entry(uid).or_default() += 1;
        }
        Ok(Slot { limits: self.clone(), peer })
    }
}

/// The slot of an unregistered connection. It is released when the connection registers or ends.
#[derive(Debug)]
pub(super) struct Slot {
    limits: UnauthenticatedLimits,
    peer: Unauthenticated,
}

impl Drop for Slot {
    fn drop(&mut self) {
        let Counts { processes, guests } = &mut *self.limits.0.borrow_mut();
        one_less(processes, self.peer.pid);
        if let User::Guest(uid) = self.peer.user {
            one_less(guests, uid);
        }
    }
}

fn one_less<K: Ord>(counts: &mut BTreeMap<K, usize>, of: K) {
    match counts.get_mut(&of) {
        Some(count) if *count > 1 => *count -= 1,
        Some(_) | None => {
            counts.remove(&of);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Bounds = Bounds { all: 5, per_process: 3 };

    const fn own(pid: i32) -> Unauthenticated {
        Unauthenticated { pid, user: User::Own }
    }

    #[test]
    fn each_process_has_its_own_share() {
        let limits = UnauthenticatedLimits::default();
        let ours: Vec<_> = (0..3).map(|_| limits.admit(own(1), BOUNDS).unwrap()).collect();
        assert_eq!(limits.admit(own(1), BOUNDS).unwrap_err(), LimitError::Process { pid: 1, limit: 3 });
        let _theirs = limits.admit(own(2), BOUNDS).unwrap();
        drop(ours);
        assert!(limits.admit(own(1), BOUNDS).is_ok());
    }

    #[test]
    fn processes_with_unknown_pids_are_not_one_process() {
        let limits = UnauthenticatedLimits::default();
        let _places: Vec<_> = (0..5).map(|_| limits.admit(own(0), BOUNDS).unwrap()).collect();
        assert_eq!(limits.admit(own(0), BOUNDS).unwrap_err(), LimitError::All { limit: 5 });
    }

    #[test]
    fn total_is_bounded() {
        let limits = UnauthenticatedLimits::default();
        let places: Vec<_> = (0..5).map(|pid| limits.admit(own(pid), BOUNDS).unwrap()).collect();
        assert_eq!(limits.admit(own(9), BOUNDS).unwrap_err(), LimitError::All { limit: 5 });
        drop(places);
        assert!(limits.0.borrow().processes.is_empty(), "nothing is kept of ended connections");
    }

    #[test]
    fn guests_leave_half_and_one_user_half_of_that() {
        let (limits, bounds) = (UnauthenticatedLimits::default(), Bounds { all: 8, per_process: 8 });
        let admit = |pid, uid| limits.admit(Unauthenticated { pid, user: User::Guest(uid) }, bounds);
        let first: Vec<_> = (0..2).map(|pid| admit(pid, 1_001).unwrap()).collect();
        assert_eq!(admit(2, 1_001).unwrap_err(), LimitError::Guest { uid: 1_001, limit: 2 });
        let second: Vec<_> = (10..12).map(|pid| admit(pid, 1_002).unwrap()).collect();
        assert_eq!(admit(20, 1_003).unwrap_err(), LimitError::Guests { limit: 4 });
        let ours: Vec<_> = (0..4).map(|_| limits.admit(own(30), bounds).unwrap()).collect();
        drop((first, second, ours));
        assert!(limits.0.borrow().guests.is_empty(), "nothing is kept of ended connections");
    }
}
