//! Connections that have not said yet who they are: so many of one process, so many of all. Pure.
//!
//! Whoever is silent has its place for the time of a handshake. Without a bound for each process, one alone could have all
//! places again and again, and nobody else would ever be heard.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc};

/// The bounds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    /// Of all processes.
    pub(super) all: usize,
    /// Of one process.
    pub(super) per_process: usize,
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
    /// Several processes together.
    #[error(
        "{limit} connections have not said who they are, which is the limit; connect again, or raise `lncl.strangers_max`"
    )]
    All { limit: usize },
}

/// Who is silent.
#[derive(Clone, Debug, Default)]
pub(super) struct Strangers(Rc<RefCell<BTreeMap<i32, usize>>>);

impl Strangers {
    /// A place for a connection of the process `pid`.
    pub(super) fn admit(&self, pid: i32, bounds: Bounds) -> Result<Place, NoPlace> {
        let mut held = self.0.borrow_mut();
        let own = held.get(&pid).copied().unwrap_or_default();
        if own >= bounds.per_process {
            return Err(NoPlace::Process { pid, limit: bounds.per_process });
        }
        if held.values().sum::<usize>() >= bounds.all {
            return Err(NoPlace::All { limit: bounds.all });
        }
        held.insert(pid, own + 1);
        Ok(Place { strangers: self.clone(), pid })
    }
}

/// The place of a stranger, until it has said who it is, or has gone.
#[derive(Debug)]
pub(super) struct Place {
    strangers: Strangers,
    pid: i32,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut held = self.strangers.0.borrow_mut();
        match held.get_mut(&self.pid) {
            Some(own) if *own > 1 => *own -= 1,
            Some(_) | None => {
                held.remove(&self.pid);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Bounds = Bounds { all: 5, per_process: 3 };

    #[test]
    fn one_process_has_its_share_and_another_its_own() {
        let strangers = Strangers::default();
        let ours: Vec<_> = (0..3).map(|_| strangers.admit(1, BOUNDS).unwrap()).collect();
        assert_eq!(strangers.admit(1, BOUNDS).unwrap_err(), NoPlace::Process { pid: 1, limit: 3 });
        let _theirs = strangers.admit(2, BOUNDS).unwrap();
        drop(ours);
        assert!(strangers.admit(1, BOUNDS).is_ok());
    }

    #[test]
    fn all_together_have_no_more_than_there_are() {
        let strangers = Strangers::default();
        let places: Vec<_> = (0..5).map(|pid| strangers.admit(pid, BOUNDS).unwrap()).collect();
        assert_eq!(strangers.admit(9, BOUNDS).unwrap_err(), NoPlace::All { limit: 5 });
        drop(places);
        assert_eq!(strangers.0.borrow().len(), 0, "nothing is kept of those who have gone");
    }
}
