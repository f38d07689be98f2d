//! Connections that have not said yet who they are: so many of one process, so many of a guest, so many of all. Pure.
//!
//! Whoever is silent has its place for the time of a handshake. Without a bound for each process, one alone could have all
//! places again and again, and nobody else would ever be heard. A guest, a user whom only the access list lets in, could have them by several
//! processes: so one has a quarter of them at most, and all guests have half.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc};

use super::core::User;

/// The bounds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    /// Of all processes.
    pub(super) all: usize,
    /// Of one process.
    pub(super) per_process: usize,
}

impl Bounds {
    /// Of all guests.
    fn guests(self) -> usize {
        (self.all / 2).max(1)
    }

    /// Of one guest.
    fn per_guest(self) -> usize {
        (self.all / 4).max(1)
    }
}

/// Who connects.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stranger {
    /// Its process; 0 where the kernel does not say it: such connections are counted with all, and not as one process.
    pub(super) pid: i32,
    /// Its user.
    pub(super) user: User,
}

/// Why a connection has no place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum NoPlace {
    /// The process is at fault.
    #[error(
        "process {pid} has {limit} connections that have not said who they are, which is the limit for one process; \
         send LNCL_REGISTER on them, or raise `lncl.strangers_per_process_max`"
    )]
    Process { pid: i32, limit: usize },
    /// The user is at fault.
    #[error(
        "user {uid} has {limit} connections that have not said who they are, a quarter of `lncl.strangers_max`; send LNCL_REGISTER on \
         them, or raise it"
    )]
    Guest { uid: u32, limit: usize },
    /// Several users together whom only the access list lets in.
    #[error(
        "{limit} connections of users whom only the access list lets in have not said who they are, half of `lncl.strangers_max`; connect \
         again, or raise it"
    )]
    Guests { limit: usize },
    /// Several processes together.
    #[error(
        "{limit} connections have not said who they are, which is the limit; connect again, or raise `lncl.strangers_max`"
    )]
    All { limit: usize },
}

/// Who is silent.
#[derive(Clone, Debug, Default)]
pub(super) struct Strangers(Rc<RefCell<Silent>>);

#[derive(Debug, Default)]
struct Silent {
    processes: BTreeMap<i32, usize>,
    guests: BTreeMap<u32, usize>,
}

impl Strangers {
    /// A place for a connection.
    pub(super) fn admit(&self, who: Stranger, bounds: Bounds) -> Result<Place, NoPlace> {
        let Silent { processes, guests } = &mut *self.0.borrow_mut();
        let of_process = processes.get(&who.pid).copied().unwrap_or_default();
        if who.pid != 0 && of_process >= bounds.per_process {
            return Err(NoPlace::Process { pid: who.pid, limit: bounds.per_process });
        }
        if let User::Guest(uid) = who.user {
            if guests.get(&uid).is_some_and(|count| *count >= bounds.per_guest()) {
                return Err(NoPlace::Guest { uid, limit: bounds.per_guest() });
            }
            if guests.values().sum::<usize>() >= bounds.guests() {
                return Err(NoPlace::Guests { limit: bounds.guests() });
            }
        }
        if processes.values().sum::<usize>() >= bounds.all {
            return Err(NoPlace::All { limit: bounds.all });
        }
        *processes.entry(who.pid).or_default() += 1;
        if let User::Guest(uid) = who.user {
            *guests.entry(uid).or_default() += 1;
        }
        Ok(Place { strangers: self.clone(), who })
    }
}

/// The place of a stranger, until it has said who it is, or has gone.
#[derive(Debug)]
pub(super) struct Place {
    strangers: Strangers,
    who: Stranger,
}

impl Drop for Place {
    fn drop(&mut self) {
        let Silent { processes, guests } = &mut *self.strangers.0.borrow_mut();
        one_less(processes, self.who.pid);
        if let User::Guest(uid) = self.who.user {
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

    const fn own(pid: i32) -> Stranger {
        Stranger { pid, user: User::Own }
    }

    #[test]
    fn one_process_has_its_share_and_another_its_own() {
        let strangers = Strangers::default();
        let ours: Vec<_> = (0..3).map(|_| strangers.admit(own(1), BOUNDS).unwrap()).collect();
        assert_eq!(strangers.admit(own(1), BOUNDS).unwrap_err(), NoPlace::Process { pid: 1, limit: 3 });
        let _theirs = strangers.admit(own(2), BOUNDS).unwrap();
        drop(ours);
        assert!(strangers.admit(own(1), BOUNDS).is_ok());
    }

    #[test]
    fn processes_whose_pids_are_unknown_are_not_one_process() {
        let strangers = Strangers::default();
        let _places: Vec<_> = (0..5).map(|_| strangers.admit(own(0), BOUNDS).unwrap()).collect();
        assert_eq!(strangers.admit(own(0), BOUNDS).unwrap_err(), NoPlace::All { limit: 5 });
    }

    #[test]
    fn all_together_have_no_more_than_there_are() {
        let strangers = Strangers::default();
        let places: Vec<_> = (0..5).map(|pid| strangers.admit(own(pid), BOUNDS).unwrap()).collect();
        assert_eq!(strangers.admit(own(9), BOUNDS).unwrap_err(), NoPlace::All { limit: 5 });
        drop(places);
        assert!(strangers.0.borrow().processes.is_empty(), "nothing is kept of those who have gone");
    }

    #[test]
    fn guests_leave_half_of_the_places_and_one_of_them_half_of_theirs_however_many_processes_they_have() {
        let (strangers, bounds) = (Strangers::default(), Bounds { all: 8, per_process: 8 });
        let admit = |pid, uid| strangers.admit(Stranger { pid, user: User::Guest(uid) }, bounds);
        let first: Vec<_> = (0..2).map(|pid| admit(pid, 1_001).unwrap()).collect();
        assert_eq!(admit(2, 1_001).unwrap_err(), NoPlace::Guest { uid: 1_001, limit: 2 });
        let second: Vec<_> = (10..12).map(|pid| admit(pid, 1_002).unwrap()).collect();
        assert_eq!(admit(20, 1_003).unwrap_err(), NoPlace::Guests { limit: 4 });
        let ours: Vec<_> = (0..4).map(|_| strangers.admit(own(30), bounds).unwrap()).collect();
        drop((first, second, ours));
        assert!(strangers.0.borrow().guests.is_empty(), "nothing is kept of those who have gone");
    }
}
