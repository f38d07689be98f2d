//! Whether the peer takes the messages for its program.

use sinew_runtime::{
    protection::raw::ECHO,
    wire::{Flags, Header, Kind},
};

/// The peer's progress with the messages sent to it, at one moment. The peer itself writes a part of this and
/// can write arbitrary values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Taking {
    /// A value that changes whenever the peer takes bytes. It has no other meaning.
    pub mark: (u64, u64),
    /// Whether an application message is ready for the peer to take. If the peer's progress cannot be
    /// determined: whether an application message waits for room in the socket.
    pub leaves_some: bool,
}

/// Returns whether this is an application's message for the program at the other end. A program that only
/// sends need not read other frames. These are frames and events of the layers, outcomes, and messages that a
/// `NodeApi` answers or keeps by itself. They include replies, which may arrive after the wait has ended.
#[inline]
pub(super) fn is_for_the_program(header: &Header) -> bool {
    let is_kept = [Kind::PING, ECHO].contains(&header.kind) || header.flags.has(Flags::REPLY);
    header.kind.is_user() && !is_kept && !header.source.app.is_layer()
}
