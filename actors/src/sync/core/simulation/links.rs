//! Links that break and heal, what is on its way over them, and nodes that are lost, paused, restarted and leave.

use super::*;
use crate::sync::list::{Entry, List};

const fn sorted((one, other): Ends) -> Ends {
    if one < other { (one, other) } else { (other, one) }
}

/// Which application of this node a list's entry is about, and how far it has come.
fn come_of(node: usize, entry: &Entry) -> (usize, Come) {
    let come = match (entry.ready, entry.phases.is_empty()) {
        (false, _) => Come::Nowhere,
        (true, true) => Come::Running,
        (true, false) => Come::Through,
    };
    (index_of(Tid::new(address(node), entry.app)), come)
}

impl World {
    /// A list goes out.
    pub(super) fn fly(&mut self, from: usize, to: NodeAddress, list: Bytes) {
        let ends = (from, (to.bits() - address(0).bits()) as usize);
        if !self.up.contains(&sorted(ends)) {
            let is_unheard = self.unheard.contains_key(&ends);
            let words = || format!("node {from} sends a list over a link that it knows to be down: {to}");
            return self.violate(is_unheard, words);
        }
        let is_repeat = self.last.insert(ends, list.clone()).is_some_and(|last| last == list);
        if !(is_repeat && self.fault == Some(Fault::RepeatsLost)) {
            self.flying.entry(ends).or_default().push_back(list);
        }
    }

    /// Whether there was a list on its way from the one to the other.
    pub(super) fn deliver(&mut self, ends: Ends) -> bool {
        let (from, to) = ends;
        if self.paused.contains(&to) {
            return false;
        }
        let Some(payload) = self.flying.get_mut(&ends).and_then(VecDeque::pop_front) else { return false };
        self.seen.count("lists", 1);
        if self.fault == Some(Fault::OneVersionForAll) {
            let version = List::parse(&payload).unwrap().version;
            let newest = self.newest.entry(to).or_default();
            if version < *newest {
                return true;
            }
            *newest = version;
        }
        self.tell(to, Input::ListReceived { from: address(from), payload });
        true
    }

    /// Whether anything was on its way.
    pub(super) fn hear_all(&mut self) -> bool {
        let mut is_heard = false;
        loop {
            let flying = self.flying.iter().filter(|(_, lists)| !lists.is_empty()).map(|(ends, _)| *ends);
            let flying: Vec<Ends> = flying.collect();
            if flying.is_empty() {
                return is_heard;
            }
            is_heard = true;
            for ends in flying {
                while self.deliver(ends) {}
            }
        }
    }

    /// The first end hears of it at once, the other one then or later.
    pub(super) fn cut(&mut self, ends: Ends, loss: Loss) {
        let (one, other) = ends;
        if self.up.remove(&sorted(ends)) {
            self.seen.count("links cut", 1);
            for (node, peer) in [(one, other), (other, one)] {
                self.flying.remove(&(node, peer));
                self.last.remove(&(node, peer));
                self.unheard.insert((node, peer), self.incarnations[peer]);
            }
            self.hear_of_break(ends);
            if loss == Loss::Both || self.chance.bool() {
                self.hear_of_break((other, one));
            } else {
                self.seen.count("breaks heard late", 1);
            }
        }
        match loss {
            Loss::Nobody => {}
            Loss::OneWay => self.lose(ends),
            Loss::Both => {
                self.lose(ends);
                self.lose((other, one));
            }
        }
        self.seen.count("losses one way", u64::from(loss == Loss::OneWay));
    }

    /// To the first, the second is lost, in the life that it was found or linked in last, if it was.
    fn lose(&mut self, (node, peer): Ends) {
        if self.paused.contains(&node) {
            return;
        }
        self.seen.count("losses", 1);
        let ends = (node, peer);
        let known = self.present.get(&ends).copied().flatten().or_else(|| self.met.get(&ends).copied());
        let life = known.unwrap_or(self.incarnations[peer]);
        let incarnation = Incarnation(life);
        let why = if self.paused.contains(&peer) { LossReason::Hung } else { LossReason::LinkDown };
        let lost = MembershipFact::NodeLost { node: address(peer), incarnation, why };
        self.tell(node, Input::MembershipChanged(lost));
    }

