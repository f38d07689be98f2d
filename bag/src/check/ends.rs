//! Both ends of each channel between two nodes.

use std::collections::{BTreeMap, BTreeSet};

use super::{EndReport, Finding, Kind, Report, file::Checked};
use crate::{
    read::Channel,
    sequences::{Sequences, ranges},
    terms::Direction,
};

/// Maximum spans of sequence numbers that a finding names.
const SPANS_MAX: usize = 8;

/// Source, destination, ID of the type, and class: the same at both ends. Not each node knows the name of the type.
type Key = [String; 4];

/// The first and the last number of each recording, by its begin.
type Spans = BTreeMap<u64, (u64, u64)>;

/// One end of a channel, of all parts together.
#[derive(Default)]
struct End {
    file: String,
    topic: String,
    /// The address of the node at the other end.
    other: String,
    labels: [String; 2],
    /// The name of the type, or its ID where this end does not know the name.
    type_name: String,
    sequences: Sequences,
    /// The recordings of each incarnation of the node. Between two of them it recorded nothing.
    incarnations: BTreeMap<u64, Spans>,
    dropped: u64,
}

/// Compares the ends, and names nodes without a given file.
pub(super) fn compare(files: &mut [Checked], report: &mut Report) {
    let given: BTreeSet<_> = files.iter().map(|file| file.report.address.clone()).collect();
    let [mut sent, mut received] = [BTreeMap::new(), BTreeMap::new()];
    for file in files.iter_mut() {
        collect(file, &mut sent, &mut received);
    }
    let mut absent: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for end in sent.values().chain(received.values()).filter(|end| !given.contains(&end.other)) {
        absent.entry(end.other.clone()).or_default().push(end.topic.clone());
    }
    for (node, topics) in absent {
        let text = format!(
            "no file of this node is given, so {} channels with it are checked at one end only",
            topics.len()
        );
        report.findings.push(Finding {
            kind: Kind::NoFile,
            file: String::new(),
            topic: node,
            text,
            from_ns: 0,
            to_ns: 0,
        });
    }
    for (key, mut end) in sent {
        end.sequences.settle();
        if given.contains(&end.other) {
            let mut other = received.remove(&key).unwrap_or_default();
            other.sequences.settle();
            both(&key, &end, &other, report);
        }
    }
}

fn collect(file: &mut Checked, sent: &mut BTreeMap<Key, End>, received: &mut BTreeMap<Key, End>) {
    let own = file.report.address.clone();
    for (topic, counted) in &mut file.channels {
        let Some(channel) = counted.channel.clone().filter(|channel| channel.value("refused").is_empty())
        else {
            continue;
        };
        let (ends, other) = match channel.direction() {
            Some(Direction::Sent) => (&mut *sent, channel.value("destination_node")),
            Some(Direction::Received) => (&mut *received, channel.value("source_node")),
            None => continue,
        };
        // Groups and broadcasts have no node, and messages within a node have one end.
        if other.is_empty() || other == own {
            continue;
        }
        let end = ends.entry(key(&channel)).or_default();
        (end.file, end.topic, end.other) = (file.report.file.clone(), topic.clone(), other.to_owned());
        end.labels = ["source", "destination"].map(|role| label(&channel, role));
        let type_name = channel.value("type");
        if end.type_name.is_empty() || type_name != nameless(channel.value("kind")) {
            type_name.clone_into(&mut end.type_name);
        }
        let numbers = &counted.sequences;
        if let (Some(first), Some(last)) = (numbers.first(), numbers.last()) {
            let spans = end.incarnations.entry(file.report.incarnation).or_default();
            let span = spans.entry(file.report.began_ns).or_insert((first, last));
            *span = (span.0.min(first), span.1.max(last));
        }
        end.sequences.absorb(std::mem::take(&mut counted.sequences));
        end.dropped = end.dropped.max(counted.last.dropped);
    }
}

/// Returns whether the number lies within a recording.
fn lies_within(spans: &Spans, number: u64) -> bool {
    spans.values().any(|(first, last)| (first..=last).contains(&&number))
}

fn key(channel: &Channel) -> Key {
    ["source_tid", "destination_tid", "kind", "class"].map(|key| channel.value(key).to_owned())
}

/// Returns the text that stands for the name of the type with this ID, where a node does not know the name.
fn nameless(kind: &str) -> String {
    kind.parse::<u32>().map_or_else(|_| kind.to_owned(), |kind| format!("{kind:08x}"))
}

fn label(channel: &Channel, role: &str) -> String {
    let name = channel.value(&format!("{role}_name"));
    if name.is_empty() { channel.value(role).to_owned() } else { name.to_owned() }
}

fn both(key: &Key, sent: &End, received: &End, report: &mut Report) {
    let [source, destination] = sent.labels.clone();
    let [_, _, kind, class] = key.clone();
    let id = nameless(&kind);
    let mut names = [&sent.type_name, &received.type_name].into_iter();
    let type_name = names.find(|name| !name.is_empty() && **name != id);
    let type_name = type_name.unwrap_or(&sent.type_name).clone();
    let is_stream = class == "Stream";
    let mut end = EndReport { source, destination, type_name, class, ..EndReport::default() };
    (end.sent, end.received) = (sent.sequences.len(), received.sequences.len());
    let mut find = |kind, end: &End, text: String| {
        let (file, topic) = (end.file.clone(), end.topic.clone());
        report.findings.push(Finding { kind, file, topic, text, from_ns: 0, to_ns: 0 });
    };
    let Some(last) = received.sequences.last() else {
        if end.sent > 0 {
            let text = format!(
                "{} messages were sent to a node whose file has none of them: not recorded there, or lost",
                end.sent
            );
            find(Kind::Lost, sent, text);
        }
        report.ends.push(end);
        return;
    };
    let missing = || sent.sequences.without(&received.sequences);
    let was_recorded = |number: &u64| received.incarnations.values().any(|spans| lies_within(spans, *number));
    end.after = missing().filter(|number| *number > last).count() as u64;
    let within = missing().filter(was_recorded).count() as u64;
    end.before = missing().count() as u64 - end.after - within;
    end.not_recorded = within.min(received.dropped);
    let lost = within - end.not_recorded;
    if is_stream {
        end.superseded_or_lost = lost;
    } else if lost > 0 {
        end.lost = lost;
        let numbers = ranges(missing().filter(was_recorded), SPANS_MAX);
        find(
            Kind::Lost,
            sent,
            format!("messages sent and not received: {lost}; their sequence numbers: {numbers}"),
        );
    }
    // Each incarnation of the source counts anew, and the other end does not know of which one a number is. So only a
    // number within the recordings of all incarnations is certainly absent.
    let has_any = !sent.incarnations.is_empty();
    let is_known =
        |number: &u64| has_any && sent.incarnations.values().all(|spans| lies_within(spans, *number));
    let unsent = || received.sequences.without(&sent.sequences).filter(is_known);
    let count = unsent().count() as u64;
    if count > sent.dropped {
        let numbers = ranges(unsent(), SPANS_MAX);
        find(
            Kind::Unsent,
            received,
            format!(
                "messages received that their source did not record: {count}; their sequence numbers: {numbers}"
            ),
        );
    }
    report.ends.push(end);
}
