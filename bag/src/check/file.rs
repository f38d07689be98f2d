//! The law of conservation in one file.

use std::{collections::BTreeMap, io::Read, sync::Arc};

use serde::Deserialize;

use super::{ChannelCounts, FINDINGS_MAX, FileReport, Finding, Kind, times::SendTimes};
use crate::{
    clocks::{Node, Offsets, Reading},
    error::BagError,
    merge::{MERGED, MERGED_FILES},
    read::{Channel, End, Header, Item, Message, Reader, Role},
    sequences::Sequences,
    terms::Direction,
    writer::{CLOCK_TOPIC, METADATA, TALLY_TOPIC},
};

/// Maximum gaps between two tallies that are named.
const GAPS_MAX: usize = 16;

/// A tally, as it stands in the file.
#[derive(Debug, Deserialize)]
struct Tally {
    #[serde(default)]
    is_whole: bool,
    #[serde(default)]
    events_lost: u64,
    channels: Vec<Tallied>,
}

/// The counters of a channel.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
pub(super) struct Tallied {
    topic: String,
    pub(super) seen: u64,
    pub(super) written: u64,
    pub(super) dropped: u64,
}

/// A raw message that waits for the one beside it.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    sequence: u32,
    log_ns: u64,
}

/// A difference between a tally and the file.
#[derive(Debug)]
struct Doubt {
    /// Messages that were written, less those in the file.
    difference: i128,
    /// From the tally before to this one.
    span_ns: (u64, u64),
    gaps: Vec<(u64, u64)>,
}

/// The messages and the counters of one channel.
#[derive(Debug, Default)]
pub(super) struct Counted {
    pub(super) channel: Option<Arc<Channel>>,
    /// Messages in the file.
    pub(super) in_file: u64,
    /// Messages in the file at the last tally.
    tallied_in_file: u64,
    /// The counters with which this part began.
    pub(super) base: Option<Tallied>,
    /// The counters of the last tally.
    pub(super) last: Tallied,
    /// Written messages beyond those in the file, found and reported.
    known: i128,
    /// A difference at the last tally that is not reported yet: the tally itself may be false.
    doubt: Option<Doubt>,
    /// The number of the last message with a header.
    last_number: Option<u64>,
    /// Numbers since the last tally that no message has, first and last.
    gaps: Vec<(u64, u64)>,
    waiting: Option<Waiting>,
    pub(super) sequences: Sequences,
    /// The send times of messages that this node sent.
    pub(super) sent: SendTimes,
}

/// A file that was read.
#[derive(Debug, Default)]
pub(super) struct Checked {
    pub(super) report: FileReport,
    pub(super) channels: BTreeMap<String, Counted>,
    pub(super) findings: Vec<Finding>,
    last_tally_ns: u64,
    /// The times of the first and the last tally, in nanoseconds of the file's wall clock.
    tallied_ns: Option<(u64, u64)>,
    /// Wall clock minus monotonic clock, in nanoseconds.
    wall_offset_ns: i64,
}

impl Checked {
    /// Returns the order of files: node, recording, part.
    pub(super) fn order(&self) -> (&str, u64, u64, u32) {
        let FileReport { address, incarnation, began_ns, part, .. } = &self.report;
        (address, *incarnation, *began_ns, *part)
    }

    /// Returns the clock of the file: its node, and the nanoseconds from the monotonic clock to the wall clock.
    pub(super) fn clock(&self) -> (Node, i64) {
        ((self.report.address.clone(), self.report.incarnation), self.wall_offset_ns)
    }

    /// Returns the times of the first and the last tally, in nanoseconds of the monotonic clock.
    pub(super) fn span_ns(&self) -> Option<(i128, i128)> {
        let monotonic = |wall_ns: u64| i128::from(wall_ns) - i128::from(self.wall_offset_ns);
        self.tallied_ns.map(|(first_ns, last_ns)| (monotonic(first_ns), monotonic(last_ns)))
    }

    fn find(&mut self, kind: Kind, topic: &str, text: String, span_ns: (u64, u64)) {
        if self.findings.len() < FINDINGS_MAX {
            let (file, (from_ns, to_ns)) = (self.report.file.clone(), span_ns);
            self.findings.push(Finding { kind, file, topic: topic.to_owned(), text, from_ns, to_ns });
        }
    }
}

