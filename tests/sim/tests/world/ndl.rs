//! The adapter of NDL: it does the work of NDL's actor for the core's outputs.

use std::net::{SocketAddr, SocketAddrV4};

use sinew_model::{
    events::{GnclEvent, NdlEvent, SyncEvent},
    facts::{LossReason, MembershipFact},
};
use sinew_ndl::{
    core::{Cast, Core, Host, Input, Output, Place},
    datagram::{Answer, Body, Datagram, encode},
};
use sinew_runtime::{tid::NodeAddress, time::Time};

use crate::{
    Fault,
    plan::Layer,
    world::{Event, Flight, World, udp_address},
};

impl World {
    /// Starts an instance of NDL on the node's core.
    pub(crate) fn start_ndl(&mut self, process: usize) {
        let linked: Vec<_> = {
            let peers = self.processes[process].store.0.iter();
            let linked = peers.filter(|(_, peer)| peer.is_linked());
            linked.map(|(node, peer)| (*node, peer.incarnation)).collect()
        };
        let paths = [udp_address(self.node_of(process))];
        let announced = self.processes[process].announced();
        self.ndl(process, |core, now| {
            core.check_links(now, |node, incarnation| linked.contains(&(node, incarnation)));
            core.announce_gncl(announced);
            core.use_seeds(now, Vec::new());
            core.start(now, &paths);
        });
    }

    pub(crate) fn ndl_input(&mut self, process: usize, input: Input) {
        self.ndl(process, |core, now| core.handle(now, input));
    }

    fn ndl(&mut self, process: usize, act: impl FnOnce(&mut Core, Time)) {
        let now = self.local(process);
        act(&mut self.processes[process].ndl, now);
        while let Some(output) = self.processes[process].ndl.poll() {
            self.execute_ndl(process, now, output);
        }
        self.set_timer(process, Layer::Ndl);
    }

    /// Handles the passing of time, after GNCL's liveness hints about the members in doubt.
    pub(crate) fn ndl_time_passed(&mut self, process: usize) {
        let mut hints = self.liveness_hints(process);
        if self.fault == Some(Fault::SignsNotTold) {
            hints.clear();
        }
        self.ndl(process, |core, now| {
            for (node, incarnation, at) in hints {
                core.handle(now, Input::HintReceived { node, incarnation, at });
            }
            core.handle(now, Input::TimePassed);
        });
    }

    fn execute_ndl(&mut self, process: usize, now: Time, output: Output) {
        let me = || self.processes[process].ndl.announcement().clone();
        match output {
            Output::SendQuery { to, correlation } => {
                let body = Body::Query(me());
                self.send_datagram(process, to, NodeAddress::ALL, Datagram { correlation, sent: now, body });
            }
            Output::SendMulticastQuery { from, correlation } => {
                let datagram = Datagram { correlation, sent: now, body: Body::Query(me()) };
                let bytes = encode(&datagram, NodeAddress::ALL).to_vec();
                for here in from {
                    for node in self.nodes() {
                        let (there, bytes) = (udp_address(node), bytes.clone());
                        self.fly(process, Flight { from: here, to: there, cast: Cast::Multicast, bytes });
                    }
                }
            }
            Output::SendAnswer { to, node, correlation, query_sent, query_received } => {
                let answer = Answer {
                    announcement: me(),
                    query_sent_ns: query_sent.as_nanos(),
                    query_received_ns: query_received.as_nanos(),
                    progress: self.processes[process].ndl.progress().clone(),
                };
                let body = Body::Answer(answer);
                self.send_datagram(process, to, node, Datagram { correlation, sent: now, body });
            }
            Output::SendLeave { to, node } => {
                let body = Body::Leave(me().into());
                self.send_datagram(process, to, node, Datagram { correlation: 0, sent: now, body });
            }
            Output::Probe { node, incarnation, to, within, requested } => {
                self.request_liveness(process, node, incarnation);
                let host = self.host_at(process, &to);
                let takes = if host == Host::IsSilent { within } else { within / 10 };
                let input = Box::new(Input::Probed { node, incarnation, host, requested });
                self.queue.push_after(takes, Event::Probed { process, input });
            }
            Output::RequestLiveness { node, incarnation } => {
                self.request_liveness(process, node, incarnation)
            }
            Output::Fact(fact) => self.member_changed(process, fact),
            Output::Moved { node, incarnation, gncl } => {
                self.coverage.count("moves");
                if self.fault != Some(Fault::MoveNotTold) {
                    self.post_gncl(process, GnclEvent::Moved { node, incarnation, gncl });
                }
            }
            Output::Forgotten { node, incarnation } => {
                self.post_gncl(process, GnclEvent::Forgotten { node, incarnation });
            }
            Output::Event { .. } | Output::ClockMeasured { .. } | Output::Stalled { .. } => {}
            Output::Collision { .. } | Output::AddressTaken { .. } => {
                self.judge
                    .violate(format!("process {process} reports {output:?}, and no address is used twice"));
            }
        }
    }

