//! Links that break and heal, frames in flight over them, and processes that come and go.

use super::*;
use sinew_sync::arrivals::Arrival;

/// Returns the set number of nodes, if any. Otherwise mostly three or four, in an eighth of the seeds more,
/// and in one of a hundred many.
pub(super) fn nodes(chance: &mut Chance) -> usize {
    let own = match chance.index(96) {
        0 => 9 + chance.index(16),
        1..=12 => 5 + chance.index(4),
        _ => 3 + chance.index(2),
    };
    let asked_for = number(NODES_VARIABLE).map(|nodes| usize::try_from(nodes).expect("a small number"));
    asked_for.inspect(|nodes| assert!(*nodes >= 3, "{NODES_VARIABLE}: three and more")).unwrap_or(own)
}

impl World {
    /// Links a process with all others.
    pub(super) fn join(&mut self, process: usize) {
        for other in (0..self.cores.len()).filter(|other| !self.ended.contains(other)).collect::<Vec<_>>() {
            self.restore(process, other);
        }
    }

    /// Delivers one frame of each other process to a process, if there is one.
    pub(super) fn deliver_all(&mut self, process: usize) {
        for other in 0..self.cores.len() {
            self.deliver(other, process);
        }
    }

    pub(super) fn fly(
        &mut self,
        from: usize,
        to: NodeAddress,
        (is_about_barriers, mut payload): (bool, Bytes),
    ) {
        let meant = |process: &usize| {
            address(self.homes[*process]) == to
                && (self.is_up(from, *process) || self.is_unaware(from, *process))
        };
        let to = (0..self.cores.len()).find(meant).expect("it was sent over a link that is down");
        if is_about_barriers && let Some(fault) = self.fault {
            payload = self.spoil(fault, from, to, &payload);
        } else if !is_about_barriers {
            payload = self.sent_list(payload);
        }
        if self.is_up(from, to) {
            self.flying.entry((from, to)).or_default().send(self.now, (is_about_barriers, payload));
        }
    }

    fn is_up(&self, a: usize, b: usize) -> bool {
        self.up.contains(&(a.min(b), a.max(b)))
    }

    fn is_unaware(&self, node: usize, peer: usize) -> bool {
        self.unreported.iter().any(|(at, other, _)| (*at, *other) == (node, peer))
    }

    fn spoil(&mut self, fault: Fault, from: usize, to: usize, payload: &Bytes) -> Bytes {
        let mut frame = Arrivals::parse(payload).unwrap();
        for barrier in &mut frame.barriers {
            let number = BARRIERS.iter().position(|(name, _)| *name == &*barrier.name);
            match fault {
                Fault::GenerationsConfused => {
                    let newest = number.map_or(0, |number| self.generation(to, number));
                    barrier.generation = barrier.generation.max(newest);
                    for arrival in &mut barrier.arrivals {
                        arrival.after = barrier.generation;
                    }
                }
                Fault::MembersLeftOut => barrier.members.clear(),
                Fault::EarlierLeftOut => barrier.earlier.clear(),
                Fault::YoungerAccepted
                | Fault::VisitsForgotten
                | Fault::HandledAgain
                | Fault::DeadlineForgotten
                | Fault::TimedOutEarly
                | Fault::LossNotReported
                | Fault::LossReportedUnasked
                | Fault::LossReportedEarly
                | Fault::WrongReason
                | Fault::ReasonKept
                | Fault::ArrivedNamed
                | Fault::AbsenceOverstated
                | Fault::ClocksConfused
                | Fault::PhasesLeftOut
                | Fault::PhasesMadeUp => {}
                Fault::DeparturesHidden => {
                    let before = self.ever.get(&from).into_iter().flat_map(|frame| &frame.barriers);
                    let before =
                        before.filter(|other| other.name == barrier.name).flat_map(|other| &other.arrivals);
                    for arrival in before {
                        if !barrier.arrivals.iter().any(|other| other.party == arrival.party) {
                            barrier.arrivals.push(Arrival { after: barrier.generation, ..arrival.clone() });
                        }
                    }
                }
            }
        }
        self.ever.insert(from, frame.clone());
        frame.encode()
    }

