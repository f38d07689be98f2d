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

    /// Adds a press of this node, with a number above `last`, and returns that number.
    pub(super) fn press(&mut self, origin: Origin, last: u32, by: Tid, reason: LeaveReason) -> u32 {
        let reason = reason.into();
        let (pressed, released, released_by) = self
            .0
            .get(&origin)
            .map_or((0, 0, Tid::NONE), |entry| (entry.pressed, entry.released, entry.released_by));
        let pressed = pressed.max(last).saturating_add(1);
        // Beyond the limit, too: a node's own press is never left out.
        self.make_room(origin, true);
        self.0.insert(origin, Entry { origin, pressed, by, reason, released, released_by });
        pressed
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
                if !self.make_room(other.origin, other.pressed > released) {
                    // All are open: this node is stopped, and does not confirm this press. Or it is a released one
                    // that is forgotten.
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

    /// Returns whether these numbers have all presses in force that are known here.
    pub(super) fn presses_are_in(&self, others: &[Entry]) -> bool {
        let others = by_origin(others);
        let mut open = self.0.values().filter(|own| own.is_open());
        open.all(|own| others.get(&own.origin).is_some_and(|other| other.pressed >= own.pressed))
    }

    /// Returns whether these numbers have all presses and releases that are known here, but for released ones that a
    /// full list has forgotten.
    pub(super) fn is_in(&self, others: &[Entry]) -> bool {
        let is_full = others.len() >= ENTRIES_MAX;
        let others = by_origin(others);
        self.0.values().all(|own| match others.get(&own.origin) {
            Some(other) => other.pressed >= own.pressed && other.released >= own.released,
            None => is_full && !own.is_open(),
        })
    }

    /// Makes room for an entry: forgets the released ones of the oldest incarnations, as far as there are as many as
    /// may be. Returns `false` if there is none: all are open, or the new one is released and older itself. So nodes
    /// that know different ones come to the same ones, and do not replace them again and again. A node that has missed
    /// the release of a forgotten one stops the others again: that is the safe side.
    fn make_room(&mut self, new: Origin, is_open: bool) -> bool {
        let age = |origin: Origin| (origin.incarnation, origin.node);
        while self.0.len() >= ENTRIES_MAX {
            let closed = self.0.values().filter(|entry| !entry.is_open()).map(|entry| entry.origin);
            let Some(oldest) = closed.min_by_key(|origin| age(*origin)) else { return false };
            if !is_open && age(new) < age(oldest) {
                return false;
            }
            self.0.remove(&oldest);
        }
        true
    }
}

fn by_origin(entries: &[Entry]) -> BTreeMap<Origin, &Entry> {
    entries.iter().map(|entry| (entry.origin, entry)).collect()
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
        stops.press(origin(node), 0, tid(node), LeaveReason::of("a test"));
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

    /// A list of released presses of these nodes.
    fn released(nodes: std::ops::Range<u32>) -> Stops {
        let mut stops = Stops::default();
        for node in nodes {
            press(&mut stops, node);
            stops.release(tid(1));
        }
        stops
    }

    #[test]
    fn full_lists_of_released_presses_become_equal() {
        let full = ENTRIES_MAX as u32;
        let (mut one, mut other) = (released(0..full), released(full / 2..full * 2));
        for _ in 0..2 {
            one.merge(&entries(&other), &operators());
            other.merge(&entries(&one), &operators());
        }
        assert_eq!(one, other);
        assert_eq!(one.merge(&entries(&other), &operators()), Merged::default());
        // A forgotten one does not come back, and is not waited for.
        let old = released(0..1);
        assert_eq!(one.merge(&entries(&old), &operators()), Merged::default());
        assert!(old.is_in(&entries(&one)) && !old.is_in(&[]));
        // A press that is in force has room, and counts for the confirmation.
        let mut late = old;
        press(&mut late, 0);
        assert!(!late.presses_are_in(&entries(&one)) && !late.is_in(&entries(&one)));
        assert!(one.merge(&entries(&late), &operators()).has_press && late.presses_are_in(&entries(&one)));
    }

    #[test]
    fn number_of_a_forgotten_press_is_not_used_again() {
        let mut stops = Stops::default();
        let press = |stops: &mut Stops, last| stops.press(origin(1), last, tid(1), LeaveReason::of("a test"));
        assert_eq!((press(&mut stops, 0), press(&mut stops, 0)), (1, 2));
        let mut fresh = Stops::default();
        assert_eq!(press(&mut fresh, 2), 3);
        stops.release(tid(1));
        assert!(stops.merge(&entries(&fresh), &operators()).has_press && stops.is_open());
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
