//! The sockets of nodes on this machine: where they can be, whether one lets us in, and what nodes that were killed have left.

use std::path::{Path, PathBuf};

use super::Check;
use crate::door;

/// Where a node may put its own.
pub(super) fn directory() -> Check {
    const NAME: &str = "socket directory";
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(|directory| PathBuf::from(directory).join("sinew"));
    let places: Vec<_> = own.iter().cloned().chain(["/run/sinew".into()]).collect();
    if let Some(place) = places.iter().find(|place| is_writable(place)) {
        return Check::fine(NAME, format!("{} is there and can be written to", place.display()));
    }
    let places: Vec<_> = places.iter().map(|place| place.display().to_string()).collect();
    let shown = match &places[..] {
        [place] => format!("{place} cannot be written to"),
        places => format!("neither {} can be written to", places.join(" nor ")),
    };
    let mend = if own.as_ref().and_then(|own| own.parent()).is_some_and(is_writable) {
        "mkdir -p \"$XDG_RUNTIME_DIR/sinew\""
    } else {
        "sudo install -d -o \"$(id -un)\" /run/sinew"
    };
    Check::finding(NAME, shown, mend)
}

fn is_writable(directory: &Path) -> bool {
    directory.is_dir() && rustix::fs::access(directory, rustix::fs::Access::WRITE_OK).is_ok()
}

/// Those behind which nobody listens any more.
pub(super) fn leftover() -> Check {
    const NAME: &str = "leftover sockets";
    let dead = door::dead();
    if dead.is_empty() {
        return Check::fine(NAME, "none".to_owned());
    }
    let shown: Vec<_> = dead.iter().map(|path| path.display().to_string()).collect();
    let seen =
        format!("{}: their nodes were killed. The next start of each takes its own away", shown.join(", "));
    Check::finding(NAME, seen, format!("start those nodes again, or: rm {}", shown.join(" ")))
}

/// Whether one lets us in.
pub(super) fn node(socket: Option<&Path>) -> Check {
    match door::find(socket) {
        Ok((path, _)) => Check::fine("node", format!("one lets us in at {}", path.display())),
        Err(error) => Check::finding("node", "none lets us in".to_owned(), error.to_string()),
    }
}
