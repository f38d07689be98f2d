//! The packets and puts that passed, and the rejected ones by cause.

use std::{collections::BTreeMap, fmt};

use crate::PacketError;

/// The cause for which a packet or a put was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DropCause {
    /// It is no packet that the link carries.
    Packet(PacketError),
    /// A packet of this host has a source address other than the host's.
    ForeignSource,
    /// A packet of this host leads out of the network.
    OutsideTarget,
    /// A discovery packet followed the last one of its port too soon. Discovery repeats it.
    GroupPace,
    /// A put is plain although this host has a project key, or encrypted although it has none.
    OtherMode,
    /// A put is not authentic: forged, altered, of another project or of another key.
    Forged,
    /// A put was received before, or is too old.
    Replayed,
    /// A received packet does not have the addresses that the put's key names.
    ForgedAddress,
    /// A received packet is for a port that is not served, and in no flow that this host began.
    ClosedPort,
    /// A host appeared while [`HOSTS_MAX`](crate::HOSTS_MAX) were present.
    TooManyHosts,
}

impl DropCause {
    /// Returns whether it occurs in normal operation: the kernel and other programs send such packets to every
    /// interface, and discovery repeats its own.
    #[must_use]
    pub const fn is_expected(self) -> bool {
        matches!(
            self,
            Self::Packet(PacketError::NotIpv4 | PacketError::OtherProtocol)
                | Self::OutsideTarget
                | Self::GroupPace
        )
    }
}

impl fmt::Display for DropCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Packet(error) => return error.fmt(f),
            Self::ForeignSource => "packets from an address that is not this host's",
            Self::OutsideTarget => "packets to an address outside of the network",
            Self::GroupPace => "discovery packets above their pace",
            Self::OtherMode => "puts in the other mode: only one end has a project key",
            Self::Forged => "puts that are not authentic: altered, or of another key",
            Self::Replayed => "puts that were received before",
            Self::ForgedAddress => "packets with other addresses than their put",
            Self::ClosedPort => "packets to a port that is not in `ports`",
            Self::TooManyHosts => "hosts beyond the maximum",
        })
    }
}

/// Counters of a link since its start.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Packets that became puts.
    pub sent: u64,
    /// Packets that were written to the device.
    pub received: u64,
    /// Dropped packets and puts, by cause. Causes that did not occur are absent.
    pub dropped: BTreeMap<DropCause, u64>,
}

impl Counts {
    pub(crate) fn dropped_one(&mut self, cause: DropCause) {
        *self.dropped.entry(cause).or_default() += 1;
    }

    /// Returns the number of packets and puts that were dropped for this cause.
    #[must_use]
    pub fn dropped_for(&self, cause: DropCause) -> u64 {
        self.dropped.get(&cause).copied().unwrap_or(0)
    }
}
