//! Links that break and heal, what is on its way over them, and processes that come and go.

use super::*;
use crate::sync::arrivals::Arrival;

/// Mostly three or four, in an eighth of the seeds more, and in one of a hundred many; or as many as are asked for.
pub(super) fn nodes(chance: &mut Chance) -> usize {
    let own = match chance.below(96) {
        0 => 9 + chance.below(16),
        1..=12 => 5 + chance.below(4),
        _ => 3 + chance.below(2),
    };
    let asked_for = number(NODES_VARIABLE).map(|nodes| usize::try_from(nodes).expect("a small number"));
    asked_for.inspect(|nodes| assert!(*nodes >= 3, "{NODES_VARIABLE}: three and more")).unwrap_or(own)
}

impl World {
    /// A process is linked with all others.
    pub(super) fn join(&mut self, process: usize) {
        for other in (0..self.cores.len()).filter(|other| !self.ended.contains(other)).collect::<Vec<_>>() {
            self.restore(process, other);
        }
    }

    /// A process hears one word of each other one, if there is one.
    pub(super) fn hear_all(&mut self, process: usize) {
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
                && (self.is_up(from, *process) || self.knows_no_better(from, *process))
        };
        let to = (0..self.cores.len()).find(meant).expect("it was sent over a link that is down");
        if is_about_barriers && let Some(fault) = self.fault {
            payload = self.spoil(fault, from, to, &payload);
        } else if !is_about_barriers {
            payload = self.list_said(payload);
        }
        if self.is_up(from, to) {
            self.flying.entry((from, to)).or_default().push_back((is_about_barriers, payload));
        }
    }

    fn is_up(&self, a: usize, b: usize) -> bool {
        self.up.contains(&(a.min(b), a.max(b)))
    }

    fn knows_no_better(&self, node: usize, peer: usize) -> bool {
        self.unheard.iter().any(|(at, other, _)| (*at, *other) == (node, peer))
    }

    fn spoil(&mut self, fault: Fault, from: usize, to: usize, payload: &Bytes) -> Bytes {
        let mut said = Arrivals::parse(payload).unwrap();
        for barrier in &mut said.barriers {
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
                Fault::YoungerBelieved
                | Fault::VisitsForgotten
                | Fault::HandledAgain
                | Fault::DeadlineForgotten
                | Fault::TimedOutEarly
                | Fault::FailNotTold
                | Fault::LossToldUnasked
                | Fault::LossToldEarly
                | Fault::WrongReason
                | Fault::ReasonKept
                | Fault::ArrivedNamed
                | Fault::AbsenceOverstated
                | Fault::ClocksConfused
                | Fault::PhasesLeftOut
                | Fault::PhasesMadeUp => {}
                Fault::DeparturesHidden => {
                    let before = self.ever.get(&from).into_iter().flat_map(|said| &said.barriers);
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
        self.ever.insert(from, said.clone());
        said.encode()
    }

    /// One end hears of it now, the other one later; with `is_lost`, both hear that the other node is lost.
    pub(super) fn cut(&mut self, a: usize, b: usize, is_lost: bool) {
        if !self.up.remove(&(a.min(b), a.max(b))) {
            return;
        }
        self.say(|| format!("the link of {a} and {b} is cut, lost: {is_lost}"));
        self.flying.remove(&(a, b));
        self.flying.remove(&(b, a));
        self.unheard.insert((a, b, self.incarnations[b]));
        self.unheard.insert((b, a, self.incarnations[a]));
        self.hear_of_break(a, b);
        if is_lost {
            self.hear_of_break(b, a);
            for (node, peer) in [(a, b), (b, a)] {
                let (incarnation, why) = (Incarnation(self.incarnations[peer]), LossReason::LinkDown);
                let lost = MembershipFact::NodeLost { node: address(self.homes[peer]), incarnation, why };
                self.tell(node, Input::MembershipChanged(lost));
            }
        }
    }

    fn hear_of_break(&mut self, node: usize, peer: usize) {
        let of = |(at, other, _): &&(usize, usize, u64)| (*at, *other) == (node, peer);
        while let Some(unheard) = self.unheard.iter().find(of).copied() {
            self.unheard.remove(&unheard);
            let (node_address, incarnation) = (address(self.homes[peer]), Incarnation(unheard.2));
            let broken = LinkFact::LinkBroken { node: node_address, incarnation };
            self.tell(node, Input::LinkChanged(broken));
        }
    }

    pub(super) fn hear_of_breaks(&mut self) {
        for (node, peer, _) in self.unheard.clone() {
            self.hear_of_break(node, peer);
        }
    }

    /// Unless one of them is linked with another process of the same address, which it takes for the node.
    pub(super) fn restore(&mut self, a: usize, b: usize) {
        let is_taken = |a: usize, b: usize| {
            (0..self.cores.len()).any(|other| self.homes[other] == self.homes[b] && self.is_up(a, other))
        };
        if self.homes[a] == self.homes[b] || is_taken(a, b) || is_taken(b, a) {
            return;
        }
        self.say(|| format!("the link of {a} and {b} is back"));
        for (node, peer) in [(a, b), (b, a)] {
            let same = |other: &usize| self.homes[*other] == self.homes[peer];
            for other in (0..self.cores.len()).filter(same).collect::<Vec<_>>() {
                self.hear_of_break(node, other);
            }
        }
        self.up.insert((a.min(b), a.max(b)));
        for (node, peer) in [(a, b), (b, a)] {
            let incarnation = Incarnation(self.incarnations[peer]);
            let up = LinkFact::LinkUp { node: address(self.homes[peer]), incarnation };
            self.tell(node, Input::LinkChanged(up));
        }
    }

    pub(super) fn restart(&mut self, node: usize) {
        // While a node has a double, the next life of it would be the younger one.
        let is_double = self.double.is_some_and(|double| self.homes[double] == self.homes[node]);
        if !self.chance.once_in(3) || is_double {
            return;
        }
        let says_goodbye = self.chance.once_in(2);
        self.say(|| format!("node {node} ends and comes back, says goodbye: {says_goodbye}"));
        let (address, life) = (address(node), Incarnation(self.incarnations[node]));
        let linked: Vec<usize> = self.living().filter(|peer| self.is_up(node, *peer)).collect();
        for peer in linked.iter().filter(|_| says_goodbye) {
            self.tell(
                *peer,
                Input::LinkChanged(LinkFact::PeerLeft { node: address, incarnation: life, gave_up: None }),
            );
        }
        self.cut_all(node);
        let generations = self.generations(node);
        (0..APPS).for_each(|app| self.judge.dies((node, app), &generations));
        self.judge.restarts(node);
        self.ever.remove(&node);
        self.lives[node] += 1;
        self.incarnations[node] = self.lives[node];
        let core = self.new_core(node);
        self.cores[node] = core;
        self.populate(node);
        linked.into_iter().for_each(|peer| self.hear_of_restart(peer, node, life));
    }

    /// A process that was linked hears nothing of it before it is linked again, or that the former life is over, or of the new one, too.
    fn hear_of_restart(&mut self, peer: usize, node: usize, former: Incarnation) {
        let (address, news) = (address(node), self.chance.below(3));
        if news > 0 {
            let why = if news == 1 { LossReason::Crashed } else { LossReason::Restarted };
            let lost = MembershipFact::NodeLost { node: address, incarnation: former, why };
            self.tell(peer, Input::MembershipChanged(lost));
        }
        if news > 1 {
            let incarnation = Incarnation(self.incarnations[node]);
            let found = MembershipFact::NodeFound { node: address, incarnation, gncl: Vec::new() };
            self.tell(peer, Input::MembershipChanged(found));
        }
    }

    fn cut_all(&mut self, node: usize) {
        for peer in (0..self.cores.len()).filter(|peer| *peer != node).collect::<Vec<_>>() {
            self.cut(node, peer, false);
        }
        self.unheard.retain(|(at, ..)| *at != node);
    }

    /// Another process comes up with the address of a node; whoever meets it first takes it for the node.
    pub(super) fn begin_double(&mut self, node: usize) {
        if self.double.is_some() || !self.chance.once_in(2) {
            return;
        }
        let (home, double) = (self.homes[node], self.cores.len());
        self.say(|| format!("process {double} comes up with the address of node {home}"));
        self.lives[home] += 1;
        self.incarnations.push(self.lives[home]);
        self.homes.push(home);
        let core = self.new_core(double);
        self.cores.push(core);
        self.double = Some(double);
        self.judge.doubled(address(home));
        self.populate(double);
    }

    /// The double gives up. Who took it for the node hears that, before or after it has met the node itself.
    pub(super) fn end_double(&mut self) {
        let Some(double) = self.double.take() else { return };
        let home = self.homes[double];
        self.say(|| format!("process {double} gives up"));
        let took = |peer: &usize| self.is_up(*peer, double) || self.knows_no_better(*peer, double);
        let peers: Vec<usize> = (0..self.nodes()).filter(took).collect();
        self.cut_all(double);
        let generations = self.generations(double);
        (0..APPS).for_each(|app| self.judge.dies((double, app), &generations));
        self.ended.insert(double);
        for peer in peers {
            if self.chance.once_in(2) {
                self.restore(peer, home);
            }
            self.hear_of_break(peer, double);
            let (node, why) = (address(home), LossReason::Duplicate);
            let lost =
                MembershipFact::NodeLost { node, incarnation: Incarnation(self.incarnations[double]), why };
            self.tell(peer, Input::MembershipChanged(lost));
            let incarnation = Incarnation(self.incarnations[home]);
            let found = MembershipFact::NodeFound { node, incarnation, gncl: Vec::new() };
            self.tell(peer, Input::MembershipChanged(found));
        }
    }

    pub(super) fn deliver(&mut self, from: usize, to: usize) -> bool {
        let Some((is_about_barriers, payload)) =
            self.flying.get_mut(&(from, to)).and_then(VecDeque::pop_front)
        else {
            return false;
        };
        let (home, life) = (self.homes[from], self.incarnations[from]);
        let from = address(home);
        if is_about_barriers {
            let youngest = self.youngest.entry((to, home)).or_default();
            *youngest = life.max(*youngest);
            if self.fault == Some(Fault::YoungerBelieved) && life < *youngest {
                return true;
            }
            self.tell(to, Input::ArrivalsReceived { from, payload });
        } else {
            self.tell(to, Input::ListReceived { from, payload });
        }
        true
    }
}
