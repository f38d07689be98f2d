//! Names of protected types, kept for the life of the process: a data ID is compared for ever.
//!
//! Who seals a message each millisecond looks its name up each time, and must not wait for a thread that brings a new one. So no lock is here: a
//! place is filled once and never emptied, and a name lies in the first place from its hash on that was free when it came. All places before that one are
//! filled by then, so that who looks for it waits at none.

use std::sync::OnceLock;

use sinew::message::Kind;

use crate::status::{Fault, Status};

/// Names of protected types of one process at most: nothing here is ever forgotten.
const NAMES_MAX: usize = 1024;

/// The same name, which stays. Where it is known, this waits for nobody and asks for no memory.
pub(crate) fn kept(name: &str) -> Result<&'static str, Fault> {
    static NAMES: Names<NAMES_MAX> = Names::new();
    NAMES.kept(name, || name.into()).ok_or_else(|| {
        let sentence = format!("this process has {NAMES_MAX} names of protected types already");
        Fault::new(Status::SinewErrorTooMany, sentence)
    })
}

struct Names<const MAX: usize> {
    places: [OnceLock<Box<str>>; MAX],
}

impl<const MAX: usize> Names<MAX> {
    const fn new() -> Self {
        Self { places: [const { OnceLock::new() }; MAX] }
    }

    /// The same name, which is made by `own` if it is new; `None` if it is, and all places are taken.
    fn kept(&self, name: &str, own: impl Fn() -> Box<str>) -> Option<&str> {
        let first = Kind::named(name).bits() as usize % MAX;
        let (before, from) = self.places.split_at(first);
        // Another thread may fill a free place first, with the same name or with another one: then that is what is compared.
        from.iter().chain(before).map(|place| &**place.get_or_init(&own)).find(|kept| *kept == name)
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::mpsc::sync_channel, thread, time::Duration};

    use super::*;

    /// Time after which a test that waits fails.
    const WATCHDOG: Duration = Duration::from_secs(30);

    #[test]
    fn a_name_is_kept_once_and_no_more_of_them_than_there_are_places() {
        // given: as many as there may be, whatever their hashes are
        let names = Names::<3>::new();
        let keep = |name: &'static str| names.kept(name, || name.into());
        let first = ["hip", "knee", "ankle"].map(keep);
        assert_eq!(first, [Some("hip"), Some("knee"), Some("ankle")]);
        // when: they come again, and one more
        let again = ["hip", "knee", "ankle"].map(|name| names.kept(name, || panic!("it is known")));
        // then
        assert_eq!(first.map(|name| name.map(str::as_ptr)), again.map(|name| name.map(str::as_ptr)));
        assert_eq!(keep("toe"), None);
    }

    #[test]
    fn threads_that_bring_one_name_at_once_get_the_same_one() {
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
    fn who_looks_for_a_known_name_does_not_wait_for_who_brings_a_new_one() {
        // given: a thread that was interrupted while it brings the second of two names
        let names = Names::<2>::new();
        assert_eq!(names.kept("hip", || "hip".into()), Some("hip"));
        let ((begins, has_begun), (allow, may_end)) = (sync_channel(1), sync_channel::<()>(1));
        thread::scope(|scope| {
            let names = &names;
            scope.spawn(move || {
                names.kept("knee", || {
                    begins.send(()).expect("somebody waits for it");
                    // Where nothing comes the test has failed.
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
