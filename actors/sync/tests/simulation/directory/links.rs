//! Links that break and heal, lists in flight over them, and nodes that are lost, paused, restarted and
//! leave.

use super::*;
use sinew_sync::list::{Entry, List};

const fn sorted((one, other): Ends) -> Ends {
    if one < other { (one, other) } else { (other, one) }
}

/// Returns the index of the application in a list's entry of this node, and its state.
fn state_of(node: usize, entry: &Entry) -> (usize, AppState) {
    let state = match (entry.ready, entry.phases.is_empty()) {
        (false, _) => AppState::NotRunning,
        (true, true) => AppState::Running,
        (true, false) => AppState::PhaseReached,
    };
    (index_of(Tid::new(address(node), entry.app)), state)
}

impl World {
    /// Sends a list.
    pub(super) fn fly(&mut self, from: usize, to: NodeAddress, list: Bytes) {
        let ends = (from, (to.bits() - address(0).bits()) as usize);
        if !self.up.contains(&sorted(ends)) {
            let is_unreported = self.unreported.contains_key(&ends);
            let words = || format!("node {from} sends a list over a link that it knows to be down: {to}");
            return self.violate(is_unreported, words);
        }
        let is_repeat = self.last.insert(ends, list.clone()).is_some_and(|last| last == list);
        if !(is_repeat && self.fault == Some(Fault::RepeatsLost)) {
            self.flying.entry(ends).or_default().send(self.now, list);
        }
    }

    /// Delivers a list from the first end to the second. Returns whether one was in flight.
    pub(super) fn deliver(&mut self, ends: Ends) -> bool {
        let (from, to) = ends;
        if self.paused.contains(&to) {
            return false;
        }
        let in_flight = self.flying.get_mut(&ends).and_then(|pipe| pipe.receive(self.now));
        let Some(payload) = in_flight else { return false };
        self.seen.add("lists", 1);
        if self.fault == Some(Fault::OneVersionForAll) {
            let version = List::parse(&payload).unwrap().version;
            let newest = self.newest.entry(to).or_default();
            if version < *newest {
                return true;
            }
            *newest = version;
        }
        self.feed(to, Input::ListReceived { from: address(from), payload });
        true
    }

    /// Delivers everything. Returns whether anything was in flight.
    pub(super) fn deliver_all(&mut self) -> bool {
        let mut is_delivered = false;
        loop {
            let flying = self.flying.iter().filter(|(_, lists)| !lists.is_empty()).map(|(ends, _)| *ends);
            let flying: Vec<Ends> = flying.collect();
            if flying.is_empty() {
                return is_delivered;
            }
            is_delivered = true;
            for ends in flying {
                while self.deliver(ends) {}
            }
        }
    }

    /// Cuts a link. The first end is notified at once, the other one then or later.
    pub(super) fn cut(&mut self, ends: Ends, loss: Loss) {
        let (one, other) = ends;
        if self.up.remove(&sorted(ends)) {
            self.seen.add("links cut", 1);
            for (node, peer) in [(one, other), (other, one)] {
                self.flying.remove(&(node, peer));
                self.last.remove(&(node, peer));
                self.unreported.insert((node, peer), self.incarnations[peer]);
            }
            self.report_break(ends);
            if loss == Loss::Both || self.chance.bool() {
                self.report_break((other, one));
            } else {
                self.seen.add("breaks reported late", 1);
            }
        }
        match loss {
            Loss::None => {}
            Loss::OneWay => self.lose(ends),
            Loss::Both => {
                self.lose(ends);
                self.lose((other, one));
            }
        }
        self.seen.add("losses one way", u64::from(loss == Loss::OneWay));
    }

    /// Notifies the first end that the second is lost, in the incarnation that was found or linked last, if
    /// any.
    fn lose(&mut self, (node, peer): Ends) {
        if self.paused.contains(&node) {
            return;
        }
        self.seen.add("losses", 1);
        let ends = (node, peer);
        let known = self.present.get(&ends).copied().flatten().or_else(|| self.met.get(&ends).copied());
        let raw = known.unwrap_or(self.incarnations[peer]);
        let incarnation = Incarnation(raw);
        let why = if self.paused.contains(&peer) { LossReason::Hung } else { LossReason::LinkDown };
        let lost = MembershipFact::NodeLost { node: address(peer), incarnation, why };
        self.feed(node, Input::MembershipChanged(lost));
    }

    fn report_break(&mut self, ends: Ends) {
        let (node, peer) = ends;
        if self.paused.contains(&node) {
            return;
        }
        if let Some(raw) = self.unreported.remove(&ends) {
            let (peer, incarnation) = (address(peer), Incarnation(raw));
            self.feed(node, Input::LinkChanged(LinkFact::LinkBroken { node: peer, incarnation }));
        }
    }

    pub(super) fn report_breaks(&mut self, node: usize) {
        for peer in 0..self.nodes {
            self.report_break((node, peer));
        }
    }

