//! The report: which nodes have confirmed, and the time within which the others are safe without having said so.

use std::time::Duration;

use sinew_runtime::{
    stop::{StopNode, StopPress, StopReport, StopState},
    tid::NodeAddress,
    time::Time,
};

use super::{super::frame::Frame, Core, Peer};

/// The note of a node in the hold at its start.
const STARTING: &str = "it has just started, and looks for other nodes";

impl Core {
    /// Returns whether this node and all others that it knows have confirmed the stop. A node that has just started may
    /// not know all.
    pub(in crate::stop) fn is_confirmed(&self) -> bool {
        self.latched == StopState::Stopped
            && !self.is_new
            && self.safe_at.is_some()
            && self.peers.values().all(|peer| peer.confirmed_at.is_some())
    }

    /// Returns whether all present nodes have said that no stop is in force.
    pub(in crate::stop) fn is_released_everywhere(&self) -> bool {
        let is_released =
            |frame: &Frame| frame.state != StopState::Stopped && self.stops.is_in(&frame.entries);
        let mut present = self.peers.values().filter(|peer| peer.lost.is_none());
        !self.stops.is_open() && present.all(|peer| peer.heard.as_ref().is_some_and(is_released))
    }

    /// Returns the knowledge of this node.
    pub(in crate::stop) fn report(&self) -> StopReport {
        let press = |entry: &super::Entry| StopPress {
            node: entry.origin.node,
            incarnation: entry.origin.incarnation,
            number: entry.pressed,
            by: entry.by,
            reason: entry.reason.clone(),
        };
        let own = StopNode {
            node: self.own.node,
            name: self.own.name.clone(),
            state: Some(self.latched),
            confirmed_us: self.since_stop(self.safe_at).filter(|_| !self.is_new),
            safe_us: self.since_stop(self.safe_at),
            outputs: self.outputs.outputs,
            bound_us: None,
            note: self.own_note(),
        };
        let others = self.peers.iter().map(|(node, peer)| self.other(*node, peer));
        StopReport {
            state: self.latched,
            presses: self.stops.entries().filter(|entry| entry.is_open()).map(press).collect(),
            nodes: std::iter::once(own).chain(others).take(1_024).collect(),
            refused: None,
        }
    }

    fn own_note(&self) -> String {
        match self.latched {
            StopState::Stopped if self.safe_at.is_none() => {
                "an output is not safe yet, or its safe function fails: see the log of this node".to_owned()
            }
            StopState::Stopped if self.is_new => STARTING.to_owned(),
            StopState::Held => self.waits_for(),
            StopState::Stopped | StopState::Released => String::new(),
        }
    }

    /// Says why this node is held.
    fn waits_for(&self) -> String {
        let is_unknown = |peer: &Peer| peer.lost.is_none() && peer.heard.is_none();
        let unknown: Vec<_> = self
            .peers
            .iter()
            .filter(|(_, peer)| is_unknown(peer))
            .map(|(node, peer)| format!("{} ({node})", peer.name))
            .take(8)
            .collect();
        if unknown.is_empty() {
            return STARTING.to_owned();
        }
        format!("the state of the stop is not received from {}", unknown.join(", "))
    }

    fn other(&self, node: NodeAddress, peer: &Peer) -> StopNode {
        let heard = peer.heard.as_ref();
        let confirmed_us = self.since_stop(peer.confirmed_at);
        let is_open = self.latched == StopState::Stopped && confirmed_us.is_none();
        let (bound, note) = if is_open { self.bound(peer) } else { (None, String::new()) };
        StopNode {
            node,
            name: peer.name.clone(),
            state: heard.map(|frame| frame.state),
            confirmed_us,
            safe_us: heard.filter(|frame| frame.is_safe).map(|frame| frame.safe_us),
            outputs: heard.map_or(0, |frame| frame.outputs),
            bound_us: bound.map(micros),
            note: if confirmed_us.is_none() { note } else { String::new() },
        }
    }

    /// Returns the time after the press within which a node that has not confirmed is safe, and how that is known.
    fn bound(&self, peer: &Peer) -> (Option<Duration>, String) {
        let why = peer.lost.as_ref().map_or_else(
            || "it is present and has not confirmed".to_owned(),
            |why| format!("it is lost: {why}"),
        );
        let Some(frame) = &peer.heard else {
            return (None, format!("{why}; its outputs are not known: stop it by hand"));
        };
        if frame.state == StopState::Stopped && self.stops.presses_are_in(&frame.entries) {
            let words = "it has the press, and an output is not safe: see its log, and stop it by hand";
            return (None, format!("{why}; {words}"));
        }
        if frame.outputs == 0 {
            return (Some(Duration::ZERO), format!("{why}; no application in its process guards an output"));
        }
        // Its senders are stopped: their commands become too old, and then it is silent.
        let stopped = frame.sources.iter().map(|source| self.cut_after(*source));
        let last = stopped.collect::<Option<Vec<_>>>().and_then(|times| times.into_iter().max());
        if let Some(last) = last {
            let bound = last + Duration::from_micros(frame.watchdog_us);
            return (Some(bound), format!("{why}; its senders are stopped, and its watchdogs make it safe"));
        }
        // One that is present may have lost nothing.
        if let Some(on_lost) = frame.on_lost_us.filter(|_| peer.lost.is_some()) {
            let bound = Duration::from_micros(on_lost);
            return (Some(bound), format!("{why}; it stops by itself when it loses a node"));
        }
        let words = "its commands come from a node that has not confirmed: stop it by hand, or set stop.on_lost on it";
        (None, format!("{why}; {words}"))
    }

    /// Returns when the echoes of this sender's node were cut, after the press; `None`: that is not known.
    fn cut_after(&self, source: NodeAddress) -> Option<Duration> {
        let stopped = self.stopped_at?;
        if source == self.own.node {
            return Some(Duration::ZERO);
        }
        self.peers.get(&source)?.confirmed_at.map(|at| at.since(stopped))
    }

    fn since_stop(&self, at: Option<Time>) -> Option<u64> {
        self.stopped_at.zip(at).map(|(stopped, at)| micros(at.since(stopped)))
    }
}

fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}
