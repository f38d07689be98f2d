//! Connections of the simulated network.

use std::time::Duration;

use bytes::BytesMut;
use sinew_gncl::core::{ConnectionId, Lane};
use sinew_runtime::{
    tid::NodeAddress,
    time::Time,
    wire::{Checksum, FrameCodec},
};
use sinew_sim::Pipe;

use crate::world::{Event, World};

/// Time until a segment is sent again, while the network is cut or has lost it.
const RESEND: Duration = Duration::from_millis(20);

/// Further delay of the segments of a slow node: longer than a restart takes.
const SLOWNESS: Duration = Duration::from_millis(60);

/// A part of a stream.
#[derive(Clone, Debug)]
pub(crate) enum Segment {
    Bytes(Vec<u8>),
    /// The other side has closed.
    End,
}

/// One end of a connection.
#[derive(Clone, Copy, Debug)]
pub(crate) struct End {
    pub(crate) process: usize,
    /// The instance of GNCL that has it.
    pub(crate) instance: u64,
    pub(crate) connection: ConnectionId,
    pub(crate) is_open: bool,
}

/// A connection: side 0 has dialled. Each pipe carries the segments of one side to the other.
#[derive(Debug)]
pub(crate) struct Tcp {
    pub(crate) ends: [End; 2],
    pub(crate) pipes: [Pipe<Segment>; 2],
}

/// The treatment of received frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    Handshake,
    Linked,
    Discard,
}

/// A connection in GNCL's adapter.
pub(crate) struct Wire {
    /// The connection and the side of it; `None` until a dial has reached its host.
    pub(crate) at: Option<(usize, usize)>,
    pub(crate) mode: Mode,
    pub(crate) checksum: Checksum,
    /// Node, lane and number of the link, while it is one.
    pub(crate) link: Option<(NodeAddress, Lane, u64)>,
    pub(crate) buffer: BytesMut,
    pub(crate) codec: FrameCodec,
    /// The time of the last message, and the last such time that the core was given.
    pub(crate) received: Time,
    pub(crate) reported: Time,
    /// Whether the first frame, an ACK, has come, and whether the core knows that messages are exchanged.
    pub(crate) greeted: bool,
    pub(crate) carried: bool,
}

impl Wire {
    pub(crate) fn new(at: Option<(usize, usize)>, handshake_max: usize) -> Self {
        Self {
            at,
            mode: Mode::Handshake,
            checksum: Checksum::Crc,
            link: None,
            buffer: BytesMut::new(),
            codec: FrameCodec::new(handshake_max),
            received: Time::ZERO,
            reported: Time::ZERO,
            greeted: false,
            carried: false,
        }
    }
}

impl World {
    pub(crate) fn node_of(&self, process: usize) -> usize {
        self.processes[process].node
    }

    /// Returns the delay of a segment: lost ones are sent again.
    fn segment_delay(&mut self, from: usize, to: usize) -> Duration {
        let (from, to) = (self.node_of(from), self.node_of(to));
        let delay = self.network.delay(&mut self.chance, from, to);
        let is_lost = self.chance.happens(self.plan.quality.lost_per_mille);
        let lost = if is_lost { RESEND } else { Duration::ZERO };
        let slow = if self.slow.contains(&from) { SLOWNESS } else { Duration::ZERO };
        delay + lost + slow
    }

    /// Sends a segment from one side of a connection.
    pub(crate) fn transmit(&mut self, tcp: usize, side: usize, segment: Segment) {
        let [here, there] = [side, 1 - side].map(|side| self.tcps[tcp].ends[side].process);
        let at = self.queue.now() + self.segment_delay(here, there);
        let at = self.tcps[tcp].pipes[side].send(at, segment);
        self.queue.push(at, Event::Segment { tcp, side: 1 - side });
    }

    /// Closes one side of a connection: the other one reads the end behind all data.
    pub(crate) fn shut(&mut self, tcp: usize, side: usize) {
        if std::mem::take(&mut self.tcps[tcp].ends[side].is_open) {
            self.transmit(tcp, side, Segment::End);
        }
    }

    /// Cuts a connection: some of the data in flight is lost, and both sides read the end.
    pub(crate) fn reset(&mut self, tcp: usize) {
        for side in 0..2 {
            self.tcps[tcp].pipes[side].cut(&mut self.chance);
            self.transmit(tcp, side, Segment::End);
        }
    }

    /// Delivers the segments that have arrived at one side.
    pub(crate) fn segments_arrive(&mut self, tcp: usize, side: usize) {
        let nodes = self.tcps[tcp].ends.map(|end| self.node_of(end.process));
        if self.network.is_apart(nodes[0], nodes[1]) {
            return self.queue.push_after(RESEND, Event::Segment { tcp, side });
        }
        let now = self.queue.now();
        while let Some(segment) = self.tcps[tcp].pipes[1 - side].receive(now) {
            self.segment_arrives(tcp, side, segment);
        }
    }

    fn segment_arrives(&mut self, tcp: usize, side: usize, segment: Segment) {
        let End { process, instance, connection, is_open } = self.tcps[tcp].ends[side];
        if !self.processes[process].is_alive {
            // The host of an ended process refuses data, unless it has failed, too.
            let is_data = matches!(segment, Segment::Bytes(_));
            if is_data && !self.dead_hosts.contains(&self.node_of(process)) {
                self.transmit(tcp, side, Segment::End);
            }
            return;
        }
        if !is_open || self.processes[process].gncl_instance != instance {
            return;
        }
        match segment {
            Segment::Bytes(bytes) => self.bytes_arrive(process, connection, &bytes),
            Segment::End => {
                self.tcps[tcp].ends[side].is_open = false;
                self.connection_ends(process, connection);
            }
        }
    }

    /// Closes all connections of an ended process or of an ended instance of GNCL.
    pub(crate) fn shut_all_of(&mut self, process: usize) {
        for tcp in 0..self.tcps.len() {
            for side in 0..2 {
                if self.tcps[tcp].ends[side].process == process {
                    self.shut(tcp, side);
                }
            }
        }
    }
}
