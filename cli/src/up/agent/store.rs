//! The files of a robot on a host.
//!
//! ```text
//! FOLDER/tools/sinew-HASH           this program, where the caller copied it
//! FOLDER/robots/ROBOT/              0700
//!   lock                            held by the caller that changes something
//!   files/HASH                      contents, each once
//!   nodes/NAME/                     the working directory of a node
//!     up.json                       its order, and the process that runs it
//!     bin/PROGRAM                   its program
//!     log, log.1                    its standard output and standard error
//!     keys/...                      its keys
//!     ...                           its configuration and files
//!   units/*.service, *.target       units of systemd
//! ```

use std::{
    fs::{self, DirBuilder, File, OpenOptions, Permissions},
    io::{self, Read, Write as _},
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
};

use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};

use super::super::order::{Hash, KEYS_PREFIX, NodeOrder, ProgramOrder};
use super::process::ProcessId;

/// The folder of all robots, below the home directory.
const DEFAULT_FOLDER: &str = ".local/state/sinew";
const RECORD: &str = "up.json";
/// Longest record of a node in bytes.
const RECORD_BYTES_MAX: u64 = 4 << 20;
/// Maximum number of entries that are read of a folder.
const ENTRIES_MAX: usize = 10_000;
/// Length in bytes from which a log is set aside at the next start.
const LOG_BYTES_KEPT: u64 = 8 << 20;

/// The files of one robot.
#[derive(Debug)]
pub(super) struct Store {
    folder: PathBuf,
    robot: PathBuf,
    /// Held while this caller may change something.
    _lock: Option<File>,
}

/// The record of a node.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) order: NodeOrder,
    /// The process that was started last.
    pub(super) process: Option<ProcessId>,
}

/// Adds the place and the remedy to an error of the system.
pub(super) fn at(path: &Path, error: &io::Error) -> String {
    format!("{}: {error}; check the path, its owner and the room on the disk", path.display())
}

impl Store {
    /// Opens the files of a robot. With `changes` the folder is created, and locked against other callers.
    pub(super) fn open(robot: &str, folder: Option<&str>, changes: bool) -> Result<Self, String> {
        let folder = match folder {
            Some(folder) => PathBuf::from(folder),
            None => {
                let home = std::env::var_os("HOME").filter(|home| !home.is_empty());
                let home =
                    home.ok_or("there is no HOME; set the folder: [host.NAME] folder = \"/var/lib/sinew\"")?;
                Path::new(&home).join(DEFAULT_FOLDER)
            }
        };
        let robot = folder.join("robots").join(robot);
        let lock = if changes { Some(locked(&robot)?) } else { None };
        Ok(Self { folder, robot, _lock: lock })
    }

    pub(super) fn robot(&self) -> &Path {
        &self.robot
    }

    /// Returns the working directory of a node.
    pub(super) fn node(&self, name: &str) -> PathBuf {
        self.robot.join("nodes").join(name)
    }

    fn content(&self, hash: &Hash) -> PathBuf {
        self.robot.join("files").join(hash.to_string())
    }

    pub(super) fn has(&self, hash: &Hash) -> bool {
        self.content(hash).is_file()
    }

    /// Stores a content, once it was proven to be that of its hash.
    pub(super) fn put(&self, hash: &Hash, bytes: u64, content: &mut dyn Read) -> Result<(), String> {
        let (folder, path) = (self.robot.join("files"), self.content(hash));
        let partial = folder.join(format!(".{hash}.part"));
        let stored = folder_of(&folder)
            .and_then(|()| write_to(&partial, content, bytes))
            .and_then(|()| Hash::of_file(&partial));
        let (found, length) = stored.map_err(|error| at(&partial, &error))?;
        if (&found, length) != (hash, bytes) {
            let _ = fs::remove_file(&partial);
            return Err(format!("{}: {length} of {bytes} bytes arrived whole; try again", path.display()));
        }
        fs::rename(&partial, &path).map_err(|error| at(&path, &error))
    }

