//! Finds the socket of a node on this machine.
//!
//! A socket that was named is asked, whoever listens there. One that was found is asked only if its file and the process that listens are of
//! this command's own user, or of root: in `/tmp` anybody can put one that answers what he likes, as that a certificate is revoked.

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

/// Sockets of one directory that are tried at most.
const SOCKETS_MAX: usize = 64;
/// Sockets of one directory that are left out and named at most; how many more there are is said.
const LEFT_OUT_MAX: usize = 4;
/// Further nodes that are asked at most.
const OTHERS_MAX: usize = 16;
/// Time to connect to all sockets together that were found: one whose process takes nobody costs 2 s.
const FOUND_WITHIN: Duration = Duration::from_secs(4);

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

/// Enters through the socket that was named, else through the first of one's own that lets us in.
pub(crate) fn find(named: Option<&Path>) -> Result<(PathBuf, NodeApi), NoDoor> {
    let from_environment = std::env::var_os("SINEW_SOCKET").map(PathBuf::from);
    let named = named.map(|path| (path.to_owned(), "--socket"));
    if let Some((path, from)) = named.or_else(|| Some((from_environment?, "SINEW_SOCKET"))) {
        let api = NodeApi::connect(&path).map_err(|cause| NoDoor::There { from, cause })?;
        return Ok((path, api));
    }
    find_at(usual_places(), own_uid()).map_err(|places| NoDoor::Nowhere { places })
}

/// The first of these places that lets us in; else what was there.
fn find_at(places: Vec<Place>, own: u32) -> Result<(PathBuf, NodeApi), String> {
    let (mut seen, until) = (String::new(), Time::now() + FOUND_WITHIN);
    for place in places {
        let found = Found::at(&place, own);
        if found.is_empty() {
            let _ = write!(seen, "\n  {}: nothing there", place.shown());
        }
        for path in found.own {
            match ask(&path, until) {
                Ok(api) => return Ok((path, api)),
                Err(why) => drop(write!(seen, "\n  {}: {why}", shown(&path))),
            }
        }
        for stranger in found.left_out {
            let _ = write!(seen, "\n  {}", stranger.in_words("--socket"));
        }
        if found.more > 0 {
            let (place, more) = (place.shown(), found.more);
            let _ = write!(seen, "\n  {place}: {more} more there belong to others: not asked");
        }
    }
    Err(seen)
}

/// Further nodes.
pub(crate) struct Others {
    /// Those behind which somebody listens.
    pub(crate) doors: Vec<(PathBuf, NodeApi)>,
    /// Those that are not asked, and why, in words.
    pub(crate) left_out: Vec<String>,
}

/// Further nodes: at these paths, beside the socket at `known`, and at the usual places; not the one at `known`.
pub(crate) fn others(known: &Path, named: &[PathBuf]) -> Others {
    let beside = known.parent().map(|directory| Place { directory: directory.to_owned(), prefix: "" });
    others_at(known, named, beside.into_iter().chain(usual_places()), own_uid())
}

fn others_at(known: &Path, named: &[PathBuf], places: impl Iterator<Item = Place>, own: u32) -> Others {
    let (mut doors, mut left_out) = (Vec::new(), Vec::new());
    let (mut seen, until) = (BTreeSet::from([real(known)]), Time::now() + FOUND_WITHIN);
    for path in named {
        if doors.len() < OTHERS_MAX
            && seen.insert(real(path))
            && let Ok(api) = NodeApi::connect(path)
        {
            doors.push((path.clone(), api));
        }
    }
    for place in places {
        let found = Found::at(&place, own);
        for path in found.own {
            if doors.len() < OTHERS_MAX
                && seen.insert(real(&path))
                && let Ok(api) = ask(&path, until)
            {
                doors.push((path, api));
            }
        }
        let new = found.left_out.into_iter().filter(|stranger| seen.insert(real(&stranger.path)));
        left_out.extend(new.map(|stranger| stranger.in_words("--other-socket")));
    }
    Others { doors, left_out }
}

