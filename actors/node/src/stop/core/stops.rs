//! The known presses and releases. Merging them is commutative, associative and idempotent, so all nodes that
//! exchange them come to the same state.

use std::collections::{BTreeMap, BTreeSet};

use sinew_model::leave_reason::LeaveReason;
use sinew_runtime::tid::Tid;

use super::super::frame::{ENTRIES_MAX, Entry, Origin};

/// The known presses and releases. spec: STOP-1
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(in crate::stop) struct Stops(BTreeMap<Origin, Entry>);

/// The effect of a merge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::stop) struct Merged {
    /// A press is new here, even if it is released already.
    pub(in crate::stop) has_press: bool,
    /// A release is new here.
    pub(in crate::stop) has_release: bool,
}

impl Stops {
    /// Returns whether a press is not released.
    pub(in crate::stop) fn is_open(&self) -> bool {
        self.0.values().any(Entry::is_open)
    }

    pub(in crate::stop) fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.0.values()
    }

    /// Adds a press of this node.
    pub(super) fn press(&mut self, origin: Origin, by: Tid, reason: LeaveReason) {
        let reason = reason.into();
        let (pressed, released, released_by) = self
            .0
            .get(&origin)
            .map_or((0, 0, Tid::NONE), |entry| (entry.pressed, entry.released, entry.released_by));
        self.make_room();
        let pressed = pressed.saturating_add(1);
        // Beyond the limit, too: a node's own press is never left out.
        self.0.insert(origin, Entry { origin, pressed, by, reason, released, released_by });
    }

    /// Releases all presses that are known here. Returns whether there was one. spec: STOP-3
    pub(super) fn release(&mut self, by: Tid) -> bool {
        let open = self.0.values_mut().filter(|entry| entry.is_open());
        open.fold(false, |_, entry| {
            (entry.released, entry.released_by) = (entry.pressed, by);
            true
        })
    }

    /// Takes the higher numbers of another node. Releases count only of `operators`. spec: STOP-2, STOP-3
    pub(super) fn merge(&mut self, others: &[Entry], operators: &BTreeSet<Tid>) -> Merged {
        let mut merged = Merged::default();
        for other in others {
            let released = if operators.contains(&other.released_by) { other.released } else { 0 };
            if !self.0.contains_key(&other.origin) {
                self.make_room();
                if self.0.len() >= ENTRIES_MAX {
                    // All are open: this node is stopped, and does not confirm this press.
                    continue;
                }
                self.0.insert(other.origin, Entry { pressed: 0, released: 0, ..other.clone() });
            }
            let Some(own) = self.0.get_mut(&other.origin) else { continue };
            if other.pressed > own.pressed {
                own.pressed = other.pressed;
                (own.by, own.reason) = (other.by, other.reason.clone());
                merged.has_press = true;
            }
            if released > own.released {
                (own.released, own.released_by) = (released, other.released_by);
                merged.has_release = true;
            }
        }
        merged
    }

    /// Returns whether these numbers have all presses that are known here.
    pub(super) fn presses_are_in(&self, others: &[Entry]) -> bool {
        self.are_in(others, |own, other| other.pressed >= own.pressed)
    }

    /// Returns whether these numbers have all presses and releases that are known here.
    pub(super) fn is_in(&self, others: &[Entry]) -> bool {
        self.are_in(others, |own, other| other.pressed >= own.pressed && other.released >= own.released)
    }

    fn are_in(&self, others: &[Entry], has: impl Fn(&Entry, &Entry) -> bool) -> bool {
        let others: BTreeMap<_, _> = others.iter().map(|entry| (entry.origin, entry)).collect();
        self.0.iter().all(|(origin, own)| others.get(origin).is_some_and(|other| has(own, other)))
    }

    /// Removes released entries, as far as there are as many as may be. A node that has missed its release stops the
    /// others again: that is the safe side.
    fn make_room(&mut self) {
        while self.0.len() >= ENTRIES_MAX {
            let closed = self.0.values().find(|entry| !entry.is_open()).map(|entry| entry.origin);
            let Some(origin) = closed else { return };
            self.0.remove(&origin);
        }
    }
}

