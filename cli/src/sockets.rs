//! Finds the socket of a node on this machine.
//!
//! A named socket is asked, whichever user's process listens there. A socket found by search is asked only if its file
//! and the listening process belong to this command's own user, or to root. In `/tmp` any user can create a socket that
//! gives false answers, for example that a certificate is revoked.

#[cfg(test)]
mod tests;

use std::{
    collections::BTreeSet,
    fmt::Write as _,
    fs, io,
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
    time::Duration,
};

use sinew::{NodeApi, Time, client::ApiError};

use crate::table::clean;

/// Maximum number of tried sockets per directory.
const SOCKETS_MAX: usize = 64;
/// Maximum number of listed skipped sockets per directory; the number of further ones is reported.
const LEFT_OUT_MAX: usize = 4;
/// Maximum number of further nodes that are asked.
const OTHERS_MAX: usize = 16;
/// Time limit to connect to all found sockets together: a process that accepts nothing costs 2 s.
const FOUND_WITHIN: Duration = Duration::from_secs(4);

/// No socket accepts this command.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NoSocketError {
    /// None at the given path.
    #[error("{cause}\nThe path is from {from}. {START}")]
    There {
        /// The source of the path.
        from: &'static str,
        /// The error of the node's API.
        cause: ApiError,
    },
    /// None at the usual places.
    #[error("no node was found on this machine. Looked at:{places}\n{START}")]
    Nowhere {
        /// The searched places, and their sockets.
        places: String,
    },
}

const START: &str = "A node has a socket when its configuration has [lncl] socket = \"/run/sinew/NAME.sock\"; start one, or name \
                     its socket: sinew --socket PATH. One to try: cargo run -p sinew-node -- bindings/c/examples/knee.toml";

/// Connects through the named socket, else through the first of the own user that accepts this command.
pub(crate) fn find(named: Option<&Path>) -> Result<(PathBuf, NodeApi), NoSocketError> {
    let from_environment = std::env::var_os("SINEW_SOCKET").map(PathBuf::from);
    let named = named.map(|path| (path.to_owned(), "--socket"));
    if let Some((path, from)) = named.or_else(|| Some((from_environment?, "SINEW_SOCKET"))) {
        let api = NodeApi::connect(&path).map_err(|cause| NoSocketError::There { from, cause })?;
        return Ok((path, api));
    }
    find_at(usual_places(), own_uid()).map_err(|places| NoSocketError::Nowhere { places })
}

/// Returns whether the socket is searched for: no option and no variable names it.
pub(crate) fn is_searched(named: Option<&Path>) -> bool {
    named.is_none() && std::env::var_os("SINEW_SOCKET").is_none()
}

/// Returns the first socket at these places that accepts this command; else a description of the places.
fn find_at(places: Vec<SocketFolder>, own: u32) -> Result<(PathBuf, NodeApi), String> {
    let (mut looked, until) = (String::new(), Time::now() + FOUND_WITHIN);
    for place in places {
        let found = Found::at(&place, own);
        if found.is_empty() {
            let _ = write!(looked, "\n  {}: nothing there", place.shown());
        }
        for path in found.own {
            match ask(&path, until) {
                Ok(api) => return Ok((path, api)),
                Err(why) => drop(write!(looked, "\n  {}: {why}", shown(&path))),
            }
        }
        for stranger in found.left_out {
            let _ = write!(looked, "\n  {}", stranger.in_words("--socket"));
        }
        if found.more > 0 {
            let (place, more) = (place.shown(), found.more);
            let _ = write!(looked, "\n  {place}: {more} more there belong to other users: not asked");
        }
    }
    Err(looked)
}

/// Further nodes.
pub(crate) struct OtherSockets {
    /// Nodes with a process that listens on their socket.
    pub(crate) nodes: Vec<(PathBuf, NodeApi)>,
    /// Sockets that are not asked, with the reason.
    pub(crate) left_out: Vec<String>,
}

/// Returns further nodes: at these paths, in the directory of the socket at `known`, and at the usual places; not the
/// one at `known`.
pub(crate) fn others(known: &Path, named: &[PathBuf]) -> OtherSockets {
    others_within(known, named, FOUND_WITHIN)
}

/// Same as [`others`], with a time limit for all connections to found sockets together.
pub(crate) fn others_within(known: &Path, named: &[PathBuf], within: Duration) -> OtherSockets {
    let beside = known.parent().map(|directory| SocketFolder { directory: directory.to_owned(), prefix: "" });
    others_at(known, named, beside.into_iter().chain(usual_places()), (own_uid(), within))
}

