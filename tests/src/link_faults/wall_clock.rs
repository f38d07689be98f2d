//! A wall clock of a process's own, which its director sets while it runs. Nobody else's clock changes, and it takes no privileges.
//!
//! The process loads a library before its C library's (`wall_clock.c`), which adds what stands in a file to CLOCK_REALTIME.

use std::{
    fs::File,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
    process::Command,
};

/// How far one jump goes: a day, in seconds.
pub(super) const JUMP: i64 = 24 * 60 * 60;

/// The library that a process with such a clock loads first.
#[derive(Debug)]
pub(super) struct Library(PathBuf);

impl Library {
    /// Compiles it into `directory`.
    ///
    /// # Panics
    /// If there is no C compiler called `cc`.
    pub(super) fn build(directory: &Path) -> Self {
        let (source, library) = (directory.join("wall_clock.c"), directory.join("wall_clock.so"));
        std::fs::write(&source, include_str!("wall_clock.c")).expect("the scenario's own directory");
        let mut compile = Command::new("cc");
        compile.args(["-shared", "-fPIC", "-O2", "-o"]).arg(&library).arg(&source).arg("-ldl");
        let status = compile.status().expect("a clock that is set needs a C compiler, `cc`");
        assert!(status.success(), "cc ended with {status}");
        Self(library)
    }
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
    pub(super) fn new(library: &Library, name: &str) -> Self {
        let path = library.0.with_file_name(name);
        let file = File::create(&path).expect("the scenario's own directory");
        let clock = Self { library: library.0.clone(), path, file, off_by: 0 };
        clock.write();
        clock
    }

    /// What the process has in its environment.
    pub(super) fn environment(&self) -> [(&'static str, &Path); 2] {
        [("LD_PRELOAD", &self.library), ("SINEW_WALL_CLOCK", &self.path)]
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
