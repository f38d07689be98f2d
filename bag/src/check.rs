//! The proof that a recording is complete: seen = written + dropped, for each channel of each file, and both ends of
//! each channel compared.

mod ends;
mod file;
mod parts;
#[cfg(test)]
mod tests;
mod times;

use std::{io::Read, path::Path};

use serde::Serialize;

use crate::{clocks::Offsets, error::BagError, read::Reader};

/// Maximum findings of one file: a file that is wrong throughout needs no more.
const FINDINGS_MAX: usize = 1_000;

/// The kind of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// The file has fewer messages than its recorder wrote.
    Missing,
    /// The file has messages that its recorder did not count.
    Uncounted,
    /// A counter is false, or the counters do not add up.
    Counter,
    /// A record of the file is damaged.
    Damaged,
    /// A part of the recording is absent, or does not continue the one before.
    Part,
    /// A message was sent, and its receiver never had it.
    Lost,
    /// A message was received, and its source never sent it.
    Unsent,
    /// The file of a node is absent, so one end is not compared.
    NoFile,
    /// A file has no tally, so nothing about its messages is provable.
    NoTally,
}

/// A finding.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Its kind.
    pub kind: Kind,
    /// The file.
    pub file: String,
    /// The topic, or the node.
    pub topic: String,
    /// One line for people.
    pub text: String,
    /// From when, in nanoseconds of the file's wall clock; 0 where it is unknown.
    pub from_ns: u64,
    /// Until when, in nanoseconds of the file's wall clock; 0 where it is unknown.
    pub to_ns: u64,
}

/// The counters of a channel in one file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ChannelCounts {
    /// The topic.
    pub topic: String,
    /// Messages that the node had, as the last tally states it, since the recording began.
    pub seen: u64,
    /// Messages that were written since the recording began.
    pub written: u64,
    /// Messages that are in no file.
    pub dropped: u64,
    /// Messages in this file.
    pub in_file: u64,
    /// Messages behind the last tally, which no counter covers.
    pub after_tally: u64,
}

/// The result for one file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FileReport {
    /// The path.
    pub file: String,
    /// The name of its node.
    pub node: String,
    /// The address of its node.
    pub address: String,
    /// The incarnation of its node.
    pub incarnation: u64,
    /// When the recording began, in nanoseconds of the monotonic clock.
    pub began_ns: u64,
    /// The number of the part.
    pub part: u32,
    /// Whether it has its summary. Otherwise its recorder was killed or could not write.
    pub is_finished: bool,
    /// Events and clock readings that are in no file.
    pub events_lost: u64,
    /// The channels.
    pub channels: Vec<ChannelCounts>,
}

/// The comparison of both ends of a channel.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct EndReport {
    /// The source.
    pub source: String,
    /// The destination.
    pub destination: String,
    /// The payload type.
    pub type_name: String,
    /// The class.
    pub class: String,
    /// Messages that the source's node recorded.
    pub sent: u64,
    /// Messages that the destination's node recorded.
    pub received: u64,
    /// Sent and not received, between the first and the last one that was received.
    pub lost: u64,
    /// Messages of class Stream that were sent and not received. A newer value may have replaced them.
    pub superseded_or_lost: u64,
    /// Sent and not received, which the recorder of the destination's node counted as dropped.
    pub not_recorded: u64,
    /// Sent before the first one that was received: the other recording began later. Also those between two recordings
    /// of the other node. If none was received: sent before the other recording began, by the clock readings.
    pub before: u64,
    /// Sent after the last one that was received: on their way, or the other recording ended earlier.
    pub after: u64,
}

/// The result of [`check()`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Report {
    /// The files, in the order of nodes and parts.
    pub files: Vec<FileReport>,
    /// The channels between two nodes with given files.
    pub ends: Vec<EndReport>,
    /// The findings.
    pub findings: Vec<Finding>,
}

impl Report {
    /// Returns whether nothing was found.
    #[must_use]
    pub fn is_fine(&self) -> bool {
        self.findings.is_empty()
    }
}

/// Checks files: all parts of one node's recording, or of several nodes.
///
/// # Errors
/// A file cannot be read, or is no recording of one node: a merged file is none.
pub fn check<P: AsRef<Path>>(files: &[P]) -> Result<Report, BagError> {
    let readers = files.iter().map(Reader::open).collect::<Result<Vec<_>, _>>()?;
    check_readers(readers)
}

/// Same as [`check()`], of files that are open, or of bytes in memory.
///
/// # Errors
/// As [`check()`].
pub fn check_readers<R: Read>(readers: Vec<Reader<R>>) -> Result<Report, BagError> {
    let mut offsets = Offsets::default();
    let mut read =
        readers.into_iter().map(|reader| file::read(reader, &mut offsets)).collect::<Result<Vec<_>, _>>()?;
    offsets.settle();
    read.sort_by(|one, other| one.order().cmp(&other.order()));
    let mut report = Report::default();
    for file in &mut read {
        report.findings.append(&mut file.findings);
    }
    parts::compare(&read, &mut report.findings);
    ends::compare(&mut read, &offsets, &mut report);
    report.files = read.into_iter().map(|file| file.report).collect();
    Ok(report)
}
