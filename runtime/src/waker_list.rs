//! Wakers of tasks that wait for the same event, each once.

use std::task::Waker;

/// The tasks that wait for the same event. An empty list has no memory.
#[derive(Debug, Default)]
pub struct WakerList(Vec<Waker>);

impl WakerList {
    /// Maximum number of wakers in a list: more than tasks of a node may wait for room, and some for the layers.
    pub const MAX: usize = 1_024 + 16;

    /// Creates an empty list.
    #[must_use]
    pub const fn new() -> Self {
        Self(Vec::new())
    }

    /// Returns whether no task waits.
    #[must_use]
    #[inline]
    pub const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Adds a task, if it is not in the list. Returns the oldest waker if there are too many. The caller wakes that
    /// one without a lock: its task then asks again, if it still waits.
    #[must_use = "the task of a removed waker would wait in vain"]
    pub fn add(&mut self, waker: &Waker) -> Option<Waker> {
        if self.0.iter().any(|known| known.will_wake(waker)) {
            return None;
        }
        let oldest = (self.0.len() >= Self::MAX).then(|| self.0.remove(0));
        self.0.push(waker.clone());
        oldest
    }

    /// Removes all wakers; the caller wakes them without a lock.
    #[must_use = "the tasks of removed wakers would wait in vain"]
    pub fn take(&mut self) -> Vec<Waker> {
        std::mem::take(&mut self.0)
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, task::Wake};

    use super::*;

    struct Task;

    impl Wake for Task {
        fn wake(self: Arc<Self>) {}
    }

    fn waker() -> Waker {
        Arc::new(Task).into()
    }

    #[test]
    fn task_is_listed_once() {
        let (mut list, one, other) = (WakerList::new(), waker(), waker());
        assert!([&one, &other, &one].into_iter().all(|waker| list.add(waker).is_none()));
        assert_eq!(list.take().len(), 2);
        assert!(list.is_empty());
    }

    #[test]
    fn oldest_task_makes_room_in_a_full_list() {
        let (mut list, first) = (WakerList::new(), waker());
        assert!(list.add(&first).is_none());
        assert!((1..WakerList::MAX).all(|_| list.add(&waker()).is_none()));
        assert!(list.add(&waker()).is_some_and(|oldest| oldest.will_wake(&first)));
        assert_eq!(list.take().len(), WakerList::MAX);
    }
}