    /// Writes the files of a node into its folder. Returns the path of its program.
    pub(super) fn place(&self, order: &NodeOrder) -> Result<PathBuf, String> {
        let folder = self.node(&order.name);
        order.files.iter().try_for_each(|file| check_path(&file.path))?;
        if let ProgramOrder::Copied { name, .. } = &order.program {
            check_path(name)?;
        }
        folder_of(&folder).map_err(|error| at(&folder, &error))?;
        if let Some(before) = self.record(&order.name)? {
            for file in before.order.files.iter().filter(|file| !order.files.contains(file)) {
                removed(&folder.join(&file.path))?;
            }
            if let Some(program) =
                program_path(&before.order).filter(|_| before.order.program != order.program)
            {
                removed(&folder.join(program))?;
            }
        }
        for file in &order.files {
            let path = folder.join(&file.path);
            self.copy(&file.hash, &path).map_err(|error| at(&path, &error))?;
        }
        match &order.program {
            ProgramOrder::Installed(path) => Ok(PathBuf::from(path)),
            ProgramOrder::Copied { name, hash } => {
                let path = folder.join("bin").join(name);
                self.link(hash, &path).map_err(|error| at(&path, &error))?;
                Ok(path)
            }
        }
    }

    /// Replaces a file as a whole.
    fn copy(&self, hash: &Hash, path: &Path) -> io::Result<()> {
        folder_of(path.parent().unwrap_or(path))?;
        let partial = path.with_file_name(".part");
        fs::copy(self.content(hash), &partial)?;
        fs::set_permissions(&partial, Permissions::from_mode(0o600))?;
        fs::rename(&partial, path)
    }

    /// Replaces a program as a whole. It is long, so that it shares its content.
    fn link(&self, hash: &Hash, path: &Path) -> io::Result<()> {
        folder_of(path.parent().unwrap_or(path))?;
        let partial = path.with_file_name(".part");
        // A part of a start that was killed may be another content by this name.
        let _ = fs::remove_file(&partial);
        if fs::hard_link(self.content(hash), &partial).is_err() {
            // The file system has no links.
            fs::copy(self.content(hash), &partial)?;
        }
        fs::set_permissions(&partial, Permissions::from_mode(0o700))?;
        fs::rename(&partial, path)?;
        // Where both were one file already, the system leaves both names.
        match fs::remove_file(&partial) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            Ok(()) | Err(_) => Ok(()),
        }
    }

    /// Opens the log of a node for a new process. A long one is set aside.
    pub(super) fn log(&self, node: &str) -> io::Result<File> {
        let path = self.log_path(node);
        if fs::metadata(&path).is_ok_and(|log| log.len() > LOG_BYTES_KEPT) {
            fs::rename(&path, path.with_file_name("log.1"))?;
        }
        OpenOptions::new().create(true).append(true).mode(0o600).open(path)
    }

    pub(super) fn log_path(&self, node: &str) -> PathBuf {
        self.node(node).join("log")
    }

    /// Returns the record of a node; `None`: it has none.
    pub(super) fn record(&self, node: &str) -> Result<Option<Record>, String> {
        let path = self.node(node).join(RECORD);
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(at(&path, &error)),
        };
        let record = serde_json::from_reader(file.take(RECORD_BYTES_MAX));
        record.map(Some).map_err(|error| {
            let path = path.display();
            format!("{path} is no record of this version: {error}; end its node by hand, and remove the file")
        })
    }

    pub(super) fn write_record(&self, record: &Record) -> Result<(), String> {
        let path = self.node(&record.order.name).join(RECORD);
        let text = serde_json::to_vec(record).map_err(|error| at(&path, &error.into()))?;
        self.write(&path, &text)
    }

    /// Writes a file as a whole.
    pub(super) fn write(&self, path: &Path, text: &[u8]) -> Result<(), String> {
        let partial = path.with_file_name(".part");
        let folder = path.parent().unwrap_or(&self.robot);
        let written = folder_of(folder)
            .and_then(|()| write_to(&partial, &mut { text }, text.len() as u64))
            .and_then(|()| fs::rename(&partial, path));
        written.map_err(|error| at(path, &error))
    }

    /// Returns the names of all nodes with files here, in their order.
    pub(super) fn nodes(&self) -> Result<Vec<String>, String> {
        let folder = self.robot.join("nodes");
        let mut names: Vec<_> = entries(&folder)?.into_iter().filter_map(|path| name_of(&path)).collect();
        names.sort();
        Ok(names)
    }

    /// Removes all files of a node that this program has made. Returns those that it has not made.
    pub(super) fn remove(&self, node: &str) -> Result<Vec<PathBuf>, String> {
        let folder = self.node(node);
        if let Some(Record { order, .. }) = self.record(node)? {
            let files = order.files.iter().map(|file| folder.join(&file.path));
            let program = program_path(&order).map(|program| folder.join(program));
            files.chain(program).try_for_each(|file| removed(&file))?;
        }
        for name in ["log", "log.1", RECORD, ".part", "bin/.part", "keys/.part"] {
            removed(&folder.join(name))?;
        }
        for name in ["bin", "keys", ""] {
            // One with other files stays.
            let _ = fs::remove_dir(folder.join(name));
        }
        entries(&folder)
    }

    /// Removes contents that no node needs, and folders that are empty.
    pub(super) fn sweep(&self) -> Result<(), String> {
        let mut needed = Vec::new();
        for node in self.nodes()? {
            let record = self.record(&node)?;
            needed.extend(record.iter().flat_map(|record| record.order.hashes()).map(ToString::to_string));
        }
        for path in entries(&self.robot.join("files"))? {
            if name_of(&path).is_none_or(|name| !needed.contains(&name)) {
                removed(&path)?;
            }
        }
        if self.nodes()?.is_empty() {
            entries(&self.robot.join("units"))?.iter().try_for_each(|unit| removed(unit))?;
            let _ = fs::remove_dir(self.robot.join("units"));
            for name in ["files", "nodes"] {
                let _ = fs::remove_dir(self.robot.join(name));
            }
            removed(&self.robot.join("lock"))?;
            let _ = fs::remove_dir(&self.robot);
            if fs::remove_dir(self.folder.join("robots")).is_ok() {
                entries(&self.folder.join("tools"))?.iter().try_for_each(|tool| removed(tool))?;
                let _ = fs::remove_dir(self.folder.join("tools"));
                let _ = fs::remove_dir(&self.folder);
            }
        }
        Ok(())
    }
}