    /// Restores a link. Both ends are notified of it after all events of the previous one.
    pub(super) fn restore(&mut self, ends: Ends) {
        let (one, other) = ends;
        let is_possible = one != other && !self.paused.contains(&one) && !self.paused.contains(&other);
        if !is_possible || !self.up.insert(sorted(ends)) {
            return;
        }
        for (node, peer) in [(one, other), (other, one)] {
            self.report_break((node, peer));
            let (raw, address) = (self.incarnations[peer], address(peer));
            let former = self.met.insert((node, peer), raw);
            if former != Some(raw) {
                // The versions of an incarnation start anew.
                self.newest.remove(&node);
            }
            // An earlier incarnation is accepted only after the loss of the later one.
            if let Some(former) = former.filter(|former| *former > raw) {
                let (incarnation, why) = (Incarnation(former), LossReason::Crashed);
                let lost = MembershipFact::NodeLost { node: address, incarnation, why };
                self.feed(node, Input::MembershipChanged(lost));
            }
        }
        for (node, peer) in [(one, other), (other, one)] {
            let (node_address, incarnation) = (address(peer), Incarnation(self.incarnations[peer]));
            let found = MembershipFact::NodeFound { node: node_address, incarnation, gncl: Vec::new() };
            // GNCL may know it before NDL reports it, and NDL may report it again.
            let [is_before, is_after] = [self.chance.bool(), self.chance.bool()];
            if is_before {
                self.feed(node, Input::MembershipChanged(found.clone()));
            }
            self.feed(node, Input::LinkChanged(LinkFact::LinkUp { node: node_address, incarnation }));
            if let Some(payload) = self.former_list((node, peer)) {
                self.feed_false(node, Input::ListReceived { from: node_address, payload });
            }
            if is_after {
                self.feed(node, Input::MembershipChanged(found));
            }
        }
    }

    /// Returns the last list of the second end on an earlier link, if a fault delivers it again.
    fn former_list(&self, ends: Ends) -> Option<Bytes> {
        let former = self.former.get(&ends).filter(|_| self.fault == Some(Fault::FormerListDelivered))?;
        let incarnation = List::parse(former).expect("a core has sent it").incarnation;
        (incarnation.0 == self.incarnations[ends.1]).then(|| former.clone())
    }

    /// Notifies a node by NDL that another is present, and before that of the end of the incarnation that it
    /// knew. GNCL has not dialled it yet.
    pub(super) fn find(&mut self, ends: Ends) {
        let (node, peer) = ends;
        if self.paused.contains(&node) || self.paused.contains(&peer) || self.up.contains(&sorted(ends)) {
            return;
        }
        self.seen.add("found without a link", 1);
        let (address, raw) = (address(peer), self.incarnations[peer]);
        let former = self.present.get(&ends).copied().flatten().filter(|former| *former != raw);
        if let Some(former) = former {
            let (incarnation, why) = (Incarnation(former), LossReason::Restarted);
            let lost = MembershipFact::NodeLost { node: address, incarnation, why };
            self.feed(node, Input::MembershipChanged(lost));
        }
        let found =
            MembershipFact::NodeFound { node: address, incarnation: Incarnation(raw), gncl: Vec::new() };
        self.feed(node, Input::MembershipChanged(found));
    }

    /// Records an input about another node. Returns that node, if there is one.
    pub(super) fn note_presence(&mut self, node: usize, input: &Input) -> Option<usize> {
        let number = |address: &NodeAddress| (address.bits() - self::address(0).bits()) as usize;
        match input {
            Input::MembershipChanged(MembershipFact::NodeFound { node: peer, incarnation, .. }) => {
                let ends = (node, number(peer));
                self.present.insert(ends, Some(incarnation.0));
                Some(ends.1)
            }
            Input::LinkChanged(LinkFact::LinkUp { node: peer, incarnation }) => {
                let ends = (node, number(peer));
                self.present.insert(ends, Some(incarnation.0));
                self.linked.insert(ends, incarnation.0);
                self.received.remove(&ends);
                Some(ends.1)
            }
            Input::ListReceived { from, payload } => {
                let ends = (node, number(from));
                if self.linked.contains_key(&ends) {
                    let list = List::parse(payload).expect("a core has sent it");
                    self.received
                        .insert(ends, list.entries.iter().map(|entry| state_of(ends.1, entry)).collect());
                    self.former.insert(ends, payload.clone());
                }
                Some(ends.1)
            }
            Input::MembershipChanged(MembershipFact::NodeLost { node: peer, incarnation, .. })
            | Input::LinkChanged(LinkFact::PeerLeft { node: peer, incarnation, .. }) => {
                let ends = (node, number(peer));
                let present = self.present.entry(ends).or_default();
                present.take_if(|raw| *raw == incarnation.0);
                self.unlink(ends, *incarnation);
                Some(ends.1)
            }
            Input::LinkChanged(LinkFact::LinkBroken { node: peer, incarnation }) => {
                let ends = (node, number(peer));
                self.unlink(ends, *incarnation);
                Some(ends.1)
            }
            Input::LinkChanged(LinkFact::DialRefused { node: peer, .. }) => Some(number(peer)),
            Input::AppChanged(_)
            | Input::GroupsChanged(_)
            | Input::Arrived { .. }
            | Input::Left { .. }
            | Input::AnswerRejected { .. }
            | Input::ArrivalsReceived { .. }
            | Input::ArrivalsRejected { .. }
            | Input::ListRejected { .. }
            | Input::DirectoryWanted { .. }
            | Input::DirectoryRejected { .. }
            | Input::ReleaseRejected { .. }
            | Input::EventRejected { .. }
            | Input::RoomMade
            | Input::TimePassed => None,
        }
    }