    /// Cuts a link. One end is notified now, the other one later; with `is_lost`, both are notified that the
    /// other node is lost.
    pub(super) fn cut(&mut self, a: usize, b: usize, is_lost: bool) {
        if !self.up.remove(&(a.min(b), a.max(b))) {
            return;
        }
        self.note(|| format!("the link of {a} and {b} is cut, lost: {is_lost}"));
        self.flying.remove(&(a, b));
        self.flying.remove(&(b, a));
        self.unreported.insert((a, b, self.incarnations[b]));
        self.unreported.insert((b, a, self.incarnations[a]));
        self.report_break(a, b);
        if is_lost {
            self.report_break(b, a);
            for (node, peer) in [(a, b), (b, a)] {
                let (incarnation, why) = (Incarnation(self.incarnations[peer]), LossReason::LinkDown);
                let lost = MembershipFact::NodeLost { node: address(self.homes[peer]), incarnation, why };
                self.feed(node, Input::MembershipChanged(lost));
            }
        }
    }

    fn report_break(&mut self, node: usize, peer: usize) {
        let of = |(at, other, _): &&(usize, usize, u64)| (*at, *other) == (node, peer);
        while let Some(unreported) = self.unreported.iter().find(of).copied() {
            self.unreported.remove(&unreported);
            let (node_address, incarnation) = (address(self.homes[peer]), Incarnation(unreported.2));
            let broken = LinkFact::LinkBroken { node: node_address, incarnation };
            self.feed(node, Input::LinkChanged(broken));
        }
    }

    pub(super) fn report_breaks(&mut self) {
        for (node, peer, _) in self.unreported.clone() {
            self.report_break(node, peer);
        }
    }

    /// Restores a link, unless one end is linked with another process of the same address, which it takes for
    /// the node.
    pub(super) fn restore(&mut self, a: usize, b: usize) {
        let is_taken = |a: usize, b: usize| {
            (0..self.cores.len()).any(|other| self.homes[other] == self.homes[b] && self.is_up(a, other))
        };
        if self.homes[a] == self.homes[b] || is_taken(a, b) || is_taken(b, a) {
            return;
        }
        self.note(|| format!("the link of {a} and {b} is back"));
        for (node, peer) in [(a, b), (b, a)] {
            let same = |other: &usize| self.homes[*other] == self.homes[peer];
            for other in (0..self.cores.len()).filter(same).collect::<Vec<_>>() {
                self.report_break(node, other);
            }
        }
        self.up.insert((a.min(b), a.max(b)));
        for (node, peer) in [(a, b), (b, a)] {
            let incarnation = Incarnation(self.incarnations[peer]);
            let up = LinkFact::LinkUp { node: address(self.homes[peer]), incarnation };
            self.feed(node, Input::LinkChanged(up));
        }
    }

    pub(super) fn restart(&mut self, node: usize) {
        // While a node has a duplicate, its next incarnation would be the younger one.
        let is_duplicate = self.duplicate.is_some_and(|duplicate| self.homes[duplicate] == self.homes[node]);
        if !self.chance.once_in(3) || is_duplicate {
            return;
        }
        let says_goodbye = self.chance.once_in(2);
        self.note(|| format!("node {node} ends and comes back, says goodbye: {says_goodbye}"));
        let (address, incarnation) = (address(node), Incarnation(self.incarnations[node]));
        let linked: Vec<usize> = self.living().filter(|peer| self.is_up(node, *peer)).collect();
        for peer in linked.iter().filter(|_| says_goodbye) {
            self.feed(
                *peer,
                Input::LinkChanged(LinkFact::PeerLeft { node: address, incarnation, gave_up: None }),
            );
        }
        self.cut_all(node);
        let generations = self.generations(node);
        (0..APPS).for_each(|app| self.judge.dies((node, app), &generations));
        self.judge.restarts(node);
        self.ever.remove(&node);
        self.incarnation_counts[node] += 1;
        self.incarnations[node] = self.incarnation_counts[node];
        let core = self.new_core(node);
        self.cores[node] = core;
        self.populate(node);
        linked.into_iter().for_each(|peer| self.report_restart(peer, node, incarnation));
    }