/// Returns the path of a copied program, relative to the folder of its node.
fn program_path(order: &NodeOrder) -> Option<PathBuf> {
    match &order.program {
        ProgramOrder::Copied { name, .. } => Some(Path::new("bin").join(name)),
        ProgramOrder::Installed(_) => None,
    }
}

fn locked(robot: &Path) -> Result<File, String> {
    let path = robot.join("lock");
    let opened = folder_of(robot)
        .and_then(|()| OpenOptions::new().create(true).truncate(false).write(true).mode(0o600).open(&path));
    let file = opened.map_err(|error| at(&path, &error))?;
    flock(&file, FlockOperation::NonBlockingLockExclusive).map_err(|why| match why {
        rustix::io::Errno::WOULDBLOCK => {
            format!(
                "{}: another `sinew up` or `sinew down` is at work; wait until it has ended",
                robot.display()
            )
        }
        other => at(&path, &other.into()),
    })?;
    Ok(file)
}

/// Refuses a path that is no file name, or one below the folder of keys.
fn check_path(path: &str) -> Result<(), String> {
    let name = path.strip_prefix(KEYS_PREFIX).unwrap_or(path);
    let is_name = !name.is_empty() && !name.contains(['/', '\0']) && ![".", ".."].contains(&name);
    if is_name { Ok(()) } else { Err(format!("{path:?} is no name of a file in the node's folder")) }
}

/// Creates a folder for this user alone, with its parents.
fn folder_of(path: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(path)
}

fn write_to(path: &Path, content: &mut dyn Read, bytes: u64) -> io::Result<()> {
    let mut file = OpenOptions::new().create(true).truncate(true).write(true).mode(0o600).open(path)?;
    io::copy(&mut content.take(bytes), &mut file)?;
    file.flush()
}

/// Removes a file, if it exists.
fn removed(path: &Path) -> Result<(), String> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(at(path, &error)),
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Returns the entries of a folder, none if it does not exist.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, String> {
    match fs::read_dir(folder) {
        Ok(entries) => Ok(entries.flatten().take(ENTRIES_MAX).map(|entry| entry.path()).collect()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(at(folder, &error)),
    }
}

fn name_of(path: &Path) -> Option<String> {
    path.file_name()?.to_str().map(str::to_owned)
}
