//! Both ends of each channel between two nodes.

use std::collections::BTreeMap;

use super::{
    EndReport, Finding, Kind, Report,
    file::Checked,
    times::{Placed, Recordings, SendTimes},
};
use crate::{
    clocks::{Node, Offsets},
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
    /// The address of this end's node.
    own: String,
    /// The address of the node at the other end.
    other: String,
    labels: [String; 2],
    /// The name of the type, or its ID where this end does not know the name.
    type_name: String,
    sequences: Sequences,
    /// The recordings of each incarnation of the node. Between two of them it recorded nothing.
    incarnations: BTreeMap<u64, Spans>,
    /// The counter of each recording, by its incarnation and its begin. Each recording counts from zero, and its parts
    /// continue each other.
    dropped: BTreeMap<(u64, u64), u64>,
    /// The send times of each file, with its clock and the begin of its recording.
    sent: Vec<((Node, i64), u64, SendTimes)>,
}

/// The recordings of each node with a given file, by its address.
type Given = BTreeMap<String, Recordings>;

/// Compares the ends, and names nodes without a given file.
pub(super) fn compare(files: &mut [Checked], offsets: &Offsets, report: &mut Report) {
    let mut given = Given::new();
    for file in files.iter() {
        let recordings = given.entry(file.report.address.clone()).or_default();
        if let Some(span_ns) = file.span_ns() {
            recordings.add((file.report.incarnation, file.report.began_ns), span_ns);
        }
    }
    let [mut sent, mut received] = [BTreeMap::new(), BTreeMap::new()];
    for file in files.iter_mut() {
        collect(file, &mut sent, &mut received);
    }
    let mut absent: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for end in sent.values().chain(received.values()).filter(|end| !given.contains_key(&end.other)) {
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
        let Some(recordings) = given.get(&end.other) else { continue };
        let mut other = received.remove(&key).unwrap_or_default();
        other.sequences.settle();
        if other.sequences.len() == 0 {
            let placed = place(&end, recordings, &given, offsets);
            let dropped = recordings.sum(other.dropped.iter().map(|(recording, count)| (*recording, *count)));
            none_received(&key, &end, &other, (&placed, dropped), report);
        } else {
            both(&key, &end, &other, &given, report);
        }
    }
}

fn collect(file: &mut Checked, sent: &mut BTreeMap<Key, End>, received: &mut BTreeMap<Key, End>) {
    let own = file.report.address.clone();
    let clock = file.clock();
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
        (end.file, end.topic) = (file.report.file.clone(), topic.clone());
        (end.own, end.other) = (own.clone(), other.to_owned());
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
        let dropped = end.dropped.entry((file.report.incarnation, file.report.began_ns)).or_default();
        *dropped = counted.last.dropped.max(*dropped);
        end.sent.push((clock.clone(), file.report.began_ns, std::mem::take(&mut counted.sent)));
    }
}

