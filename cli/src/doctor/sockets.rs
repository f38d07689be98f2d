//! Checks the sockets of nodes on this machine: their directory, whether one accepts this command, and leftovers of
//! killed nodes.

use std::path::{Path, PathBuf};

use super::Check;
use crate::sockets;

/// Checks the places where a node may create its socket. If a node runs with its socket elsewhere, none of the usual
/// places is needed.
pub(super) fn directory(has_node: bool) -> Check {
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(|directory| PathBuf::from(directory).join("sinew"));
    directory_of(own.as_deref(), Path::new("/run/sinew"), has_node)
}

/// Checks the directory of the user, if there is one, and that of the host.
fn directory_of(own: Option<&Path>, common: &Path, has_node: bool) -> Check {
    const NAME: &str = "socket directory";
    let places: Vec<_> = own.into_iter().chain([common]).collect();
    if let Some(place) = places.iter().find(|place| is_writable(place)) {
        return Check::fine(NAME, format!("{} is there and can be written to", place.display()));
    }
    let state = |place: &&Path| {
        let state = if place.exists() { "cannot be written to" } else { "does not exist" };
        format!("{} {state}", place.display())
    };
    let detail = places.iter().map(state).collect::<Vec<_>>().join(", ");
    if has_node {
        return Check::fine(NAME, format!("{detail}; the node that was found has its socket elsewhere"));
    }
    let make = match own.filter(|own| own.parent().is_some_and(is_writable)) {
        Some(_) => "mkdir -p \"$XDG_RUNTIME_DIR/sinew\"".to_owned(),
        None if common.parent().is_some_and(is_writable) => format!("mkdir -p {}", common.display()),
        None => format!("sudo install -d -o \"$(id -un)\" {}", common.display()),
    };
    Check::finding(
        NAME,
        detail,
        format!("{make}; or set `lncl.socket` of each node to another place, as /tmp/sinew-NAME.sock"),
    )
}

fn is_writable(directory: &Path) -> bool {
    directory.is_dir() && rustix::fs::access(directory, rustix::fs::Access::WRITE_OK).is_ok()
}

/// Reports the sockets without a listening process.
pub(super) fn leftover() -> Check {
    const NAME: &str = "leftover sockets";
    let dead = sockets::dead();
    if dead.is_empty() {
        return Check::fine(NAME, "none".to_owned());
    }
    let shown: Vec<_> = dead.iter().map(|path| path.display().to_string()).collect();
    let detail =
        format!("{}: their nodes were killed. The next start of each removes its own", shown.join(", "));
    Check::finding(NAME, detail, format!("start those nodes again, or: rm {}", shown.join(" ")))
}

/// Checks whether one accepts this command.
pub(super) fn node(socket: Option<&Path>) -> Check {
    match sockets::find(socket) {
        Ok((path, _)) => Check::fine("node", format!("one accepts this command at {}", path.display())),
        Err(error) => Check::finding("node", "none accepts this command".to_owned(), error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use sinew_testkit::TestDirectory;

    use super::*;

    #[test]
    fn missing_socket_directory_is_a_finding_without_a_node() {
        let directory = TestDirectory::new();
        let missing = directory.join("sinew");
        let found = directory_of(None, &missing, false);
        assert!(found.detail.ends_with("/sinew does not exist"), "{}", found.detail);
        let fix = found.fix.expect("a finding");
        let make = format!("mkdir -p {}; or set `lncl.socket`", missing.display());
        assert!(fix.starts_with(&make), "{fix}");
        let elsewhere = directory_of(None, &missing, true);
        assert!(
            elsewhere.fix.is_none() && elsewhere.detail.contains("does not exist; the node"),
            "{}",
            elsewhere.detail
        );
        // One of two places is enough.
        std::fs::create_dir(&missing).expect("the test's own directory");
        let own = directory.join("user/sinew");
        let there = directory_of(Some(&own), &missing, false);
        assert!(
            there.fix.is_none() && there.detail.ends_with("is there and can be written to"),
            "{}",
            there.detail
        );
    }
}
