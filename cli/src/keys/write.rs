//! Files and directories that are created completely or not at all, with the intended permissions from the start.

use std::{
    fs::{DirBuilder, File, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{DirBuilderExt, OpenOptionsExt},
    path::{Path, PathBuf},
};

/// The permitted readers of a file; only its owner may write.
#[derive(Clone, Copy, Debug)]
pub(super) enum Readers {
    /// Its owner.
    Owner,
    /// All users of this machine.
    All,
}

/// Writes a file, replacing an existing one atomically. A reader gets either the old or the new content, also after a
/// power failure.
pub(super) fn file(path: &Path, readers: Readers, bytes: &[u8]) -> io::Result<()> {
    let mode = match readers {
        Readers::Owner => 0o600,
        Readers::All => 0o644,
    };
    let beside = beside(path)?;
    let written = (|| {
        let mut file = OpenOptions::new().write(true).create_new(true).mode(mode).open(&beside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    })();
    if written.is_err() {
        // An unfinished file is useless.
        let _ = std::fs::remove_file(&beside);
    }
    written?;
    sync(path)
}

/// Creates a directory that only its owner may enter.
pub(super) fn directory(path: &Path) -> io::Result<()> {
    DirBuilder::new().mode(0o700).create(path)
}

/// A directory that is filled before it is renamed to its final name; if it is dropped before, it is removed.
pub(super) struct Staged {
    path: PathBuf,
    is_placed: bool,
}

impl Staged {
    /// Creates an empty one in the directory of its target.
    pub(super) fn beside(target: &Path) -> io::Result<Self> {
        let path = beside(target)?;
        directory(&path)?;
        Ok(Self { path, is_placed: false })
    }

    /// Returns its current path.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Renames it to its final name. An existing directory that is not empty stays, and causes an error.
    pub(super) fn place(mut self, target: &Path) -> io::Result<()> {
        std::fs::rename(&self.path, target)?;
        self.is_placed = true;
        sync(target)
    }

    /// Renames it to its final name, replacing an existing directory, which is removed.
    pub(super) fn replace(self, target: &Path) -> io::Result<()> {
        if !target.exists() {
            return self.place(target);
        }
        let exchange = rustix::fs::RenameFlags::EXCHANGE;
        rustix::fs::renameat_with(rustix::fs::CWD, &self.path, rustix::fs::CWD, target, exchange)?;
        // The old directory is dropped now.
        sync(target)
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        if !self.is_placed {
            // Its name marks it as temporary, and the next one has another name.
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// Returns an unused name in the directory of `path`.
fn beside(path: &Path) -> io::Result<PathBuf> {
    let name = path.file_name().ok_or_else(|| io::Error::other("this path has no name at its end"))?;
    Ok(path.with_file_name(format!(".{}.{}.new", name.to_string_lossy(), std::process::id())))
}

/// Flushes the directory entry to the disk.
fn sync(path: &Path) -> io::Result<()> {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    File::open(parent.unwrap_or_else(|| Path::new(".")))?.sync_all()
}
