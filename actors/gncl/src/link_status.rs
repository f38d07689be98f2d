//! The status of the connections to other nodes, for queries: since when they exist or not, and how the last
//! dial failed.

use std::{collections::BTreeMap, io, net::SocketAddr, sync::Mutex};

use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use sinew_model::facts::LinkFact;

/// Maximum number of nodes with a status. For a further one, the status with the oldest change is dropped,
/// first of nodes without a connection. Any process that can connect can claim to be any node, but a node
/// that is being dialled changes its status each second.
const NODES_MAX: usize = 1_024;

/// The status table, kept outside the layer, so that it is available when the layer hangs.
#[derive(Debug, Default)]
pub struct LinkStatusTable(Mutex<BTreeMap<NodeAddress, Entry>>);

/// A status, and the time of its last change.
#[derive(Debug, Default)]
struct Entry {
    status: LinkStatus,
    written: Time,
}

/// The status of the connection to one node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LinkStatus {
    /// Time since which there is a connection.
    pub linked: Option<Time>,
    /// Time at which the last connection broke, if there is none.
    pub broken: Option<Time>,
    /// The last dial, if it failed and there was no connection since.
    pub dial: Option<FailedDial>,
}

/// A failed dial.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedDial {
    pub at: Time,
    pub address: SocketAddr,
    pub error: String,
    pub failure: DialFailure,
    /// Number of failed dials, including this one, since the last connection.
    pub count: u64,
}

/// The stage at which a dial failed; each has a different remedy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DialFailure {
    /// The host is reachable, and no process listens.
    Refused,
    /// A process listens, and has not authenticated as the expected node, or does not accept this node.
    NotAuthenticated,
    /// A process listened, and closed the connection before the authentication.
    HungUp,
    /// Another error of the system, mostly that there is no route.
    System,
}

impl DialFailure {
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
            Self::NotAuthenticated
        } else if ENDS.contains(&kind) {
            Self::HungUp
        } else {
            Self::System
        }
    }

    /// Returns its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Refused => "refused",
            Self::NotAuthenticated => "not proven",
            Self::HungUp => "hung up",
            Self::System => "system",
        }
    }
}

impl LinkStatusTable {
    /// Returns the status of `node`.
    pub fn of(&self, node: NodeAddress) -> LinkStatus {
        lock(&self.0).get(&node).map(|entry| entry.status.clone()).unwrap_or_default()
    }

    pub(super) fn dial_failed(&self, now: Time, node: NodeAddress, address: SocketAddr, error: &io::Error) {
        let (error, failure) = (error.to_string(), DialFailure::of(error));
        self.write(now, node, |status| {
            let count = status.dial.as_ref().map_or(0, |dial| dial.count) + 1;
            status.dial = Some(FailedDial { at: now, address, error, failure, count });
        });
    }

    pub(super) fn fact(&self, now: Time, fact: &LinkFact) {
        match *fact {
            LinkFact::LinkUp { node, .. } => {
                self.write(now, node, |status| {
                    *status = LinkStatus { linked: Some(now), ..LinkStatus::default() }
                });
            }
            LinkFact::LinkBroken { node, .. } => {
                self.write(now, node, |status| (status.linked, status.broken) = (None, Some(now)));
            }
            LinkFact::PeerLeft { node, .. } => drop(lock(&self.0).remove(&node)),
            LinkFact::DialRefused { .. } => {}
        }
    }