impl FromIterator<Entry> for Stops {
    fn from_iter<T: IntoIterator<Item = Entry>>(entries: T) -> Self {
        Self(entries.into_iter().map(|entry| (entry.origin, entry)).collect())
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{AppAddress, Incarnation, NodeAddress};

    use super::*;

    fn origin(node: u32) -> Origin {
        Origin { node: NodeAddress::new(node), incarnation: Incarnation(1) }
    }

    fn tid(node: u32) -> Tid {
        Tid::new(NodeAddress::new(node), AppAddress::new(0x1001))
    }

    fn operators() -> BTreeSet<Tid> {
        (0..9).map(tid).collect()
    }

    fn press(stops: &mut Stops, node: u32) {
        stops.press(origin(node), tid(node), LeaveReason::of("a test"));
    }

    fn entries(stops: &Stops) -> Vec<Entry> {
        stops.entries().cloned().collect()
    }

    fn merged(mut one: Stops, other: &Stops) -> Stops {
        one.merge(&entries(other), &operators());
        one
    }

    /// Some states, by all orders of two presses at each of two nodes, and releases between them.
    fn states() -> Vec<Stops> {
        let mut states = vec![Stops::default()];
        for _ in 0..3 {
            for at in 0..states.len() {
                for step in 0..3 {
                    let mut next = states[at].clone();
                    if step == 2 {
                        next.release(tid(3));
                    } else {
                        press(&mut next, step + 1);
                    }
                    if !states.contains(&next) {
                        states.push(next);
                    }
                }
            }
        }
        states
    }

    fn numbers(stops: &Stops) -> Vec<(Origin, u32, u32)> {
        stops.entries().map(|entry| (entry.origin, entry.pressed, entry.released)).collect()
    }

    // spec: STOP-2
    #[test]
    fn merge_is_commutative_associative_and_idempotent() {
        let states = states();
        for one in &states {
            assert_eq!(numbers(&merged(one.clone(), one)), numbers(one));
            for other in &states {
                let both = merged(one.clone(), other);
                assert_eq!(numbers(&both), numbers(&merged(other.clone(), one)));
                assert!(one.is_in(&entries(&both)) && other.is_in(&entries(&both)));
                for third in states.iter().take(9) {
                    let late = merged(one.clone(), &merged(other.clone(), third));
                    assert_eq!(numbers(&merged(both.clone(), third)), numbers(&late));
                }
            }
        }
    }

    // spec: STOP-2
    #[test]
    fn press_that_a_release_did_not_know_outlasts_it() {
        let (mut one, mut other) = (Stops::default(), Stops::default());
        press(&mut one, 1);
        other.merge(&entries(&one), &operators());
        // Concurrently
        press(&mut one, 1);
        assert!(other.release(tid(2)) && !other.is_open());
        assert!(merged(one.clone(), &other).is_open() && merged(other, &one).is_open());
    }

    // spec: STOP-3
    #[test]
    fn release_counts_of_operators_only() {
        let (mut one, mut other) = (Stops::default(), Stops::default());
        press(&mut one, 1);
        other.merge(&entries(&one), &operators());
        other.release(tid(77));
        assert_eq!(one.merge(&entries(&other), &operators()), Merged::default());
        assert!(one.is_open() && !one.is_in(&entries(&Stops::default())));
        assert!(!other.is_in(&entries(&one)) && other.presses_are_in(&entries(&one)));
    }

    #[test]
    fn open_presses_beyond_the_limit_are_not_confirmed() {
        let mut full = Stops::default();
        for node in 0..ENTRIES_MAX as u32 {
            let mut one = Stops::default();
            press(&mut one, node);
            full.merge(&entries(&one), &operators());
        }
        let mut late = Stops::default();
        press(&mut late, 5_000);
        assert_eq!(full.merge(&entries(&late), &operators()), Merged::default());
        assert!(full.is_open() && !late.presses_are_in(&entries(&full)));
        // Its own press has room in any case.
        press(&mut full, 6_000);
        assert_eq!(full.entries().count(), ENTRIES_MAX + 1);
        // Released ones give room.
        full.release(tid(1));
        assert!(full.merge(&entries(&late), &operators()).has_press && full.is_open());
    }
}
