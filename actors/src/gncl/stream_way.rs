//! Which way values of class Stream go to a peer, for whoever asks.

use super::Peer;

/// What went to a peer by datagram so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ByDatagram {
    /// Values that were sent at least once.
    pub(crate) sent: u64,
    /// Those of them that the peer has acknowledged.
    pub(crate) arrived: u64,
    /// The longest payload that goes so, where longer datagrams do not arrive.
    pub(crate) payload_max: Option<usize>,
}

/// What went by datagram; `None` where the two nodes have not agreed on datagrams, so that all goes by the connection.
pub(crate) fn by_datagram(peer: &Peer) -> Option<ByDatagram> {
    let channel = peer.channel()?;
    let (position, payload_max) = (channel.position(), channel.payload_max());
    Some(ByDatagram { sent: position.counts.sent, arrived: position.arrived, payload_max })
}