    fn write(&self, now: Time, node: NodeAddress, write: impl FnOnce(&mut LinkStatus)) {
        let mut table = lock(&self.0);
        if table.len() >= NODES_MAX && !table.contains_key(&node) {
            let oldest =
                table.iter().min_by_key(|(_, Entry { status, written })| (status.linked.is_some(), *written));
            let oldest = oldest.map(|(node, _)| *node);
            oldest.and_then(|node| table.remove(&node));
        }
        let entry = table.entry(node).or_default();
        entry.written = now;
        write(&mut entry.status);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew_runtime::tid::Incarnation;

    use super::*;

    #[test]
    fn dials_are_counted_and_a_break_is_remembered() {
        let (table, node) = (LinkStatusTable::default(), NodeAddress::from([127, 0, 0, 2]));
        let at = |seconds| Time::ZERO + Duration::from_secs(seconds);
        let address: SocketAddr = ([127, 0, 0, 2], 7).into();
        let incarnation = Incarnation(1);
        table.dial_failed(at(1), node, address, &io::ErrorKind::ConnectionRefused.into());
        table.dial_failed(at(2), node, address, &io::Error::other("timed out"));
        let dial = table.of(node).dial.expect("two have failed");
        assert_eq!((dial.count, dial.error.as_str(), dial.at), (2, "timed out", at(2)));
        assert_eq!(dial.failure, DialFailure::System);
        table.fact(at(3), &LinkFact::LinkUp { node, incarnation });
        assert_eq!(table.of(node), LinkStatus { linked: Some(at(3)), broken: None, dial: None });
        table.fact(at(4), &LinkFact::LinkBroken { node, incarnation });
        assert_eq!(table.of(node), LinkStatus { linked: None, broken: Some(at(4)), dial: None });
        table.fact(at(5), &LinkFact::PeerLeft { node, incarnation, gave_up: None });
        assert_eq!(table.of(node), LinkStatus::default());
    }

    #[test]
    fn progress_of_a_dial_is_known_by_its_error() {
        let of = |kind: io::ErrorKind| DialFailure::of(&kind.into()).name();
        assert_eq!(of(io::ErrorKind::ConnectionRefused), "refused");
        assert_eq!(of(io::ErrorKind::InvalidData), "not proven");
        assert_eq!([io::ErrorKind::ConnectionReset, io::ErrorKind::UnexpectedEof].map(of), ["hung up"; 2]);
        assert_eq!([io::ErrorKind::TimedOut, io::ErrorKind::HostUnreachable].map(of), ["system"; 2]);
    }

    #[test]
    fn node_silent_for_longest_makes_room() {
        // Given: a node with a connection, one that is dialled in vain, and strangers that came and went in between
        let table = LinkStatusTable::default();
        let at = |seconds| Time::ZERO + Duration::from_secs(seconds);
        let incarnation = Incarnation(1);
        let node = |number| NodeAddress::new(number);
        let (linked, dialled, first) = (node(1), node(2), 3);
        table.fact(at(1), &LinkFact::LinkUp { node: linked, incarnation });
        table.fact(at(1), &LinkFact::LinkBroken { node: dialled, incarnation });
        let last = NODES_MAX as u32;
        for number in first..=last {
            table.fact(at(2), &LinkFact::LinkBroken { node: node(number), incarnation });
        }
        let refused = io::ErrorKind::ConnectionRefused.into();
        table.dial_failed(at(3), dialled, ([127, 0, 0, 2], 7).into(), &refused);
        // When
        table.fact(at(4), &LinkFact::LinkUp { node: node(last + 1), incarnation });
        // Then
        assert_eq!(lock(&table.0).len(), NODES_MAX);
        assert_eq!(table.of(node(first)), LinkStatus::default(), "the oldest of those without a connection");
        assert_eq!(table.of(node(last + 1)).linked, Some(at(4)));
        assert_eq!(table.of(linked).linked, Some(at(1)));
        assert_eq!(table.of(dialled).dial.map(|dial| dial.count), Some(1));
    }

    #[test]
    fn oldest_makes_room_if_all_have_connections() {
        let table = LinkStatusTable::default();
        for number in 0..=NODES_MAX as u32 {
            let (node, now) = (NodeAddress::new(number + 1), Time::from_nanos(u64::from(number)));
            table.fact(now, &LinkFact::LinkUp { node, incarnation: Incarnation(1) });
        }
        assert_eq!(lock(&table.0).len(), NODES_MAX);
        assert_eq!(table.of(NodeAddress::new(1)), LinkStatus::default());
    }
}
