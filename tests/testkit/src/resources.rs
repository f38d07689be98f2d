//! Resources held by a process, as the operating system reports them.

use std::{fmt, fs};

/// The resources of a process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Resources {
    /// Open file descriptors.
    pub descriptors: usize,
    /// Anonymous memory mappings.
    pub memories: usize,
    /// Anonymous memory that it has touched: its own, and rings. Its share of the program's text is excluded,
    /// because that grows when another process of the same program exits.
    pub own_kib: u64,
    /// Resident memory.
    pub resident_kib: u64,
    /// Threads.
    pub threads: u64,
}

impl Resources {
    /// The resources that the process holds now; all zero if it no longer exists.
    #[must_use]
    pub fn of(process: u32) -> Self {
        let read = |name: &str| fs::read_to_string(format!("/proc/{process}/{name}")).unwrap_or_default();
        let status = read("status");
        let field = |name: &str| {
            let line = status.lines().find(|line| line.starts_with(name));
            line.and_then(|line| line.split_whitespace().nth(1)?.parse().ok()).unwrap_or_default()
        };
        Self {
            descriptors: fs::read_dir(format!("/proc/{process}/fd")).map_or(0, Iterator::count),
            memories: read("maps").lines().filter(|line| line.contains("memfd:")).count(),
            own_kib: field("RssAnon:") + field("RssShmem:"),
            resident_kib: field("VmRSS:"),
            threads: field("Threads:"),
        }
    }

    /// Returns whether it has released everything that it can release completely.
    #[must_use]
    pub const fn is_back_at(&self, before: &Self) -> bool {
        self.descriptors <= before.descriptors && self.memories <= before.memories
    }
}

impl fmt::Display for Resources {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { descriptors, memories, own_kib, resident_kib, .. } = self;
        write!(
            f,
            "{descriptors:>4} descriptors {memories:>4} memory files mapped {own_kib:>7} KiB without a file {resident_kib:>7} KiB (RSS)"
        )
    }
}
