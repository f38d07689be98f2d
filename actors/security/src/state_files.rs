//! Files in the state directory of a node (`node.state`): private to the node's user, replaced as a whole.

use std::{
    fs::{DirBuilder, File, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
};

use sinew_runtime::tid::NodeAddress;

use crate::files;

/// Returns the path of the file with these contents, of the project's node with this address. A node of another project
/// may use the same address and directory.
#[must_use]
pub fn path(directory: &Path, contents: &str, project: &str, node: NodeAddress) -> PathBuf {
    let letter = |byte: u8| match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' => char::from(byte).to_string(),
        other => format!("%{other:02x}"),
    };
    let project: String = project.bytes().map(letter).collect();
    directory.join(format!("{contents}-{project}-{node}"))
}

/// Replaces a file in the state directory, which is created if only itself is missing. A reader gets either the old or
/// the new content, also after a power failure.
///
/// # Errors
/// Returns why the file cannot be written, with the remedy.
pub fn replace(path: &Path, bytes: &[u8]) -> Result<(), String> {
    let directory = path.parent().unwrap_or_else(|| Path::new("."));
    match DirBuilder::new().mode(0o700).create(directory) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
            return Err(format!(
                "{}: {error}; make the directory, for the node's user, or set `node.state` to another one",
                directory.display()
            ));
        }
        Ok(()) | Err(_) => {}
    }
    files::directory(directory).map_err(|why| why.to_string())?;
    write(path, directory, bytes).map_err(|error| {
        format!("{error}; let the node's user write in {}, and see that there is room", directory.display())
    })
}

fn write(path: &Path, directory: &Path, bytes: &[u8]) -> io::Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let beside = directory.join(format!(".{name}.new"));
    // A killed process may have left this file.
    let _ = std::fs::remove_file(&beside);
    let written = (|| {
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&beside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    })();
    if written.is_err() {
        // Removes the incomplete file.
        let _ = std::fs::remove_file(&beside);
    }
    written?;
    // Makes the renamed directory entry durable, too.
    File::open(directory)?.sync_all()
}
