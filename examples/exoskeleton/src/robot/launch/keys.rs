//! Whether the keys of all four nodes are there and theirs, before anything of the robot is started or written.

use std::path::{Path, PathBuf};

use sinew::security::{CredentialFault, Credentials, Identity, UnixTime};
use thiserror::Error;

use crate::part::Part;
use crate::robot::topology::Topology;

/// Names that are tried for a directory that is not there yet.
const NAMES_MAX: u32 = 1_000;

/// Keys that are not those of this robot's nodes. The user is at fault; nothing was started.
#[derive(Debug, Error)]
#[error(
    "the keys in {directory} are not those of this robot's nodes:\n{faults}\nThis makes them all, with the addresses that the nodes have:\n  \
     {command}\nThen walk with --keys {out}"
)]
pub struct KeyFaults {
    directory: String,
    /// One a line, of each node the first.
    faults: String,
    command: String,
    out: String,
}

/// Looks at the keys of each node, which are in the directory that the user calls `given`.
pub(super) fn check(topology: &Topology, given: &Path) -> Result<(), KeyFaults> {
    let faults: Vec<String> = Part::ALL.into_iter().filter_map(|part| fault(topology, part)).collect();
    if faults.is_empty() {
        return Ok(());
    }
    let nodes = Part::ALL.map(|part| format!("{part}={}", topology.place(part).address));
    let out = quoted(&free(given).display().to_string());
    let command = format!("sinew keys init {} {} --out {out}", quoted(&topology.project), nodes.join(" "));
    let faults = if given.exists() { faults.join("\n") } else { "  there is no such directory".to_owned() };
    Err(KeyFaults { directory: given.display().to_string(), faults, command, out })
}

/// The first thing that is wrong with the keys of a node, with no remedy for it alone: that may take an address from another one.
fn fault(topology: &Topology, part: Part) -> Option<String> {
    let config = topology.node_config(part);
    let keys = config.security.keys.as_ref()?;
    let address = config.node_address();
    let identity = Identity { project: config.project.clone(), address, name: config.name.clone() };
    let faults = Credentials::load(keys, &identity, config.security.times, UnixTime::now()).err()?;
    let first = faults.faults().first()?;
    Some(if let CredentialFault::OtherNode { certified, .. } = first {
        format!("  {part} is to be {identity}, and its keys are of {certified}")
    } else {
        format!("  {part}: {first}")
    })
}

/// A directory that `sinew keys init` makes or fills: it replaces nothing.
fn free(given: &Path) -> PathBuf {
    // Without a slash at its end.
    let given: PathBuf = given.components().collect();
    let is_free = |path: &Path| match std::fs::read_dir(path) {
        Ok(mut inside) => inside.next().is_none(),
        Err(_) => !path.exists(),
    };
    let numbered = (2..=NAMES_MAX).map(|number| PathBuf::from(format!("{}-{number}", given.display())));
    let free = std::iter::once(given.clone()).chain(numbered).find(|path| is_free(path));
    // As many robots have no keys: then the command says what is in the way.
    free.unwrap_or(given)
}

/// One word for the shell.
fn quoted(word: &str) -> String {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "/._-".contains(sign);
    if word.chars().all(is_plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::topology::for_this_host;

    #[test]
    fn robot_without_its_keys_is_told_one_command_that_makes_all_of_them_where_there_is_room() {
        let mut topology = for_this_host(1).unwrap();
        "walker".clone_into(&mut topology.project);
        let directory = std::env::temp_dir().join(format!("exoskeleton-no-keys-{}", std::process::id()));
        topology.keys = Some(directory.clone());
        let told = |given: &Path| check(&topology, given).unwrap_err().to_string();
        let command = "\n  sinew keys init walker central=127.0.0.1 hip=127.0.0.2 knee=127.0.0.3 ankle=127.0.0.4 --out ";
        // There is no directory.
        let words = told(&directory);
        assert!(words.contains(&format!("{command}{}\n", directory.display())), "{words}");
        assert!(words.contains("there is no such directory"), "{words}");
        // There is one with something else in it: each node is named, and another directory.
        std::fs::create_dir_all(directory.join("nodes")).unwrap();
        let words = told(&directory.join(""));
        std::fs::remove_dir_all(&directory).unwrap();
        assert!(words.contains(&format!("{command}{}-2\n", directory.display())), "{words}");
        for part in Part::ALL {
            assert!(words.contains(&format!("\n  {part}: ")), "{words}");
        }
        // What the shell would take for several words is one.
        "ada's walker".clone_into(&mut topology.project);
        let words = check(&topology, Path::new("/nowhere/my keys")).unwrap_err().to_string();
        assert!(words.contains(r"sinew keys init 'ada'\''s walker' central="), "{words}");
        assert!(words.contains(" --out '/nowhere/my keys'\n"), "{words}");
        assert!(words.ends_with("--keys '/nowhere/my keys'"), "{words}");
        // Without any nothing is looked at.
        topology.keys = None;
        assert!(check(&topology, &directory).is_ok());
    }
}
