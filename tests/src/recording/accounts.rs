//! The counters of a recording, by source, beside the messages that were sent.

use std::{collections::BTreeMap, path::Path};

use sinew_bag::{
    check::{self, Finding, Kind},
    read::{Channel, Item, Reader, Role},
};

use super::source;

/// The counters of a source: its accepted messages, or its refused ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Messages before the recording began.
    pub before: u64,
    /// Messages while it ran.
    pub seen: u64,
    /// Messages in files.
    pub written: u64,
    /// Messages in no file.
    pub dropped: u64,
}

/// The counters of all sources of a recording.
#[derive(Clone, Debug, Default)]
pub struct Accounts {
    topics: BTreeMap<String, Account>,
    /// The result of the check.
    pub report: check::Report,
}

impl Accounts {
    /// Reads and checks the parts of a recording, in their order.
    ///
    /// # Panics
    /// If a file cannot be read.
    #[must_use]
    pub fn of<P: AsRef<Path>>(files: &[P]) -> Self {
        let report = sinew_bag::check(files).unwrap_or_else(|error| panic!("{error}"));
        let mut topics: BTreeMap<String, Account> = BTreeMap::new();
        for counts in report.files.iter().flat_map(|file| &file.channels) {
            let account = topics.entry(counts.topic.clone()).or_default();
            // They count from the beginning of the recording, over all parts.
            account.seen = account.seen.max(counts.seen);
            account.written = account.written.max(counts.written);
            account.dropped = account.dropped.max(counts.dropped);
        }
        for path in files {
            for (topic, before) in starts(path.as_ref()) {
                topics.entry(topic).or_default().before = before;
            }
        }
        Self { topics, report }
    }

    /// Returns the counters of the source's accepted messages, or of its refused ones.
    #[must_use]
    pub fn source(&self, number: u64, is_refused: bool) -> Account {
        let ending = if is_refused { "/rejected" } else { "" };
        let topic = format!("/{}/recorded.load{ending}", source(number));
        self.topics.get(&topic).copied().unwrap_or_default()
    }

    /// Returns the messages of all channels that are in no file.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.topics.values().map(|account| account.dropped).sum()
    }

    /// Returns the findings. That other nodes have no file is none.
    #[must_use]
    pub fn findings(&self) -> Vec<&Finding> {
        self.report.findings.iter().filter(|finding| finding.kind != Kind::NoFile).collect()
    }

    /// Compares a finished recording with the accepted and refused messages of each source since the node began to
    /// record. Returns a sentence for each difference.
    #[must_use]
    pub fn differences(&self, offered: &[[u64; 2]]) -> Vec<String> {
        let mut faults: Vec<_> = self.findings().iter().map(|found| format!("{found:?}")).collect();
        for (number, counts) in (0_u64..).zip(offered) {
            let account = self.source(number, false);
            if account.before + account.seen != counts[0] {
                faults.push(format!("{}: {} accepted, {account:?}", source(number), counts[0]));
            }
            if account.seen != account.written + account.dropped {
                faults.push(format!("{}: seen is not written plus dropped: {account:?}", source(number)));
            }
            let refused = self.source(number, true);
            if refused.before + refused.seen > counts[1] {
                faults.push(format!("{}: {} refused, {refused:?}", source(number), counts[1]));
            }
        }
        faults
    }
}

/// Returns the topics of payloads, and the messages of each before the recording began.
fn starts(path: &Path) -> Vec<(String, u64)> {
    let mut reader = Reader::open(path).unwrap_or_else(|error| panic!("{error}"));
    while let Some(item) = reader.next_item().transpose() {
        drop(item);
    }
    let payloads = reader.channels().values().filter(|channel| channel.role() == Role::Raw);
    payloads
        .map(|channel| (channel.topic.clone(), channel.value("seen_before").parse().unwrap_or_default()))
        .collect()
}

/// Returns the number of payloads in a file.
///
/// # Panics
/// If it cannot be read, or has a damaged record.
#[must_use]
pub fn messages_in(path: &Path) -> u64 {
    count(path, |channel| channel.role() == Role::Raw)
}

/// Returns the number of tallies in a file; 0 if it is not there, or has nothing yet.
///
/// # Panics
/// If it has a damaged record.
#[must_use]
pub fn tallies_in(path: &Path) -> u64 {
    let has_begun = path.metadata().is_ok_and(|file| file.len() > 0);
    if has_begun { count(path, |channel| channel.topic == "/sinew/tally") } else { 0 }
}

fn count(path: &Path, is_counted: impl Fn(&Channel) -> bool) -> u64 {
    let mut reader = Reader::open(path).unwrap_or_else(|error| panic!("{error}"));
    let mut count = 0;
    loop {
        match reader.next_item() {
            Ok(Some(Item::Message(message))) => count += u64::from(is_counted(&message.channel)),
            Ok(Some(Item::Metadata(..))) => {}
            Ok(None) => return count,
            Err(error) => panic!("{error}"),
        }
    }
}
