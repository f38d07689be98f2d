//! When an endpoint has direct links with other processes of its node.

#[cfg(doc)]
use super::Registration;

/// When an endpoint has direct links: rings in shared memory to and from another process of the node, which
/// bypass the node. Both sides must accept links, and each link costs both a ring of
/// [`Registration::direct_ring_bytes`].
///
/// | value | accepts links that others request | requests a link to another endpoint |
/// | --- | --- | --- |
/// | `Automatic` | yes | at the 8th message to it within one second |
/// | `Always` | yes | at the first message to it |
/// | `Never` | no | never |
///
/// An endpoint has 64 links at most, 16 if they are automatic: with more frequent peers than that, all of them are
/// reached through the node, which is quicker then. Messages to further peers go through the node, too. An endpoint
/// that guards an output makes no automatic link from then on.
///
/// # Examples
///
/// ```
/// use sinew::{Registration, client::DirectLinks};
///
/// // Has links with the peers of its control loop, and none with those that get a command now and then.
/// let gait = Registration::new().name("gait").direct(DirectLinks::Automatic);
/// // Has its link early, with the first message before the control loop begins.
/// let drive = Registration::new().name("knee.drive").direct(DirectLinks::Always);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum DirectLinks {
    /// Accepts links, and requests one to each peer with frequent messages: at the 8th message within one
    /// second. A control loop at 1 kHz has its link after 8 ms; an occasional command costs no memory.
    #[default]
    Automatic,
    /// Accepts links, and requests one at the first message to a peer.
    Always,
    /// Sends and receives all messages through the node.
    Never,
}

impl DirectLinks {
    /// Returns whether links that other endpoints request are accepted.
    pub(super) const fn accepts(self) -> bool {
        match self {
            Self::Automatic | Self::Always => true,
            Self::Never => false,
        }
    }
}
