//! A wall clock for a single process, set by its scenario at run time. No other clock changes, and no
//! privileges are needed.
//!
//! The process preloads a library (`wall_clock.c`) that adds the content of a file to CLOCK_REALTIME.

use std::{
    fs::File,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
};

use sinew_testkit::preload::Preload;

/// Size of one jump: a day, in seconds.
pub(super) const JUMP: i64 = 24 * 60 * 60;

/// Compiles the library that a process with such a clock preloads, into `directory`.
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
    /// Its offset in seconds.
    pub(super) off_by: i64,
}

impl WallClock {
    /// A correct clock; `name` is unique.
    pub(super) fn new(library: &Preload, name: &str) -> Self {
        let path = library.path().with_file_name(name);
        let file = File::create(&path).expect("the scenario's own directory");
        let clock = Self { library: library.path().to_owned(), path, file, off_by: 0 };
        clock.write();
        clock
    }

    /// The environment variables of the process.
    pub(super) fn environment(&self) -> [(&'static str, &Path); 2] {
        [(Preload::VARIABLE, &self.library), ("SINEW_WALL_CLOCK", &self.path)]
    }

    /// Makes the clock jump by this many seconds.
    pub(super) fn jump(&mut self, seconds: i64) {
        self.off_by += seconds;
        self.write();
    }

    fn write(&self) {
        self.file.write_all_at(&self.off_by.to_ne_bytes(), 0).expect("a small file can be written");
    }
}
