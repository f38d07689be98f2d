//! Finds the socket of a node on this machine.

use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

use sinew::{ApiError, NodeApi};

/// Sockets in one directory that are tried at most.
const SOCKETS_MAX: usize = 64;

/// Nobody let us in.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NoDoor {
    /// At the path that was given.
    #[error("{cause}\nThe path is from {from}. {START}")]
    There {
        /// Where the path was given.
        from: &'static str,
        /// What the node's API says.
        cause: ApiError,
    },
    /// At none of the usual places.
    #[error("no node was found on this machine. Looked at:{places}\n{START}")]
    Nowhere {
        /// Where it was looked, and what was there.
        places: String,
    },
}

const START: &str = "A node has such a door when its configuration has [lncl] socket = \"/run/sinew/NAME.sock\"; start one, or say where \
                     it is: sinew --socket PATH. One to try: cargo run -p sinew-c --bin sinew-node -- bindings/c/examples/knee.toml";

/// Enters through the socket that was named, else through the first that lets us in.
pub(crate) fn find(named: Option<&Path>) -> Result<(PathBuf, NodeApi), NoDoor> {
    let from_environment = std::env::var_os("SINEW_SOCKET").map(PathBuf::from);
    let named = named.map(|path| (path.to_owned(), "--socket"));
    if let Some((path, from)) = named.or_else(|| Some((from_environment?, "SINEW_SOCKET"))) {
        let api = NodeApi::connect(&path).map_err(|cause| NoDoor::There { from, cause })?;
        return Ok((path, api));
    }
    let mut places = String::new();
    for (directory, prefix) in usual_places() {
        let sockets = sockets(&directory, prefix);
        let shown = directory.join(format!("{prefix}*.sock"));
        if sockets.is_empty() {
            let _ = write!(places, "\n  {}: nothing there", shown.display());
        }
        for path in sockets {
            match NodeApi::connect(&path) {
                Ok(api) => return Ok((path, api)),
                Err(error) => drop(write!(places, "\n  {}: {}", path.display(), in_short(&error))),
            }
        }
    }
    Err(NoDoor::Nowhere { places })
}

/// Directories, and how a socket's name begins there.
fn usual_places() -> Vec<(PathBuf, &'static str)> {
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(|directory| (Path::new(&directory).join("sinew"), ""));
    own.into_iter().chain([("/run/sinew".into(), ""), ("/tmp".into(), "sinew-")]).collect()
}

/// The sockets in `directory` whose name begins so, in the order of their names.
fn sockets(directory: &Path, prefix: &str) -> Vec<PathBuf> {
    let is_one = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str());
        name.is_some_and(|name| name.starts_with(prefix) && name.ends_with(".sock"))
    };
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let mut paths: Vec<_> = entries.map(|entry| entry.path()).filter(is_one).take(SOCKETS_MAX).collect();
    paths.sort();
    paths
}

fn in_short(error: &ApiError) -> String {
    if let ApiError::NoNode { cause, .. } = error { cause.to_string() } else { error.to_string() }
}
