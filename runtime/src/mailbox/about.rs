//! Which node an event of a layer is about: its place among that node's messages depends on it.

use super::is_event;
use crate::{
    tid::NodeAddress,
    wire::{Flags, Header},
};

/// Set in the correlation of an event that is about the end of a node; the node's address is below it.
const END: u64 = 1 << 32;

/// What an event that a layer tells an application is about. It is written into the event's correlation, so that every queue on the way
/// knows it, also in other processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum About {
    /// The end of a life of this node: it comes behind all messages of that node.
    End(NodeAddress),
    /// Anything else of this node: it comes behind what was said of its end.
    Node(NodeAddress),
}

impl About {
    /// What the event with this header is about, if it is one and says so.
    #[must_use]
    pub fn of(header: &Header) -> Option<Self> {
        let Header { correlation, flags, .. } = *header;
        if correlation == 0 || flags.has(Flags::REPLY) || flags.has(Flags::ASK) || !is_event(header) {
            return None;
        }
        // The lower half is the address, whatever is above.
        let node = NodeAddress::new(correlation as u32);
        Some(if correlation & END == 0 { Self::Node(node) } else { Self::End(node) })
    }

    /// Says so in the header of an event.
    pub fn write(self, header: &mut Header) {
        header.correlation = match self {
            Self::End(node) => END | u64::from(node.bits()),
            Self::Node(node) => u64::from(node.bits()),
        };
    }

    /// The node.
    #[must_use]
    pub const fn node(self) -> NodeAddress {
        match self {
            Self::End(node) | Self::Node(node) => node,
        }
    }
}
