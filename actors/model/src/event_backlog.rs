//! Pending events for one reader: in order, coalescing, bounded.
//!
//! A reader with a full event queue gets its pending events as soon as it has room. Meanwhile a new event removes
//! the pending ones that it makes obsolete. A reader that stalls therefore ends with the true state, however much
//! happened. The [rules](CoalescingRules) of the events say which ones are obsolete.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    fmt::Debug,
};

/// The rules by which pending events of one kind are coalesced.
pub trait CoalescingRules {
    /// The events.
    type Event: Debug;
    /// The subject of an event. Only events about one subject are coalesced.
    type Subject: Clone + Debug + Ord;
    /// The incarnation of a subject.
    type Incarnation: Clone + Debug + PartialEq;

    /// Whether a reader needs the end of an incarnation of which it was not notified. If so, the last one of each
    /// subject is kept.
    const KEEPS_UNKNOWN_ENDS: bool;

    /// Returns the subject of an event.
    fn subject(&self, event: &Self::Event) -> Self::Subject;

    /// Returns the effect of an event on the reader's knowledge of its subject.
    fn role(&self, event: &Self::Event) -> Role<Self::Incarnation>;

    /// Returns whether `later` makes `former`, an earlier event about the same subject, obsolete. Ends are coalesced
    /// by their incarnations.
    fn supersedes(&self, later: &Self::Event, former: &Self::Event) -> bool;

    /// Returns whether the event is dropped before others if there are too many.
    fn is_minor(&self, event: &Self::Event) -> bool {
        let _ = event;
        false
    }
}

/// Effect of an event on the reader's knowledge of a subject.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role<I> {
    /// The reader knows this incarnation of the subject from now on.
    Begins(I),
    /// The state of a known subject changes. The event is dropped if the reader does not know the subject.
    Changes,
    /// This incarnation of the subject has ended.
    Ends(I),
    /// The event does not depend on the reader's knowledge.
    Standalone,
}

/// The pending events for one reader.
#[derive(Debug)]
pub struct EventBacklog<R: CoalescingRules> {
    rules: R,
    capacity: usize,
    /// By their sequence numbers.
    events: BTreeMap<u64, R::Event>,
    next_number: u64,
    /// The sequence numbers of each subject's events.
    numbers: BTreeMap<R::Subject, Vec<u64>>,
    /// The subjects that the reader knows, each with its incarnation.
    known: BTreeMap<R::Subject, R::Incarnation>,
}

impl<R: CoalescingRules> EventBacklog<R> {
    /// Creates an empty backlog of at most `capacity` events.
    #[must_use]
    pub fn new(rules: R, capacity: usize) -> Self {
        let (events, numbers, known) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        Self { rules, capacity, events, next_number: 0, numbers, known }
    }

    /// Returns the number of pending events.
    #[must_use]
    pub fn len(&self) -> usize {
        self.events.len()
    }

