//! The state of one destination: with a link, on the way to one, or without one.

use sinew_runtime::{time::Time, wire::Class};

use super::LinkNumber;

/// Classes with a received mark.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Marks {
    classes: [bool; 3],
    pub(super) confirm: Option<u64>,
}

impl Marks {
    pub(super) const fn has(&self, class: Class) -> bool {
        self.classes[class as usize]
    }

    pub(super) fn are_all(&self) -> bool {
        self.classes == [true; 3]
    }

    /// Records a mark. Returns whether all have arrived.
    pub(super) fn note(&mut self, class: Class, confirm: Option<u64>) -> bool {
        self.classes[class as usize] = true;
        self.confirm = self.confirm.or(confirm);
        self.are_all()
    }
}

/// Whether the peer has accepted our SWITCH.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Switch {
    /// Never sent yet: messages go through the node. If this process ended now, its ring would not be read.
    Unsent {
        at: Time,
    },
    /// Sent; repeated at `again` without an answer.
    Sent {
        correlation: u64,
        again: Time,
    },
    /// To be sent again.
    Resend {
        at: Time,
    },
    Taken,
}

impl Switch {
    /// Returns when it must be sent, if no answer arrives before.
    pub(super) const fn due(&self) -> Option<Time> {
        match self {
            Self::Unsent { at } | Self::Resend { at } | Self::Sent { again: at, .. } => Some(*at),
            Self::Taken => None,
        }
    }
}

/// Whether the peer's ring is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PeerRing {
    Held(Marks),
    Open,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Peer {
    /// Through the node; a link is not requested before `until`.
    Refused { until: Time },
    /// Through the node. `count` messages were sent in the interval that ends at `until`.
    Counted { until: Time, count: u32 },
    /// Through the node; LNCL has been asked.
    Asked { correlation: u64, until: Time },
    /// Through the node; the peer has requested a link, and our offer is in the link's socket.
    Offered { number: LinkNumber, marks: Marks, ended_at: Option<Time> },
    /// Through our ring, until the peer has ended.
    Direct { number: LinkNumber, switch: Switch, peer_ring: PeerRing, ended_at: Option<Time> },
}

impl Peer {
    pub(super) const fn link(&self) -> Option<LinkNumber> {
        match self {
            Self::Refused { .. } | Self::Counted { .. } | Self::Asked { .. } => None,
            Self::Offered { number, .. } | Self::Direct { number, .. } => Some(*number),
        }
    }

    /// Returns the link that messages are written to.
    pub(super) const fn written_link(&self) -> Option<LinkNumber> {
        match self {
            Self::Direct { switch: Switch::Unsent { .. }, .. } => None,
            Self::Direct { number, ended_at: None, .. } => Some(*number),
            Self::Direct { .. }
            | Self::Refused { .. }
            | Self::Counted { .. }
            | Self::Asked { .. }
            | Self::Offered { .. } => None,
        }
    }

    /// Returns until when this state has an effect, if there is neither a link nor a request for one.
    pub(super) const fn expires(&self) -> Option<Time> {
        match self {
            Self::Refused { until } | Self::Counted { until, .. } => Some(*until),
            Self::Asked { .. } | Self::Offered { .. } | Self::Direct { .. } => None,
        }
    }

    pub(super) const fn correlation(&self) -> Option<u64> {
        match self {
            Self::Asked { correlation, .. }
            | Self::Direct { switch: Switch::Sent { correlation, .. }, .. } => Some(*correlation),
            Self::Refused { .. } | Self::Counted { .. } | Self::Offered { .. } | Self::Direct { .. } => None,
        }
    }
}
