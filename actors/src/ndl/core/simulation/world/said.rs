//! What cores say: datagrams go to the network, facts to the judge.

use super::*;
use crate::ndl::NodeEvent;

impl World {
    pub(super) fn obey(&mut self, from: usize, now: Time, output: Output) {
        let me = || self.processes[from].patient.core.announcement().clone();
        match output {
            Output::SendQuery { to, correlation } => {
                if network_of(to.here) == network_of(to.there) {
                    self.judge.asked(self.now, from, to.there, correlation);
                }
                let datagram = Datagram { correlation, sent: now, body: Body::Query(me()) };
                self.send(from, to, What::Query, &datagram);
            }
            Output::SendMulticastQuery { correlation, .. } => {
                let datagram = Datagram { correlation, sent: now, body: Body::Query(me()) };
                self.send_to_all(from, &datagram);
            }
            Output::SendAnswer { to, correlation, query_sent, query_received, .. } => {
                let (query_sent_ns, query_received_ns) = (query_sent.as_nanos(), query_received.as_nanos());
                let answer = Answer {
                    announcement: me(),
                    query_sent_ns,
                    query_received_ns,
                    progress: self.processes[from].patient.core.progress().clone(),
                };
                let datagram = Datagram { correlation, sent: now, body: Body::Answer(answer) };
                self.send(from, to, What::Answer(correlation), &datagram);
            }
            Output::SendLeave { to, .. } => {
                let datagram = Datagram { correlation: 0, sent: now, body: Body::Leave(me().into()) };
                self.processes[from].goodbyes.insert(to.there);
                self.send(from, to, What::Leave, &datagram);
            }
            Output::Probe { node, incarnation, to, within, asked } => {
                let host = self.said_of(from, node_at(node), &to);
                let takes = if host == Host::IsSilent { within } else { WORD_MAX.min(within / 2) };
                self.ask_for_a_sign(from, node, WORD_MAX.min(within / 2));
                let at = self.now + self.chance.between(Duration::ZERO, takes);
                self.push(at, Event::Tell(from, Box::new(Input::Probed { node, incarnation, host, asked })));
            }
            Output::AskForSign { node, .. } => self.ask_for_a_sign(from, node, WORD_MAX),
            Output::Fact(fact) => self.told(from, fact),
            Output::ClockMeasured { node, offset, .. } => {
                let Some(peer) = self.current_of(node) else { return };
                let truth =
                    self.local(peer).as_nanos().cast_signed() - self.local(from).as_nanos().cast_signed();
                self.judge.measured(self.now, from, (node, offset), truth);
            }
            Output::Stalled { late } => {
                self.trace(|| format!("{from} was late by {late:?}"));
                self.judge.reported_a_stall(from);
            }
            Output::Moved { .. }
            | Output::Forgotten { .. }
            | Output::Collision { .. }
            | Output::AddressTaken { .. } => {
                self.judge.violations.push(format!("{:?}: {from} says {output:?}", self.now));
            }
            Output::Event { event, .. } => self.told_to_application(from, &event),
        }
    }

    /// The process that is this node now.
    pub(super) fn current_of(&self, node: NodeAddress) -> Option<usize> {
        self.current.get(&node_at(node)).copied()
    }

    fn told_to_application(&mut self, process: usize, event: &NodeEvent) {
        self.trace(|| format!("{process} tells its application {event:?}"));
        match *event {
            NodeEvent::NodeLost { node, incarnation, silent_us, bound_us, .. } => {
                let said = [silent_us, bound_us].map(Duration::from_micros);
                self.judge.told_of_a_loss(self.now, process, (node, incarnation), said);
            }
            NodeEvent::AppStalled { trouble: Trouble::Unheard, .. } => self.seen.unheard_told += 1,
            NodeEvent::AppStalled { .. } => self.seen.stalls_told += 1,
            NodeEvent::NodeRestarted { node, incarnation, silent_us, bound_us, .. } => {
                self.seen.restarts_told += 1;
                let said = [silent_us, bound_us].map(Duration::from_micros);
                self.judge.told_of_a_restart(self.now, process, (node, incarnation), said);
            }
            NodeEvent::NodeFound { .. } | NodeEvent::AppResumed { .. } => {}
        }
        let truth = |node: NodeAddress, incarnation: Incarnation| {
            let life = self.judge.life(node, incarnation);
            life.map(|process| self.processes[process].troubles.clone()).unwrap_or_default()
        };
        if let Err(words) = self.listeners.told(process, event, truth) {
            let words = format!("{:?}: to the application of {process}, {event:?}: {words}", self.now);
            self.judge.violations.push(words);
        }
    }

