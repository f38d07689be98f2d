//! The state of each node and its label, for the metrics and the page.

use std::collections::{BTreeMap, BTreeSet};

use sinew::{NodeAddress, inspect::LostReport};

use crate::snapshot::Snapshot;

/// Maximum characters of a label. A name has fewer; another node may report any text.
const LABEL_MAX: usize = 64;
/// The reasons of a loss, as nodes report them. `gave up` is followed by the reason of the node that gave up.
const LOSSES: [&str; 7] = ["left", "gave up", "crashed", "hung", "link down", "restarted", "duplicate"];

/// The state of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum State {
    /// It answers.
    Up,
    /// It answers, and is about to end.
    Stops,
    /// The entry node has lost it: the class of the loss, and the reason in words.
    Lost(&'static str, String),
    /// It is known, and has not answered in time: why.
    Silent(String),
}

/// A node of the system.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NodeRow {
    pub(crate) node: NodeAddress,
    pub(crate) label: String,
    pub(crate) state: State,
}

/// The labels of all nodes: the name of a node, or its address where it has no name or shares its name.
pub(crate) struct NodeLabels(BTreeMap<NodeAddress, String>);

impl NodeLabels {
    pub(crate) fn of(snapshot: &Snapshot) -> Self {
        let mut names: BTreeMap<NodeAddress, &str> = BTreeMap::new();
        let mut add = |node, name| {
            let known = names.entry(node).or_insert(name);
            if known.is_empty() {
                *known = name;
            }
        };
        snapshot.entry.iter().for_each(|entry| add(entry.node, &entry.name));
        snapshot.answers().for_each(|answers| add(answers.node.node, &answers.node.name));
        snapshot.nodes.iter().for_each(|one| add(one.node, &one.name));
        for report in snapshot.entry.iter().chain(snapshot.answers().map(|answers| &answers.node)) {
            report.lost.iter().for_each(|lost| add(lost.node, &lost.name));
            report.peers.iter().for_each(|peer| add(peer.node, peer.name.as_deref().unwrap_or_default()));
        }
        let mut owners: BTreeMap<String, usize> = BTreeMap::new();
        for name in names.values() {
            *owners.entry(bounded(name)).or_default() += 1;
        }
        let label = |(node, name): (NodeAddress, &str)| {
            let name = bounded(name);
            let is_clear = !name.is_empty() && owners.get(&name) == Some(&1);
            (node, if is_clear { name } else { node.to_string() })
        };
        Self(names.into_iter().map(label).collect())
    }

    pub(crate) fn get(&self, node: NodeAddress) -> String {
        self.0.get(&node).cloned().unwrap_or_else(|| node.to_string())
    }
}

/// Returns a text of another node as a label.
pub(crate) fn bounded(text: &str) -> String {
    text.chars().take(LABEL_MAX).collect()
}

/// Returns the class of a loss.
pub(crate) fn loss_class(why: &str) -> &'static str {
    LOSSES.into_iter().find(|class| why.starts_with(class)).unwrap_or("other")
}

/// Returns all nodes of the system, in the order of their addresses.
pub(crate) fn rows(snapshot: &Snapshot, labels: &NodeLabels) -> Vec<NodeRow> {
    let row = |node, state| NodeRow { node, label: labels.get(node), state };
    let lost = |of: &LostReport| State::Lost(loss_class(&of.why), of.why.clone());
    let mut rows = Vec::new();
    for one in &snapshot.nodes {
        let state = match &one.result {
            Ok(answers) if answers.node.stopping => State::Stops,
            Ok(_) => State::Up,
            Err(why) => State::Silent(why.clone()),
        };
        rows.push(row(one.node, state));
    }
    let asked: BTreeSet<_> = rows.iter().map(|row| row.node).collect();
    if let Ok(entry) = &snapshot.entry {
        let gone = entry.lost.iter().filter(|lost| !asked.contains(&lost.node));
        let mut gone: BTreeMap<_, _> = gone.map(|of| (of.node, lost(of))).collect();
        // Messages for it or from it remain, and the entry node no longer lists why it was lost.
        for peer in entry.peers.iter().filter(|peer| !peer.is_there && !asked.contains(&peer.node)) {
            gone.entry(peer.node).or_insert_with(|| State::Lost("other", "lost".to_owned()));
        }
        rows.extend(gone.into_iter().map(|(node, state)| row(node, state)));
    }
    rows.sort_by_key(|row| row.node);
    rows
}

#[cfg(test)]
mod tests {
    use sinew::{Time, inspect::PeerReport};

    use super::*;
    use crate::metrics::tests::{lost, node_report, snapshot};

    #[test]
    fn losses_have_few_classes() {
        assert_eq!(loss_class("gave up: the address is in use"), "gave up");
        assert_eq!(loss_class("link down"), "link down");
        assert_eq!(loss_class("eaten"), "other");
    }

    #[test]
    fn nodes_that_share_a_name_have_addresses_as_labels() {
        let node = |last| NodeAddress::from([10, 0, 0, last]);
        let mut snapshot = Snapshot::without_entry(Time::from_nanos(0), String::new());
        let mut report = node_report(node(1), "hip");
        report.lost = vec![lost(node(2), "knee", "crashed"), lost(node(3), "knee", "left")];
        snapshot.entry = Ok(report);
        let labels = NodeLabels::of(&snapshot);
        let all = [1, 2, 3, 4].map(|last| labels.get(node(last)));
        assert_eq!(all, ["hip", "10.0.0.2", "10.0.0.3", "10.0.0.4"].map(str::to_owned));
    }

    #[test]
    fn lost_node_that_answers_again_is_not_lost() {
        let mut snapshot = snapshot();
        let far = NodeAddress::from([10, 0, 0, 9]);
        let Ok(entry) = &mut snapshot.entry else { panic!("it has answered") };
        let incarnation = entry.incarnation;
        entry.lost = vec![lost(snapshot.nodes[0].node, "hip", "crashed"), lost(far, "knee", "hung")];
        entry.peers.push(PeerReport::lost(far, incarnation));
        let rows = rows(&snapshot, &NodeLabels::of(&snapshot));
        let states: Vec<_> = rows.iter().map(|row| &row.state).collect();
        assert_eq!(rows.len(), snapshot.nodes.len() + 1);
        assert_eq!(states.first(), Some(&&State::Up));
        assert_eq!(states.last(), Some(&&State::Lost("hung", "hung".to_owned())));
    }
}