/// Sockets of one's own at the usual places behind which nobody listens.
pub(crate) fn dead() -> Vec<PathBuf> {
    let (own, until) = (own_uid(), Time::now() + FOUND_WITHIN);
    let usual = usual_places().into_iter().flat_map(|place| Found::at(&place, own).own);
    let is_dead = |path: &PathBuf| {
        let refused = NodeApi::connect_found(path, until.since(Time::now())).err();
        matches!(refused, Some(ApiError::NoNode { cause, .. }) if cause.kind() == io::ErrorKind::ConnectionRefused)
    };
    usual.filter(is_dead).collect()
}

/// Connects to a socket that was found, if there is time left.
fn ask(path: &Path, until: Time) -> Result<NodeApi, String> {
    let left = until.since(Time::now());
    if left.is_zero() {
        return Err(format!("not asked: those before it have taken all of {FOUND_WITHIN:?}"));
    }
    NodeApi::connect_found(path, left).map_err(|error| in_short(&error))
}

fn real(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

fn own_uid() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// A directory, and how a socket's name begins there.
struct Place {
    directory: PathBuf,
    prefix: &'static str,
}

impl Place {
    fn shown(&self) -> String {
        shown(&self.directory.join(format!("{}*.sock", self.prefix)))
    }

    fn has(&self, path: &Path) -> bool {
        let name = path.file_name().and_then(|name| name.to_str());
        name.is_some_and(|name| name.starts_with(self.prefix) && name.ends_with(".sock"))
    }
}

fn usual_places() -> Vec<Place> {
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(|directory| Path::new(&directory).join("sinew"));
    let own = own.map(|directory| Place { directory, prefix: "" });
    let others = [("/run/sinew", ""), ("/tmp", "sinew-")];
    let others = others.map(|(directory, prefix)| Place { directory: directory.into(), prefix });
    own.into_iter().chain(others).collect()
}

/// The sockets at one place.
#[derive(Debug, Default)]
struct Found {
    /// Those of one's own user and of root, in the order of their names.
    own: Vec<PathBuf>,
    /// Some of the others.
    left_out: Vec<Strangers>,
    /// How many others there are beside these.
    more: usize,
}

/// A socket of another user.
#[derive(Debug)]
struct Strangers {
    path: PathBuf,
    uid: u32,
}

impl Found {
    /// Looks at the files, and connects to none. Those of others have bounds of their own: thousands of them hide none of one's own.
    fn at(place: &Place, own: u32) -> Self {
        let entries = fs::read_dir(&place.directory).into_iter().flatten().flatten();
        let mut found = Self::default();
        for path in entries.map(|entry| entry.path()).filter(|path| place.has(path)) {
            match stranger(&path, own) {
                None if found.own.len() < SOCKETS_MAX => found.own.push(path),
                // So many are tried.
                None => {}
                Some(uid) if found.left_out.len() < LEFT_OUT_MAX => {
                    found.left_out.push(Strangers { path, uid });
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

impl Strangers {
    /// Why it is not asked, and by which option it is all the same.
    fn in_words(&self, option: &str) -> String {
        let (path, uid) = (shown(&self.path), self.uid);
        format!("{path} belongs to uid {uid}: not asked; name it with {option} to ask it all the same")
    }
}

/// The user other than `own` and root to whom this file belongs, or where it is a link what it stands for.
fn stranger(path: &Path, own: u32) -> Option<u32> {
    // What has gone meanwhile, or leads nowhere, is nobody's: who connects to it is told so, and sees who listens there.
    let file = fs::symlink_metadata(path).ok()?;
    let target = if file.is_symlink() { fs::metadata(path).ok() } else { None };
    let mut owners = [Some(file), target].into_iter().flatten().map(|file| file.uid());
    owners.find(|uid| *uid != own && *uid != 0)
}

/// A path, in which others may have put what terminals obey.
fn shown(path: &Path) -> String {
    clean(&path.display().to_string())
}

fn in_short(error: &ApiError) -> String {
    if let ApiError::NoNode { cause, .. } = error { cause.to_string() } else { error.to_string() }
}
