//! The adapter of GNCL: it does the work of GNCL's actor for the core's outputs.

use std::net::SocketAddr;

use bytes::Bytes;
use sinew_gncl::core::{Attach, ConnectionId, HANDSHAKE_PAYLOAD_MAX, Input, Lane, Output, Refusal, write};
use sinew_model::{
    events::{GnclEvent, NdlEvent, SyncEvent},
    facts::{LinkFact, LossReason, MembershipFact},
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::{Checksum, Kind},
};

use crate::{
    Fault,
    plan::Layer,
    process::new_gncl,
    sessions::{Kept, bytes_of, frame},
    tcp::{End, Mode, Segment, Tcp, Wire},
    world::{Event, World, node_address},
};

impl World {
    pub(crate) fn gncl(&mut self, process: usize, input: Input) {
        self.report_heard(process, &input);
        let now = self.local(process);
        self.processes[process].gncl.handle(now, input);
        while let Some(output) = self.processes[process].gncl.poll() {
            self.obey_gncl(process, output);
        }
        self.set_timer(process, Layer::Gncl);
    }

    /// Reports to the core when messages were last received, before an input that depends on it.
    fn report_heard(&mut self, process: usize, before: &Input) {
        let of = if let Input::PingReceived(connection) | Input::PongReceived(connection) = before {
            Some(*connection)
        } else if matches!(before, Input::TimePassed) {
            None
        } else {
            return;
        };
        let process = &mut self.processes[process];
        for (connection, wire) in &mut process.wires {
            if of.is_none_or(|of| of == *connection) && wire.reported < wire.received {
                wire.reported = wire.received;
                process.gncl.handle(wire.received, Input::FramesReceived(*connection, wire.received));
            }
        }
    }

    fn obey_gncl(&mut self, process: usize, output: Output) {
        let here = self.processes[process].address;
        match output {
            Output::Dial { connection, address } => self.dial(process, connection, address),
            Output::SendHello(connection, hello) => {
                let message = frame(here, hello.peer, Kind::GNCL_HELLO, write(&hello));
                self.write(process, connection, bytes_of(&message, Checksum::Crc));
            }
            Output::Attach(attach) => self.attach(process, &attach),
            Output::Detach { connection, node, lane } => self.detach(process, connection, node, lane),
            Output::Refuse(connection, refusal) => self.refuse(process, connection, &refusal),
            Output::Close(connection) => self.close(process, connection),
            Output::SendPing(node, lane) => self.send_signal(process, node, lane, Kind::GNCL_PING),
            Output::SendPong(node, lane) => self.send_signal(process, node, lane, Kind::GNCL_PONG),
            Output::SendGoodbye(node) => {
                for lane in Lane::ALL {
                    let peer = self.processes[process].store.0.get_mut(&node);
                    if let Some(way) = peer.and_then(|peer| peer.way(lane)) {
                        way.finish();
                    }
                }
                self.flush(process, node);
            }
            Output::Forget(node) => {
                if self.fault != Some(Fault::SessionsOfEndedPeer) {
                    self.processes[process].store.0.remove(&node);
                }
            }
            Output::Fact(fact) => self.link_changed(process, fact),
            Output::Silent(_) | Output::Count { .. } => {}
        }
    }

    fn dial(&mut self, process: usize, connection: ConnectionId, address: SocketAddr) {
        let wire = Wire::new(None, HANDSHAKE_PAYLOAD_MAX);
        self.processes[process].wires.insert(connection, wire);
        let instance = self.processes[process].gncl_instance;
        let Some(node) = self.node_at(address) else { return };
        let words = self.judge.dials(self.queue.now(), process, node_address(node));
        self.judge.violations.extend(words);
        let here = self.node_of(process);
        let delay = self.network.delay(&mut self.chance, here, node);
        self.queue.push_after(delay, Event::Dialled { process, instance, connection, address });
    }

    /// A dial reaches its host, if there is a way.
    pub(crate) fn dialled(
        &mut self,
        process: usize,
        instance: u64,
        connection: ConnectionId,
        address: SocketAddr,
    ) {
        let here = self.node_of(process);
        let Some(node) = self.node_at(address) else { return };
        if !self.may_connect(here, node) {
            return;
        }
        let delay = self.network.delay(&mut self.chance, node, here);
        let Some(there) = self.current(node) else {
            return self.queue.push_after(delay, Event::DialRefused { process, instance, connection });
        };
        if self.processes[there].gncl_at != address {
            // The former address is not the host's any more.
            return;
        }
        let accepted = self.processes[there].gncl.open();
        let end = |process, instance, connection| End { process, instance, connection, is_open: true };
        let ends =
            [end(process, instance, connection), end(there, self.processes[there].gncl_instance, accepted)];
        let tcp = self.tcps.len();
        self.tcps.push(Tcp { ends, pipes: Default::default() });
        self.processes[there].wires.insert(accepted, Wire::new(Some((tcp, 1)), HANDSHAKE_PAYLOAD_MAX));
        let from = self.processes[process].gncl_at.ip();
        self.queue.push_after(delay, Event::Reached { tcp });
        self.gncl(there, Input::Accepted(accepted, from));
    }

