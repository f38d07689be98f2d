//! Outputs of cores: datagrams go to the network, facts to the judge.

use sinew_model::facts::NodeEvent;

use super::*;

impl World {
    pub(super) fn execute(&mut self, from: usize, now: Time, output: Output) {
        let me = || self.processes[from].tested.core.announcement().clone();
        match output {
            Output::SendQuery { to, correlation } => {
                if network_of(to.here) == network_of(to.there) {
                    self.judge.query_sent(self.now(), from, to.there, correlation);
                }
                let datagram = Datagram { correlation, sent: now, body: Body::Query(me()) };
                self.send(from, to, Kind::Query, &datagram);
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
                    progress: self.processes[from].tested.core.progress().clone(),
                };
                let datagram = Datagram { correlation, sent: now, body: Body::Answer(answer) };
                self.send(from, to, Kind::Answer(correlation), &datagram);
            }
            Output::SendLeave { to, .. } => {
                let datagram = Datagram { correlation: 0, sent: now, body: Body::Leave(me().into()) };
                self.processes[from].leaves.insert(to.there);
                self.send(from, to, Kind::Leave, &datagram);
            }
            Output::Probe { node, incarnation, to, within, requested } => {
                let host = self.response_at(from, node_at(node), &to);
                let takes = if host == Host::IsSilent { within } else { REPORT_DELAY_MAX.min(within / 2) };
                self.request_liveness(from, node, REPORT_DELAY_MAX.min(within / 2));
                let delay = self.chance.between(Duration::ZERO, takes);
                let input = Box::new(Input::Probed { node, incarnation, host, requested });
                self.queue.push_after(delay, Event::Input(from, input));
            }
            Output::RequestLiveness { node, .. } => self.request_liveness(from, node, REPORT_DELAY_MAX),
            Output::Fact(fact) => self.fact_reported(from, &fact),
            Output::ClockMeasured { node, offset, .. } => {
                let Some(peer) = self.current_of(node) else { return };
                let truth =
                    self.local(peer).as_nanos().cast_signed() - self.local(from).as_nanos().cast_signed();
                self.judge.measured(self.now(), from, (node, offset), truth);
            }
            Output::Stalled { late } => {
                self.note(|| format!("{from} was late by {late:?}"));
                self.judge.reported_a_stall(from);
            }
            Output::Moved { .. }
            | Output::Forgotten { .. }
            | Output::Collision { .. }
            | Output::AddressTaken { .. } => {
                self.judge.violations.push(format!("{:?}: {from} reports {output:?}", self.now()));
            }
            Output::Event { event, .. } => self.event_published(from, &event),
        }
    }

    /// Returns the process that is this node now.
    pub(super) fn current_of(&self, node: NodeAddress) -> Option<usize> {
        self.current.get(&node_at(node)).copied()
    }

    fn event_published(&mut self, process: usize, event: &NodeEvent) {
        self.note(|| format!("{process} notifies its application of {event:?}"));
        match *event {
            NodeEvent::NodeLost { node, incarnation, silent_us, bound_us, .. } => {
                let silence = [silent_us, bound_us].map(Duration::from_micros);
                self.judge.loss_notified(self.now(), process, (node, incarnation), silence);
            }
            NodeEvent::AppStalled { trouble: Trouble::Unheard, .. } => {
                self.coverage.count("events of silent layers")
            }
            NodeEvent::AppStalled { .. } => self.coverage.count("stall events"),
            NodeEvent::NodeRestarted { node, incarnation, silent_us, bound_us, .. } => {
                self.coverage.count("restart events");
                let silence = [silent_us, bound_us].map(Duration::from_micros);
                self.judge.restart_notified(self.now(), process, (node, incarnation), silence);
            }
            NodeEvent::NodeFound { .. } | NodeEvent::AppResumed { .. } => {}
        }
        let truth = |node: NodeAddress, incarnation: Incarnation| {
            let other = self.judge.process_of(node, incarnation);
            other.map(|process| self.processes[process].troubles.clone()).unwrap_or_default()
        };
        if let Err(words) = self.listeners.notified(process, event, truth) {
            let words = format!("{:?}: to the application of {process}, {event:?}: {words}", self.now());
            self.judge.violations.push(words);
        }
    }

    fn fact_reported(&mut self, process: usize, fact: &MembershipFact) {
        self.listeners.expect(process, fact);
        self.note(|| format!("{process} reports {fact:?}"));
        format!("{:?} {process} {fact:?}", self.now()).hash(&mut self.digest);
        match *fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.coverage.count("found");
                if let Some(other) = self.current_of(node) {
                    let address = self.processes[other].addresses[0];
                    self.processes[process].met.insert(address);
                }
                self.judge.found(self.now(), process, node, incarnation);
            }
            MembershipFact::NodeLost { node, incarnation, ref why } => {
                use sinew_model::facts::LossReason::{
                    Crashed, Duplicate, GaveUp, Hung, Left, LinkDown, Restarted,
                };
                match why {
                    Left | GaveUp(_) => self.coverage.count("left"),
                    Crashed => self.coverage.count("crashed"),
                    Hung => self.coverage.count("hung"),
                    LinkDown => self.coverage.count("link down"),
                    Restarted => self.coverage.count("restarted"),
                    Duplicate => {
                        self.judge.violations.push(format!("{:?}: {process} reports {fact:?}", self.now()));
                        return;
                    }
                }
                self.judge.lost(self.now(), process, (node, incarnation), why.clone());
                if matches!(why, Hung | LinkDown) && self.has_delivered(process, (node, incarnation)) {
                    self.judge.violations.push(format!(
                        "{:?}: {process} reports {fact:?}, and the connection with it delivers",
                        self.now()
                    ));
                }
                let host = self.settled_host_of(process, node_at(node));
                self.judge.check_class(self.now(), process, (node, incarnation), (why.clone(), host));
            }
        }
    }

    fn send_to_all(&mut self, sender: usize, datagram: &Datagram) {
        let bytes: Rc<[u8]> = encode(datagram, NodeAddress::ALL).as_ref().into();
        let all: Vec<SocketAddr> = self.at.keys().copied().collect();
        for from in self.processes[sender].addresses.clone() {
            for to in all.iter().copied().filter(|to| network_of(*to) == network_of(from)) {
                let (cast, kind, bytes) = (Cast::Multicast, Kind::Query, bytes.clone());
                self.fly(&Flight { sender, from, to, cast, kind, bytes });
            }
        }
    }

    fn send(&mut self, sender: usize, to: Place, kind: Kind, datagram: &Datagram) {
        let Place { here: from, there: to } = to;
        assert!(self.processes[sender].addresses.contains(&from), "it is sent from a local address");
        if network_of(from) != network_of(to) {
            self.coverage.count("datagrams");
            self.note(|| format!("{sender} sends {kind:?} from {from} to {to}, which are not connected"));
            return;
        }
        let bytes = encode(datagram, NodeAddress::ALL).as_ref().into();
        self.fly(&Flight { sender, from, to, cast: Cast::Unicast, kind, bytes });
    }

    fn fly(&mut self, flight: &Flight) {
        let Flight { sender, from, to, kind, .. } = *flight;
        self.coverage.count("datagrams");
        let Some(receiver) = self.at.get(&to).map(|process| self.processes[*process].node) else {
            self.note(|| format!("{sender} sends {kind:?} to {to}, which no process has"));
            return;
        };
        let nodes = (self.processes[sender].node, receiver);
        let delays = self.networks.arrivals(&mut self.chance, nodes, network_of(from));
        self.note(|| format!("{sender} sends {kind:?} from {from} to {to}, there after {delays:?}"));
        self.coverage.add("datagrams lost", u64::from(delays.is_empty()));
        for delay in delays {
            self.queue.push_after(delay, Event::Datagram(flight.clone()));
        }
    }
}
