//! What the shell does for values that go by datagram: sockets, and words on a connection about them.

use std::net::TcpListener;

use sinew_runtime::{tid::NodeAddress, time::Time, wire::Kind};

use super::{
    super::{
        core::{Attach, write},
        peer::{Store, frame},
    },
    Gncl,
};

impl Gncl {
    /// Binds a socket for datagrams beside each of these, if they are wanted and may go as they are.
    pub(super) fn bind_datagrams(&self, listeners: &[TcpListener]) {
        let config = &self.stores.config;
        if config.gncl.datagrams && self.stores.secured.get().is_none() {
            let addresses: Vec<_> =
                listeners.iter().filter_map(|listener| listener.local_addr().ok()).collect();
            let Store { datagrams, refusals, .. } = &self.stores.gncl;
            datagrams.bind(&addresses, config, refusals);
        }
    }

    /// Says on a connection for Stream where this node reads datagrams. spec: DATAGRAM-2
    pub(super) fn announce_datagrams(&self, attach: &Attach) {
        let Some(transport) = self.wires.get(&attach.connection).and_then(|wire| wire.transport.as_ref())
        else {
            return;
        };
        let Some(peer) = self.stores.gncl.peer(attach.node) else { return };
        let (Some(channel), Some(way)) = (peer.channel(), peer.way(attach.lane)) else { return };
        let (Ok(local), Ok(remote)) = (transport.socket().local_addr(), transport.socket().peer_addr())
        else {
            return;
        };
        let Some(door) = self.stores.gncl.datagrams.beside(local) else { return };
        let payload_max = usize::try_from(attach.payload_max).unwrap_or(usize::MAX);
        let payload_max = payload_max.min(self.stores.config.payload_max);
        let said = channel.connected(door, (local, remote), payload_max);
        way.say(frame(self.stores.node, attach.node, Kind::GNCL_DATAGRAMS, write(&said)));
    }

    /// The peer lives, whether or not its datagrams come.
    pub(super) fn peer_speaks(&self, node: NodeAddress) {
        if let Some(peer) = self.stores.gncl.peer(node) {
            peer.channel().iter().for_each(|channel| channel.heard(Time::now()));
        }
    }
}
