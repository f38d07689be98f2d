//! Writes a frozen journal, or the ring of a dead node, as an MCAP file.

use std::{
    io,
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

use serde_json::{Value, json};
use sinew::{NodeAddress, inspect::FrozenFacts};
use sinew_recorder::{BagError, FileOptions, FrozenRing, RecordingError};

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
    /// The address of the node, and its incarnation if the facts have it.
    pub(super) origin: (NodeAddress, Option<u64>),
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
    let Source { ring, facts: FrozenFacts { report, .. }, times, address } = source;
    // They were read when the span was frozen. A ring has its own, each second.
    let has_clocks = trigger.is_some();
    let ring = FrozenRing { path: ring, report, address: *address, times: times.clone(), has_clocks };
    let options = FileOptions { replace, ..FileOptions::default() };
    let program = concat!("sinew record fetch ", env!("CARGO_PKG_VERSION"));
    let written = ring.write(file.clone(), options, program).map_err(|why| {
        if let RecordingError::File(why) = why {
            creation_error(why)
        } else {
            SystemError::Bag(why.to_string())
        }
    })?;
    Ok(Converted {
        file,
        node: report.name.clone(),
        origin: (*address, report.incarnation.map(|incarnation| incarnation.0)),
        written: written.totals.written,
        dropped: written.totals.dropped,
        first_ns: written.first_ns,
        last_ns: written.last_ns,
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
