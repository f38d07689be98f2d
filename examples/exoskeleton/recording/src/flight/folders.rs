//! The folders of the flight recorder of a run on this host.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};

use super::{Frozen, gather};

/// The folder of files in memory: on a disk the system would stop a sender while it stores a page.
const MEMORY: &str = "/dev/shm";
/// Maximum number of runs of one process ID, of which some were killed and have left their folder.
const RUNS_MAX: u32 = 100;

/// The folders of the flight recorder of a run. That of the journals is removed with this value, which has to outlive
/// the nodes.
#[derive(Debug)]
pub struct FlightFolders {
    journals: PathBuf,
    frozen: PathBuf,
}

impl FlightFolders {
    /// Creates the folder of the journals in memory, and that of the frozen spans in the folder of the run. Both are
    /// for this user alone.
    ///
    /// # Errors
    /// The system's error, with the folder and a remedy.
    pub fn create(run_folder: &Path) -> io::Result<Self> {
        let memory = Path::new(MEMORY);
        let memory = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        let name = format!("sinew-exoskeleton-{}", std::process::id());
        let mut names = (1..=RUNS_MAX).map(|number| memory.join(format!("{name}-{number}")));
        let journals = names.find_map(|folder| match create(&folder) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => None,
            created => Some(created.map(|()| folder)),
        });
        let journals = journals.unwrap_or_else(|| {
            let why = format!("{} has {RUNS_MAX} folders {name}-*; remove those", memory.display());
            Err(io::Error::other(why))
        })?;
        let folders = Self { journals, frozen: run_folder.join("frozen") };
        create(&folders.frozen)?;
        Ok(folders)
    }

    /// Returns the folder in memory, for a journal of each node.
    #[must_use]
    pub fn journals(&self) -> &Path {
        &self.journals
    }

    /// Returns the folder of the frozen spans.
    #[must_use]
    pub fn frozen(&self) -> &Path {
        &self.frozen
    }

    /// Writes the frozen spans as files. To be called when all nodes have ended.
    #[must_use]
    pub fn gather(&self) -> Frozen {
        gather(&self.frozen, &self.journals)
    }
}

impl Drop for FlightFolders {
    fn drop(&mut self) {
        // Nodes that end in order remove theirs, and the last one removes all.
        let _ = fs::remove_dir_all(&self.journals);
    }
}

fn create(folder: &Path) -> io::Result<()> {
    DirBuilder::new().mode(0o700).create(folder).map_err(|error| {
        let why = format!(
            "the folder {} cannot be created: {error}; make room there, or walk with --no-record",
            folder.display()
        );
        io::Error::new(error.kind(), why)
    })
}

#[cfg(test)]
#[path = "folders_tests.rs"]
mod tests;
