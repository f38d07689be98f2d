//! The decisions of a node about the stop: its knowledge of presses, the states that it sends, and its latch. Pure:
//! time, and the state of outputs and of other nodes, come in as arguments.

mod report;
#[cfg(test)]
mod simulation;
mod stops;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use sinew_model::leave_reason::LeaveReason;
use sinew_runtime::{
    protection::StoppedOutputs,
    stop::StopState,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

pub(super) use self::stops::Stops;
use super::frame::{Entry, Frame, Origin, SOURCES_MAX};

/// Time between two states to a node that does not have the newest one. spec: STOP-4
const REPEAT: Duration = Duration::from_millis(20);
/// How long the state is repeated that often.
const REPEATED_FOR: Duration = Duration::from_secs(1);
/// Time between two states to a node that has it.
const REFRESH: Duration = Duration::from_secs(2);
/// Least time between two answers to one node.
const ANSWER_GAP: Duration = Duration::from_millis(5);
/// The same when nothing has changed for longer.
const LATE_GAP: Duration = Duration::from_millis(200);
/// Maximum number of other nodes, as the discovery has at most.
const PEERS_MAX: usize = 4_096;

/// The identity of this node, and its configuration.
#[derive(Clone, Debug)]
pub(super) struct Own {
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
    pub(super) name: String,
    /// Whether a former life of it may have had outputs that were live: it has kept its state.
    pub(super) has_lived: bool,
    /// How long it is held at its start.
    pub(super) hold: Duration,
    /// Time within which it presses after it has lost a node; `None`: it does not.
    pub(super) on_lost: Option<Duration>,
}

/// Another node, as the discovery knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct SeenNode {
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
    pub(super) name: String,
    /// Why it is lost; `None`: it is present.
    pub(super) lost: Option<String>,
}

/// An event.
#[derive(Clone, Debug)]
pub(super) enum Input {
    /// The stop is pressed at this node.
    Pressed { by: Tid, reason: LeaveReason },
    /// An operator releases the stop at this node.
    Released { by: Tid },
    /// A state of another node has arrived. `operators`: the applications that may release, of those that it names.
    FrameReceived { from: NodeAddress, frame: Frame, operators: BTreeSet<Tid> },
    /// The present nodes, and those that were lost without a farewell.
    NodesSeen(Vec<SeenNode>),
    /// The outputs of this process, and how many of them are not safe.
    OutputsSeen(StoppedOutputs, usize),
    /// The time has passed.
    TimePassed,
}

/// An order to the shell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Output {
    /// Sets the latch that the outputs of this node obey.
    SetLatch(StopState),
    /// Makes the outputs safe by a stop that was over before this node learned of it. The latch keeps its state.
    PassStop,
    /// Sends a state to another node.
    Send(NodeAddress, Box<Frame>),
    /// Writes the presses and releases to the state directory.
    Keep,
}

/// The knowledge of another node.
#[derive(Clone, Debug)]
struct Peer {
    incarnation: Incarnation,
    name: String,
    lost: Option<String>,
    /// The last state of this incarnation.
    heard: Option<Frame>,
    /// When this incarnation was found, or found again.
    found_at: Time,
    sent_at: Option<Time>,
    /// When the next state is due.
    due: Time,
    /// When it confirmed that it is safe by the presses that are known here.
    confirmed_at: Option<Time>,
}

/// The core. Call [`poll`](Self::poll) until it returns `None` after each [`handle`](Self::handle).
#[derive(Debug)]
pub(super) struct Core {
    own: Own,
    stops: Stops,
    /// The number of the last press of this incarnation: no later one has it again, even if its entry is forgotten.
    pressed: u32,
    began: Time,
    /// Whether the hold at the start lasts.
    is_new: bool,
    peers: BTreeMap<NodeAddress, Peer>,
    outputs: StoppedOutputs,
    /// When this node learned of the newest press; `None` while no stop is in force.
    stopped_at: Option<Time>,
    /// When its outputs were safe after that.
    safe_at: Option<Time>,
    /// When its state changed last.
    changed_at: Time,
    latched: StopState,
    /// Whether outputs could ever be armed in this life, or in a former one.
    has_run: bool,
    /// Whether the newest presses and releases are ordered to be written.
    is_kept: bool,
    orders: VecDeque<Output>,
}

impl Core {
    /// Begins the life of a node, with the presses and releases of former ones.
    pub(super) fn new(own: Own, stops: Stops, now: Time) -> Self {
        let has_run = own.has_lived;
        let mut core = Self {
            own,
            stopped_at: stops.is_open().then_some(now),
            stops,
            pressed: 0,
            began: now,
            is_new: true,
            peers: BTreeMap::new(),
            outputs: StoppedOutputs::default(),
            safe_at: None,
            changed_at: now,
            // As the latch of a new node.
            latched: StopState::Released,
            has_run,
            is_kept: true,
            orders: VecDeque::new(),
        };
        core.settle(now);
        core
    }

