//! Who holds which wills, without clock and socket: facts in, orders out. See the parent module's rules.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
    time::Duration,
};

use sinew_runtime::{
    app::Will,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::words::{HeldWill, Testament, WILLS_MAX};

/// Time between two lists to a node when nothing changes.
pub(super) const REPEAT: Duration = Duration::from_secs(2);
/// Bytes of a list beside its wills, at most.
const WORD: usize = 64;
/// Least time between two of them.
const SPACING: Duration = Duration::from_millis(5);

/// What has happened.
#[derive(Clone, Debug)]
pub(crate) enum Input {
    /// An application of this node with these wills is ready.
    Lives { app: AppAddress, wills: Arc<[Will]> },
    /// It has ended, and its node has executed its wills.
    Ended { app: AppAddress },
    /// Messages can flow to a node.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// They cannot any more.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// A node is lost.
    NodeLost { node: NodeAddress, incarnation: Incarnation },
    /// A node has said that it gives up. Its goodbye on its link, if it has one, says that it has executed its wills itself.
    GaveUp { node: NodeAddress, incarnation: Incarnation },
    /// This life was another process than the one that has the node's address.
    WasNobody { node: NodeAddress, incarnation: Incarnation },
    /// A node has left in order.
    NodeLeft { node: NodeAddress, incarnation: Incarnation },
    /// The certificate with which this life was linked is revoked: whose words its wills are nobody knows.
    Revoked { node: NodeAddress, incarnation: Incarnation },
    /// A node has told its wills.
    Told { from: NodeAddress, testament: Testament },
    /// The time of [`Core::next_wake`] has come.
    TimePassed,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Output {
    /// Tell a node our wills; so many more stay at home.
    Tell { to: NodeAddress, testament: Testament, left_out: usize },
    /// Execute a will of an application of this lost life of a node, towards our own applications.
    Execute { node: NodeAddress, life: Incarnation, will: HeldWill },
}

/// The wills of this node's applications, and those of other nodes.
#[derive(Debug)]
pub(crate) struct Core {
    incarnation: Incarnation,
    bytes_max: usize,
    own: BTreeMap<AppAddress, Vec<HeldWill>>,
    peers: BTreeMap<NodeAddress, Peer>,
    nodes_max: usize,
    version: u64,
    outputs: VecDeque<Output>,
}

#[derive(Debug, Default)]
struct Peer {
    linked: Option<Incarnation>,
    /// The linked life gives up: a link that breaks now, without a goodbye, is its loss.
    gives_up: bool,
    sent: Option<Time>,
    /// When it is told our wills.
    due: Option<Time>,
    /// What it told us last.
    held: Option<Testament>,
}

impl Core {
    /// No wills yet; it holds those of at most `nodes_max` nodes, and tells its own in at most `bytes_max`.
    pub(crate) const fn new(incarnation: Incarnation, nodes_max: usize, bytes_max: usize) -> Self {
        Self {
            incarnation,
            bytes_max,
            own: BTreeMap::new(),
            peers: BTreeMap::new(),
            nodes_max,
            version: 0,
            outputs: VecDeque::new(),
        }
    }

    /// Takes in what has happened.
    pub(crate) fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::Lives { app, wills } => {
                let held: Vec<_> = wills.iter().filter_map(|will| HeldWill::new(app, will)).collect();
                if !held.is_empty() {
                    self.own.insert(app, held);
                    self.changed(now);
                }
            }
            Input::Ended { app } => {
                if self.own.remove(&app).is_some() {
                    self.changed(now);
                }
            }
            Input::LinkUp { node, incarnation } => self.link_up(now, node, incarnation),
            Input::LinkBroken { node, incarnation } => {
                if let Some(peer) = self.peers.get_mut(&node)
                    && peer.linked.is_some_and(|life| life <= incarnation)
                {
                    (peer.linked, peer.due) = (None, None);
                    if std::mem::take(&mut peer.gives_up) {
                        self.execute(node, |life| life <= incarnation);
                    }
                }
            }
            // spec: WILL-2
            Input::GaveUp { node, incarnation } => match self.peers.get_mut(&node) {
                Some(peer) if peer.linked.is_some_and(|life| life <= incarnation) => peer.gives_up = true,
                Some(_) | None => self.execute(node, |life| life <= incarnation),
            },
            Input::NodeLost { node, incarnation } => self.execute(node, |life| life <= incarnation),
            // The node itself, in whatever life, may be alive. spec: WILL-2
            Input::WasNobody { node, incarnation } => self.execute(node, |life| life == incarnation),
            // spec: WILL-2, WILL-5
            Input::NodeLeft { node, incarnation } | Input::Revoked { node, incarnation } => {
                drop(self.take_held(node, |life| life <= incarnation));
            }
            Input::Told { from, testament } => self.told(from, testament),
            Input::TimePassed => {}
        }
        self.peers.retain(|_, peer| peer.linked.is_some() || peer.held.is_some());
        self.publish(now);
    }

    /// The next thing to be done; take until there is none.
    pub(super) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When to come back.
    pub(crate) fn next_wake(&self) -> Option<Time> {
        self.peers.values().filter_map(|peer| peer.due).min()
    }

    /// The life of a node that was told to be linked last, if its link is not told to be broken.
    pub(super) fn linked(&self, node: NodeAddress) -> Option<Incarnation> {
        self.peers.get(&node)?.linked
    }

    fn at(&mut self, node: NodeAddress) -> Option<&mut Peer> {
        if !self.peers.contains_key(&node) && self.peers.len() >= self.nodes_max {
            return None;
        }
        Some(self.peers.entry(node).or_default())
    }

    fn changed(&mut self, now: Time) {
        for peer in self.peers.values_mut().filter(|peer| peer.linked.is_some()) {
            let earliest = peer.sent.map_or(now, |sent| now.max(sent + SPACING));
            peer.due = Some(peer.due.map_or(earliest, |due| due.min(earliest)));
        }
    }

    fn link_up(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        // spec: WILL-3
        self.execute(node, |life| life < incarnation);
        let has_wills = !self.own.is_empty();
        if let Some(peer) = self.at(node) {
            (peer.linked, peer.gives_up) = (Some(incarnation), false);
            peer.due = has_wills.then_some(now);
        }
    }

    fn told(&mut self, from: NodeAddress, testament: Testament) {
        // spec: WILL-3
        self.execute(from, |life| life < testament.incarnation);
        let Some(peer) = self.at(from) else { return };
        let is_former = peer.linked.is_some_and(|life| testament.incarnation < life);
        let is_old =
            |held: &Testament| (held.incarnation, held.version) > (testament.incarnation, testament.version);
        if !is_former && !peer.held.as_ref().is_some_and(is_old) {
            peer.held = Some(testament);
        }
    }

    fn take_held(&mut self, node: NodeAddress, is_over: impl Fn(Incarnation) -> bool) -> Option<Testament> {
        self.peers.get_mut(&node)?.held.take_if(|held| is_over(held.incarnation))
    }

    fn execute(&mut self, node: NodeAddress, is_over: impl Fn(Incarnation) -> bool) {
        let held = self.take_held(node, is_over);
        let Some(Testament { incarnation: life, wills, .. }) = held else { return };
        self.outputs.extend(wills.into_iter().map(|will| Output::Execute { node, life, will }));
    }

    /// spec: WILL-1
    fn publish(&mut self, now: Time) {
        let mut left = self.bytes_max.saturating_sub(WORD);
        let has_room =
            |will: &&HeldWill| left.checked_sub(will.bytes_max()).inspect(|rest| left = *rest).is_some();
        let own = self.own.values().flatten();
        let wills: Vec<_> = own.clone().filter(has_room).take(WILLS_MAX).cloned().collect();
        let left_out = own.count() - wills.len();
        for (to, peer) in &mut self.peers {
            if peer.due.is_none_or(|due| due > now) {
                continue;
            }
            self.version += 1;
            peer.sent = Some(now);
            peer.due = (!wills.is_empty()).then(|| now + REPEAT);
            let (incarnation, version) = (self.incarnation, self.version);
            let testament = Testament { incarnation, version, wills: wills.clone() };
            self.outputs.push_back(Output::Tell { to: *to, testament, left_out });
        }
    }
}