    fn hear_of_break(&mut self, ends: Ends) {
        let (node, peer) = ends;
        if self.paused.contains(&node) {
            return;
        }
        if let Some(life) = self.unheard.remove(&ends) {
            let (peer, incarnation) = (address(peer), Incarnation(life));
            self.tell(node, Input::LinkChanged(LinkFact::LinkBroken { node: peer, incarnation }));
        }
    }

    pub(super) fn hear_of_breaks(&mut self, node: usize) {
        for peer in 0..self.nodes {
            self.hear_of_break((node, peer));
        }
    }

    /// Both ends hear of the new link after all that became of the one before.
    pub(super) fn restore(&mut self, ends: Ends) {
        let (one, other) = ends;
        let is_possible = one != other && !self.paused.contains(&one) && !self.paused.contains(&other);
        if !is_possible || !self.up.insert(sorted(ends)) {
            return;
        }
        for (node, peer) in [(one, other), (other, one)] {
            self.hear_of_break((node, peer));
            let (life, address) = (self.incarnations[peer], address(peer));
            let former = self.met.insert((node, peer), life);
            if former != Some(life) {
                // The versions of a life begin anew.
                self.newest.remove(&node);
            }
            // Only after the later life's loss is an earlier one taken.
            if let Some(former) = former.filter(|former| *former > life) {
                let (incarnation, why) = (Incarnation(former), LossReason::Crashed);
                let lost = MembershipFact::NodeLost { node: address, incarnation, why };
                self.tell(node, Input::MembershipChanged(lost));
            }
        }
        for (node, peer) in [(one, other), (other, one)] {
            let (node_address, incarnation) = (address(peer), Incarnation(self.incarnations[peer]));
            let found = MembershipFact::NodeFound { node: node_address, incarnation, gncl: Vec::new() };
            // GNCL may know it before NDL says so, and NDL say so again.
            let [is_before, is_after] = [self.chance.bool(), self.chance.bool()];
            if is_before {
                self.tell(node, Input::MembershipChanged(found.clone()));
            }
            self.tell(node, Input::LinkChanged(LinkFact::LinkUp { node: node_address, incarnation }));
            if let Some(payload) = self.former_list((node, peer)) {
                self.deceive(node, Input::ListReceived { from: node_address, payload });
            }
            if is_after {
                self.tell(node, Input::MembershipChanged(found));
            }
        }
    }

    /// What the second said to the first on a link before, if a fault has it told again.
    fn former_list(&self, ends: Ends) -> Option<Bytes> {
        let former = self.former.get(&ends).filter(|_| self.fault == Some(Fault::FormerListTold))?;
        let life = List::parse(former).expect("a core has sent it").incarnation;
        (life.0 == self.incarnations[ends.1]).then(|| former.clone())
    }

    /// NDL says that a node is there, and before it that the life which it knew is over; GNCL has not dialled it yet.
    pub(super) fn find(&mut self, ends: Ends) {
        let (node, peer) = ends;
        if self.paused.contains(&node) || self.paused.contains(&peer) || self.up.contains(&sorted(ends)) {
            return;
        }
        self.seen.count("found without a link", 1);
        let (address, life) = (address(peer), self.incarnations[peer]);
        let former = self.present.get(&ends).copied().flatten().filter(|former| *former != life);
        if let Some(former) = former {
            let (incarnation, why) = (Incarnation(former), LossReason::Restarted);
            let lost = MembershipFact::NodeLost { node: address, incarnation, why };
            self.tell(node, Input::MembershipChanged(lost));
        }
        let found =
            MembershipFact::NodeFound { node: address, incarnation: Incarnation(life), gncl: Vec::new() };
        self.tell(node, Input::MembershipChanged(found));
    }

