//! The channels of all clients, and their numbers.

use std::collections::BTreeMap;

use crate::source::LiveChannel;

/// Channels of a server. Further ones are not offered.
const CHANNELS_MAX: usize = 4_096;

/// The channels of a server. A number is used once.
#[derive(Debug, Default)]
pub(super) struct Channels {
    by_topic: BTreeMap<String, (u32, LiveChannel)>,
    topics: BTreeMap<u32, String>,
    next: u32,
}

/// The result of adding a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    /// It was there, or there is no room.
    None,
    /// It is new, with this number.
    New(u32),
    /// It has another encoding or schema than before: the former number is withdrawn.
    Replaced { former: u32, new: u32 },
}

impl Channels {
    /// Adds a channel, or replaces one of the same topic.
    pub(super) fn put(&mut self, channel: LiveChannel) -> Change {
        let is_full = self.by_topic.len() >= CHANNELS_MAX;
        let former = match self.by_topic.get_mut(&channel.topic) {
            Some((_, known)) if is_same(known, &channel) => {
                known.metadata = channel.metadata;
                return Change::None;
            }
            Some((number, _)) => Some(*number),
            None if is_full => return Change::None,
            None => None,
        };
        self.next += 1;
        let new = self.next;
        self.topics.insert(new, channel.topic.clone());
        self.by_topic.insert(channel.topic.clone(), (new, channel));
        match former {
            Some(former) => {
                self.topics.remove(&former);
                Change::Replaced { former, new }
            }
            None => Change::New(new),
        }
    }

    /// Returns the topic of a number.
    pub(super) fn topic(&self, number: u32) -> Option<&str> {
        self.topics.get(&number).map(String::as_str)
    }

    /// Returns the number of a topic.
    pub(super) fn number(&self, topic: &str) -> Option<u32> {
        self.by_topic.get(topic).map(|(number, _)| *number)
    }

    /// Returns the channel of a number.
    pub(super) fn get(&self, number: u32) -> Option<&LiveChannel> {
        self.by_topic.get(self.topic(number)?).map(|(_, channel)| channel)
    }

    /// Returns all channels with their numbers.
    pub(super) fn all(&self) -> Vec<(u32, &LiveChannel)> {
        self.by_topic.values().map(|(number, channel)| (*number, channel)).collect()
    }
}

/// Returns whether a client reads the messages of both in the same way.
fn is_same(one: &LiveChannel, other: &LiveChannel) -> bool {
    (&one.encoding, &one.schema_name, &one.schema_encoding, &one.schema)
        == (&other.encoding, &other.schema_name, &other.schema_encoding, &other.schema)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(topic: &str, schema: &[u8]) -> LiveChannel {
        LiveChannel { topic: topic.to_owned(), schema: schema.to_vec(), ..LiveChannel::default() }
    }

    #[test]
    fn channel_with_another_schema_has_another_number() {
        let mut channels = Channels::default();
        assert_eq!(channels.put(channel("/a", b"1")), Change::New(1));
        assert_eq!(channels.put(channel("/b", b"1")), Change::New(2));
        assert_eq!(channels.put(channel("/a", b"1")), Change::None);
        assert_eq!(channels.put(channel("/a", b"2")), Change::Replaced { former: 1, new: 3 });
        assert_eq!(
            (channels.topic(1), channels.topic(3), channels.number("/a")),
            (None, Some("/a"), Some(3))
        );
        assert_eq!(channels.get(3).map(|found| &found.schema[..]), Some(&b"2"[..]));
        assert_eq!(channels.all().len(), 2);
    }

    #[test]
    fn channels_have_a_bound() {
        let mut channels = Channels::default();
        for number in 0..CHANNELS_MAX {
            assert_ne!(channels.put(channel(&number.to_string(), b"")), Change::None);
        }
        assert_eq!(channels.put(channel("further", b"")), Change::None);
        assert!(matches!(channels.put(channel("7", b"other")), Change::Replaced { .. }));
    }
}
