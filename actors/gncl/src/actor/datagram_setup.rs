//! The shell's part of values sent by datagram: sockets, and their announcement on a connection.

use std::net::TcpListener;

use sinew_runtime::{tid::NodeAddress, time::Time, wire::Kind};

use super::{
    super::{
        core::{Attach, write},
        frame::frame,
        peer::Store,
    },
    Gncl,
};

impl Gncl {
    /// Binds a datagram socket beside each of these listeners, if datagrams are enabled and may be sent unprotected.
    pub(super) fn bind_datagrams(&self, listeners: &[TcpListener]) {
        let config = &self.state.ctx.config;
        if config.gncl.datagrams && self.state.security.secured.get().is_none() {
            let addresses: Vec<_> =
                listeners.iter().filter_map(|listener| listener.local_addr().ok()).collect();
            let Store { datagrams, refusals, .. } = &self.state.store;
            datagrams.bind(&addresses, config, refusals);
        }
    }

    /// Announces on a Stream connection where this node reads datagrams. spec: DATAGRAM-2
    pub(super) fn announce_datagrams(&self, attach: &Attach) {
        let Some(transport) = self.wires.get(&attach.connection).and_then(|wire| wire.transport.as_ref())
        else {
            return;
        };
        let Some(peer) = self.state.store.peer(attach.node) else { return };
        let (Some(channel), Some(session)) = (peer.channel(), peer.session(attach.lane)) else { return };
        let (Ok(local), Ok(remote)) = (transport.socket().local_addr(), transport.socket().peer_addr())
        else {
            return;
        };
        let Some(bound) = self.state.store.datagrams.beside(local) else { return };
        let payload_max = usize::try_from(attach.payload_max).unwrap_or(usize::MAX);
        let payload_max = payload_max.min(self.state.ctx.config.payload_max);
        let announcement = channel.connected(bound, (local, remote), payload_max);
        session.send_urgent(frame(
            self.state.ctx.node,
            attach.node,
            Kind::GNCL_DATAGRAMS,
            write(&announcement),
        ));
    }

    /// Marks the peer as alive, whether or not its datagrams arrive.
    pub(super) fn mark_channel_alive(&self, node: NodeAddress) {
        if let Some(peer) = self.state.store.peer(node) {
            peer.channel().iter().for_each(|channel| channel.on_frame(Time::now()));
        }
    }
}