    /// A dial has reached its host.
    pub(crate) fn reached(&mut self, tcp: usize) {
        let End { process, instance, connection, .. } = self.tcps[tcp].ends[0];
        let is_current =
            self.processes[process].is_alive && self.processes[process].gncl_instance == instance;
        match self.processes[process].wires.get_mut(&connection).filter(|_| is_current) {
            Some(wire) => {
                wire.at = Some((tcp, 0));
                self.gncl(process, Input::Connected(connection));
            }
            None => self.shut(tcp, 0),
        }
    }

    pub(crate) fn dial_refused(&mut self, process: usize, instance: u64, connection: ConnectionId) {
        let is_current = self.processes[process].gncl_instance == instance;
        if is_current && self.processes[process].wires.remove(&connection).is_some() {
            self.gncl(process, Input::DialFailed { connection, refused: true });
        }
    }

    fn attach(&mut self, process: usize, attach: &Attach) {
        let Attach { connection, node, lane, .. } = *attach;
        let (now, fault) = (self.local(process), self.fault);
        let p = &mut self.processes[process];
        let here = p.address;
        let Some(wire) = p.wires.get_mut(&connection) else { return };
        let welcome =
            attach.welcome.as_ref().map(|words| frame(here, node, Kind::GNCL_WELCOME, write(words)));
        let keeps_former = fault == Some(Fault::SessionsOfEndedPeer);
        let peer = p.store.meet(now, here, attach, keeps_former);
        let Some(way) = peer.way(lane) else { return };
        let link = way.connect(attach.checksum(), welcome.as_ref());
        (wire.mode, wire.checksum, wire.link) = (Mode::Linked, attach.checksum(), Some((node, lane, link)));
        self.flush(process, node);
    }

    fn detach(&mut self, process: usize, connection: ConnectionId, node: NodeAddress, lane: Lane) {
        let p = &mut self.processes[process];
        let link = p.wires.get_mut(&connection).and_then(|wire| wire.link.take());
        if let Some((.., link)) = link
            && let Some(way) = p.store.0.get_mut(&node).and_then(|peer| peer.way(lane))
        {
            way.disconnect(link);
        }
    }

    fn refuse(&mut self, process: usize, connection: ConnectionId, refusal: &Refusal) {
        self.coverage.count("refusals");
        let here = self.processes[process].address;
        let message = frame(here, NodeAddress::HERE, Kind::GNCL_REFUSAL, write(refusal));
        self.write(process, connection, bytes_of(&message, Checksum::Crc));
        let wire = self.processes[process].wires.get_mut(&connection);
        if let Some(wire) = wire {
            wire.mode = Mode::Discard;
            if let Some((tcp, side)) = wire.at {
                // Only this direction is closed: the end of the peer's is still read.
                self.transmit(tcp, side, Segment::End);
            }
        }
    }

    fn close(&mut self, process: usize, connection: ConnectionId) {
        if let Some(wire) = self.processes[process].wires.remove(&connection)
            && let Some((tcp, side)) = wire.at
        {
            self.shut(tcp, side);
        }
    }

    fn send_signal(&mut self, process: usize, node: NodeAddress, lane: Lane, kind: Kind) {
        let peer = self.processes[process].store.0.get_mut(&node);
        if let Some(way) = peer.and_then(|peer| peer.way(lane)) {
            way.send_signal(kind, Bytes::new());
        }
        self.flush(process, node);
    }

    /// Requests a liveness hint on each established connection.
    pub(crate) fn request_liveness(&mut self, process: usize, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.processes[process].store.of(node, incarnation) {
            peer.ways.iter_mut().for_each(|way| way.send_signal(Kind::GNCL_PING, Bytes::new()));
        }
        self.flush(process, node);
    }

    /// Sends a message on the session with this node. Returns whether it was accepted.
    pub(crate) fn submit(&mut self, process: usize, node: NodeAddress, message: Kept) -> bool {
        let peer = self.processes[process].store.0.get_mut(&node);
        let is_taken = peer.and_then(|peer| peer.way(Lane::Control)).is_some_and(|way| way.submit(message));
        self.flush(process, node);
        is_taken
    }

    /// Transmits the bytes that the sessions with this node have written.
    pub(crate) fn flush(&mut self, process: usize, node: NodeAddress) {
        let wires = self.processes[process].wires.iter();
        let linked = wires.filter_map(|(connection, wire)| Some((*connection, wire.link?)));
        let linked: Vec<_> = linked.filter(|(_, link)| link.0 == node).collect();
        for (connection, (_, lane, _)) in linked {
            let peer = self.processes[process].store.0.get_mut(&node);
            let written = peer.and_then(|peer| peer.way(lane)).map(|way| std::mem::take(&mut way.written));
            self.write(process, connection, written.unwrap_or_default());
        }
    }

    fn write(&mut self, process: usize, connection: ConnectionId, bytes: Vec<u8>) {
        let wire = self.processes[process].wires.get(&connection);
        if let Some((tcp, side)) = wire.and_then(|wire| wire.at)
            && !bytes.is_empty()
            && self.tcps[tcp].ends[side].is_open
        {
            self.transmit(tcp, side, Segment::Bytes(bytes));
        }
    }

