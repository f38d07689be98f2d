//! A directory of one test.

use std::path::PathBuf;

use crate::unique;

/// An empty directory for this test only. Dropping the value removes it.
#[derive(Debug)]
pub struct TestDirectory(PathBuf);

impl TestDirectory {
    /// Creates the directory.
    ///
    /// # Panics
    /// If the host's directory for temporary files cannot be written to.
    #[must_use]
    pub fn new() -> Self {
        let path = std::env::temp_dir().join(format!("sinew-test-{}", unique()));
        std::fs::create_dir_all(&path).expect("a directory for temporary files");
        Self(path)
    }

    /// A path inside the directory.
    #[must_use]
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes a file, such as a node's configuration, and returns its path.
    ///
    /// # Panics
    /// If the file cannot be written.
    #[must_use]
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.join(name);
        std::fs::write(&path, text).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        path
    }
}

impl Default for TestDirectory {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for TestDirectory {
    fn drop(&mut self) {
        // A leftover temporary directory is no reason to fail a test.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
