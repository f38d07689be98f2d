//! Frames from GNCL itself to that of another node.

use bytes::Bytes;
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message},
};

/// Creates a frame from this node's GNCL to that of `node`.
pub(crate) fn frame(here: NodeAddress, node: NodeAddress, kind: Kind, payload: Bytes) -> Message {
    let mut header = Header::new(kind, Tid::new(here, AppAddress::GNCL), Tid::new(node, AppAddress::GNCL));
    header.sent = Time::now();
    Message::new(header, payload)
}
