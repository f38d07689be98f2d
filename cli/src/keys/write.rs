//! Files and directories that are there whole, or not at all, and for whom they are meant from the first moment on.

use std::{
    fs::{DirBuilder, File, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{DirBuilderExt, OpenOptionsExt},
    path::{Path, PathBuf},
};

/// Who may read a file; only its owner may write.
#[derive(Clone, Copy, Debug)]
pub(super) enum Readers {
    /// Its owner.
    Owner,
    /// All users of this machine.
    All,
}

/// Writes a file, in the place of one that is there. Whoever reads it reads the old one or the new one, also after the power has failed.
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
        // What could not be finished is of no use to anybody.
        let _ = std::fs::remove_file(&beside);
    }
    written?;
    sync(path)
}

/// A directory that only its owner may enter.
pub(super) fn directory(path: &Path) -> io::Result<()> {
    DirBuilder::new().mode(0o700).create(path)
}

/// A directory that is filled before it gets its name; dropped without one it is removed.
pub(super) struct Staged {
    path: PathBuf,
    is_placed: bool,
}

impl Staged {
    /// An empty one, beside where it is to be.
    pub(super) fn beside(target: &Path) -> io::Result<Self> {
        let path = beside(target)?;
        directory(&path)?;
        Ok(Self { path, is_placed: false })
    }

    /// Where it is now.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Gives it its name. A directory that is there and not empty stays, and that is an error.
    pub(super) fn place(mut self, target: &Path) -> io::Result<()> {
        std::fs::rename(&self.path, target)?;
        self.is_placed = true;
        sync(target)
    }

    /// Gives it its name, in the place of a directory that is there, which is removed.
    pub(super) fn replace(self, target: &Path) -> io::Result<()> {
        if !target.exists() {
            return self.place(target);
        }
        let exchange = rustix::fs::RenameFlags::EXCHANGE;
        rustix::fs::renameat_with(rustix::fs::CWD, &self.path, rustix::fs::CWD, target, exchange)?;
        // What is dropped now is the old one.
        sync(target)
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        if !self.is_placed {
            // It has a name that says so, and the next one has another.
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// A name beside `path` that nobody else uses.
fn beside(path: &Path) -> io::Result<PathBuf> {
    let name = path.file_name().ok_or_else(|| io::Error::other("this path has no name at its end"))?;
    Ok(path.with_file_name(format!(".{}.{}.new", name.to_string_lossy(), std::process::id())))
}

/// The name itself is on the disk, too.
fn sync(path: &Path) -> io::Result<()> {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    File::open(parent.unwrap_or_else(|| Path::new(".")))?.sync_all()
}