    fn told(&mut self, process: usize, fact: MembershipFact) {
        self.listeners.owes(process, &fact);
        self.trace(|| format!("{process} says {fact:?}"));
        format!("{:?} {process} {fact:?}", self.now).hash(&mut self.digest);
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.seen.found += 1;
                if let Some(other) = self.current_of(node) {
                    let address = self.processes[other].addresses[0];
                    self.processes[process].met.insert(address);
                }
                self.judge.found(self.now, process, node, incarnation);
            }
            MembershipFact::NodeLost { node, incarnation, ref why } => {
                use crate::ndl::LossReason::{Crashed, Duplicate, GaveUp, Hung, Left, LinkDown, Restarted};
                match why {
                    Left | GaveUp(_) => self.seen.left += 1,
                    Crashed => self.seen.crashed += 1,
                    Hung => self.seen.hung += 1,
                    LinkDown => self.seen.link_down += 1,
                    Restarted => self.seen.restarted += 1,
                    Duplicate => {
                        self.judge.violations.push(format!("{:?}: {process} says {fact:?}", self.now));
                        return;
                    }
                }
                self.judge.lost(self.now, process, (node, incarnation), why.clone());
                if matches!(why, Hung | LinkDown) && self.has_delivered(process, (node, incarnation)) {
                    self.judge.violations.push(format!(
                        "{:?}: {process} says {fact:?}, and the connection with it delivers",
                        self.now
                    ));
                }
                let host = self.settled_host_of(process, node_at(node));
                self.judge.check_class(self.now, process, (node, incarnation), (why.clone(), host));
            }
        }
    }

    fn send_to_all(&mut self, sender: usize, datagram: &Datagram) {
        let bytes: Rc<[u8]> = encode(datagram, NodeAddress::ALL).as_ref().into();
        let all: Vec<SocketAddr> = self.at.keys().copied().collect();
        for from in self.processes[sender].addresses.clone() {
            for to in all.iter().copied().filter(|to| network_of(*to) == network_of(from)) {
                let (way, what, bytes) = (Way::Multicast, What::Query, bytes.clone());
                self.fly(&Flying { sender, from, to, way, what, bytes });
            }
        }
    }

    fn send(&mut self, sender: usize, to: Place, what: What, datagram: &Datagram) {
        let Place { here: from, there: to } = to;
        assert!(self.processes[sender].addresses.contains(&from), "it is sent from an address that is ours");
        if network_of(from) != network_of(to) {
            self.seen.datagrams += 1;
            self.trace(|| format!("{sender} sends {what:?} from {from} to {to}, which nothing joins"));
            return;
        }
        let bytes = encode(datagram, NodeAddress::ALL).as_ref().into();
        self.fly(&Flying { sender, from, to, way: Way::Unicast, what, bytes });
    }

    fn fly(&mut self, flying: &Flying) {
        let Flying { sender, from, to, what, .. } = *flying;
        self.seen.datagrams += 1;
        let Some(receiver) = self.at.get(&to).map(|process| self.processes[*process].node) else {
            self.trace(|| format!("{sender} sends {what:?} to {to}, where nobody is"));
            return;
        };
        let nodes = (self.processes[sender].node, receiver);
        let delays = self.network.delays(&mut self.chance, nodes, network_of(from));
        self.trace(|| format!("{sender} sends {what:?} from {from} to {to}, there after {delays:?}"));
        self.seen.dropped += u64::from(delays.is_empty());
        for delay in delays {
            self.push(self.now + delay, Event::Land(flying.clone()));
        }
    }
}