/// Reads a file to its end, and notes its clock readings in `offsets`.
pub(super) fn read<R: Read>(mut reader: Reader<R>, offsets: &mut Offsets) -> Result<Checked, BagError> {
    let file = reader.path().display().to_string();
    let mut checked = Checked { report: FileReport { file, ..FileReport::default() }, ..Checked::default() };
    let (mut has_origin, mut messages) = (false, 0);
    loop {
        match reader.next_item() {
            Ok(Some(Item::Metadata(name, fields))) if name == METADATA => {
                checked.origin(&fields);
                has_origin = true;
            }
            Ok(Some(Item::Metadata(name, fields))) if name == MERGED => {
                return Err(merged(&checked.report.file, fields.get(MERGED_FILES)));
            }
            Ok(Some(Item::Metadata(..))) => {}
            Ok(Some(Item::Message(message))) => {
                messages += 1;
                checked.message(&message);
                if has_origin && message.channel.topic == CLOCK_TOPIC {
                    checked.reading(&message, offsets);
                }
            }
            Ok(None) => break,
            Err(error @ BagError::Damaged { .. }) => {
                checked.find(Kind::Damaged, "", error.to_string(), (checked.last_tally_ns, 0));
            }
            Err(error) => return Err(error),
        }
    }
    if !has_origin {
        let text = "it does not name the node that recorded it; give the files that `sinew record` wrote";
        return Err(BagError::Unfit(format!("{}: {text}", checked.report.file)));
    }
    checked.end(reader.end(), messages);
    Ok(checked)
}

/// Returns why a merged file is refused: a merged file has the order of its times, and a tally is true only in the
/// order in which its file was written.
fn merged(file: &str, former: Option<&String>) -> BagError {
    let former = former.map_or_else(String::new, |former| format!(": {former}"));
    BagError::Unfit(format!(
        "{file}: it is a merged file: its messages are sorted by time, so its tallies do not prove that none is missing; check the files that it was made of{former}"
    ))
}

impl Checked {
    fn origin(&mut self, fields: &BTreeMap<String, String>) {
        let text = |key: &str| fields.get(key).cloned().unwrap_or_default();
        let report = &mut self.report;
        (report.node, report.address) = (text("node"), text("address"));
        report.incarnation = text("incarnation").parse().unwrap_or(0);
        report.began_ns = text("began_ns").parse().unwrap_or(0);
        report.part = text("part").parse().unwrap_or(0);
        self.wall_offset_ns = text("wall_offset_ns").parse().unwrap_or(0);
    }

    fn reading(&self, message: &Message<'_>, offsets: &mut Offsets) {
        // Without a reading the two clocks are compared by the others.
        let Ok(reading) = serde_json::from_slice::<Reading>(message.data) else { return };
        let (node, offset_ns) = self.clock();
        offsets.note(&node, offset_ns, &reading);
    }

    fn message(&mut self, message: &Message<'_>) {
        let channel = &message.channel;
        match channel.role() {
            Role::Raw => self.raw(message),
            Role::Beside(raw) => self.beside(raw, message),
            Role::Other if channel.topic == TALLY_TOPIC => self.tally(message),
            Role::Other => {}
        }
    }

    fn raw(&mut self, message: &Message<'_>) {
        let topic = message.channel.topic.clone();
        let counted = self.channels.entry(topic.clone()).or_default();
        counted.channel = Some(Arc::clone(&message.channel));
        counted.in_file += 1;
        if message.channel.direction() == Some(Direction::Sent) {
            counted.sent.insert(message.publish_ns);
        }
        let waiting = Waiting { sequence: message.sequence, log_ns: message.log_ns };
        if let Some(alone) = counted.waiting.replace(waiting) {
            self.without_view(&topic, alone);
        }
    }

    /// The view of a message was cut out. The payload is there, so no message is missing.
    fn without_view(&mut self, topic: &str, Waiting { sequence, log_ns }: Waiting) {
        let text = format!("the view of the message with sequence {sequence} (lower 32 bits) is missing");
        self.find(Kind::Missing, topic, text, (log_ns, log_ns));
    }

    fn beside(&mut self, raw: &str, message: &Message<'_>) {
        let Some(header) = Header::of(message) else { return };
        let counted = self.channels.entry(raw.to_owned()).or_default();
        counted.sequences.insert(header.sequence);
        let expected = counted.last_number.map_or(header.number, |last| last.saturating_add(1));
        if expected < header.number && counted.gaps.len() < GAPS_MAX {
            counted.gaps.push((expected, header.number - 1));
        }
        counted.last_number = Some(header.number);
        let waiting = counted.waiting.take();
        let is_pair =
            |found: &Waiting| found.sequence == header.sequence as u32 && found.log_ns == message.log_ns;
        if waiting.as_ref().is_some_and(is_pair) {
            return;
        }
        // The payload was cut out: its number is known, so the tally does not report it again.
        counted.known += 1;
        let text =
            format!("message {} (sequence {}) is missing; its view is there", header.number, header.sequence);
        self.find(Kind::Missing, raw, text, (message.log_ns, message.log_ns));
        if let Some(alone) = waiting {
            self.without_view(raw, alone);
        }
    }

