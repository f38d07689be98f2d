//! The channels of a recording and the views of its messages as they come, without a file.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use super::{
    CHANNELS_MAX,
    channel::{Channel, Companion, View},
    records::{self, Fixed},
};
use crate::{
    protobuf::Output,
    terms::{ChannelId, ChannelInfo, ClockReading, Event, Origin, Record},
    view,
};

/// A channel of views: the description that a recording has of it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ViewChannel {
    /// The topic, such as `/knee.sensor/leg.angle/view`.
    pub topic: String,
    /// The encoding of the messages: `protobuf` or `json`.
    pub encoding: &'static str,
    /// The name of the schema, such as `sinew.leg.Angle`.
    pub schema_name: String,
    /// The encoding of the schema: `protobuf` (a `FileDescriptorSet`) or `jsonschema`.
    pub schema_encoding: &'static str,
    /// The schema.
    pub schema: Vec<u8>,
    /// The metadata that a recording has of this channel and of that of the payloads; those of this channel win.
    pub metadata: BTreeMap<String, String>,
}

/// A part of the stream of a [`ViewWriter`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ViewItem {
    /// A channel, before its first message.
    Channel(ViewChannel),
    /// A message of a wanted topic.
    Message {
        /// The topic of its channel.
        topic: Arc<str>,
        /// When it was handed over, in nanoseconds of the wall clock: the `log_time` of a recording.
        time_ns: u64,
        /// The view: the same bytes as in a recording.
        data: Vec<u8>,
    },
    /// Messages of a wanted topic that were not read in time.
    Missed {
        /// The topic of their channel.
        topic: Arc<str>,
        /// Their number.
        count: u64,
    },
}

/// A channel, and whether its messages are wanted.
#[derive(Debug)]
struct Viewed {
    channel: Channel,
    topic: Arc<str>,
    is_wanted: bool,
}

/// Takes the same channels and messages as a [`BagWriter`](crate::BagWriter), and makes a stream of views in place of a
/// file: with the same topics, schemas, metadata and bytes. Messages of other topics than the wanted ones are counted
/// and not encoded.
///
/// # Examples
///
/// ```
/// use std::collections::BTreeSet;
///
/// use sinew_bag::{ChannelInfo, Class, Direction, Origin, Party, Record, ViewItem, ViewWriter};
///
/// let mut views = ViewWriter::new(Origin::default());
/// views.want(&BTreeSet::from(["/knee.sensor/exo.angle/view".to_owned()]));
/// let party = Party { text: "127.0.0.2/1".into(), name: Some("knee.sensor".into()), ..Party::default() };
/// let channel = views.channel(&ChannelInfo {
///     source: &party,
///     destination: &party,
///     type_name: "exo.angle",
///     kind: 7,
///     class: Class::Stream,
///     direction: Direction::Sent,
///     is_protected: false,
///     schema: None,
///     refused: None,
///     seen_before: 0,
/// });
/// // The payload is {"degrees": 5}.
/// views.message(channel.expect("there is room"), &Record { payload: b"\x81\xa7degrees\x05", ..Record::default() });
/// let items = views.take();
/// assert!(matches!(&items[0], ViewItem::Channel(channel) if channel.encoding == "json"));
/// assert!(matches!(&items[1], ViewItem::Message { data, .. } if data.starts_with(b"{\"degrees\":5")));
/// ```
#[derive(Debug)]
pub struct ViewWriter {
    origin: Origin,
    channels: Vec<Viewed>,
    /// The topics in use, as each channel needs its own.
    topics: BTreeSet<String>,
    wanted: BTreeSet<String>,
    items: Vec<ViewItem>,
    events_lost: u64,
}

impl ViewWriter {
    /// Begins without channels.
    #[must_use]
    pub const fn new(origin: Origin) -> Self {
        Self {
            origin,
            channels: Vec::new(),
            topics: BTreeSet::new(),
            wanted: BTreeSet::new(),
            items: Vec::new(),
            events_lost: 0,
        }
    }

    /// Returns the channels that every recording has: tallies, clocks and events.
    #[must_use]
    pub fn fixed_channels() -> Vec<ViewChannel> {
        let describe = |of: &Fixed| ViewChannel {
            topic: of.topic.to_owned(),
            encoding: "json",
            schema_name: of.schema.to_owned(),
            schema_encoding: "jsonschema",
            schema: of.json_schema.as_bytes().to_vec(),
            metadata: BTreeMap::new(),
        };
        records::all().map(describe).collect()
    }

    /// Returns the channel of the first messages of this type from this source, as it will be if the schema is known:
    /// a program can offer it before it reads any message.
    #[must_use]
    pub fn expected(info: &ChannelInfo<'_>) -> ViewChannel {
        describe(&Channel::new(info, false, &mut BTreeSet::new()))
    }

    /// Sets the topics of which messages are encoded.
    pub fn want(&mut self, topics: &BTreeSet<String>) {
        self.wanted.clone_from(topics);
        for one in &mut self.channels {
            one.is_wanted = self.wanted.contains(&*one.topic);
        }
    }

