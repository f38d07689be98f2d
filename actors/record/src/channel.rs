//! The key of a channel in a journal's table.
//!
//! ```text
//! word 0  source
//!      1  destination
//!      2  bits 0..32 payload type, 32..40 class, 40..48 form, 48..56 rejection (0: accepted), others 0
//! ```

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Kind},
};
use sinew_shm::journal::ChannelKey;

/// The form of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Form {
    /// A message that an application of the node has sent, to any application.
    Sent,
    /// A message to an application of the node, from another node or from an application that is not recorded. Of a
    /// message to a group also that at a member of this node that rejected it.
    Received,
    /// A [`NodeFact`](crate::facts::NodeFact).
    Node,
    /// A [`ClockFact`](crate::facts::ClockFact).
    Clock,
    /// A [`LogFact`](crate::facts::LogFact).
    Log,
    /// An [`OutcomeEntry`](crate::outcome::OutcomeEntry).
    Outcome,
}

impl Form {
    /// All forms.
    pub const ALL: [Self; 6] =
        [Self::Sent, Self::Received, Self::Node, Self::Clock, Self::Log, Self::Outcome];

    /// Returns the number in a record.
    #[must_use]
    pub const fn code(self) -> u8 {
        self as u8 + 1
    }

    /// Returns the form with this number.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code).checked_sub(1)?).copied()
    }

    /// Returns whether it is that of messages.
    #[must_use]
    pub const fn is_message(self) -> bool {
        matches!(self, Self::Sent | Self::Received)
    }
}

/// A channel: messages of one type from one application to another, or facts or outcomes of one node.
///
/// # Examples
///
/// ```
/// use sinew_record::{Channel, Form};
/// use sinew_runtime::{tid::Tid, wire::{Class, Kind}};
///
/// let knee: Tid = "10.0.0.2/80000001".parse()?;
/// let torque = Channel {
///     source: knee,
///     destination: knee,
///     kind: Kind::named("demo.torque"),
///     class: Class::Stream,
///     form: Form::Sent,
///     refused: None,
/// };
/// assert_eq!(Channel::of(torque.key()), Some(torque));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// The sender; for a fact or an outcome the node's own address without an application.
    pub source: Tid,
    /// The destination; of received messages to a group, the member.
    pub destination: Tid,
    /// The payload type.
    pub kind: Kind,
    /// The class.
    pub class: Class,
    /// The form of its records.
    pub form: Form,
    /// Why the messages of this channel were rejected; `None` if they were accepted.
    pub refused: Option<Rejection>,
}

impl Channel {
    /// Returns the channel of all facts of a form, or of all outcomes, of a node.
    #[must_use]
    pub const fn of_node(node: NodeAddress, form: Form) -> Self {
        let (source, kind) = (Tid::new(node, AppAddress::NONE), Kind::from_bits(0));
        Self { source, destination: Tid::NONE, kind, class: Class::Control, form, refused: None }
    }

    /// Returns the key in the table.
    #[must_use]
    pub fn key(&self) -> ChannelKey {
        let (class, form) = (class_code(self.class), self.form.code());
        let bits = u64::from(self.kind.bits())
            | u64::from(class) << 32
            | u64::from(form) << 40
            | u64::from(refused_code(self.refused)) << 48;
        ChannelKey([self.source.bits(), self.destination.bits(), bits])
    }

    /// Reads a key. `None` if no writer of this version has written it.
    #[must_use]
    pub fn of(ChannelKey([source, destination, bits]): ChannelKey) -> Option<Self> {
        let [_, _, _, _, class, form, refused, rest] = bits.to_le_bytes();
        if rest != 0 {
            return None;
        }
        Some(Self {
            source: Tid::from_bits(source),
            destination: Tid::from_bits(destination),
            kind: Kind::from_bits(bits as u32),
            class: Class::ALL.get(usize::from(class)).copied()?,
            form: Form::from_code(form)?,
            refused: refused_of(refused)?,
        })
    }
}

const fn class_code(class: Class) -> u8 {
    match class {
        Class::Control => 0,
        Class::Stream => 1,
        Class::Bulk => 2,
    }
}

/// Returns 0 for an accepted message, else the byte of the outcome on the wire.
pub(crate) fn refused_code(refused: Option<Rejection>) -> u8 {
    refused.map_or(0, |why| Outcome::Rejected(why).code())
}

/// Reads such a byte; `None` if it is not assigned.
pub(crate) fn refused_of(code: u8) -> Option<Option<Rejection>> {
    match (code, Outcome::from_code(code)) {
        (0, _) => Some(None),
        (_, Some(Outcome::Rejected(why))) => Some(Some(why)),
        (
            _,
            Some(
                Outcome::Delivered
                | Outcome::Expired
                | Outcome::Failed
                | Outcome::PeerLost
                | Outcome::Unknown,
            )
            | None,
        ) => None,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Any key is that of a channel, or of none, and no two keys are those of one channel.
        #[test]
        fn any_key_is_read_or_refused(words in any::<[u64; 3]>(), small in any::<u32>()) {
            for key in [ChannelKey(words), ChannelKey([words[0], words[1], u64::from(small) << 24])] {
                if let Some(channel) = Channel::of(key) {
                    prop_assert_eq!(channel.key(), key);
                }
            }
        }
    }

    #[test]
    fn each_form_and_rejection_has_its_own_key() {
        let mut keys = std::collections::BTreeSet::new();
        let refusals = (0..=u8::MAX).filter_map(refused_of);
        let mut count = 0;
        for refused in refusals {
            for (form, class) in Form::ALL.into_iter().flat_map(|form| Class::ALL.map(|class| (form, class)))
            {
                let (source, kind) = (Tid::from_bits(7), Kind::named("test.any"));
                let channel = Channel { source, destination: source, kind, class, form, refused };
                assert_eq!(Channel::of(channel.key()), Some(channel));
                keys.insert(channel.key());
                count += 1;
            }
        }
        assert_eq!(keys.len(), count);
        assert!(count > 6 * 3 * 10);
    }
}
