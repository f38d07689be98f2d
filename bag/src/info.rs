//! A summary of one file.

use std::{collections::BTreeMap, path::Path};

use serde::Serialize;

use crate::{
    error::{BagError, DamageList},
    read::{End, Item, Reader, Role},
};

/// A channel of a file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ChannelSummary {
    /// The topic.
    pub topic: String,
    /// The source; empty on channels of the recorder.
    pub source: String,
    /// The destination; empty on channels of the recorder.
    pub destination: String,
    /// The payload type, or the name of the schema.
    pub type_name: String,
    /// The class; empty on channels of the recorder.
    pub class: String,
    /// `sent` or `received`; empty on channels of the recorder.
    pub direction: String,
    /// Messages.
    pub messages: u64,
    /// Bytes of all messages.
    pub bytes: u64,
    /// The time of the first message, in nanoseconds of the file's wall clock.
    pub first_ns: u64,
    /// The time of the last message, in nanoseconds of the file's wall clock.
    pub last_ns: u64,
}

/// The summary of a file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Info {
    /// The path.
    pub file: String,
    /// Metadata of the recorder, such as the node and its incarnation.
    pub origin: BTreeMap<String, String>,
    /// Whether it has its summary. Otherwise its recorder was killed or could not write.
    pub is_finished: bool,
    /// Bytes of the file.
    pub bytes: u64,
    /// The time of the first message, in nanoseconds of the file's wall clock.
    pub first_ns: u64,
    /// The time of the last message, in nanoseconds of the file's wall clock.
    pub last_ns: u64,
    /// The channels of payloads and those of the recorder. The views are left out.
    pub channels: Vec<ChannelSummary>,
    /// Damaged records, which were skipped: the first 1,000, and the number of the others.
    pub damage: Vec<String>,
}

/// Sums up a file.
///
/// # Errors
/// It cannot be read, or is no MCAP file.
pub fn info(path: impl AsRef<Path>) -> Result<Info, BagError> {
    let path = path.as_ref();
    let mut reader = Reader::open(path)?;
    let mut info = Info { file: path.display().to_string(), first_ns: u64::MAX, ..Info::default() };
    let mut channels: BTreeMap<u16, ChannelSummary> = BTreeMap::new();
    let mut damage = DamageList::default();
    loop {
        match reader.next_item() {
            Ok(Some(Item::Metadata(_, fields))) => info.origin.extend(fields),
            Ok(Some(Item::Message(message))) => {
                let (log_ns, channel) = (message.log_ns, &message.channel);
                info.first_ns = info.first_ns.min(log_ns);
                info.last_ns = info.last_ns.max(log_ns);
                if matches!(channel.role(), Role::Beside(_)) {
                    continue;
                }
                let summary = channels.entry(channel.id).or_insert_with(|| summary(channel, log_ns));
                summary.messages += 1;
                summary.bytes += message.data.len() as u64;
                summary.first_ns = summary.first_ns.min(log_ns);
                summary.last_ns = summary.last_ns.max(log_ns);
            }
            Ok(None) => break,
            Err(error @ BagError::Damaged { .. }) => damage.add(&error),
            Err(error) => return Err(error),
        }
    }
    info.first_ns = info.first_ns.min(info.last_ns);
    info.is_finished = matches!(reader.end(), End::Finished { .. });
    info.bytes = std::fs::metadata(path).map_err(|cause| BagError::read(path, cause))?.len();
    info.channels = channels.into_values().collect();
    info.damage = damage.into_lines(path);
    Ok(info)
}

fn summary(channel: &crate::read::Channel, log_ns: u64) -> ChannelSummary {
    let named = |role: &str| {
        let name = channel.value(&format!("{role}_name"));
        if name.is_empty() { channel.value(role).to_owned() } else { name.to_owned() }
    };
    let own = channel.value("type");
    let schema = || channel.schema.as_ref().map(|schema| schema.name.clone()).unwrap_or_default();
    ChannelSummary {
        topic: channel.topic.clone(),
        source: named("source"),
        destination: named("destination"),
        type_name: if own.is_empty() { schema() } else { own.to_owned() },
        class: channel.value("class").to_owned(),
        direction: channel.value("direction").to_owned(),
        messages: 0,
        bytes: 0,
        first_ns: log_ns,
        last_ns: log_ns,
    }
}