    /// Processes the end of a connection.
    pub(crate) fn connection_ends(&mut self, process: usize, connection: ConnectionId) {
        self.gncl(process, Input::Ended(connection));
        self.close(process, connection);
    }

    /// Notifies NDL and the sync manager of a link.
    fn link_changed(&mut self, process: usize, fact: LinkFact) {
        self.note(process, || format!("GNCL reports {fact:?}"));
        self.judge.link_changed(self.queue.now(), process, &fact);
        match fact {
            LinkFact::LinkUp { node, .. } => {
                self.coverage.count("links up");
                // Also where the link ends before anything looks for it.
                self.processes[process].unlinked_since.remove(&node);
            }
            LinkFact::LinkBroken { .. } => self.coverage.count("links broken"),
            LinkFact::PeerLeft { node, incarnation, .. } => {
                self.coverage.count("departures");
                self.processes[process].store.leaves(node, incarnation);
            }
            LinkFact::DialRefused { .. } => {}
        }
        self.post_ndl(process, NdlEvent::Link(fact.clone()));
        if self.fault == Some(Fault::DepartureToldAgain)
            && let LinkFact::LinkUp { node, incarnation } = fact
            && self.judge.has_left_before(node, incarnation)
        {
            self.post_ndl(process, NdlEvent::Link(LinkFact::PeerLeft { node, incarnation, gave_up: None }));
        }
        if self.fault != Some(Fault::BreakNotTold) || !matches!(fact, LinkFact::LinkBroken { .. }) {
            self.post_sync(process, SyncEvent::Link(fact));
        }
    }

    /// Handles an event of NDL.
    pub(crate) fn take_gncl_event(&mut self, process: usize, event: GnclEvent) {
        let input = match event {
            GnclEvent::Membership(MembershipFact::NodeFound { node, incarnation, gncl }) => {
                self.takes_back(process, node, incarnation);
                Input::NodeFound { node, incarnation, addresses: gncl }
            }
            GnclEvent::Moved { node, incarnation, gncl } => {
                Input::NodeFound { node, incarnation, addresses: gncl }
            }
            GnclEvent::Membership(MembershipFact::NodeLost { node, incarnation, why }) => {
                Input::of_loss(&why, node, incarnation)
            }
            GnclEvent::Forgotten { node, incarnation } => Input::NodeDisowned { node, incarnation },
            GnclEvent::DenyListChanged => return,
        };
        self.gncl(process, input);
    }

    fn takes_back(&mut self, process: usize, node: NodeAddress, incarnation: Incarnation) {
        if self.processes[process].store.has_given_up(node, incarnation) {
            self.gncl(process, Input::NodeDisowned { node, incarnation });
        }
    }

    /// Replaces this layer's instance: its connections are cut, its peers and their sessions stay.
    pub(crate) fn restart_gncl(&mut self, process: usize) {
        self.shut_all_of(process);
        let now = self.queue.now();
        let p = &mut self.processes[process];
        p.wires.clear();
        p.gncl_instance += 1;
        p.gncl = new_gncl(&p.config, p.address, p.incarnation, self.plan.seed + p.gncl_instance);
        p.timers[Layer::Gncl as usize].clear();
        let mut broken = Vec::new();
        for (node, peer) in &mut p.store.0 {
            for way in &mut peer.ways {
                way.cut();
            }
            broken.push((*node, peer.incarnation));
        }
        for (node, incarnation) in broken.iter().copied() {
            let fact = LinkFact::LinkBroken { node, incarnation };
            self.judge.link_changed(now, process, &fact);
            if self.fault != Some(Fault::CutLinksNotTold) {
                self.post_sync(process, SyncEvent::Link(fact));
            }
        }
        for (node, incarnation) in broken {
            self.gncl(process, Input::Restored { node, incarnation });
        }
        if self.fault == Some(Fault::MembersNotRead) {
            return;
        }
        let local = self.local(process);
        for (node, lost) in self.processes[process].ndl.lost_nodes() {
            if !matches!(lost.why, LossReason::Left | LossReason::GaveUp(_) | LossReason::Duplicate) {
                self.gncl(process, Input::of_loss(&lost.why, node, lost.incarnation));
            }
        }
        for member in self.processes[process].ndl.members(local) {
            self.takes_back(process, member.node, member.incarnation);
            let (node, incarnation, addresses) = (member.node, member.incarnation, member.gncl);
            self.gncl(process, Input::NodeFound { node, incarnation, addresses });
        }
    }

    /// Returns GNCL's last receipts from the members in doubt.
    pub(crate) fn liveness_hints(&self, process: usize) -> Vec<(NodeAddress, Incarnation, Time)> {
        let p = &self.processes[process];
        let hint = |(node, incarnation)| {
            let peer = p.store.0.get(&node).filter(|peer| peer.incarnation == incarnation)?;
            Some((node, incarnation, peer.sign?))
        };
        p.ndl.in_doubt().into_iter().filter_map(hint).collect()
    }
}