    fn tally(&mut self, message: &Message<'_>) {
        let (before_ns, now_ns) = (self.last_tally_ns, message.log_ns);
        let tally: Tally = match serde_json::from_slice(message.data) {
            Ok(tally) => tally,
            Err(error) => {
                let text = format!("a tally cannot be read: {error}");
                return self.find(Kind::Counter, TALLY_TOPIC, text, (now_ns, now_ns));
            }
        };
        let (first_ns, last_ns) = self.tallied_ns.unwrap_or((now_ns, now_ns));
        self.tallied_ns = Some((first_ns.min(now_ns), last_ns.max(now_ns)));
        let is_first = before_ns == 0 && self.channels.is_empty();
        self.report.events_lost = tally.events_lost;
        for tallied in tally.channels {
            let counted = self.channels.entry(tallied.topic.clone()).or_default();
            if is_first && tally.is_whole {
                counted.base = Some(tallied.clone());
            }
            let last = std::mem::replace(&mut counted.last, tallied.clone());
            self.add_up(&tallied, &last, now_ns);
        }
        let topics: Vec<_> = self.channels.keys().cloned().collect();
        for topic in topics {
            self.compare(&topic, (before_ns, now_ns));
        }
        self.last_tally_ns = now_ns;
    }

    /// seen = written + dropped, and no counter runs backwards.
    fn add_up(&mut self, now: &Tallied, last: &Tallied, at_ns: u64) {
        let Tallied { topic, seen, written, dropped } = now;
        if u128::from(*seen) != u128::from(*written) + u128::from(*dropped) {
            let text =
                format!("{seen} seen are not {written} written and {dropped} dropped: a counter is false");
            self.find(Kind::Counter, topic, text, (at_ns, at_ns));
        }
        if seen < &last.seen || written < &last.written || dropped < &last.dropped {
            let text = format!(
                "a counter runs backwards: {} seen, {} written, {} dropped, then {seen}, {written}, {dropped}",
                last.seen, last.written, last.dropped
            );
            self.find(Kind::Counter, topic, text, (at_ns, at_ns));
        }
    }

    /// Compares the messages in the file with the counter of the last tally.
    fn compare(&mut self, topic: &str, span_ns: (u64, u64)) {
        let Some(counted) = self.channels.get_mut(topic) else { return };
        counted.tallied_in_file = counted.in_file;
        let base = counted.base.as_ref().map_or(0, |base| base.written);
        let stated = i128::from(counted.last.written) - i128::from(base);
        let difference = stated - i128::from(counted.in_file) - counted.known;
        let gaps = std::mem::take(&mut counted.gaps);
        let doubt = counted.doubt.take();
        let rest =
            difference - doubt.as_ref().map_or(0, |doubt| if difference == 0 { 0 } else { doubt.difference });
        if rest != 0 {
            counted.doubt = Some(Doubt { difference: rest, span_ns, gaps });
        }
        let Some(doubt) = doubt else { return };
        if difference == 0 {
            let text = format!(
                "the counter of written messages is wrong by {} in this tally alone",
                doubt.difference
            );
            self.find(Kind::Counter, topic, text, (doubt.span_ns.1, doubt.span_ns.1));
        } else {
            counted.known += doubt.difference;
            self.differs(topic, &doubt);
        }
    }

    fn differs(&mut self, topic: &str, Doubt { difference, span_ns, gaps }: &Doubt) {
        let (kind, mut text) = match difference {
            0.. => (Kind::Missing, format!("messages missing between two tallies: {difference}")),
            _ => (Kind::Uncounted, format!("messages that its recorder did not count: {}", -difference)),
        };
        if !gaps.is_empty() {
            text += &format!("; no message has the numbers {}", crate::sequences::spans(gaps));
        }
        self.find(kind, topic, text, *span_ns);
    }

    fn end(&mut self, end: End, messages: u64) {
        let topics: Vec<_> = self.channels.keys().cloned().collect();
        for topic in &topics {
            let Some(counted) = self.channels.get_mut(topic) else { continue };
            counted.sequences.settle();
            let (doubt, waiting) = (counted.doubt.take(), counted.waiting.take());
            if let Some(doubt) = doubt {
                self.differs(topic, &doubt);
            }
            if let Some(alone) = waiting {
                self.without_view(topic, alone);
            }
        }
        if self.tallied_ns.is_none() {
            let text = "not provable: no tally: without its counters and its times, no missing message of this \
                        recording is found; give the whole file";
            self.find(Kind::NoTally, "", text.to_owned(), (0, 0));
        }
        if let End::Finished { messages: stated } = end {
            self.report.is_finished = true;
            if let Some(stated) = stated.filter(|stated| *stated != messages) {
                let text = format!("the summary states {stated} messages, the file has {messages}");
                self.find(Kind::Counter, "", text, (0, 0));
            }
        }
        let count = |(topic, counted): (&String, &Counted)| ChannelCounts {
            topic: topic.clone(),
            seen: counted.last.seen,
            written: counted.last.written,
            dropped: counted.last.dropped,
            in_file: counted.in_file,
            after_tally: counted.in_file - counted.tallied_in_file,
        };
        self.report.channels = self.channels.iter().map(count).collect();
    }
}
