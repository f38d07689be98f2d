//! The channels of a recording, and which of them have copies of the messages of others.

use std::collections::BTreeMap;

use sinew_bag::{
    Direction,
    read::{Channel, Role},
};
use sinew_runtime::{
    tid::Tid,
    wire::{Class, Kind},
};
use sinew_schema::Schema;

use crate::Order;

/// A channel of payloads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordedChannel {
    /// The topic in the first file that has it.
    pub topic: String,
    /// The sender.
    pub source: Tid,
    /// The name of the sender.
    pub source_name: Option<String>,
    /// The destination.
    pub destination: Tid,
    /// The name of the destination: of an application, or of a group.
    pub destination_name: Option<String>,
    /// The type of the payload.
    pub kind: Kind,
    /// The name of the type.
    pub type_name: String,
    /// The class.
    pub class: Class,
    /// Whether the recording node sent the messages.
    pub direction: Direction,
    /// Whether the payloads have envelopes of protection.
    pub is_protected: bool,
    /// Whether its messages were rejected.
    pub is_refused: bool,
    /// The structure of the type, where the recording has it.
    pub schema: Option<Schema>,
}

/// The parts by which a channel of one file is that of another one.
pub(crate) type ChannelKey = (Tid, Tid, Kind, Class, Direction, bool, bool);

impl RecordedChannel {
    /// Reads the metadata of a channel; `None` if it has no payloads of Sinew.
    pub(crate) fn of(channel: &Channel) -> Option<Self> {
        if channel.role() != Role::Raw {
            return None;
        }
        let tid = |key: &str| channel.value(key).parse().ok().map(Tid::from_bits);
        let text = |key: &str| Some(channel.value(key).to_owned()).filter(|text| !text.is_empty());
        let class = match channel.class()? {
            sinew_bag::Class::Control => Class::Control,
            sinew_bag::Class::Stream => Class::Stream,
            sinew_bag::Class::Bulk => Class::Bulk,
        };
        Some(Self {
            topic: channel.topic.clone(),
            source: tid("source_tid")?,
            source_name: text("source_name"),
            destination: tid("destination_tid")?,
            destination_name: text("destination_name"),
            kind: channel.value("kind").parse().ok().map(Kind::from_bits)?,
            type_name: channel.value("type").to_owned(),
            class,
            direction: channel.direction()?,
            is_protected: channel.value("protected") == "true",
            is_refused: !channel.value("refused").is_empty(),
            schema: serde_json::from_str(channel.value("schema")).ok(),
        })
    }

    pub(crate) const fn key(&self) -> ChannelKey {
        let Self { source, destination, kind, class, direction, is_protected, is_refused, .. } = *self;
        (source, destination, kind, class, direction, is_protected, is_refused)
    }

    /// Returns whether messages of this channel are in `other`, too, which is a channel of the same source, type and
    /// class.
    fn is_copy_of(&self, other: &Self, order: Order) -> bool {
        let is_of_many = !other.destination.is_single();
        if other.is_refused {
            return false;
        }
        if self.is_refused {
            // A member of a group that rejects a message has a record of its own.
            return is_of_many;
        }
        let is_same = other.destination == self.destination;
        match order {
            Order::Sent => {
                (self.direction, other.direction) == (Direction::Received, Direction::Sent)
                    && (is_same || is_of_many)
            }
            Order::Arrived => {
                (self.direction, other.direction) == (Direction::Sent, Direction::Received)
                    && (is_same || !self.destination.is_single())
            }
        }
    }
}

/// Returns, for each channel, whether its messages are wanted: a merged file has a message where it was sent and where
/// it arrived.
pub(crate) fn without_copies<'c>(
    channels: impl Iterator<Item = &'c RecordedChannel> + Clone,
    order: Order,
) -> Vec<bool> {
    let group = |channel: &RecordedChannel| (channel.source, channel.kind, channel.class);
    let mut groups: BTreeMap<_, Vec<&RecordedChannel>> = BTreeMap::new();
    for channel in channels.clone() {
        groups.entry(group(channel)).or_default().push(channel);
    }
    let is_wanted = |channel: &RecordedChannel| {
        let mut others = groups.get(&group(channel)).into_iter().flatten();
        others.all(|other| !channel.is_copy_of(other, order))
    };
    channels.map(is_wanted).collect()
}
