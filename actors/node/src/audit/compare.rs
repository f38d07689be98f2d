//! Compares two consecutive readings of all nodes, and finds the messages that are not accounted for. Pure.
//!
//! Each place is read atomically, so that its invariant holds. The two ends of a link are not read together,
//! and messages move meanwhile. The comparison is exact nevertheless: every node was read a first time before
//! any node was read a second time. Messages that a sender knew as acknowledged at its first reading were
//! taken by the receiver by its second one. Messages that the receiver had taken at its first reading were
//! numbered by the sender by its second one.

use sinew_runtime::{tid::NodeAddress, wire::Class};

use super::{
    reading::{NodeAudit, Receiving, Sending, Session},
    system::{At, Link, LinkState, Unexplained},
};

/// Returns every link, from each end that was read, as of the second reading.
pub(super) fn links(after: &[NodeAudit]) -> Vec<Link> {
    let mut links = Vec::new();
    for node in after {
        for session in &node.sessions {
            links.push(link(node.node, session, after));
        }
    }
    links
}

fn link(from: NodeAddress, session: &Session, all: &[NodeAudit]) -> Link {
    let there = receiving(all, (from, session.node, session.class));
    let state = match there {
        Some(there) if is_same(&session.sending, there) => LinkState::OneSession,
        Some(_) => LinkState::BegunAnew,
        None => LinkState::OneEndOnly,
    };
    Link {
        from,
        to: session.node,
        class: session.class,
        state,
        sent: session.sending.next.saturating_sub(1),
        acknowledged: session.sending.acknowledged.saturating_sub(1),
        taken: there.filter(|_| state == LinkState::OneSession).map(|there| there.next.saturating_sub(1)),
    }
}

/// The sender, the receiver, and the class.
type Route = (NodeAddress, NodeAddress, Option<Class>);

/// Returns the counters of the receiver of this direction.
fn receiving(all: &[NodeAudit], (from, to, class): Route) -> Option<&Receiving> {
    session(all, (to, from, class)).map(|session| &session.receiving)
}

/// Returns the counters of the sender of this direction.
fn sending(all: &[NodeAudit], way: Route) -> Option<&Sending> {
    session(all, way).map(|session| &session.sending)
}

fn session(all: &[NodeAudit], (at, with, class): Route) -> Option<&Session> {
    let node = all.iter().find(|node| node.node == at)?;
    node.sessions.iter().find(|session| session.node == with && session.class == class)
}

/// Returns whether both count in the same epoch for the same receiver.
fn is_same(sending: &Sending, receiving: &Receiving) -> bool {
    sending.memory == Some(receiving.memory) && sending.epoch == receiving.epoch
}

/// Returns the messages that are not accounted for, place by place and link by link.
pub(super) fn unexplained(before: &[NodeAudit], after: &[NodeAudit]) -> Vec<Unexplained> {
    let mut found = Vec::new();
    for node in after {
        found.extend(in_places(node));
        for Session { node: to, class, .. } in &node.sessions {
            let (from, to, class) = (node.node, *to, *class);
            let messages = on_link(before, after, (from, to, class));
            let at = At::Link { from, to, class };
            found.extend((messages != 0).then_some(Unexplained { at, messages }));
        }
    }
    found
}

fn in_places(node: &NodeAudit) -> impl Iterator<Item = Unexplained> + '_ {
    node.entries.iter().filter_map(|entry| {
        let messages = entry.account.unexplained();
        let at = At::Place { node: node.node, place: entry.place.clone() };
        (messages != 0).then_some(Unexplained { at, messages })
    })
}

