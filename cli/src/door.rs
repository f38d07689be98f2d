//! Finds the socket of a node on this machine.

use std::{
    collections::BTreeSet,
    fmt::Write as _,
    io,
    path::{Path, PathBuf},
};

use sinew::{ApiError, NodeApi};

/// Sockets in one directory that are tried at most.
const SOCKETS_MAX: usize = 64;
/// Further nodes that are asked at most.
const OTHERS_MAX: usize = 16;

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

/// Further nodes: at the usual places, beside the socket at `known`, and at these paths; not the one at `known`.
pub(crate) fn others(known: &Path, named: &[PathBuf]) -> Vec<(PathBuf, NodeApi)> {
    let beside = known.parent().map(|directory| sockets(directory, "")).unwrap_or_default();
    let usual = usual_places().into_iter().flat_map(|(directory, prefix)| sockets(&directory, prefix));
    let mut seen = BTreeSet::from([real(known)]);
    let paths = named.iter().cloned().chain(beside).chain(usual).filter(|path| seen.insert(real(path)));
    paths.filter_map(|path| Some((path.clone(), NodeApi::connect(&path).ok()?))).take(OTHERS_MAX).collect()
}

/// Sockets at the usual places behind which nobody listens.
pub(crate) fn dead() -> Vec<PathBuf> {
    let usual = usual_places().into_iter().flat_map(|(directory, prefix)| sockets(&directory, prefix));
    let is_dead = |path: &PathBuf| {
        let refused = NodeApi::connect(path).err();
        matches!(refused, Some(ApiError::NoNode { cause, .. }) if cause.kind() == io::ErrorKind::ConnectionRefused)
    };
    usual.filter(is_dead).collect()
}

fn real(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
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
