//! The observers of one sort of event in this process: a list that is read without a lock, and that owns none of them.

use std::sync::{
    Arc, Mutex, Weak,
    atomic::{AtomicBool, Ordering},
};

use arc_swap::ArcSwapOption;

use crate::lock;

/// Maximum number of observers in a process: each node of it that records is one.
const OBSERVERS_MAX: usize = 64;

/// The observers, some of which may have been dropped.
pub(crate) struct Observers<T: ?Sized + 'static> {
    list: ArcSwapOption<Vec<Weak<T>>>,
    /// Whether there may be one. SYNC: Relaxed; the list has its own order, and an observer that is just being added
    /// may miss an event.
    is_used: AtomicBool,
    /// Held while the list is replaced.
    change: Mutex<()>,
}

impl<T: ?Sized + 'static> Observers<T> {
    /// Creates an empty list.
    pub(crate) const fn new() -> Self {
        Self { list: ArcSwapOption::const_empty(), is_used: AtomicBool::new(false), change: Mutex::new(()) }
    }

    /// Adds an observer for as long as it lives, in place of `former`: each event reaches one of the two. Returns
    /// `false` if there are too many; `former` is removed all the same.
    pub(crate) fn add(&self, observer: &Arc<T>, former: Option<&Arc<T>>) -> bool {
        self.replace(former, Some(observer))
    }

    /// Removes an observer. Without any other one an event costs one load again.
    pub(crate) fn remove(&self, observer: &Arc<T>) {
        self.replace(Some(observer), None);
    }

    /// Removes `former`, and adds `next` if there is room. Returns whether there is.
    fn replace(&self, former: Option<&Arc<T>>, next: Option<&Arc<T>>) -> bool {
        let _change = lock(&self.change);
        let before = self.list.load();
        let former = former.map(Arc::downgrade);
        let stays = |other: &&Weak<T>| {
            other.strong_count() > 0 && former.as_ref().is_none_or(|former| !former.ptr_eq(other))
        };
        let mut observers: Vec<_> =
            before.iter().flat_map(|observers| observers.iter()).filter(stays).cloned().collect();
        let has_room = observers.len() < OBSERVERS_MAX;
        observers.extend(next.filter(|_| has_room).map(Arc::downgrade));
        self.is_used.store(!observers.is_empty(), Ordering::Relaxed);
        self.list.store(Some(Arc::new(observers)));
        has_room
    }

    /// Calls each living observer. It never waits, also while an observer is added, which may miss this event. Without
    /// any observer it costs one load.
    #[inline]
    pub(crate) fn each(&self, call: impl FnMut(&T)) {
        if self.is_used.load(Ordering::Relaxed) {
            self.call(call);
        }
    }

    #[cold]
    fn call(&self, mut call: impl FnMut(&T)) {
        let observers = self.list.load();
        let observers = observers.iter().flat_map(|observers| observers.iter());
        observers.filter_map(Weak::upgrade).for_each(|observer| call(&observer));
    }

    /// Keeps the list from being replaced.
    #[cfg(test)]
    pub(crate) fn while_changed(&self) -> std::sync::MutexGuard<'_, ()> {
        lock(&self.change)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn events(observers: &Observers<AtomicUsize>) {
        observers.each(|count| _ = count.fetch_add(1, Ordering::Relaxed));
    }

    #[test]
    fn event_reaches_either_an_observer_or_its_former_one() {
        let observers = Observers::new();
        events(&observers);
        let [former, next] = [Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0))];
        assert!(observers.add(&former, None));
        events(&observers);
        assert!(observers.add(&next, Some(&former)));
        events(&observers);
        assert_eq!([former.load(Ordering::Relaxed), next.load(Ordering::Relaxed)], [1, 1]);
    }

    #[test]
    fn removed_observer_leaves_the_others_and_no_cost() {
        let observers = Observers::new();
        let [first, second] = [Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0))];
        assert!(observers.add(&first, None) && observers.add(&second, None));
        observers.remove(&first);
        events(&observers);
        assert_eq!([first.load(Ordering::Relaxed), second.load(Ordering::Relaxed)], [0, 1]);
        assert!(observers.is_used.load(Ordering::Relaxed));
        observers.remove(&second);
        events(&observers);
        assert_eq!(second.load(Ordering::Relaxed), 1);
        assert!(!observers.is_used.load(Ordering::Relaxed));
        // And: a later one is called
        assert!(observers.add(&first, None));
        events(&observers);
        assert_eq!(first.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn observers_are_bounded_and_a_dropped_one_makes_room() {
        let observers = Observers::new();
        let all: Vec<_> = (0..OBSERVERS_MAX).map(|_| Arc::new(AtomicUsize::new(0))).collect();
        assert!(all.iter().all(|one| observers.add(one, None)));
        let further = Arc::new(AtomicUsize::new(0));
        assert!(!observers.add(&further, None));
        drop(all);
        assert!(observers.add(&further, None));
        events(&observers);
        assert_eq!(further.load(Ordering::Relaxed), 1);
    }
}