/// Compares the send times of all files with the recordings of the receiver.
fn place(sent: &End, recordings: &Recordings, given: &Given, offsets: &Offsets) -> Placed {
    let mut parts: BTreeMap<(u64, u64), Placed> = BTreeMap::new();
    for ((node, offset_ns), began_ns, times) in &sent.sent {
        let placed = recordings.place((node, *offset_ns), times, &sent.other, offsets);
        let sum = parts.entry((node.1, *began_ns)).or_default();
        sum.within += placed.within;
        sum.after += placed.after;
        sum.has_no_clock |= placed.has_no_clock;
    }
    let sum_of = |count: fn(&Placed) -> u64| {
        let counts = parts.iter().map(|(recording, placed)| (*recording, count(placed)));
        given.get(&sent.own).map_or(0, |own| own.sum(counts))
    };
    let mut sum = Placed {
        within: sum_of(|placed| placed.within),
        after: sum_of(|placed| placed.after),
        has_no_clock: parts.values().any(|placed| placed.has_no_clock),
    };
    // Two files of one node may have the same message.
    let count = sent.sequences.len();
    sum.within = sum.within.min(count);
    sum.after = sum.after.min(count - sum.within);
    sum
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

/// Returns the report of a channel, without its comparison.
fn describe(key: &Key, sent: &End, received: &End) -> EndReport {
    let [source, destination] = sent.labels.clone();
    let [_, _, kind, class] = key.clone();
    let id = nameless(&kind);
    let mut names = [&sent.type_name, &received.type_name].into_iter();
    let type_name = names.find(|name| !name.is_empty() && **name != id);
    let type_name = type_name.unwrap_or(&sent.type_name).clone();
    let (sent, received) = (sent.sequences.len(), received.sequences.len());
    EndReport { source, destination, type_name, class, sent, received, ..EndReport::default() }
}

fn find(kind: Kind, end: &End, text: String, report: &mut Report) {
    let (file, topic) = (end.file.clone(), end.topic.clone());
    report.findings.push(Finding { kind, file, topic, text, from_ns: 0, to_ns: 0 });
}

/// Reports a channel of which the receiver's files have no message: only those are lost that were sent while it
/// recorded, and that it did not count as dropped.
fn none_received(
    key: &Key,
    sent: &End,
    received: &End,
    (placed, dropped): (&Placed, u64),
    report: &mut Report,
) {
    let mut end = describe(key, sent, received);
    end.after = placed.after;
    end.before = end.sent - placed.within - placed.after;
    end.not_recorded = placed.within.min(dropped);
    let lost = placed.within - end.not_recorded;
    if lost > 0 {
        let when = if placed.has_no_clock {
            "it is unknown whether they were sent before its recording began, as no clock reading connects the two nodes"
        } else {
            "they were sent while it recorded"
        };
        let text = format!(
            "{lost} messages were sent to a node whose file has none of them: not recorded there, or lost; {when}"
        );
        find(Kind::Lost, sent, text, report);
    }
    report.ends.push(end);
}

/// Returns how many of these numbers, in their order, the recordings of an end can have dropped. Where recordings
/// overlap in time, each that has both earlier and later messages must have dropped the number.
fn excused(end: &End, given: &Given, numbers: impl Iterator<Item = u64>) -> u64 {
    let groups = given.get(&end.own).map(Recordings::groups).unwrap_or_default();
    let mut left: BTreeMap<usize, Vec<DropBudget>> = BTreeMap::new();
    for (incarnation, spans) in &end.incarnations {
        for (began_ns, span) in spans {
            let recording = (*incarnation, *began_ns);
            // One without a tally has counted nothing.
            let Some(group) = groups.get(&recording) else { continue };
            let dropped = end.dropped.get(&recording).copied().unwrap_or(0);
            left.entry(*group).or_default().push(DropBudget { span: *span, left: dropped });
        }
    }
    numbers.filter(|number| left.values_mut().any(|group| excuse(group, *number))).count() as u64
}

/// The counted drops of a recording that no missing message has used yet.
struct DropBudget {
    /// The first and the last number in the recording.
    span: (u64, u64),
    left: u64,
}

impl DropBudget {
    fn covers(&self, number: u64) -> bool {
        (self.span.0..=self.span.1).contains(&number)
    }
}

/// Takes the number from the counters of dropped messages of all recordings of a group that it lies within. Returns
/// `false` if there is none, or if one has no dropped message left.
fn excuse(group: &mut [DropBudget], number: u64) -> bool {
    let mut within = group.iter().filter(|recording| recording.covers(number)).peekable();
    if within.peek().is_none() || within.any(|recording| recording.left == 0) {
        return false;
    }
    group.iter_mut().filter(|recording| recording.covers(number)).for_each(|recording| recording.left -= 1);
    true
}

fn both(key: &Key, sent: &End, received: &End, given: &Given, report: &mut Report) {
    let Some(last) = received.sequences.last() else { return };
    let mut end = describe(key, sent, received);
    let is_stream = end.class == "Stream";
    let missing = || sent.sequences.without(&received.sequences);
    let was_recorded = |number: &u64| received.incarnations.values().any(|spans| lies_within(spans, *number));
    end.after = missing().filter(|number| *number > last).count() as u64;
    let within = missing().filter(was_recorded).count() as u64;
    end.before = missing().count() as u64 - end.after - within;
    end.not_recorded = excused(received, given, missing().filter(was_recorded));
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
            report,
        );
    }
    // Each incarnation of the source counts anew, and the other end does not know of which one a number is. So only a
    // number within the recordings of all incarnations is certainly absent.
    let has_any = !sent.incarnations.is_empty();
    let is_known =
        |number: &u64| has_any && sent.incarnations.values().all(|spans| lies_within(spans, *number));
    let unsent = || received.sequences.without(&sent.sequences).filter(is_known);
    let count = unsent().count() as u64;
    if count > excused(sent, given, unsent()) {
        let numbers = ranges(unsent(), SPANS_MAX);
        find(
            Kind::Unsent,
            received,
            format!(
                "messages received that their source did not record: {count}; their sequence numbers: {numbers}"
            ),
            report,
        );
    }
    report.ends.push(end);
}
