//! The will core: which node holds which wills. It has no clock and no socket; it takes inputs and returns
//! outputs. The parent module has the rules.

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

use super::protocol::{HeldWill, Testament, WILLS_MAX};

/// Time between two lists to a node when nothing changes.
pub(super) const REPEAT: Duration = Duration::from_secs(2);
/// Maximum size of a list without its wills, in bytes.
const FRAME_OVERHEAD: usize = 64;
/// Minimum time between two lists to a node.
const SPACING: Duration = Duration::from_millis(5);

/// An event that the core handles.
#[derive(Clone, Debug)]
pub enum Input {
    /// An application of this node with these wills is ready.
    Ready { app: AppAddress, wills: Arc<[Will]> },
    /// An application has ended, and this node has executed its wills.
    Ended { app: AppAddress },
    /// The link to a node is up.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// The link to a node is broken.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// A node is lost.
    NodeLost { node: NodeAddress, incarnation: Incarnation },
    /// A node has reported that it gives up. A goodbye on its link means that it has executed its wills
    /// itself.
    GaveUp { node: NodeAddress, incarnation: Incarnation },
    /// This incarnation was another process than the one that has the node's address.
    Duplicate { node: NodeAddress, incarnation: Incarnation },
    /// A node has left in order.
    NodeLeft { node: NodeAddress, incarnation: Incarnation },
    /// The certificate of this incarnation's link is revoked. The origin of its wills is therefore unknown.
    Revoked { node: NodeAddress, incarnation: Incarnation },
    /// A node has sent its wills.
    TestamentReceived { from: NodeAddress, testament: Testament },
    /// The time of [`Core::next_wake`] has been reached.
    TimePassed,
}

/// An action for the shell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Output {
    /// Send the wills of this node to another node. `left_out` is the number of wills without room.
    Publish { to: NodeAddress, testament: Testament, left_out: usize },
    /// Execute a will of an application of this lost incarnation of a node, for local applications.
    Execute { node: NodeAddress, incarnation: Incarnation, will: HeldWill },
}

/// The wills of this node's applications, and those of other nodes.
#[derive(Debug)]
pub struct Core {
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
    /// The linked incarnation gives up. If the link breaks now without a goodbye, the node counts as lost.
    gives_up: bool,
    sent: Option<Time>,
    /// The time at which this node's wills are sent next.
    due: Option<Time>,
    /// The last list received from the node.
    held: Option<Testament>,
}

impl Core {
    /// Returns a core without wills. It holds the wills of at most `nodes_max` nodes, and sends lists of at
    /// most `bytes_max` bytes.
    pub const fn new(incarnation: Incarnation, nodes_max: usize, bytes_max: usize) -> Self {
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

    /// Handles an input.
    pub fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::Ready { app, wills } => {
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
                    && peer.linked.is_some_and(|linked| linked <= incarnation)
                {
                    (peer.linked, peer.due) = (None, None);
                    if std::mem::take(&mut peer.gives_up) {
                        self.execute(node, |held| held <= incarnation);
                    }
                }
            }
            // spec: WILL-2
            Input::GaveUp { node, incarnation } => match self.peers.get_mut(&node) {
                Some(peer) if peer.linked.is_some_and(|linked| linked <= incarnation) => peer.gives_up = true,
                Some(_) | None => self.execute(node, |held| held <= incarnation),
            },
            Input::NodeLost { node, incarnation } => self.execute(node, |held| held <= incarnation),
            // The node itself may be alive in another incarnation. spec: WILL-2
            Input::Duplicate { node, incarnation } => self.execute(node, |held| held == incarnation),
            // spec: WILL-2, WILL-5
            Input::NodeLeft { node, incarnation } | Input::Revoked { node, incarnation } => {
                drop(self.take_held(node, |held| held <= incarnation));
            }
            Input::TestamentReceived { from, testament } => self.testament_received(from, testament),
            Input::TimePassed => {}
        }
        self.peers.retain(|_, peer| peer.linked.is_some() || peer.held.is_some());
        self.publish(now);
    }

    /// Returns the next output. The caller repeats this until it returns `None`.
    pub(super) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Returns the time of the next `Input::TimePassed`.
    pub fn next_wake(&self) -> Option<Time> {
        self.peers.values().filter_map(|peer| peer.due).min()
    }

    /// Returns the incarnation of a node with a link that was last reported as up, unless it was reported as
    /// broken.
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
        self.execute(node, |held| held < incarnation);
        let has_wills = !self.own.is_empty();
        if let Some(peer) = self.at(node) {
            (peer.linked, peer.gives_up) = (Some(incarnation), false);
            peer.due = has_wills.then_some(now);
        }
    }

    fn testament_received(&mut self, from: NodeAddress, testament: Testament) {
        // spec: WILL-3
        self.execute(from, |held| held < testament.incarnation);
        let Some(peer) = self.at(from) else { return };
        let is_former = peer.linked.is_some_and(|linked| testament.incarnation < linked);
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
        let Some(Testament { incarnation, wills, .. }) = held else { return };
        self.outputs.extend(wills.into_iter().map(|will| Output::Execute { node, incarnation, will }));
    }

    /// Sends the list to each node for which it is due. spec: WILL-1
    fn publish(&mut self, now: Time) {
        let mut left = self.bytes_max.saturating_sub(FRAME_OVERHEAD);
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
            self.outputs.push_back(Output::Publish { to: *to, testament, left_out });
        }
    }
}
