//! Where each value submitted to a peer's datagram channel is, for an audit.

/// Counters of the submitted values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Values sent at least once.
    pub sent: u64,
    /// Values superseded before they were sent.
    pub superseded: u64,
    /// Values that expired before they were sent.
    pub expired: u64,
    /// Values that were queued when the channel ended.
    pub lost: u64,
    /// Values that were sent, and dropped because they were too old.
    pub expired_late: u64,
    /// Values that were sent, and may or may not have arrived.
    pub unknown: u64,
}

/// Where each value is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Position {
    pub counts: Counts,
    /// Values not sent yet.
    pub waiting: u64,
    /// Values sent, and neither acknowledged nor dropped as lost.
    pub unacknowledged: u64,
    /// Values received by the peer.
    pub arrived: u64,
}

impl Position {
    /// Returns the number of superseded values that have not arrived, sent or not.
    pub fn superseded(&self) -> u64 {
        self.counts.superseded + self.ended().0
    }

    /// Returns the number of expired values that are not known to have arrived after all.
    pub fn expired(&self) -> u64 {
        self.counts.expired + self.ended().1
    }

    /// Returns the number of sent values of unknown arrival.
    pub fn unknown(&self) -> u64 {
        self.ended().2
    }

    /// Returns the number of all submitted values.
    pub const fn taken(&self) -> u64 {
        let Counts { sent, superseded, expired, lost, .. } = self.counts;
        sent + superseded + expired + lost + self.waiting
    }

    /// Returns the sent values that have neither arrived nor are in flight: superseded, expired, unknown. If
    /// an acknowledgement was lost, these are fewer than were counted at their end.
    fn ended(&self) -> (u64, u64, u64) {
        let rest = self.counts.sent - self.unacknowledged - self.arrived;
        let expired = self.counts.expired_late.min(rest);
        let unknown = self.counts.unknown.min(rest - expired);
        (rest - expired - unknown, expired, unknown)
    }
}
