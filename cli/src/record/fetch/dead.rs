//! The rings of dead nodes on this host: files of this user that were not closed, and that nothing writes.

use std::{
    fs::{self, File},
    io::Read as _,
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
};

use sinew::{NodeAddress, inspect::FrozenFacts};
use sinew_recorder::{JournalReader, Start};

/// Maximum number of files of the folder that are looked at, and of rings that are returned.
const FILES_MAX: usize = 65_536;
const RINGS_MAX: usize = 256;
/// Maximum bytes of the facts beside a ring.
const FACTS_BYTES_MAX: u64 = 4 << 20;

/// The ring of a dead node.
pub(super) struct DeadRing {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) address: NodeAddress,
    pub(super) facts: FrozenFacts,
}

/// Returns the rings of dead nodes of this project: those that still have their name, and those that a later
/// incarnation has kept.
pub(super) fn rings(folder: &Path, project: &str) -> Vec<DeadRing> {
    let Ok(files) = fs::read_dir(folder) else { return Vec::new() };
    let mut paths: Vec<_> = files
        .take(FILES_MAX)
        .filter_map(|file| Some(file.ok()?.path()))
        .filter(|path| is_ring(path) && is_own(path))
        .collect();
    paths.sort();
    paths.into_iter().filter_map(|path| ring(path, project)).take(RINGS_MAX).collect()
}

fn is_ring(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with("sinew-")
        && (name.ends_with(".journal") || (name.contains("-died-") && name.ends_with(".frozen")))
}

/// Whether it is a file of this user; root reads those of all users.
fn is_own(path: &Path) -> bool {
    let own = rustix::process::geteuid().as_raw();
    path.symlink_metadata().is_ok_and(|metadata| metadata.is_file() && (own == 0 || metadata.uid() == own))
}

fn ring(path: PathBuf, project: &str) -> Option<DeadRing> {
    let reader = JournalReader::open(&path, Start::Newest).ok()?;
    let identity = String::from_utf8(reader.identity().to_vec()).ok()?;
    let mut lines = identity.lines();
    let (name, address) = (lines.next()?.to_owned(), lines.next()?.parse().ok()?);
    // A kept ring may be a copy, which was closed.
    let is_kept = path.extension().is_some_and(|ending| ending == "frozen");
    let has_ended_in_order = !is_kept && reader.is_closed().ok()?;
    if lines.next() != Some(project) || reader.is_writer_alive() || has_ended_in_order {
        return None;
    }
    let mut facts = read_facts(&path.with_extension("facts")).unwrap_or_default();
    facts.report.name.clone_from(&name);
    Some(DeadRing { path, name, address, facts })
}

fn read_facts(path: &Path) -> Option<FrozenFacts> {
    let mut bytes = Vec::new();
    if !is_own(path) {
        return None;
    }
    File::open(path).ok()?.take(FACTS_BYTES_MAX).read_to_end(&mut bytes).ok()?;
    rmp_serde::from_slice(&bytes).ok()
}
