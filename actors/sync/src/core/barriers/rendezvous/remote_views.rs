//! The barrier state that other nodes published, and the schedule of this node's own frame.

use super::*;

/// Time between two frames to a peer when nothing changed.
const REPEAT: Duration = Duration::from_secs(2);
/// Minimum time between two frames to a peer. An application that passes repeatedly costs a thousand frames a
/// second, not one for each pass.
const SPACING: Duration = Duration::from_millis(1);

/// The published barrier state of the other nodes.
#[derive(Debug)]
pub(super) struct RemoteViews(BTreeMap<NodeAddress, RemoteView>);

#[derive(Debug, Default)]
struct RemoteView {
    state: Option<PublishedState>,
    /// Whether the node published its state since the link came up.
    has_reported: bool,
    sent: Option<Time>,
    due: Option<Time>,
}

/// The last state that a node published.
#[derive(Debug)]
struct PublishedState {
    incarnation: Incarnation,
    version: u64,
    barriers: BTreeMap<BarrierKey, PublishedBarrier>,
}

impl RemoteViews {
    pub(super) const fn new() -> Self {
        Self(BTreeMap::new())
    }

    /// Handles a link to `node` that is up.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress, has_barriers: bool) {
        self.0.entry(node).or_default().due = has_barriers.then_some(now);
    }

    /// Invalidates the state of `node` until it is published again. This node's frame stays scheduled: `node`
    /// may be linked in an incarnation that has sent nothing yet.
    pub(super) fn invalidate(&mut self, node: NodeAddress) {
        if let Some(view) = self.0.get_mut(&node) {
            view.has_reported = false;
        }
    }

    pub(super) fn retain(&mut self, is_known: impl Fn(NodeAddress) -> bool) {
        self.0.retain(|node, _| is_known(*node));
    }

    /// Stores the state that a node published. Returns its barriers, unless the state is known or outdated.
    /// `linked` is the node's linked incarnation. spec: SYNC-11
    ///
    /// # Errors
    /// Returns why the state is not used.
    pub(super) fn store(
        &mut self,
        from: NodeAddress,
        frame: Arrivals,
        linked: Option<Incarnation>,
    ) -> Result<Vec<PublishedBarrier>, &'static str> {
        if linked.is_some_and(|linked| linked != frame.incarnation) {
            return Err("this is about another incarnation of its node than the linked one");
        }
        let view = self.0.entry(from).or_default();
        // The linked incarnation is the valid one, even if it is earlier: the other one was a duplicate of
        // the node.
        let is_over = |known: &&PublishedState| linked.is_some() && known.incarnation != frame.incarnation;
        let known = view.state.as_ref().filter(|known| !is_over(known));
        let known = known.map(|known| (known.incarnation, known.version));
        if known.is_some_and(|known| (frame.incarnation, frame.version) < known) {
            return Ok(Vec::new());
        }
        view.has_reported = true;
        if known == Some((frame.incarnation, frame.version)) {
            return Ok(Vec::new());
        }
        let barriers = frame.barriers.iter().map(|barrier| (barrier.key(), barrier.clone())).collect();
        view.state =
            Some(PublishedState { incarnation: frame.incarnation, version: frame.version, barriers });
        Ok(frame.barriers)
    }

    /// Returns the last published state of one barrier, for each node.
    pub(super) fn about(&self, key: &BarrierKey) -> impl Iterator<Item = &PublishedBarrier> {
        self.0.values().filter_map(|view| view.state.as_ref()?.barriers.get(key))
    }

    /// Returns the applications that wait at a barrier behind `generation`, on the reachable nodes. `linked`
    /// returns the incarnation of such a node.
    pub(super) fn waiting(
        &self,
        key: &BarrierKey,
        generation: u64,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
    ) -> impl Iterator<Item = (Member, &str)> {
        let reported = self.0.iter().filter(|(_, view)| view.has_reported).filter_map(move |(node, view)| {
            let state = view.state.as_ref().filter(|state| linked(*node) == Some(state.incarnation))?;
            Some((*node, state.incarnation, state.barriers.get(key)?))
        });
        reported.flat_map(move |(node, incarnation, barrier)| {
            let there = barrier.arrivals.iter().filter(move |arrival| arrival.after == generation);
            there.map(move |arrival| {
                let member = Member { node, incarnation, party: arrival.party };
                (member, arrival.name.as_deref().unwrap_or_default())
            })
        })
    }

    /// Returns the generation of a barrier that a member's node is known to know. An ended incarnation needs
    /// to know nothing; it has ended if a later one is valid. Otherwise the clock of the node's host may have
    /// been reset, and the member's incarnation may be the later one. spec: SYNC-12
    pub(super) fn known_generation(
        &self,
        here: (NodeAddress, Incarnation),
        own: u64,
        key: &BarrierKey,
        member: &Member,
    ) -> u64 {
        if member.node == here.0 {
            return if member.incarnation == here.1 { own } else { u64::MAX };
        }
        let Some(view) = self.0.get(&member.node) else { return 0 };
        let Some(state) = &view.state else { return 0 };
        match state.incarnation.cmp(&member.incarnation) {
            std::cmp::Ordering::Less => 0,
            std::cmp::Ordering::Equal => state.barriers.get(key).map_or(0, |barrier| barrier.generation),
            std::cmp::Ordering::Greater if view.has_reported => u64::MAX,
            std::cmp::Ordering::Greater => 0,
        }
    }

    /// Schedules the changed frame to every linked node, at the earliest `SPACING` after the last one.
    pub(super) fn make_due(&mut self, now: Time) {
        for view in self.0.values_mut() {
            let earliest = view.sent.map_or(now, |sent| now.max(sent + SPACING));
            view.due = Some(view.due.map_or(earliest, |due| due.min(earliest)));
        }
    }

    /// Schedules the rejected frame to `node` again.
    pub(super) fn frame_rejected(&mut self, now: Time, node: NodeAddress) {
        if let Some(view) = self.0.get_mut(&node) {
            view.due = Some(now + crate::core::retry::RETRY);
        }
    }

    /// Returns the linked nodes to which the frame is due now.
    pub(super) fn take_due(
        &mut self,
        now: Time,
        has_barriers: bool,
        is_linked: impl Fn(NodeAddress) -> bool,
    ) -> Vec<NodeAddress> {
        let mut due = Vec::new();
        for (node, view) in &mut self.0 {
            if view.due.is_none_or(|due| due > now) {
                continue;
            }
            let is_sent = has_barriers && is_linked(*node);
            view.due = is_sent.then(|| now + REPEAT);
            if is_sent {
                view.sent = Some(now);
                due.push(*node);
            }
        }
        due
    }

    /// Returns the time at which the frame is sent to a node next.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.0.values().filter_map(|view| view.due).min()
    }
}

impl PublishedBarrier {
    /// Returns the identity of this barrier.
    pub(super) fn key(&self) -> BarrierKey {
        BarrierKey {
            name: self.name.clone(),
            parties: self.parties.iter().map(ToString::to_string).collect(),
        }
    }
}
