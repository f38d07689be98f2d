//! What a process has of the host, as the host says.

use std::{collections::BTreeSet, fmt, fs, path::PathBuf};

/// What is counted of a process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Held {
    /// Its open descriptors.
    pub descriptors: usize,
    /// Mappings of memory that has no file.
    pub memories: usize,
    /// What it has touched of memory that has no file: its own, and rings. Not its share of the program's text, which grows when
    /// another process of the same program ends.
    pub own_kib: u64,
    /// The memory that it has mapped and touched.
    pub resident_kib: u64,
}

impl Held {
    /// What the process holds now; nothing if it is none any more.
    #[must_use]
    pub fn of(process: u32) -> Self {
        let read = |name: &str| fs::read_to_string(format!("/proc/{process}/{name}")).unwrap_or_default();
        let status = read("status");
        let kib = |name: &str| {
            let line = status.lines().find(|line| line.starts_with(name));
            line.and_then(|line| line.split_whitespace().nth(1)?.parse().ok()).unwrap_or_default()
        };
        Self {
            descriptors: fs::read_dir(format!("/proc/{process}/fd")).map_or(0, Iterator::count),
            memories: read("maps").lines().filter(|line| line.contains("memfd:")).count(),
            own_kib: kib("RssAnon:") + kib("RssShmem:"),
            resident_kib: kib("VmRSS:"),
        }
    }

    /// Whether it has given back all that it can give back to the last one.
    #[must_use]
    pub const fn is_back_at(&self, before: &Self) -> bool {
        self.descriptors <= before.descriptors && self.memories <= before.memories
    }
}

impl fmt::Display for Held {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { descriptors, memories, own_kib, resident_kib } = self;
        write!(
            f,
            "{descriptors:>4} descriptors {memories:>4} memory files mapped {own_kib:>7} KiB without a file {resident_kib:>7} KiB (RSS)"
        )
    }
}

/// Files that do not go with the process that made them: shared memory with a name, and temporary files with ours.
#[must_use]
pub(super) fn files_of_the_host() -> BTreeSet<PathBuf> {
    let list = |path: &str| fs::read_dir(path).into_iter().flatten().flatten().map(|entry| entry.path());
    let is_ours = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        // Other tests of this run have directories of their own.
        name.contains("sinew") && !name.starts_with("sinew-test-")
    };
    list("/dev/shm").chain(list("/tmp").filter(is_ours)).collect()
}