    /// Notifies a formerly linked process of the restart in one of three ways: not before the next link; that
    /// the old incarnation is over; or of the new incarnation, too.
    fn report_restart(&mut self, peer: usize, node: usize, former: Incarnation) {
        let (address, reports) = (address(node), self.chance.index(3));
        if reports > 0 {
            let why = if reports == 1 { LossReason::Crashed } else { LossReason::Restarted };
            let lost = MembershipFact::NodeLost { node: address, incarnation: former, why };
            self.feed(peer, Input::MembershipChanged(lost));
        }
        if reports > 1 {
            let incarnation = Incarnation(self.incarnations[node]);
            let found = MembershipFact::NodeFound { node: address, incarnation, gncl: Vec::new() };
            self.feed(peer, Input::MembershipChanged(found));
        }
    }

    fn cut_all(&mut self, node: usize) {
        for peer in (0..self.cores.len()).filter(|peer| *peer != node).collect::<Vec<_>>() {
            self.cut(node, peer, false);
        }
        self.unreported.retain(|(at, ..)| *at != node);
    }

    /// Starts another process with the address of a node. A peer takes the first of the two that it meets for
    /// the node.
    pub(super) fn start_duplicate(&mut self, node: usize) {
        if self.duplicate.is_some() || !self.chance.once_in(2) {
            return;
        }
        let (home, duplicate) = (self.homes[node], self.cores.len());
        self.note(|| format!("process {duplicate} comes up with the address of node {home}"));
        self.incarnation_counts[home] += 1;
        self.incarnations.push(self.incarnation_counts[home]);
        self.homes.push(home);
        let core = self.new_core(duplicate);
        self.cores.push(core);
        self.duplicate = Some(duplicate);
        self.judge.add_duplicate(address(home));
        self.populate(duplicate);
    }

    /// Ends the duplicate. Peers that took it for the node are notified, before or after they have met the
    /// node itself.
    pub(super) fn end_duplicate(&mut self) {
        let Some(duplicate) = self.duplicate.take() else { return };
        let home = self.homes[duplicate];
        self.note(|| format!("process {duplicate} gives up"));
        let took = |peer: &usize| self.is_up(*peer, duplicate) || self.is_unaware(*peer, duplicate);
        let peers: Vec<usize> = (0..self.nodes()).filter(took).collect();
        self.cut_all(duplicate);
        let generations = self.generations(duplicate);
        (0..APPS).for_each(|app| self.judge.dies((duplicate, app), &generations));
        self.ended.insert(duplicate);
        for peer in peers {
            if self.chance.once_in(2) {
                self.restore(peer, home);
            }
            self.report_break(peer, duplicate);
            let (node, why) = (address(home), LossReason::Duplicate);
            let lost = MembershipFact::NodeLost {
                node,
                incarnation: Incarnation(self.incarnations[duplicate]),
                why,
            };
            self.feed(peer, Input::MembershipChanged(lost));
            let incarnation = Incarnation(self.incarnations[home]);
            let found = MembershipFact::NodeFound { node, incarnation, gncl: Vec::new() };
            self.feed(peer, Input::MembershipChanged(found));
        }
    }

    pub(super) fn deliver(&mut self, from: usize, to: usize) -> bool {
        let Some((is_about_barriers, payload)) =
            self.flying.get_mut(&(from, to)).and_then(|pipe| pipe.receive(self.now))
        else {
            return false;
        };
        let (home, incarnation) = (self.homes[from], self.incarnations[from]);
        let from = address(home);
        if is_about_barriers {
            let youngest = self.youngest.entry((to, home)).or_default();
            *youngest = incarnation.max(*youngest);
            if self.fault == Some(Fault::YoungerAccepted) && incarnation < *youngest {
                return true;
            }
            self.feed(to, Input::ArrivalsReceived { from, payload });
        } else {
            self.feed(to, Input::ListReceived { from, payload });
        }
        true
    }
}