    /// Whom a node is told of, if it is told of one.
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
                self.heard.remove(&ends);
                Some(ends.1)
            }
            Input::ListReceived { from, payload } => {
                let ends = (node, number(from));
                if self.linked.contains_key(&ends) {
                    let list = List::parse(payload).expect("a core has sent it");
                    self.heard
                        .insert(ends, list.entries.iter().map(|entry| come_of(ends.1, entry)).collect());
                    self.former.insert(ends, payload.clone());
                }
                Some(ends.1)
            }
            Input::MembershipChanged(MembershipFact::NodeLost { node: peer, incarnation, .. })
            | Input::LinkChanged(LinkFact::PeerLeft { node: peer, incarnation, .. }) => {
                let ends = (node, number(peer));
                let present = self.present.entry(ends).or_default();
                present.take_if(|life| *life == incarnation.0);
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
            | Input::AnswerNotTaken { .. }
            | Input::ArrivalsReceived { .. }
            | Input::ArrivalsNotTaken { .. }
            | Input::ListNotTaken { .. }
            | Input::DirectoryWanted { .. }
            | Input::DirectoryNotTaken { .. }
            | Input::ReleaseNotTaken { .. }
            | Input::EventNotTaken { .. }
            | Input::TimePassed => None,
        }
    }

    fn unlink(&mut self, ends: Ends, life: Incarnation) {
        if self.linked.get(&ends) == Some(&life.0) {
            self.linked.remove(&ends);
            self.heard.remove(&ends);
        }
    }

    /// No directory names applications of a life that its node was told is over, or that another one came after, and none of them as
    /// ready while that node has no link to theirs.
    pub(super) fn judge_presence(&mut self, ends: Ends) {
        let (node, peer) = ends;
        let (core, address) = (&self.cores[node], address(peer));
        let directory = core.directory();
        let of_peer = || directory.iter().filter(|entry| entry.tid.node == address);
        let (is_named, ready) = (of_peer().next().is_some(), of_peer().filter(|entry| entry.ready).count());
        let listed = core.names_elsewhere(Some(address)).next().map(|said| said.life.0);
        let present = self.present.get(&ends).copied().flatten();
        self.violate(!is_named || listed == present, || {
            format!(
                "the directory of node {node} names life {listed:?} of node {peer}, which is in {present:?}"
            )
        });
        let is_linked = self.linked.contains_key(&ends);
        self.violate(ready == 0 || is_linked, || {
            format!("the directory of node {node} has {ready} of node {peer} ready, to which it has no link")
        });
    }

    pub(super) fn part(&mut self, side: u64, loss: Loss) {
        self.seen.count("parts", 1);
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
        self.seen.count("pauses", u64::from(self.paused.insert(node)));
    }

    /// The others hear of it at once, or later.
    pub(super) fn restart(&mut self, node: usize, clock: Clock) {
        self.seen.count("restarts", 1);
        self.seen.count("clocks anew", u64::from(clock == Clock::BeginsAnew));
        for peer in (0..self.nodes).filter(|peer| *peer != node) {
            self.cut((node, peer), Loss::Nobody);
        }
        self.begin_anew(node, clock);
    }

    /// Those that are linked hear that it leaves.
    pub(super) fn leave(&mut self, node: usize) {
        self.seen.count("goodbyes", 1);
        let incarnation = Incarnation(self.incarnations[node]);
        for peer in (0..self.nodes).filter(|peer| *peer != node) {
            let is_told = self.up.contains(&sorted((node, peer))) && !self.paused.contains(&peer);
            if is_told {
                let left = LinkFact::PeerLeft { node: address(node), incarnation, gave_up: None };
                self.tell(peer, Input::LinkChanged(left));
            }
            self.cut((node, peer), Loss::Nobody);
        }
        self.begin_anew(node, Clock::GoesOn);
    }

    fn begin_anew(&mut self, node: usize, clock: Clock) {
        self.paused.remove(&node);
        self.unheard.retain(|(at, _), _| *at != node);
        self.met.retain(|(at, _), _| *at != node);
        self.present.retain(|(at, _), _| *at != node);
        self.linked.retain(|(at, _), _| *at != node);
        self.heard.retain(|(at, _), _| *at != node);
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
