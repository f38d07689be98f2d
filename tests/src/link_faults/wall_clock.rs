//! A wall clock of a process's own, which its director sets while it runs. Nobody else's clock changes, and it takes no privileges.
//!
//! The process loads a library before its C library's (`wall_clock.c`), which adds what stands in a file to CLOCK_REALTIME.

use std::{
    fs::File,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
};

use crate::preload::Preload;

/// How far one jump goes: a day, in seconds.
pub(super) const JUMP: i64 = 24 * 60 * 60;

/// The library that a process with such a clock loads first, in `directory`.
///
/// # Panics
/// If there is no C compiler called `cc`.
pub(super) fn library(directory: &Path) -> Preload {
    Preload::build(directory, "wall_clock", include_str!("wall_clock.c"))
}

/// The clock of one process.
#[derive(Debug)]
pub(super) struct WallClock {
    library: PathBuf,
    path: PathBuf,
    file: File,
    /// Seconds by which it is off.
    pub(super) off_by: i64,
}

impl WallClock {
    /// A clock that is right; `name` is no other's.
    pub(super) fn new(library: &Preload, name: &str) -> Self {
        let path = library.path().with_file_name(name);
        let file = File::create(&path).expect("the scenario's own directory");
        let clock = Self { library: library.path().to_owned(), path, file, off_by: 0 };
        clock.write();
        clock
    }

    /// What the process has in its environment.
    pub(super) fn environment(&self) -> [(&'static str, &Path); 2] {
        [(Preload::VARIABLE, &self.library), ("SINEW_WALL_CLOCK", &self.path)]
    }

    /// It jumps by so many seconds.
    pub(super) fn jump(&mut self, seconds: i64) {
        self.off_by += seconds;
        self.write();
    }

    fn write(&self) {
        self.file.write_all_at(&self.off_by.to_ne_bytes(), 0).expect("a small file can be written");
    }
}