fn on_link(before: &[NodeAudit], after: &[NodeAudit], way: Route) -> i64 {
    let beyond = |ahead: u64, behind: u64| i64::try_from(ahead.saturating_sub(behind)).unwrap_or(i64::MAX);
    let lost = match (sending(before, way), receiving(after, way)) {
        (Some(sent), Some(received)) if is_same(sent, received) => beyond(sent.acknowledged, received.next),
        _ => 0,
    };
    let surplus = match (sending(after, way), receiving(before, way)) {
        (Some(sent), Some(received)) if is_same(sent, received) => beyond(received.next, sent.next),
        _ => 0,
    };
    lost - surplus
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::audit::{Audit, Entry, Place};
    use sinew_session::counts::Account;

    const A: NodeAddress = NodeAddress::new(1);
    const B: NodeAddress = NodeAddress::new(2);

    fn node(node: NodeAddress, with: NodeAddress, sent: (u64, u64), received: u64) -> NodeAudit {
        let (acknowledged, next) = sent;
        let memory = |node: NodeAddress| u64::from(node.bits());
        let sending = Sending { epoch: 5, memory: Some(memory(with)), acknowledged, next };
        let receiving = Receiving { memory: memory(node), epoch: 5, next: received };
        NodeAudit {
            node,
            name: "test".to_owned(),
            incarnation: Incarnation(1),
            entries: Vec::new(),
            sessions: vec![Session { node: with, class: None, sending, receiving }],
            refused: std::collections::BTreeMap::new(),
        }
    }

    /// Returns the reports of A, which has sent `sent` to B, and of B, which has received `received`. The other
    /// direction is idle.
    fn pair(sent: (u64, u64), received: u64) -> Vec<NodeAudit> {
        vec![node(A, B, sent, 1), node(B, A, (1, 1), received)]
    }

    fn from_a(taken: u64, delivered: u64) -> Entry {
        let place = Place::FromNode { node: A, class: None };
        Entry { place, account: Account { taken, delivered, ..Account::default() } }
    }

    #[test]
    fn acknowledged_but_missing_message_names_its_link() {
        let audit = Audit::of(A, &pair((10, 12), 9), pair((10, 12), 9), Vec::new());
        let at = At::Link { from: A, to: B, class: None };
        assert_eq!(audit.unexplained, [Unexplained { at, messages: 1 }]);
        assert_eq!(audit.missing(), 1);
        assert!(audit.to_string().contains("0.0.0.1 -> 0.0.0.2: 1 missing"), "{audit}");
    }

    #[test]
    fn received_but_never_sent_message_names_its_link() {
        let audit = Audit::of(A, &pair((10, 12), 14), pair((10, 12), 14), Vec::new());
        let at = At::Link { from: A, to: B, class: None };
        assert_eq!(audit.unexplained, [Unexplained { at, messages: -2 }]);
    }

    #[test]
    fn messages_moving_between_readings_are_not_missing() {
        // In each reading one of the two nodes was read much later than the other.
        for (first, second) in [(1, 900), (500, 501), (900, 1_000)] {
            let audit = Audit::of(
                A,
                &pair((first, first + 5), first),
                pair((second, second + 5), second + 3),
                Vec::new(),
            );
            assert_eq!(audit.missing(), 0, "{audit}");
            let late = Audit::of(
                A,
                &pair((first, first), first + 4),
                pair((second, second + 5), second - 1),
                Vec::new(),
            );
            assert_eq!(late.missing(), 0, "{late}");
        }
    }

    #[test]
    fn restarted_session_is_not_compared() {
        let mut after = pair((10, 12), 1);
        after[1].sessions[0].receiving.memory = 77;
        let audit = Audit::of(A, &after.clone(), after, Vec::new());
        assert_eq!(
            (audit.missing(), audit.links[0].state, audit.links[0].taken),
            (0, LinkState::BegunAnew, None)
        );
    }

    #[test]
    fn arrivals_of_forgotten_session_are_not_in_flight() {
        let mut nodes = pair((10, 12), 1);
        nodes[1].sessions[0].receiving.memory = 77;
        let to_b = Place::ToNode { node: B, class: None };
        let account = Account { taken: 12, delivered: 10, unacknowledged: 2, ..Account::default() };
        nodes[0].entries.push(Entry { place: to_b, account });
        nodes[1].entries.push(from_a(1, 1));
        let former = Account { taken: 10, delivered: 10, ..Account::default() };
        nodes[1].entries.push(Entry { place: Place::FromFormerNodes, account: former });
        let total = Audit::of(A, &nodes.clone(), nodes, Vec::new()).total();
        assert_eq!((total.unacknowledged, total.unexplained()), (2, 0), "{total:?}");
    }

    #[test]
    fn message_lost_behind_link_names_its_place() {
        let mut nodes = pair((10, 10), 10);
        nodes[1].entries.push(from_a(9, 8));
        let lost = Audit::of(A, &nodes.clone(), nodes, Vec::new());
        let at = At::Place { node: B, place: Place::FromNode { node: A, class: None } };
        assert_eq!(lost.unexplained, [Unexplained { at, messages: 1 }]);
    }

    #[test]
    fn links_of_silent_node_have_one_end() {
        let mut nodes = pair((10, 12), 9);
        nodes.truncate(1);
        let audit = Audit::of(A, &nodes.clone(), nodes, vec![B]);
        assert_eq!((audit.missing(), audit.links[0].state), (0, LinkState::OneEndOnly));
        assert!(audit.to_string().contains("0.0.0.2 did not answer"), "{audit}");
    }
}
