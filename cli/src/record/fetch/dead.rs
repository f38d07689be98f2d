//! The rings of dead nodes on this host: files of this user that were not closed, and that nothing writes.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use rustix::time::{ClockId, clock_gettime};
use sinew::{NodeAddress, inspect::FrozenFacts};
use sinew_recorder::{Owners, RingOrigin, is_own};

/// Maximum number of files of the folder that are looked at, and of rings that are returned.
const FILES_MAX: usize = 65_536;
const RINGS_MAX: usize = 256;
/// Largest change of the wall clock since the node has died, in nanoseconds. A host needs longer to start again.
const OFFSET_STEP_MAX: u64 = 5_000_000_000;

/// The ring of a dead node.
pub(super) struct DeadRing {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) address: NodeAddress,
    pub(super) facts: FrozenFacts,
    pub(super) incarnation: u64,
    /// The ID of the whole ring. The node hands it out by this ID after its next start.
    pub(super) id: String,
    /// Whether its times are of the clock that counts now.
    pub(super) is_of_this_boot: bool,
}

impl DeadRing {
    /// Returns whether the file is still that of this incarnation: the next one gives it another name.
    pub(super) fn is_there(&self) -> bool {
        let origin = RingOrigin::read(&self.path, Owners::AllForRoot);
        origin.is_some_and(|origin| origin.incarnation == self.incarnation)
    }

    /// Returns why it was not gathered with a span, and the remedy.
    pub(super) fn remedy(&self) -> String {
        let why = if self.is_of_this_boot {
            "no other node of this host has the span"
        } else {
            "it is of an earlier start of the host, or the wall clock was set since"
        };
        format!(
            "{} at {} has died, and {} is not gathered: {why}; the whole ring is written by `sinew record fetch {}`",
            self.name,
            self.address,
            self.path.display(),
            self.id
        )
    }
}

/// Returns whether a ring with this time of creation and this offset to the wall clock was written since the host has
/// started: the monotonic clock begins anew with it. All times are nanoseconds.
fn is_of_this_boot(created: u64, wall_offset: i64, now: u64, present_offset: i64) -> bool {
    created <= now && wall_offset.abs_diff(present_offset) <= OFFSET_STEP_MAX
}

/// Returns the monotonic clock, and the nanoseconds from it to the wall clock.
fn clocks() -> (u64, i64) {
    let nanoseconds = |clock| {
        let now = clock_gettime(clock);
        i128::from(now.tv_sec) * 1_000_000_000 + i128::from(now.tv_nsec)
    };
    let (now, wall) = (nanoseconds(ClockId::Monotonic), nanoseconds(ClockId::Realtime));
    (u64::try_from(now).unwrap_or(u64::MAX), i64::try_from(wall - now).unwrap_or(i64::MAX))
}

/// Returns the rings of dead nodes of this project: those that still have their name, and those that a later
/// incarnation has kept.
pub(super) fn rings(folders: BTreeSet<&Path>, project: &str) -> Vec<DeadRing> {
    let mut paths: Vec<_> = folders
        .into_iter()
        .filter_map(|folder| fs::read_dir(folder).ok())
        .flat_map(|files| files.take(FILES_MAX))
        .filter_map(|file| Some(file.ok()?.path()))
        .filter(|path| is_ring(path) && is_own(path, Owners::AllForRoot))
        .collect();
    paths.sort();
    let rings = paths.into_iter().filter_map(|path| ring(path, project)).take(RINGS_MAX);
    without_copies(rings.collect())
}

/// Leaves out the second file of one ring: a node that starts again renames it, or copies it to another folder, at the
/// same time.
fn without_copies(mut rings: Vec<DeadRing>) -> Vec<DeadRing> {
    let mut known = BTreeSet::new();
    rings.retain(|ring| known.insert((ring.address, ring.incarnation)));
    rings
}

fn is_ring(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with("sinew-")
        && (name.ends_with(".journal") || (name.contains("-died-") && name.ends_with(".frozen")))
}

fn ring(path: PathBuf, project: &str) -> Option<DeadRing> {
    let origin = RingOrigin::read(&path, Owners::AllForRoot).filter(|origin| origin.project == project)?;
    let (now, present_offset) = clocks();
    let is_of_this_boot = is_of_this_boot(origin.created_ns, origin.wall_offset_ns, now, present_offset);
    let id = origin.id();
    let RingOrigin { node: name, address, facts, incarnation, .. } = origin;
    Some(DeadRing { path, name, address, facts, incarnation, id, is_of_this_boot })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    #[test]
    fn ring_of_an_earlier_boot_is_known() {
        let (now, offset) = (500 * SECOND, 1_700_000_000_000_000_000);
        assert!(is_of_this_boot(400 * SECOND, offset, now, offset + 1_000));
        assert!(!is_of_this_boot(501 * SECOND, offset, now, offset), "it is of a later time");
        assert!(!is_of_this_boot(400 * SECOND, offset, now, offset + 60_000_000_000));
        assert!(!is_of_this_boot(400 * SECOND, i64::MIN, now, i64::MAX));
    }

    fn ring(path: &str, incarnation: u64) -> DeadRing {
        DeadRing {
            path: path.into(),
            name: "knee".to_owned(),
            address: NodeAddress::new(0x0a00_0002),
            facts: FrozenFacts::default(),
            incarnation,
            id: format!("died-{incarnation:x}"),
            is_of_this_boot: true,
        }
    }

    #[test]
    fn ring_with_two_names_counts_once() {
        let (journal, kept) = ("sinew-leg-10.0.0.2.journal", "sinew-leg-10.0.0.2-died-1f.frozen");
        let rings = without_copies(vec![ring(kept, 0x1f), ring(journal, 0x1f), ring(journal, 0x20)]);
        let found: Vec<_> = rings.iter().map(|ring| ring.incarnation).collect();
        assert_eq!(found, [0x1f, 0x20]);
    }

    #[test]
    fn skipped_ring_has_a_remedy() {
        let ring = ring("/dev/shm/sinew-leg-10.0.0.2.journal", 0x1f);
        assert!(ring.remedy().contains("`sinew record fetch died-1f`"), "{}", ring.remedy());
    }
}