    /// Returns whether no event is pending.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.events.is_empty()
    }

    /// Returns the pending events, to change details that no rule depends on.
    pub fn events_mut(&mut self) -> impl Iterator<Item = &mut R::Event> {
        self.events.values_mut()
    }

    /// Adds an event, and removes the pending ones that it makes obsolete. The end of a known incarnation keeps its
    /// position: a successor may be reported only after it. Returns whether an event was dropped because there are too
    /// many.
    pub fn push(&mut self, event: R::Event) -> bool {
        let (subject, role) = (self.rules.subject(&event), self.rules.role(&event));
        self.remove_of(&subject, |this, former| this.rules.supersedes(&event, former));
        match role {
            Role::Begins(_) | Role::Standalone => self.insert(subject, event),
            Role::Changes if self.will_know(&subject) => self.insert(subject, event),
            Role::Changes => {}
            Role::Ends(incarnation) => self.push_end(subject, &incarnation, event),
        }
        let is_over_full = self.events.len() > self.capacity;
        if is_over_full {
            self.make_room();
        }
        is_over_full
    }

    /// Offers the events in order until one is refused. Returns whether all were accepted.
    pub fn offer(&mut self, mut accept: impl FnMut(&mut R::Event) -> bool) -> bool {
        while let Some(mut first) = self.events.first_entry() {
            if !accept(first.get_mut()) {
                return false;
            }
            let (number, event) = first.remove_entry();
            let subject = self.rules.subject(&event);
            self.forget_number(&subject, number);
            match self.rules.role(&event) {
                Role::Begins(incarnation) => _ = self.known.insert(subject, incarnation),
                Role::Ends(incarnation) if self.is_known(&subject, &incarnation) => {
                    self.known.remove(&subject);
                }
                Role::Ends(_) | Role::Changes | Role::Standalone => {}
            }
        }
        true
    }

    /// Removes the pending events that do not match `is_kept`.
    pub fn retain(&mut self, is_kept: impl Fn(&R::Event) -> bool) {
        let numbers = self.events.iter().filter(|(_, event)| !is_kept(event)).map(|(number, _)| *number);
        for number in numbers.collect::<Vec<_>>() {
            self.remove(number);
        }
    }

    fn push_end(&mut self, subject: R::Subject, incarnation: &R::Incarnation, event: R::Event) {
        let is_same = |role| matches!(role, Role::Ends(ended) if ended == *incarnation);
        let mut kept = self.numbers.get(&subject).into_iter().flatten();
        let same = kept.find(|number| self.events.get(number).is_some_and(|e| is_same(self.rules.role(e))));
        if let Some(same) = same.copied() {
            // The subject was back for a while, of which the reader was not notified. The latest event counts.
            self.events.insert(same, event);
        } else if self.is_known(&subject, incarnation) {
            self.insert(subject, event);
        } else if R::KEEPS_UNKNOWN_ENDS {
            self.remove_of(&subject, Self::is_unknown_end);
            self.insert(subject, event);
        }
    }

    fn insert(&mut self, subject: R::Subject, event: R::Event) {
        self.numbers.entry(subject).or_default().push(self.next_number);
        self.events.insert(self.next_number, event);
        self.next_number += 1;
    }

    /// Removes the events of a subject that match.
    fn remove_of(&mut self, subject: &R::Subject, is_one: impl Fn(&Self, &R::Event) -> bool) {
        let numbers = self.numbers.get(subject).into_iter().flatten();
        let those = numbers.filter(|number| self.events.get(number).is_some_and(|event| is_one(self, event)));
        for number in those.copied().collect::<Vec<_>>() {
            self.remove(number);
        }
    }

    fn remove(&mut self, number: u64) {
        if let Some(event) = self.events.remove(&number) {
            self.forget_number(&self.rules.subject(&event), number);
        }
    }

    fn forget_number(&mut self, subject: &R::Subject, number: u64) {
        if let Entry::Occupied(mut numbers) = self.numbers.entry(subject.clone()) {
            numbers.get_mut().retain(|kept| *kept != number);
            if numbers.get().is_empty() {
                numbers.remove();
            }
        }
    }

    fn is_known(&self, subject: &R::Subject, incarnation: &R::Incarnation) -> bool {
        self.known.get(subject) == Some(incarnation)
    }

    /// Returns whether the reader knows the subject once it has read all pending events.
    fn will_know(&self, subject: &R::Subject) -> bool {
        let numbers = self.numbers.get(subject).into_iter().flatten().rev();
        for event in numbers.filter_map(|number| self.events.get(number)) {
            match self.rules.role(event) {
                Role::Begins(_) => return true,
                Role::Ends(_) => return false,
                Role::Changes | Role::Standalone => {}
            }
        }
        self.known.contains_key(subject)
    }

    /// Returns whether the event is the end of an incarnation of which the reader was not notified.
    fn is_unknown_end(&self, event: &R::Event) -> bool {
        match self.rules.role(event) {
            Role::Ends(incarnation) => !self.is_known(&self.rules.subject(event), &incarnation),
            Role::Begins(_) | Role::Changes | Role::Standalone => false,
        }
    }

    /// Drops the least important event: the oldest end of an unknown incarnation, else the oldest minor event, else
    /// the oldest event. The backlog is only this full if subjects unknown to the reader appear and disappear.
    fn make_room(&mut self) {
        let first = |is_one: &dyn Fn(&R::Event) -> bool| {
            self.events.iter().find(|(_, event)| is_one(event)).map(|(number, _)| *number)
        };
        let least = first(&|event| self.is_unknown_end(event))
            .or_else(|| first(&|event| self.rules.is_minor(event)))
            .or_else(|| first(&|_| true));
        if let Some(number) = least {
            self.remove(number);
        }
    }
}

#[cfg(test)]
mod tests;