fn others_at(
    known: &Path,
    named: &[PathBuf],
    places: impl Iterator<Item = SocketFolder>,
    (own, within): (u32, Duration),
) -> OtherSockets {
    let (mut nodes, mut left_out) = (Vec::new(), Vec::new());
    let (mut seen, until) = (BTreeSet::from([real(known)]), Time::now() + within);
    for path in named {
        if nodes.len() < OTHERS_MAX
            && seen.insert(real(path))
            && let Ok(api) = NodeApi::connect(path)
        {
            nodes.push((path.clone(), api));
        }
    }
    for place in places {
        let found = Found::at(&place, own);
        for path in found.own {
            if nodes.len() < OTHERS_MAX
                && seen.insert(real(&path))
                && let Ok(api) = ask(&path, until)
            {
                nodes.push((path, api));
            }
        }
        let new = found.left_out.into_iter().filter(|stranger| seen.insert(real(&stranger.path)));
        left_out.extend(new.map(|stranger| stranger.in_words("--other-socket")));
    }
    OtherSockets { nodes, left_out }
}

/// Returns the sockets of the own user at the usual places that have no listening process.
pub(crate) fn dead() -> Vec<PathBuf> {
    let (own, until) = (own_uid(), Time::now() + FOUND_WITHIN);
    let usual = usual_places().into_iter().flat_map(|place| Found::at(&place, own).own);
    let is_dead = |path: &PathBuf| {
        let refused = NodeApi::connect_trusted(path, until.since(Time::now())).err();
        matches!(refused, Some(ApiError::NoNode { cause, .. }) if cause.kind() == io::ErrorKind::ConnectionRefused)
    };
    usual.filter(is_dead).collect()
}

/// Connects to a found socket, if there is time left.
fn ask(path: &Path, until: Time) -> Result<NodeApi, String> {
    let left = until.since(Time::now());
    if left.is_zero() {
        return Err(format!("not asked: those before it have taken all of {FOUND_WITHIN:?}"));
    }
    NodeApi::connect_trusted(path, left).map_err(|error| in_short(&error))
}

fn real(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

fn own_uid() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// A directory, and the prefix of socket names there.
struct SocketFolder {
    directory: PathBuf,
    prefix: &'static str,
}

impl SocketFolder {
    fn shown(&self) -> String {
        shown(&self.directory.join(format!("{}*.sock", self.prefix)))
    }

    fn has(&self, path: &Path) -> bool {
        let name = path.file_name().and_then(|name| name.to_str());
        name.is_some_and(|name| name.starts_with(self.prefix) && name.ends_with(".sock"))
    }
}

fn usual_places() -> Vec<SocketFolder> {
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(|directory| Path::new(&directory).join("sinew"));
    let own = own.map(|directory| SocketFolder { directory, prefix: "" });
    let others = [("/run/sinew", ""), ("/tmp", "sinew-")];
    let others = others.map(|(directory, prefix)| SocketFolder { directory: directory.into(), prefix });
    own.into_iter().chain(others).collect()
}

/// The sockets at one place.
#[derive(Debug, Default)]
struct Found {
    /// Those of the own user and of root, in the order of their names.
    own: Vec<PathBuf>,
    /// Some of the others.
    left_out: Vec<ForeignSockets>,
    /// Number of further ones.
    more: usize,
}

/// A socket of another user.
#[derive(Debug)]
struct ForeignSockets {
    path: PathBuf,
    uid: u32,
}

impl Found {
    /// Lists the files, and connects to none. Those of other users have their own bounds: thousands of them cannot hide
    /// one of the own user.
    fn at(place: &SocketFolder, own: u32) -> Self {
        let entries = fs::read_dir(&place.directory).into_iter().flatten().flatten();
        let mut found = Self::default();
        for path in entries.map(|entry| entry.path()).filter(|path| place.has(path)) {
            match stranger(&path, own) {
                None if found.own.len() < SOCKETS_MAX => found.own.push(path),
                // Further ones are not tried.
                None => {}
                Some(uid) if found.left_out.len() < LEFT_OUT_MAX => {
                    found.left_out.push(ForeignSockets { path, uid });
                }
                Some(_) => found.more += 1,
            }
        }
        found.own.sort();
        found.left_out.sort_by(|one, next| one.path.cmp(&next.path));
        found
    }

    fn is_empty(&self) -> bool {
        self.own.is_empty() && self.left_out.is_empty()
    }
}

impl ForeignSockets {
    /// Returns why it is not asked, and the option that asks it nevertheless.
    fn in_words(&self, option: &str) -> String {
        let (path, uid) = (shown(&self.path), self.uid);
        format!("{path} belongs to uid {uid}: not asked; name it with {option} to ask it nevertheless")
    }
}

/// Returns the owner of this file, or of its target if it is a link, unless that is `own` or root.
fn stranger(path: &Path, own: u32) -> Option<u32> {
    // A removed file, or a broken link, has no other owner: a connection to it reports the error.
    let file = fs::symlink_metadata(path).ok()?;
    let target = if file.is_symlink() { fs::metadata(path).ok() } else { None };
    let mut owners = [Some(file), target].into_iter().flatten().map(|file| file.uid());
    owners.find(|uid| *uid != own && *uid != 0)
}

/// Returns a path as text; other users may have put control characters of terminals in it.
fn shown(path: &Path) -> String {
    clean(&path.display().to_string())
}

fn in_short(error: &ApiError) -> String {
    if let ApiError::NoNode { cause, .. } = error { cause.to_string() } else { error.to_string() }
}
