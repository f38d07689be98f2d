//! Writes a frozen journal, or the ring of a dead node, as an MCAP file.

use std::{
    io,
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

use serde_json::{Value, json};
use sinew::{
    NodeAddress,
    inspect::{FrozenFacts, Selection},
};
use sinew_bag::{BagError, BagWriter, Options, Origin};
use sinew_recorder::{JournalReader, Names, ReadJournalError, Recorder, Setup, Span, Start};

use crate::system::SystemError;

/// A journal without a writer.
pub(super) struct Source<'a> {
    pub(super) ring: &'a Path,
    pub(super) facts: FrozenFacts,
    /// The times to write.
    pub(super) times: RangeInclusive<u64>,
    pub(super) address: NodeAddress,
}

/// A file that was written.
pub(super) struct Converted {
    pub(super) file: PathBuf,
    pub(super) node: String,
    pub(super) written: u64,
    pub(super) dropped: u64,
    /// The times of its first and its last record, in nanoseconds of the monotonic clock of the node's host.
    pub(super) first_ns: u64,
    pub(super) last_ns: u64,
    /// The times that were asked for.
    pub(super) times: RangeInclusive<u64>,
    /// The time of the trigger and its error, if the node had it.
    pub(super) trigger: Option<(u64, u64)>,
    pub(super) has_died: bool,
}

impl Converted {
    /// Returns the time from its first to its last record, in nanoseconds. A ring has a record each second at least, so
    /// a longer part that is missing was overwritten, or was not recorded.
    pub(super) const fn covered_ns(&self) -> u64 {
        self.last_ns.saturating_sub(self.first_ns)
    }

    /// Returns the time that was asked for, in nanoseconds. `None`: the whole ring.
    pub(super) fn span_ns(&self) -> Option<u64> {
        (*self.times.end() < u64::MAX).then(|| self.times.end().saturating_sub(*self.times.start()))
    }

    pub(super) fn json(&self) -> Value {
        json!({
            "covered_ns": self.covered_ns(), "span_ns": self.span_ns(),
            "file": self.file, "node": self.node, "written": self.written, "dropped": self.dropped,
            "first_ns": self.first_ns, "last_ns": self.last_ns, "begin_ns": self.times.start(),
            "end_ns": self.times.end(), "at_ns": self.trigger.map(|(at_ns, _)| at_ns),
            "bound_ns": self.trigger.map(|(_, bound_ns)| bound_ns), "has_died": self.has_died,
        })
    }
}

/// Writes the file. `trigger` is the time of the trigger, and its error.
pub(super) fn convert(
    source: &Source<'_>,
    trigger: Option<(u64, u64)>,
    file: PathBuf,
    replace: bool,
) -> Result<Converted, SystemError> {
    let fault = |why: ReadJournalError| SystemError::Bag(why.to_string());
    let Source { ring, facts: FrozenFacts { report, .. }, times, address } = source;
    let span = Span::scan(ring, times).map_err(fault)?;
    let reader = JournalReader::open(ring, Start::Oldest).map_err(fault)?;
    let node = report.node.unwrap_or(*address);
    let origin = Origin {
        node: report.name.clone(),
        address: node.to_string(),
        incarnation: report.incarnation.map_or(0, |incarnation| incarnation.0),
        version: concat!("sinew record fetch ", env!("CARGO_PKG_VERSION")).to_owned(),
        wall_offset_ns: reader.wall_offset().map_err(fault)?,
        began_ns: if span.records == 0 { *times.start() } else { span.first_ns },
    };
    let bag = BagWriter::create(file.clone(), Options { replace, ..Options::default() }, origin)
        .map_err(creation_error)?;
    let mut names = Names::default();
    // All that the node knew of its types is in the report.
    let kinds: Vec<_> = report.types.iter().map(|one| one.kind).collect();
    names.learn(report, &kinds);
    let setup = Setup { node, selection: Selection::default(), names, left_out: Vec::new() };
    let mut recorder = Recorder::of_span(reader, bag, setup, &span);
    if trigger.is_some() {
        // They were read when the span was frozen. A ring has its own, each second.
        recorder.clocks(span.last_ns, &report.clocks);
    }
    loop {
        match recorder.pump(span.last_ns) {
            Ok(true) => break,
            // Messages that are missing are counted by their numbers.
            Ok(false) | Err(ReadJournalError::Damaged { .. }) => {}
            Err(why) => return Err(fault(why)),
        }
    }
    let written = recorder.take_fault();
    let totals = recorder.finish(span.last_ns)?;
    if let Some(why) = written {
        return Err(why.into());
    }
    Ok(Converted {
        file,
        node: report.name.clone(),
        written: totals.written,
        dropped: totals.dropped,
        first_ns: span.first_ns,
        last_ns: span.last_ns,
        times: times.clone(),
        trigger,
        has_died: false,
    })
}

/// Names the option that replaces a file, if there is one.
fn creation_error(why: BagError) -> SystemError {
    let BagError::Write { path, cause } = &why else { return why.into() };
    if cause.kind() != io::ErrorKind::AlreadyExists {
        return why.into();
    }
    let path = path.display();
    SystemError::Bag(format!(
        "{path}: this file exists; replace a file of a former run with --force, or name another folder with --out"
    ))
}

/// Returns the name of a file: `knee-ID.mcap`.
pub(super) fn file_name(node: &str, id: &str, ending: &str) -> String {
    let letter = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let safe = |text: &str| text.trim_start_matches('.').chars().map(letter).collect::<String>();
    format!("{}-{}.{ending}", safe(node), safe(id))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn existing_file_has_the_option_as_remedy() {
        let of = |kind: io::ErrorKind| {
            creation_error(BagError::Write { path: "knee.mcap".into(), cause: kind.into() }).to_string()
        };
        assert!(of(io::ErrorKind::AlreadyExists).contains("--force"));
        assert!(!of(io::ErrorKind::PermissionDenied).contains("--force"));
    }

    #[test]
    fn names_of_files_have_no_path_in_them() {
        assert_eq!(file_name("../leg/knee", "10.0.0.2-1f-3", "mcap"), "_leg_knee-10.0.0.2-1f-3.mcap");
    }
}
