//! A library that a process of a scenario preloads, to replace a part of the system for this process alone.
//! It needs no privileges.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// The compiled library.
#[derive(Debug)]
pub struct Preload(PathBuf);

impl Preload {
    /// The environment variable that names it.
    pub const VARIABLE: &str = "LD_PRELOAD";
    /// The environment variable with the seconds of [`wall_clock`](Self::wall_clock).
    pub const WALL_AHEAD: &str = "SINEW_WALL_AHEAD_S";

    /// Compiles `source` into `directory`; `name` must be unique there.
    ///
    /// # Panics
    /// If there is no C compiler called `cc`.
    #[must_use]
    pub fn build(directory: &Path, name: &str, source: &str) -> Self {
        let file = directory.join(name).with_extension("c");
        let library = file.with_extension("so");
        std::fs::write(&file, source).expect("the scenario's own directory");
        let mut compile = Command::new("cc");
        compile.args(["-shared", "-fPIC", "-O2", "-o"]).arg(&library).arg(&file).arg("-ldl");
        let status =
            compile.status().expect("a part of the system in place of its own needs a C compiler, `cc`");
        assert!(status.success(), "cc ended with {status}");
        Self(library)
    }

    /// Compiles the library that puts the wall clock of a process ahead, for every way to read it. `None`, with a
    /// printed reason, where the kernel does not let a process replace its vDSO.
    ///
    /// # Panics
    /// As [`build`](Self::build).
    #[must_use]
    pub fn wall_clock(directory: &Path) -> Option<Self> {
        let library = Self::build(directory, "wall_clock_ahead", include_str!("wall_clock.c"));
        let mut trial = Command::new("true");
        let trial = trial.env(Self::VARIABLE, library.path()).env(Self::WALL_AHEAD, "1").status();
        let works = trial.is_ok_and(|status| status.success());
        if !works {
            println!("skipped: this kernel does not let a process replace its vDSO");
        }
        works.then_some(library)
    }

    /// The path of the library.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }
}
