//! Two readings of all nodes, one after the other, and what cannot be explained in them. Pure.
//!
//! A place is read at one moment, so that its law holds. The ends of a link are not, and messages move meanwhile. What is said
//! here is true all the same: every node was read
//! a first time before any was read a second time. What a sender knew at its first reading to have arrived, the receiver has
//! taken by its second one; what the receiver had taken at its first, the sender has numbered by its second.

use sinew_runtime::{tid::NodeAddress, wire::Class};

use super::{
    reading::{NodeAudit, Receiving, Sending, Session},
    system::{At, Link, LinkState, Unexplained},
};

/// Every link, from each end that was read, as the second reading has it.
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

/// From whom, to whom, and of which class.
type Way = (NodeAddress, NodeAddress, Option<Class>);

/// What the receiver of a way says.
fn receiving(all: &[NodeAudit], (from, to, class): Way) -> Option<&Receiving> {
    session(all, (to, from, class)).map(|session| &session.receiving)
}

/// What the sender of a way says.
fn sending(all: &[NodeAudit], way: Way) -> Option<&Sending> {
    session(all, way).map(|session| &session.sending)
}

fn session(all: &[NodeAudit], (at, with, class): Way) -> Option<&Session> {
    let node = all.iter().find(|node| node.node == at)?;
    node.sessions.iter().find(|session| session.node == with && session.class == class)
}

/// Whether both count in the same epoch of the same memory.
fn is_same(sending: &Sending, receiving: &Receiving) -> bool {
    sending.memory == Some(receiving.memory) && sending.epoch == receiving.epoch
}

/// What cannot be explained, place by place and link by link.
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

fn on_link(before: &[NodeAudit], after: &[NodeAudit], way: Way) -> i64 {
    let beyond = |ahead: u64, behind: u64| i64::try_from(ahead.saturating_sub(behind)).unwrap_or(i64::MAX);
    let lost = match (sending(before, way), receiving(after, way)) {
        (Some(sent), Some(came)) if is_same(sent, came) => beyond(sent.acknowledged, came.next),
        _ => 0,
    };
    let surplus = match (sending(after, way), receiving(before, way)) {
        (Some(sent), Some(came)) if is_same(sent, came) => beyond(came.next, sent.next),
        _ => 0,
    };
    lost - surplus
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::audit::{Account, Audit, Entry, Place};

    const A: NodeAddress = NodeAddress::new(1);
    const B: NodeAddress = NodeAddress::new(2);

    fn node(node: NodeAddress, with: NodeAddress, sent: (u64, u64), came: u64) -> NodeAudit {
        let (acknowledged, next) = sent;
        let memory = |node: NodeAddress| u64::from(node.bits());
        let sending = Sending { epoch: 5, memory: Some(memory(with)), acknowledged, next };
        let receiving = Receiving { memory: memory(node), epoch: 5, next: came };
        NodeAudit {
            node,
            name: "test".to_owned(),
            incarnation: Incarnation(1),
            entries: Vec::new(),
            sessions: vec![Session { node: with, class: None, sending, receiving }],
            refused: std::collections::BTreeMap::new(),
        }
    }

    /// A has sent `sent` to B, which has taken `came`; nothing goes the other way.
    fn pair(sent: (u64, u64), came: u64) -> Vec<NodeAudit> {
        vec![node(A, B, sent, 1), node(B, A, (1, 1), came)]
    }

    fn from_a(taken: u64, delivered: u64) -> Entry {
        let place = Place::FromNode { node: A, class: None };
        Entry { place, account: Account { taken, delivered, ..Account::default() } }
    }

    #[test]
    fn a_message_that_is_known_to_have_arrived_and_was_not_taken_names_its_link() {
        let audit = Audit::of(A, &pair((10, 12), 9), pair((10, 12), 9), Vec::new());
        let at = At::Link { from: A, to: B, class: None };
        assert_eq!(audit.unexplained, [Unexplained { at, messages: 1 }]);
        assert_eq!(audit.missing(), 1);
        assert!(audit.to_string().contains("0.0.0.1 -> 0.0.0.2: 1 missing"), "{audit}");
    }

    #[test]
    fn one_that_was_taken_and_never_sent_names_its_link_too() {
        let audit = Audit::of(A, &pair((10, 12), 14), pair((10, 12), 14), Vec::new());
        let at = At::Link { from: A, to: B, class: None };
        assert_eq!(audit.unexplained, [Unexplained { at, messages: -2 }]);
    }

    #[test]
    fn messages_that_move_between_the_readings_are_not_missing() {
        // At each reading one of the two was read much later than the other.
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
    fn a_session_that_one_side_has_begun_anew_is_compared_with_nothing() {
        let mut after = pair((10, 12), 1);
        after[1].sessions[0].receiving.memory = 77;
        let audit = Audit::of(A, &after.clone(), after, Vec::new());
        assert_eq!(
            (audit.missing(), audit.links[0].state, audit.links[0].taken),
            (0, LinkState::BegunAnew, None)
        );
    }

    #[test]
    fn what_arrived_in_a_session_that_the_other_end_has_forgotten_is_not_under_way() {
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
    fn a_message_that_got_lost_behind_a_link_names_its_place() {
        let mut nodes = pair((10, 10), 10);
        nodes[1].entries.push(from_a(9, 8));
        let lost = Audit::of(A, &nodes.clone(), nodes, Vec::new());
        let at = At::Place { node: B, place: Place::FromNode { node: A, class: None } };
        assert_eq!(lost.unexplained, [Unexplained { at, messages: 1 }]);
    }

    #[test]
    fn a_node_that_did_not_answer_leaves_its_links_with_one_end() {
        let mut nodes = pair((10, 12), 9);
        nodes.truncate(1);
        let audit = Audit::of(A, &nodes.clone(), nodes, vec![B]);
        assert_eq!((audit.missing(), audit.links[0].state), (0, LinkState::OneEndOnly));
        assert!(audit.to_string().contains("0.0.0.2 did not answer"), "{audit}");
    }
}
