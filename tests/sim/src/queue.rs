//! The events of a world, in virtual time.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// A queue of events in virtual time. Events of the same time are returned in the order of their insertion.
#[derive(Clone, Debug)]
pub struct Queue<E> {
    now: Time,
    inserted: u64,
    events: BTreeMap<(Time, u64), E>,
}

impl<E> Queue<E> {
    /// Creates an empty queue at this virtual time.
    #[must_use]
    pub const fn starting_at(now: Time) -> Self {
        Self { now, inserted: 0, events: BTreeMap::new() }
    }

    /// Returns the present virtual time.
    #[must_use]
    pub const fn now(&self) -> Time {
        self.now
    }

    /// Inserts an event. A time in the past counts as the present.
    pub fn push(&mut self, at: Time, event: E) {
        self.inserted += 1;
        self.events.insert((at.max(self.now), self.inserted), event);
    }

    /// Inserts an event after this delay.
    pub fn push_after(&mut self, delay: Duration, event: E) {
        self.push(self.now + delay, event);
    }

    /// Returns the next event, and sets the time to it.
    pub fn pop(&mut self) -> Option<E> {
        let ((at, _), event) = self.events.pop_first()?;
        self.now = at;
        Some(event)
    }

    /// Returns the next event until `end`, inclusive, and sets the time to it. Without one the time is `end`.
    pub fn pop_until(&mut self, end: Time) -> Option<E> {
        if self.events.first_key_value().is_some_and(|((at, _), _)| *at <= end) {
            return self.pop();
        }
        self.now = self.now.max(end);
        None
    }

    /// Removes the events for which `keep` is false.
    pub fn retain(&mut self, mut keep: impl FnMut(&E) -> bool) {
        self.events.retain(|_, event| keep(event));
    }

    /// Returns the number of events.
    #[must_use]
    pub fn len(&self) -> usize {
        self.events.len()
    }

    /// Returns whether there is no event.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.events.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_of_one_time_keep_their_order() {
        let mut queue = Queue::starting_at(Time::from_nanos(10));
        queue.push(Time::from_nanos(30), 'c');
        queue.push(Time::from_nanos(20), 'a');
        queue.push(Time::from_nanos(20), 'b');
        queue.push(Time::from_nanos(5), '0');
        let popped: Vec<_> = std::iter::from_fn(|| Some((queue.pop()?, queue.now().as_nanos()))).collect();
        assert_eq!(popped, [('0', 10), ('a', 20), ('b', 20), ('c', 30)]);
    }

    #[test]
    fn time_advances_to_the_end_without_an_event() {
        let mut queue = Queue::starting_at(Time::ZERO);
        queue.push(Time::from_nanos(30), 'c');
        assert_eq!(queue.pop_until(Time::from_nanos(29)), None);
        assert_eq!(queue.now(), Time::from_nanos(29));
        assert_eq!(queue.pop_until(Time::from_nanos(30)), Some('c'));
    }
}
