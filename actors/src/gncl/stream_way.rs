//! Which way values of class Stream go to a peer, for whoever asks.

use super::Peer;

/// What went to a peer by datagram so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ByDatagram {
    /// Values that were sent at least once.
    pub(crate) sent: u64,
    /// Those of them that the peer has acknowledged.
    pub(crate) arrived: u64,
}

/// What went by datagram; `None` where the two nodes have not agreed on datagrams, so that all goes by the connection.
pub(crate) fn by_datagram(peer: &Peer) -> Option<ByDatagram> {
    let position = peer.channel()?.position();
    Some(ByDatagram { sent: position.counts.sent, arrived: position.arrived })
}
