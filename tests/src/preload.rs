//! A library that a process of a scenario loads before its C library, so that a part of the system is another one for it. It takes no
//! privileges, and nobody else notices.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// The compiled library.
#[derive(Debug)]
pub(crate) struct Preload(PathBuf);

impl Preload {
    /// The variable of a process's environment that names it.
    pub(crate) const VARIABLE: &str = "LD_PRELOAD";

    /// Compiles `source` into `directory`; `name` is no other's there.
    ///
    /// # Panics
    /// If there is no C compiler called `cc`.
    pub(crate) fn build(directory: &Path, name: &str, source: &str) -> Self {
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

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}
