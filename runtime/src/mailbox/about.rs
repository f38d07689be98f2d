//! The node that a layer's event is about, which determines its position among that node's messages.

use super::is_event;
use crate::{
    tid::NodeAddress,
    wire::{Flags, Header},
};

/// Set in the correlation of an event about the end of a node; the node's address is below it.
const END: u64 = 1 << 32;

/// The subject of an event that a layer sends to an application. It is encoded in the event's correlation, so
/// that every queue on the path knows it, also in other processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum About {
    /// The end of an incarnation of this node: the event follows all messages of that node.
    End(NodeAddress),
    /// Any other event about this node: it follows the events about the node's end.
    Node(NodeAddress),
}

impl About {
    /// Returns the subject of the event with this header, if it is an event with one.
    #[must_use]
    pub fn of(header: &Header) -> Option<Self> {
        let Header { correlation, flags, .. } = *header;
        if correlation == 0 || flags.has(Flags::REPLY) || flags.has(Flags::ASK) || !is_event(header) {
            return None;
        }
        // The lower half is the address, independent of the upper half.
        let node = NodeAddress::new(correlation as u32);
        Some(if correlation & END == 0 { Self::Node(node) } else { Self::End(node) })
    }

    /// Encodes the subject in the header of an event.
    pub fn write(self, header: &mut Header) {
        header.correlation = match self {
            Self::End(node) => END | u64::from(node.bits()),
            Self::Node(node) => u64::from(node.bits()),
        };
    }

    /// Returns the node.
    #[must_use]
    pub const fn node(self) -> NodeAddress {
        match self {
            Self::End(node) | Self::Node(node) => node,
        }
    }
}
