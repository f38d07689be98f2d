//! Transport of class Stream to a peer, for queries.

use super::Peer;

/// Values sent to a peer by datagram so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatagramShare {
    /// Values that were sent at least once.
    pub sent: u64,
    /// Values among `sent` that the peer has acknowledged.
    pub arrived: u64,
    /// The longest payload sent by datagram, if longer datagrams do not arrive.
    pub payload_max: Option<usize>,
}

/// Returns the values sent by datagram; `None` if the two nodes have not agreed on datagrams, and all values
/// use the connection.
pub fn datagram_share(peer: &Peer) -> Option<DatagramShare> {
    let channel = peer.channel()?;
    let (position, payload_max) = (channel.position(), channel.payload_max());
    Some(DatagramShare { sent: position.counts.sent, arrived: position.arrived, payload_max })
}