    /// Returns the response of the host at these addresses.
    fn host_at(&self, process: usize, to: &[SocketAddr]) -> Host {
        let here = self.node_of(process);
        Host::by(to.iter().map(|address| match self.node_at(*address) {
            None => Host::IsSilent,
            Some(node) if !self.may_connect(here, node) => Host::IsSilent,
            Some(node) => match self.current(node) {
                Some(there) if self.processes[there].gncl_at == *address => Host::Accepts,
                // The former address is not the host's any more.
                Some(_) => Host::IsSilent,
                None => Host::Refuses,
            },
        }))
    }

    /// Fences an ended incarnation, then notifies GNCL and the sync manager.
    fn member_changed(&mut self, process: usize, fact: MembershipFact) {
        self.note(process, || format!("NDL reports {fact:?}"));
        let words = self.judge.member_changed(self.queue.now(), process, &fact);
        self.judge.violations.extend(words);
        let store = &mut self.processes[process].store;
        match &fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.coverage.count("nodes found");
                store.stays(*node, *incarnation);
            }
            MembershipFact::NodeLost { node, incarnation, why } => {
                self.coverage.count("nodes lost");
                match why {
                    LossReason::Left | LossReason::GaveUp(_) => store.leaves(*node, *incarnation),
                    LossReason::Crashed
                    | LossReason::Hung
                    | LossReason::LinkDown
                    | LossReason::Restarted
                    | LossReason::Duplicate => store.fence(*node, *incarnation),
                }
            }
        }
        let is_loss = matches!(fact, MembershipFact::NodeLost { .. });
        if !(is_loss && self.fault == Some(Fault::LossNotToldToGncl)) {
            self.post_gncl(process, GnclEvent::Membership(fact.clone()));
        }
        let late = self.late_loss(process, &fact);
        self.post_sync(process, SyncEvent::Membership(fact));
        if let Some(late) = late {
            self.post_sync(process, SyncEvent::Membership(late));
        }
    }

    /// Returns the loss that a fault delivers behind the find of the next incarnation.
    fn late_loss(&self, process: usize, fact: &MembershipFact) -> Option<MembershipFact> {
        let MembershipFact::NodeFound { node, incarnation, .. } = *fact else { return None };
        let is_planted = self.fault == Some(Fault::LateLossOfAnyIncarnation);
        let was_lost = self.judge.has_lost_former(process, node, incarnation);
        (is_planted && was_lost).then_some(MembershipFact::NodeLost {
            node,
            incarnation,
            why: LossReason::Restarted,
        })
    }

    fn send_datagram(&mut self, process: usize, to: Place, node: NodeAddress, datagram: Datagram) {
        let bytes = encode(&datagram, node).to_vec();
        self.fly(process, Flight { from: to.here, to: to.there, cast: Cast::Unicast, bytes });
    }

    fn fly(&mut self, process: usize, flight: Flight) {
        let here = self.node_of(process);
        let Some(there) = self.node_at(flight.to) else { return };
        let delays = if here == there {
            vec![std::time::Duration::ZERO]
        } else if self.muffled.contains(&(here, there)) {
            Vec::new()
        } else {
            self.network.arrivals(&mut self.chance, here, there)
        };
        self.coverage.count(if delays.is_empty() { "datagrams lost" } else { "datagrams" });
        for delay in delays {
            self.queue.push_after(delay, Event::Datagram(flight.clone()));
        }
    }

    /// Delivers a datagram to the process that has the address now.
    pub(crate) fn datagram_arrives(&mut self, flight: &Flight) {
        let process = self.node_at(flight.to).and_then(|node| self.current(node));
        if let Some(process) = process {
            let place = Place { there: flight.from, here: flight.to };
            self.ndl(process, |core, now| core.receive(now, place, flight.cast, &flight.bytes));
        }
    }

    pub(crate) fn take_ndl_event(&mut self, process: usize, event: NdlEvent) {
        let input = match event {
            NdlEvent::Link(fact) => Input::Link(fact),
            NdlEvent::App(fact) => Input::AppChanged(fact),
        };
        self.ndl_input(process, input);
    }

    /// Lets GNCL of a node listen at another port, and announces it.
    pub(crate) fn move_gncl(&mut self, process: usize) {
        let port = self.processes[process].gncl_at.port() + 1;
        self.processes[process].gncl_at.set_port(port);
        let announced = self.processes[process].announced();
        self.ndl(process, |core, _| core.announce_gncl(announced));
    }
}

/// Returns the announcement of an address of GNCL.
pub(crate) fn announced_at(address: SocketAddr) -> (Vec<SocketAddrV4>, Option<u16>) {
    match address {
        SocketAddr::V4(address) => (vec![address], None),
        SocketAddr::V6(_) => (Vec::new(), None),
    }
}
