//! A channel of a recording: its topics, its metadata and its counters.

use std::collections::{BTreeMap, BTreeSet};

use crate::{
    terms::{ChannelInfo, Party},
    view,
};

/// The counters of a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Counts {
    /// Messages that the node had since the recording began, by the number of the last one.
    pub(super) seen: u64,
    pub(super) written: u64,
    pub(super) dropped: u64,
    pub(super) misfits: u64,
}

/// The form of the message that stands beside each payload.
#[derive(Debug)]
pub(super) enum View {
    /// The payload as a message of protocol buffers, and the header.
    Typed(Box<view::View>),
    /// The payload as JSON, and the header.
    Json,
    /// The header alone.
    Header,
}

/// The channel beside that of the payloads.
#[derive(Debug)]
pub(super) struct Companion {
    pub(super) view: View,
    pub(super) topic: String,
    pub(super) metadata: BTreeMap<String, String>,
}

/// A channel.
#[derive(Debug)]
pub(super) struct Channel {
    /// The topic of the payloads.
    pub(super) topic: String,
    pub(super) metadata: BTreeMap<String, String>,
    pub(super) companion: Companion,
    seen_before: u64,
    pub(super) counts: Counts,
    /// The counters in the last tally.
    pub(super) tallied: Option<Counts>,
    /// Written messages in the current chunk.
    pub(super) unsaved: u64,
    /// The part in which both channels stand, and their numbers there.
    pub(super) placed: Option<(u32, [u16; 2])>,
}

impl Channel {
    pub(super) fn new(info: &ChannelInfo<'_>, raw_only: bool, topics: &mut BTreeSet<String>) -> Self {
        let typed = || info.schema.and_then(|schema| view::View::new(info.type_name, schema));
        let view = if raw_only {
            View::Header
        } else {
            typed().map_or(View::Json, |view| View::Typed(Box::new(view)))
        };
        let role = match view {
            View::Typed(_) => "view",
            View::Json => "json",
            View::Header => "header",
        };
        let topic = topic(info, topics);
        let beside = unique(format!("{topic}/{}", if raw_only { "header" } else { "view" }), topics);
        let mut metadata = metadata(info);
        metadata.insert("sinew.role".to_owned(), "raw".to_owned());
        metadata.insert("sinew.view".to_owned(), beside.clone());
        let own = [("sinew.role", role), ("sinew.raw", &topic)];
        let own = own.map(|(key, value)| (key.to_owned(), value.to_owned()));
        Self {
            companion: Companion { view, topic: beside, metadata: own.into() },
            topic,
            metadata,
            seen_before: info.seen_before,
            counts: Counts::default(),
            tallied: None,
            unsaved: 0,
            placed: None,
        }
    }

    /// Notes the number of a message.
    pub(super) fn sees(&mut self, number: u64) {
        self.counts.seen = self.counts.seen.max(number.saturating_sub(self.seen_before));
    }
}

fn metadata(info: &ChannelInfo<'_>) -> BTreeMap<String, String> {
    let mut all = BTreeMap::new();
    let mut put = |key: &str, value: String| all.insert(format!("sinew.{key}"), value);
    for (role, Party { tid, text, name, node }) in
        [("source", info.source), ("destination", info.destination)]
    {
        put(role, text.clone());
        put(&format!("{role}_tid"), tid.to_string());
        put(&format!("{role}_name"), name.clone().unwrap_or_default());
        put(&format!("{role}_node"), node.clone().unwrap_or_default());
    }
    put("type", info.type_name.to_owned());
    put("kind", info.kind.to_string());
    put("class", info.class.to_string());
    put("direction", info.direction.to_string());
    put("protected", info.is_protected.to_string());
    put("seen_before", info.seen_before.to_string());
    put("refused", info.refused.unwrap_or_default().to_owned());
    let schema = info.schema.and_then(|schema| serde_json::to_string(schema).ok());
    put("schema", schema.unwrap_or_default());
    all
}

/// Chooses the topic: source and type, and as much more as makes it the only one.
fn topic(info: &ChannelInfo<'_>, topics: &mut BTreeSet<String>) -> String {
    let mut topic = format!("/{}/{}", info.source.label(), info.type_name);
    if info.refused.is_some() {
        topic += "/rejected";
    }
    let more = [
        String::new(),
        format!("/to/{}", info.destination.label()),
        format!("/{}", info.direction),
        format!("/{}", info.class),
    ];
    for part in more {
        topic += &part;
        if topics.insert(topic.clone()) {
            return topic;
        }
    }
    unique(topic, topics)
}

fn unique(topic: String, topics: &mut BTreeSet<String>) -> String {
    let mut found = topic.clone();
    for number in 2_u32.. {
        if topics.insert(found.clone()) {
            break;
        }
        found = format!("{topic}/{number}");
    }
    found
}
