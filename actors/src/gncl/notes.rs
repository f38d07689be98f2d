//! What is told of the connections to other nodes to whoever asks: since when they stand or do not, and how the last dial failed.

use std::{collections::BTreeMap, net::SocketAddr, sync::Mutex};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::LinkFact;
use crate::stores::lock;

/// Nodes of which something is kept, at most; of a further one nothing is told.
const NODES_MAX: usize = 1_024;

/// Kept beside the layer, so that it is there when the layer hangs.
#[derive(Debug, Default)]
pub(crate) struct Notes(Mutex<BTreeMap<NodeAddress, Note>>);

/// What is known of the connection to one node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Note {
    /// Since when there is one.
    pub(crate) linked: Option<Time>,
    /// When the last one broke, if there is none.
    pub(crate) broken: Option<Time>,
    /// The last dial, if it failed and none has led to a connection since.
    pub(crate) dial: Option<FailedDial>,
}

/// A dial that has led to nobody.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FailedDial {
    pub(crate) at: Time,
    pub(crate) address: SocketAddr,
    pub(crate) error: String,
    /// How many have failed, with this one, since there was a connection last.
    pub(crate) count: u64,
}

impl Notes {
    /// What is known of `node`.
    pub(crate) fn of(&self, node: NodeAddress) -> Note {
        lock(&self.0).get(&node).cloned().unwrap_or_default()
    }

    pub(super) fn dial_failed(&self, now: Time, node: NodeAddress, address: SocketAddr, error: String) {
        self.change(node, |note| {
            let count = note.dial.as_ref().map_or(0, |dial| dial.count) + 1;
            note.dial = Some(FailedDial { at: now, address, error, count });
        });
    }

    pub(super) fn fact(&self, now: Time, fact: &LinkFact) {
        match *fact {
            LinkFact::LinkUp { node, .. } => {
                self.change(node, |note| *note = Note { linked: Some(now), ..Note::default() });
            }
            LinkFact::LinkBroken { node, .. } => {
                self.change(node, |note| (note.linked, note.broken) = (None, Some(now)));
            }
            LinkFact::PeerLeft { node, .. } => drop(lock(&self.0).remove(&node)),
            LinkFact::DialRefused { .. } => {}
        }
    }

    fn change(&self, node: NodeAddress, change: impl FnOnce(&mut Note)) {
        let mut notes = lock(&self.0);
        if notes.len() < NODES_MAX || notes.contains_key(&node) {
            change(notes.entry(node).or_default());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew_runtime::tid::Incarnation;

    use super::*;

    #[test]
    fn dials_are_counted_until_there_is_a_connection_and_a_break_is_remembered() {
        let (notes, node) = (Notes::default(), NodeAddress::from([127, 0, 0, 2]));
        let at = |seconds| Time::ZERO + Duration::from_secs(seconds);
        let address: SocketAddr = ([127, 0, 0, 2], 7).into();
        let incarnation = Incarnation(1);
        notes.dial_failed(at(1), node, address, "refused".to_owned());
        notes.dial_failed(at(2), node, address, "timed out".to_owned());
        let dial = notes.of(node).dial.expect("two have failed");
        assert_eq!((dial.count, dial.error.as_str(), dial.at), (2, "timed out", at(2)));
        notes.fact(at(3), &LinkFact::LinkUp { node, incarnation });
        assert_eq!(notes.of(node), Note { linked: Some(at(3)), broken: None, dial: None });
        notes.fact(at(4), &LinkFact::LinkBroken { node, incarnation });
        assert_eq!(notes.of(node), Note { linked: None, broken: Some(at(4)), dial: None });
        notes.fact(at(5), &LinkFact::PeerLeft { node, incarnation });
        assert_eq!(notes.of(node), Note::default());
    }

    #[test]
    fn of_more_nodes_than_are_kept_nothing_is_told() {
        let notes = Notes::default();
        for number in 0..=NODES_MAX as u32 {
            let node = NodeAddress::new(number + 1);
            notes.fact(Time::ZERO, &LinkFact::LinkBroken { node, incarnation: Incarnation(1) });
        }
        assert_eq!(lock(&notes.0).len(), NODES_MAX);
    }
}
