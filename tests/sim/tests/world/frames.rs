//! The frames that GNCL's adapter reads from a connection.

use sinew_gncl::core::{ConnectionId, HANDSHAKE_PAYLOAD_MAX, Input, Introduction, Lane, RefusalError, read};
use sinew_model::events::SyncEvent;
use sinew_runtime::{
    tid::{AppAddress, NodeAddress},
    wire::{Kind, Message},
};
use sinew_session::Ack;
use tokio_util::codec::Decoder as _;

use crate::{tcp::Mode, world::World};

impl World {
    /// Processes bytes that were read from a connection.
    pub(crate) fn bytes_arrive(&mut self, process: usize, connection: ConnectionId, bytes: &[u8]) {
        if let Some(wire) = self.processes[process].wires.get_mut(&connection) {
            wire.buffer.extend_from_slice(bytes);
        }
        loop {
            let now = self.local(process);
            let payload_max = self.processes[process].config.payload_max.max(HANDSHAKE_PAYLOAD_MAX);
            let p = &mut self.processes[process];
            let Some(wire) = p.wires.get_mut(&connection) else { return };
            match wire.mode {
                Mode::Handshake => wire.codec.set_payload_max(HANDSHAKE_PAYLOAD_MAX),
                Mode::Linked => wire.codec.set_payload_max(payload_max),
                Mode::Discard => return wire.buffer.clear(),
            }
            wire.codec.set_checksum(wire.checksum);
            let decoded = wire.codec.decode(&mut wire.buffer);
            let linked = wire.link.filter(|_| wire.mode == Mode::Linked);
            if let Some((node, ..)) = linked
                && let Some(peer) = p.store.0.get_mut(&node)
            {
                peer.sign = Some(now);
            }
            match decoded {
                Ok(None) => return,
                Ok(Some(message)) => match linked {
                    Some((node, lane, link)) if !is_for_the_shell(&message) => {
                        self.message_arrives(process, connection, (node, lane, link), message);
                    }
                    Some(_) | None => self.frame_arrives(process, connection, &message),
                },
                Err(error) => {
                    let decline = RefusalError::Violation(error.to_string());
                    return self.gncl(process, Input::Violated(connection, decline));
                }
            }
        }
    }

    /// Processes a frame that is not about the connection itself.
    fn message_arrives(
        &mut self,
        process: usize,
        connection: ConnectionId,
        (node, lane, link): (NodeAddress, Lane, u64),
        message: Message,
    ) {
        let now = self.local(process);
        let p = &mut self.processes[process];
        if let Some(wire) = p.wires.get_mut(&connection) {
            wire.received = now;
        }
        let received = self.receive(process, (node, lane, link), message);
        self.flush(process, node);
        if let Err(decline) = received {
            let words = decline.to_string();
            self.judge.violated(process, node, &words);
            return self.gncl(process, Input::Violated(connection, decline));
        }
        let wire = self.processes[process].wires.get_mut(&connection);
        // The first frame is always an ACK. A later one shows that local messages arrive.
        if let Some(wire) = wire.filter(|wire| !wire.carried)
            && std::mem::replace(&mut wire.greeted, true)
        {
            wire.carried = true;
            self.gncl(process, Input::TrafficSeen(connection));
        }
    }

    fn receive(
        &mut self,
        process: usize,
        (node, lane, link): (NodeAddress, Lane, u64),
        message: Message,
    ) -> Result<(), RefusalError> {
        let peer = self.processes[process].store.0.get_mut(&node);
        let Some(way) = peer.and_then(|peer| peer.way(lane)) else { return Ok(()) };
        if message.header.destination.app == AppAddress::GNCL && message.header.kind == Kind::GNCL_ACK {
            let ack: Ack = read(&message.payload)?;
            way.on_ack(link, &ack);
            return Ok(());
        }
        if way.arrive(link, &message).map_err(RefusalError::Violation)? && message.header.source.node == node
        {
            self.post_sync(process, SyncEvent::Message(message));
        }
        Ok(())
    }

    /// Processes a frame of the handshake, or one about the liveness of a link.
    fn frame_arrives(&mut self, process: usize, connection: ConnectionId, message: &Message) {
        let input =
            input_of(connection, message).unwrap_or_else(|decline| Input::Violated(connection, decline));
        if !matches!(input, Input::Violated(..) | Input::PingReceived(_) | Input::PongReceived(_)) {
            let now = self.local(process);
            self.gncl(process, Input::FramesReceived(connection, now));
        }
        if matches!(input, Input::GoodbyeReceived(_)) {
            let p = &mut self.processes[process];
            if let Some((node, lane, _)) = p.wires.get(&connection).and_then(|wire| wire.link)
                && let Some(way) = p.store.0.get_mut(&node).and_then(|peer| peer.way(lane))
            {
                way.acknowledge();
                self.flush(process, node);
            }
        }
        self.gncl(process, input);
    }
}

/// Whether this message is about the link itself.
fn is_for_the_shell(message: &Message) -> bool {
    const KINDS: [Kind; 6] = [
        Kind::GNCL_HELLO,
        Kind::GNCL_WELCOME,
        Kind::GNCL_REFUSAL,
        Kind::GNCL_PING,
        Kind::GNCL_PONG,
        Kind::GNCL_GOODBYE,
    ];
    message.header.destination.app == AppAddress::GNCL && KINDS.contains(&message.header.kind)
}

fn input_of(connection: ConnectionId, message: &Message) -> Result<Input, RefusalError> {
    let introduction = || -> Result<Introduction, RefusalError> {
        let introduction: Introduction = read(&message.payload)?;
        if introduction.node != message.header.source.node {
            return Err(RefusalError::Violation("the source of this frame is another node".to_owned()));
        }
        Ok(introduction)
    };
    match message.header.kind {
        Kind::GNCL_HELLO => Ok(Input::HelloReceived(connection, introduction()?)),
        Kind::GNCL_WELCOME => Ok(Input::WelcomeReceived(connection, introduction()?)),
        Kind::GNCL_REFUSAL => Ok(Input::RefusalReceived(connection, read(&message.payload)?)),
        Kind::GNCL_PING => Ok(Input::PingReceived(connection)),
        Kind::GNCL_PONG => Ok(Input::PongReceived(connection)),
        Kind::GNCL_GOODBYE => Ok(Input::GoodbyeReceived(connection)),
        kind => {
            Err(RefusalError::Violation(format!("a frame of kind {kind} came before the handshake was over")))
        }
    }
}
