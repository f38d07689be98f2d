//! Names of protected types, kept for the life of the process: a data ID is compared until the process ends.
//!
//! A thread that seals a message each millisecond looks its name up each time, and must not wait for a thread
//! that adds a new one. So there is no lock: a slot is filled once and never emptied. A name is in the first
//! slot, from its hash on, that was free when it was added. All slots before that one are filled by then, so
//! that a lookup waits at none of them.

use std::sync::OnceLock;

use sinew_runtime::wire::Kind;

use crate::status::{CallError, Status};

/// Maximum number of names of protected types in one process: none is ever removed.
const NAMES_MAX: usize = 1024;

/// Returns the same name with static lifetime. If the name is known, this neither waits nor allocates.
pub(crate) fn kept(name: &str) -> Result<&'static str, CallError> {
    static NAMES: Names<NAMES_MAX> = Names::new();
    NAMES.kept(name, || name.into()).ok_or_else(|| {
        let sentence = format!("this process has {NAMES_MAX} names of protected types already");
        CallError::new(Status::SinewErrorTooMany, sentence)
    })
}

struct Names<const MAX: usize> {
    slots: [OnceLock<Box<str>>; MAX],
}

impl<const MAX: usize> Names<MAX> {
    const fn new() -> Self {
        Self { slots: [const { OnceLock::new() }; MAX] }
    }

    /// Returns the kept copy of the name, created by `own` if it is new; `None` if it is new and all slots
    /// are taken.
    fn kept(&self, name: &str, own: impl Fn() -> Box<str>) -> Option<&str> {
        let first = Kind::named(name).bits() as usize % MAX;
        let (before, from) = self.slots.split_at(first);
        // Another thread may fill a free slot first, with the same name or with another one: then that name
        // is compared.
        from.iter().chain(before).map(|slot| &**slot.get_or_init(&own)).find(|kept| *kept == name)
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::mpsc::sync_channel, thread, time::Duration};

    use super::*;

    /// Time after which a test that waits fails.
    const WATCHDOG: Duration = Duration::from_secs(30);

    #[test]
    fn names_are_kept_once_and_bounded() {
        // given: as many names as there are slots, with any hashes
        let names = Names::<3>::new();
        let keep = |name: &'static str| names.kept(name, || name.into());
        let first = ["hip", "knee", "ankle"].map(keep);
        assert_eq!(first, [Some("hip"), Some("knee"), Some("ankle")]);
        // when: the same names are added again, and one more
        let again = ["hip", "knee", "ankle"].map(|name| names.kept(name, || panic!("it is known")));
        // then
        assert_eq!(first.map(|name| name.map(str::as_ptr)), again.map(|name| name.map(str::as_ptr)));
        assert_eq!(keep("toe"), None);
    }

    #[test]
    fn concurrent_additions_of_a_name_share_one_copy() {
        let names = Names::<8>::new();
        let kept: Vec<_> = thread::scope(|scope| {
            let bring = |name: &'static str| {
                let names = &names;
                scope.spawn(move || names.kept(name, || name.into()).map(|kept| (name, kept)))
            };
            let threads: Vec<_> = ["hip", "knee"].repeat(8).into_iter().map(bring).collect();
            threads.into_iter().map(|thread| thread.join().expect("it does not panic")).collect()
        });
        for (name, kept) in kept.into_iter().map(|kept| kept.expect("there is room")) {
            let known = names.kept(name, || panic!("it is known"));
            assert_eq!((kept, Some(kept.as_ptr())), (name, known.map(str::as_ptr)));
        }
    }

    #[test]
    fn lookup_does_not_wait_for_an_insertion() {
        // given: a thread that was interrupted while it adds the second of two names
        let names = Names::<2>::new();
        assert_eq!(names.kept("hip", || "hip".into()), Some("hip"));
        let ((begins, has_begun), (allow, may_end)) = (sync_channel(1), sync_channel::<()>(1));
        thread::scope(|scope| {
            let names = &names;
            scope.spawn(move || {
                names.kept("knee", || {
                    begins.send(()).expect("the test waits for it");
                    // Without an answer the test has failed.
                    let _ = may_end.recv_timeout(WATCHDOG);
                    "knee".into()
                })
            });
            has_begun.recv_timeout(WATCHDOG).expect("the name is new");
            // when
            let (finds, found) = sync_channel(1);
            scope.spawn(move || finds.send(names.kept("hip", || panic!("it is known"))));
            // then
            assert_eq!(found.recv_timeout(WATCHDOG / 2), Ok(Some("hip")));
            allow.send(()).expect("it waits");
        });
        assert_eq!(names.kept("knee", || panic!("it is known")), Some("knee"));
    }
}