    /// Adds a channel; `None` if there are as many as a recording may have.
    pub fn channel(&mut self, info: &ChannelInfo<'_>) -> Option<ChannelId> {
        if self.channels.len() >= CHANNELS_MAX {
            return None;
        }
        let channel = Channel::new(info, false, &mut self.topics);
        let topic: Arc<str> = channel.companion.topic.as_str().into();
        let is_wanted = self.wanted.contains(&*topic);
        let mut described = describe(&channel);
        let Origin { address, incarnation, .. } = &self.origin;
        for (key, value) in [("sinew.node", address.clone()), ("sinew.incarnation", incarnation.to_string())]
        {
            described.metadata.insert(key.to_owned(), value);
        }
        self.items.push(ViewItem::Channel(described));
        self.channels.push(Viewed { channel, topic, is_wanted });
        Some(ChannelId(self.channels.len() as u32 - 1))
    }

    /// Takes a message.
    ///
    /// # Panics
    /// If `channel` is of another writer.
    pub fn message(&mut self, channel: ChannelId, record: &Record<'_>) {
        let Viewed { channel, topic, is_wanted } = &mut self.channels[channel.0 as usize];
        channel.sees(record.number);
        channel.counts.written += 1;
        if !*is_wanted {
            return;
        }
        let mut view = Output::default();
        channel.counts.misfits += u64::from(!channel.companion(record, &mut view));
        let time_ns = self.origin.wall_ns(record.handed_over_ns);
        self.items.push(ViewItem::Message { topic: Arc::clone(topic), time_ns, data: view.0 });
    }

    /// Counts messages that were not read in time, between these two times.
    ///
    /// # Panics
    /// If `channel` is of another writer.
    pub fn dropped(&mut self, channel: ChannelId, count: u64, span_ns: (u64, u64)) {
        let Viewed { channel, topic, is_wanted } = &mut self.channels[channel.0 as usize];
        channel.counts.dropped += count;
        channel.counts.seen += count;
        if *is_wanted {
            self.items.push(ViewItem::Missed { topic: Arc::clone(topic), count });
        }
        let text = format!("{}: {count} messages were not read in time", channel.topic);
        let data = serde_json::json!({ "topic": channel.topic, "count": count });
        self.event(&records::gap(&text, &data, span_ns.1));
    }

    /// Takes the counters of all channels that changed.
    pub fn tally(&mut self, now_ns: u64) {
        if self.wants(&records::TALLY) {
            let channels = self.channels.iter_mut().map(|one| &mut one.channel);
            let text = records::tally(channels, 0, self.events_lost, false);
            self.record(&records::TALLY, now_ns, text);
        }
    }

    /// Takes the measured clock of another node.
    pub fn clock(&mut self, now_ns: u64, reading: &ClockReading) {
        if self.wants(&records::CLOCK) {
            let text = records::clock(&self.origin, now_ns, reading);
            self.record(&records::CLOCK, now_ns, text);
        }
    }

    /// Takes an event.
    pub fn event(&mut self, event: &Event<'_>) {
        let of = records::of_topic(event.topic);
        if self.wants(of) {
            let text = records::event(&self.origin, event);
            self.record(of, event.at_ns, text);
        }
    }

    /// Counts events that were not read in time.
    pub const fn lose_events(&mut self, count: u64) {
        self.events_lost = self.events_lost.saturating_add(count);
    }

    /// Returns the items since the last call. The caller bounds them by the number of messages that it gives at a time.
    pub fn take(&mut self) -> Vec<ViewItem> {
        std::mem::take(&mut self.items)
    }

    fn wants(&self, of: &Fixed) -> bool {
        self.wanted.contains(of.topic)
    }

    fn record(&mut self, of: &Fixed, now_ns: u64, text: String) {
        let time_ns = self.origin.wall_ns(now_ns);
        self.items.push(ViewItem::Message { topic: of.topic.into(), time_ns, data: text.into_bytes() });
    }
}

fn describe(channel: &Channel) -> ViewChannel {
    let Companion { topic, metadata, .. } = &channel.companion;
    let (schema_name, schema_encoding, schema) = channel.companion.schema();
    let mut all = channel.metadata.clone();
    all.extend(metadata.clone());
    ViewChannel {
        topic: topic.clone(),
        encoding: channel.companion.encoding(),
        schema_name,
        schema_encoding,
        schema,
        metadata: all,
    }
}

impl Companion {
    /// Returns the name of the schema, its encoding and its bytes.
    pub(super) fn schema(&self) -> (String, &'static str, Vec<u8>) {
        match &self.view {
            View::Typed(plan) => (plan.name(), "protobuf", plan.descriptor()),
            View::Header => (view::HEADER_TYPE.to_owned(), "protobuf", view::header_descriptor()),
            View::Json => ("sinew.json".to_owned(), "jsonschema", br#"{"type":"object"}"#.to_vec()),
        }
    }
}