    fn unlink(&mut self, ends: Ends, incarnation: Incarnation) {
        if self.linked.get(&ends) == Some(&incarnation.0) {
            self.linked.remove(&ends);
            self.received.remove(&ends);
        }
    }

    /// Checks a directory against the node's inputs. It lists no applications of an incarnation that is over
    /// or superseded, and none as ready without a link to their node.
    pub(super) fn judge_presence(&mut self, ends: Ends) {
        let (node, peer) = ends;
        let (core, address) = (&self.cores[node], address(peer));
        let directory = core.directory();
        let of_peer = || directory.iter().filter(|entry| entry.tid.node == address);
        let (is_named, ready) = (of_peer().next().is_some(), of_peer().filter(|entry| entry.ready).count());
        let listed = core.names_elsewhere(Some(address)).next().map(|names| names.incarnation.0);
        let present = self.present.get(&ends).copied().flatten();
        self.violate(!is_named || listed == present, || {
            format!(
                "the directory of node {node} names incarnation {listed:?} of node {peer}, which is in {present:?}"
            )
        });
        let is_linked = self.linked.contains_key(&ends);
        self.violate(ready == 0 || is_linked, || {
            format!("the directory of node {node} has {ready} of node {peer} ready, to which it has no link")
        });
    }

    pub(super) fn part(&mut self, side: u64, loss: Loss) {
        self.seen.add("parts", 1);
        let is_there = |node: usize| side >> (node % 64) & 1 == 1;
        for one in (0..self.nodes).filter(|node| is_there(*node)) {
            for other in (0..self.nodes).filter(|node| !is_there(*node)) {
                if self.up.contains(&sorted((one, other))) {
                    self.cut((one, other), loss);
                }
            }
        }
    }

    pub(super) fn join(&mut self, node: usize) {
        for peer in 0..self.nodes {
            self.restore((node, peer));
        }
    }

    pub(super) fn pause(&mut self, node: usize) {
        self.seen.add("pauses", u64::from(self.paused.insert(node)));
    }

    /// Restarts a node. The others are notified at once, or later.
    pub(super) fn restart(&mut self, node: usize, clock: Clock) {
        self.seen.add("restarts", 1);
        self.seen.add("clocks anew", u64::from(clock == Clock::BeginsAnew));
        for peer in (0..self.nodes).filter(|peer| *peer != node) {
            self.cut((node, peer), Loss::None);
        }
        self.begin_anew(node, clock);
    }

    /// Lets a node leave. The linked ones are notified.
    pub(super) fn leave(&mut self, node: usize) {
        self.seen.add("goodbyes", 1);
        let incarnation = Incarnation(self.incarnations[node]);
        for peer in (0..self.nodes).filter(|peer| *peer != node) {
            let is_notified = self.up.contains(&sorted((node, peer))) && !self.paused.contains(&peer);
            if is_notified {
                let left = LinkFact::PeerLeft { node: address(node), incarnation, gave_up: None };
                self.feed(peer, Input::LinkChanged(left));
            }
            self.cut((node, peer), Loss::None);
        }
        self.begin_anew(node, Clock::GoesOn);
    }

    fn begin_anew(&mut self, node: usize, clock: Clock) {
        self.paused.remove(&node);
        self.unreported.retain(|(at, _), _| *at != node);
        self.met.retain(|(at, _), _| *at != node);
        self.present.retain(|(at, _), _| *at != node);
        self.linked.retain(|(at, _), _| *at != node);
        self.received.retain(|(at, _), _| *at != node);
        self.former.retain(|(at, _), _| *at != node);
        self.newest.remove(&node);
        self.incarnations[node] = match clock {
            Clock::GoesOn => self.incarnations[node] + 1,
            Clock::BeginsAnew => {
                self.earliest[node] -= 100;
                self.earliest[node]
            }
        };
        self.apps[node].clear();
        self.cores[node] = self.new_core(node);
        self.watch(node);
    }
}