    /// Handles an event.
    pub(super) fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::Pressed { by, reason } => self.press(now, by, reason),
            Input::Released { by } => {
                if self.stops.release(by) {
                    self.note_change(now);
                    self.is_kept = false;
                }
            }
            Input::FrameReceived { from, frame, operators } => self.receive(now, from, frame, &operators),
            Input::NodesSeen(nodes) => self.see(now, nodes),
            Input::OutputsSeen(outputs, not_safe) => {
                if self.outputs != outputs {
                    // Before the node may be lost: the others tell by it when its outputs are safe.
                    self.outputs = outputs;
                    self.peers.values_mut().for_each(|peer| peer.due = now);
                }
                // spec: STOP-5. The node withdraws its confirmation if an output is created during the stop and the
                // safe function of that output fails.
                if self.stopped_at.is_some() && (not_safe == 0) != self.safe_at.is_some() {
                    self.safe_at = (not_safe == 0).then_some(now);
                    self.note_change(now);
                }
            }
            Input::TimePassed => {}
        }
        self.settle(now);
    }

    /// Returns the next order.
    pub(super) fn poll(&mut self) -> Option<Output> {
        self.orders.pop_front()
    }

    /// Returns when [`Input::TimePassed`] is due at the latest.
    pub(super) fn next_wake(&self) -> Option<Time> {
        self.peers.values().map(|peer| peer.due).min()
    }

    /// Returns when the hold at the start ends, by the nodes that are seen then or later.
    pub(super) fn hold_ends(&self) -> Time {
        self.began + self.own.hold
    }

    /// Returns whether a stop is in force.
    pub(super) fn is_stopped(&self) -> bool {
        self.stops.is_open()
    }

    /// Returns whether the outputs of this process were seen safe since the newest press.
    pub(super) const fn is_safe(&self) -> bool {
        self.safe_at.is_some()
    }

    /// Returns the state of the latch, as ordered last.
    pub(super) const fn latched(&self) -> StopState {
        self.latched
    }

    /// Returns the known presses and releases.
    pub(super) const fn stops(&self) -> &Stops {
        &self.stops
    }

    fn press(&mut self, now: Time, by: Tid, reason: LeaveReason) {
        let Own { node, incarnation, .. } = self.own;
        self.pressed = self.stops.press(Origin { node, incarnation }, self.pressed, by, reason);
        self.begin_stop(now);
    }

    /// A press is new here: all confirmations begin anew.
    fn begin_stop(&mut self, now: Time) {
        (self.stopped_at, self.safe_at) = (Some(now), None);
        self.peers.values_mut().for_each(|peer| peer.confirmed_at = None);
        self.note_change(now);
        self.is_kept = false;
    }

    /// spec: STOP-2
    fn receive(&mut self, now: Time, from: NodeAddress, frame: Frame, operators: &BTreeSet<Tid>) {
        let merged = self.stops.merge(&frame.entries, operators);
        if merged.has_press && self.stops.is_open() {
            self.begin_stop(now);
        } else if merged.has_press || merged.has_release {
            if merged.has_press && self.has_run && self.latched != StopState::Stopped {
                // This node was away during a whole stop, or ended in it. spec: STOP-7
                self.orders.push_back(Output::PassStop);
            }
            self.note_change(now);
            self.is_kept = false;
        }
        if !self.peers.contains_key(&from) {
            if self.peers.len() >= PEERS_MAX {
                return;
            }
            self.peers.insert(from, Peer::new(frame.sender, String::new(), now));
        }
        let is_behind = !self.stops.is_in(&frame.entries);
        let confirms = frame.is_safe && self.stops.is_open() && self.stops.presses_are_in(&frame.entries);
        let Some(peer) = self.peers.get_mut(&from) else { return };
        if peer.incarnation > frame.sender {
            // Its presses count, its state does not.
            return;
        }
        if peer.incarnation < frame.sender {
            let name = std::mem::take(&mut peer.name);
            *peer = Peer::new(frame.sender, name, now);
        }
        if is_behind || frame.wants_state {
            let is_recent = now.since(self.changed_at.max(peer.found_at)) < REPEATED_FOR;
            let gap = if is_recent { ANSWER_GAP } else { LATE_GAP };
            let soonest = peer.sent_at.map_or(now, |at| at + gap);
            peer.due = peer.due.min(soonest.max(now));
        }
        if confirms {
            peer.confirmed_at = peer.confirmed_at.or(Some(now));
        }
        peer.heard = Some(frame);
    }

    fn see(&mut self, now: Time, nodes: Vec<SeenNode>) {
        // By what the discovery has found, and not by the time alone: the look may be late. spec: STOP-6
        self.is_new &= now < self.hold_ends();
        let seen: BTreeSet<_> = nodes.iter().map(|node| node.node).collect();
        // One that has said farewell is no part of the system.
        self.peers.retain(|node, _| seen.contains(node));
        let mut lost = None;
        for node in nodes {
            let SeenNode { node: address, incarnation, name, lost: why } = node;
            let peer = self.peers.entry(address).or_insert_with(|| Peer::new(incarnation, name.clone(), now));
            if peer.incarnation < incarnation {
                *peer = Peer::new(incarnation, name.clone(), now);
            }
            if !name.is_empty() {
                peer.name = name;
            }
            if let Some(why) = why.as_ref().filter(|_| peer.lost.is_none() && peer.heard.is_some()) {
                lost = Some(format!("node {} is lost: {why}", peer.name));
            }
            if why.is_none() && peer.lost.is_some() {
                // Meanwhile it may have been pressed, or released.
                *peer = Peer::new(peer.incarnation, std::mem::take(&mut peer.name), now);
            }
            peer.lost = why;
        }
        // spec: STOP-10
        if let Some(reason) = lost.filter(|_| self.own.on_lost.is_some()) {
            self.press(now, Tid::new(self.own.node, AppAddress::STOP), LeaveReason::of(&reason));
        }
    }

    /// All nodes get the new state at once. spec: STOP-4
    fn note_change(&mut self, now: Time) {
        self.changed_at = now;
        self.peers.values_mut().for_each(|peer| peer.due = now);
    }

    /// Sets the latch, and sends the states that are due.
    fn settle(&mut self, now: Time) {
        let state = self.state();
        if state != self.latched {
            if state != StopState::Stopped {
                (self.stopped_at, self.safe_at) = (None, None);
            }
            self.latched = state;
            self.has_run |= state == StopState::Released;
            // Before any state is sent: a confirmation follows the latch.
            self.orders.push_back(Output::SetLatch(state));
            self.note_change(now);
        }
        if !std::mem::replace(&mut self.is_kept, true) {
            self.orders.push_back(Output::Keep);
        }
        self.send_due(now);
    }

    /// spec: STOP-1, STOP-6
    fn state(&self) -> StopState {
        let is_unknown = |peer: &Peer| peer.lost.is_none() && peer.heard.is_none();
        if self.stops.is_open() {
            StopState::Stopped
        } else if self.is_new || self.peers.values().any(is_unknown) {
            StopState::Held
        } else {
            StopState::Released
        }
    }

    fn send_due(&mut self, now: Time) {
        let due: Vec<_> =
            self.peers.iter().filter(|(_, peer)| peer.due <= now).map(|(node, _)| *node).collect();
        for node in due {
            let Some(peer) = self.peers.get(&node) else { continue };
            let is_awaited = self.is_awaited(now, peer);
            let has_state = peer.heard.as_ref().is_some_and(|heard| self.stops.is_in(&heard.entries));
            let frame = Box::new(self.frame(peer.heard.is_none() || is_awaited));
            self.orders.push_back(Output::Send(node, frame));
            let is_repeated = is_awaited || !has_state && self.is_recent(now, peer);
            let next = if is_repeated { REPEAT } else { REFRESH };
            if let Some(peer) = self.peers.get_mut(&node) {
                (peer.sent_at, peer.due) = (Some(now), now + next);
            }
        }
    }

    /// Returns whether the confirmation of a node is asked for again and again.
    fn is_awaited(&self, now: Time, peer: &Peer) -> bool {
        self.stops.is_open() && peer.confirmed_at.is_none() && self.is_recent(now, peer)
    }

    fn is_recent(&self, now: Time, peer: &Peer) -> bool {
        now.since(self.changed_at.max(peer.found_at)) < REPEATED_FOR
    }

    /// The state for another node.
    fn frame(&self, wants_state: bool) -> Frame {
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        let safe = self.stopped_at.zip(self.safe_at);
        // With more sources than fit none is a proof that all senders are stopped: the reader finds itself missing.
        let sources: Vec<_> = self.outputs.sources.iter().copied().take(SOURCES_MAX).collect();
        let has_all = sources.len() == self.outputs.sources.len();
        Frame {
            sender: self.own.incarnation,
            state: self.latched,
            entries: self.stops.entries().cloned().collect(),
            is_safe: safe.is_some(),
            safe_us: safe.map_or(0, |(stopped, safe)| micros(safe.since(stopped))),
            outputs: self.outputs.outputs,
            watchdog_us: micros(self.outputs.watchdog),
            sources: if has_all { sources } else { vec![NodeAddress::ALL] },
            on_lost_us: self.own.on_lost.map(micros),
            wants_state,
        }
    }
}

impl Peer {
    fn new(incarnation: Incarnation, name: String, now: Time) -> Self {
        Self {
            incarnation,
            name,
            lost: None,
            heard: None,
            found_at: now,
            sent_at: None,
            due: now,
            confirmed_at: None,
        }
    }
}
