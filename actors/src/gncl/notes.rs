//! What is told of the connections to other nodes to whoever asks: since when they stand or do not, and how the last dial failed.

use std::{collections::BTreeMap, io, net::SocketAddr, sync::Mutex};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::LinkFact;
use crate::stores::lock;

/// Nodes of which something is kept, at most. For a further one that is forgotten of which nothing new was heard for longest, of those
/// without a connection if there is one: whoever can connect can say that it is any node, and one that is dialled is heard of each second.
const NODES_MAX: usize = 1_024;

/// Kept beside the layer, so that it is there when the layer hangs.
#[derive(Debug, Default)]
pub(crate) struct Notes(Mutex<BTreeMap<NodeAddress, Entry>>);

/// A note, and when something was last written there.
#[derive(Debug, Default)]
struct Entry {
    note: Note,
    written: Time,
}

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
    pub(crate) fault: DialFault,
    /// How many have failed, with this one, since there was a connection last.
    pub(crate) count: u64,
}

/// How far a dial came that failed: what mends it is another thing each time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DialFault {
    /// The host is there, and nobody listens.
    Refused,
    /// Somebody listens, and it is not proven that he is who is meant, or he does not take this node.
    NotProven,
    /// Somebody listened, and hung up before that was proven.
    HungUp,
    /// The system says something else: mostly that there is no way.
    System,
}

impl DialFault {
    fn of(error: &io::Error) -> Self {
        const ENDS: [io::ErrorKind; 4] = [
            io::ErrorKind::ConnectionReset,
            io::ErrorKind::ConnectionAborted,
            io::ErrorKind::BrokenPipe,
            io::ErrorKind::UnexpectedEof,
        ];
        let kind = error.kind();
        if kind == io::ErrorKind::ConnectionRefused {
            Self::Refused
        } else if kind == io::ErrorKind::InvalidData {
            Self::NotProven
        } else if ENDS.contains(&kind) {
            Self::HungUp
        } else {
            Self::System
        }
    }

    /// As reports call it.
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Refused => "refused",
            Self::NotProven => "not proven",
            Self::HungUp => "hung up",
            Self::System => "system",
        }
    }
}

impl Notes {
    /// What is known of `node`.
    pub(crate) fn of(&self, node: NodeAddress) -> Note {
        lock(&self.0).get(&node).map(|entry| entry.note.clone()).unwrap_or_default()
    }

    pub(super) fn dial_failed(&self, now: Time, node: NodeAddress, address: SocketAddr, error: &io::Error) {
        let (error, fault) = (error.to_string(), DialFault::of(error));
        self.write(now, node, |note| {
            let count = note.dial.as_ref().map_or(0, |dial| dial.count) + 1;
            note.dial = Some(FailedDial { at: now, address, error, fault, count });
        });
    }

    pub(super) fn fact(&self, now: Time, fact: &LinkFact) {
        match *fact {
            LinkFact::LinkUp { node, .. } => {
                self.write(now, node, |note| *note = Note { linked: Some(now), ..Note::default() });
            }
            LinkFact::LinkBroken { node, .. } => {
                self.write(now, node, |note| (note.linked, note.broken) = (None, Some(now)));
            }
            LinkFact::PeerLeft { node, .. } => drop(lock(&self.0).remove(&node)),
            LinkFact::DialRefused { .. } => {}
        }
    }

    fn write(&self, now: Time, node: NodeAddress, write: impl FnOnce(&mut Note)) {
        let mut notes = lock(&self.0);
        if notes.len() >= NODES_MAX && !notes.contains_key(&node) {
            let oldest =
                notes.iter().min_by_key(|(_, Entry { note, written })| (note.linked.is_some(), *written));
            let oldest = oldest.map(|(node, _)| *node);
            oldest.and_then(|node| notes.remove(&node));
        }
        let entry = notes.entry(node).or_default();
        entry.written = now;
        write(&mut entry.note);
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
        notes.dial_failed(at(1), node, address, &io::ErrorKind::ConnectionRefused.into());
        notes.dial_failed(at(2), node, address, &io::Error::other("timed out"));
        let dial = notes.of(node).dial.expect("two have failed");
        assert_eq!((dial.count, dial.error.as_str(), dial.at), (2, "timed out", at(2)));
        assert_eq!(dial.fault, DialFault::System);
        notes.fact(at(3), &LinkFact::LinkUp { node, incarnation });
        assert_eq!(notes.of(node), Note { linked: Some(at(3)), broken: None, dial: None });
        notes.fact(at(4), &LinkFact::LinkBroken { node, incarnation });
        assert_eq!(notes.of(node), Note { linked: None, broken: Some(at(4)), dial: None });
        notes.fact(at(5), &LinkFact::PeerLeft { node, incarnation, gave_up: None });
        assert_eq!(notes.of(node), Note::default());
    }

    #[test]
    fn how_far_a_dial_came_is_known_by_its_error() {
        let of = |kind: io::ErrorKind| DialFault::of(&kind.into()).word();
        assert_eq!(of(io::ErrorKind::ConnectionRefused), "refused");
        assert_eq!(of(io::ErrorKind::InvalidData), "not proven");
        assert_eq!([io::ErrorKind::ConnectionReset, io::ErrorKind::UnexpectedEof].map(of), ["hung up"; 2]);
        assert_eq!([io::ErrorKind::TimedOut, io::ErrorKind::HostUnreachable].map(of), ["system"; 2]);
    }

    #[test]
    fn for_one_more_node_that_one_is_forgotten_of_which_nothing_was_heard_for_longest() {
        // Given: one with a connection, one that is dialled in vain, and strangers that came between and went
        let notes = Notes::default();
        let at = |seconds| Time::ZERO + Duration::from_secs(seconds);
        let incarnation = Incarnation(1);
        let node = |number| NodeAddress::new(number);
        let (linked, dialled, first) = (node(1), node(2), 3);
        notes.fact(at(1), &LinkFact::LinkUp { node: linked, incarnation });
        notes.fact(at(1), &LinkFact::LinkBroken { node: dialled, incarnation });
        let last = NODES_MAX as u32;
        for number in first..=last {
            notes.fact(at(2), &LinkFact::LinkBroken { node: node(number), incarnation });
        }
        let refused = io::ErrorKind::ConnectionRefused.into();
        notes.dial_failed(at(3), dialled, ([127, 0, 0, 2], 7).into(), &refused);
        // When
        notes.fact(at(4), &LinkFact::LinkUp { node: node(last + 1), incarnation });
        // Then
        assert_eq!(lock(&notes.0).len(), NODES_MAX);
        assert_eq!(notes.of(node(first)), Note::default(), "the oldest of those without a connection");
        assert_eq!(notes.of(node(last + 1)).linked, Some(at(4)));
        assert_eq!(notes.of(linked).linked, Some(at(1)));
        assert_eq!(notes.of(dialled).dial.map(|dial| dial.count), Some(1));
    }

    #[test]
    fn where_all_have_connections_the_oldest_one_makes_room() {
        let notes = Notes::default();
        for number in 0..=NODES_MAX as u32 {
            let (node, now) = (NodeAddress::new(number + 1), Time::from_nanos(u64::from(number)));
            notes.fact(now, &LinkFact::LinkUp { node, incarnation: Incarnation(1) });
        }
        assert_eq!(lock(&notes.0).len(), NODES_MAX);
        assert_eq!(notes.of(NodeAddress::new(1)), Note::default());
    }
}
