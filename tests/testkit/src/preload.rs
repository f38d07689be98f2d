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

    /// The path of the library.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }
}
