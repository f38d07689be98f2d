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
#[error("the keys in {directory} are not good for this robot's nodes:\n{faults}\n{remedy}")]
pub struct KeyFaults {
    directory: String,
    /// One a line, of each node the first.
    faults: String,
    remedy: String,
}

/// Looks at the keys of each node, which are in the directory that the user calls `given`.
pub(super) fn check(topology: &Topology, given: &Path) -> Result<(), KeyFaults> {
    let mut faults: Vec<Fault> = Part::ALL.into_iter().filter_map(|part| fault(topology, part)).collect();
    if faults.is_empty() {
        faults.extend(strangers(topology));
    }
    if faults.is_empty() {
        return Ok(());
    }
    let directory = given.display().to_string();
    let told =
        |faults: &[Fault]| faults.iter().map(|fault| fault.words.clone()).collect::<Vec<_>>().join("\n");
    if let Some(project) = project_around(given) {
        let remedy = format!("This is the directory of one node; name that of the project: --keys {project}");
        return Err(KeyFaults { directory, faults: told(&faults), remedy });
    }
    if given.join("ca.pem").exists() && faults.iter().all(|fault| fault.is_of_one) {
        let parts: Vec<_> = faults.iter().map(|fault| fault.part.to_string()).collect();
        let command = format!("sinew keys issue {} --keys {}", parts.join(" "), quoted(&directory));
        let remedy = format!(
            "Where no line says what mends it, this makes the keys of these nodes anew:\n  {command}"
        );
        return Err(KeyFaults { directory, faults: told(&faults), remedy });
    }
    let nodes = Part::ALL.map(|part| format!("{part}={}", topology.place(part).address));
    let out = quoted(&free(given).display().to_string());
    let command = format!("sinew keys init {} {} --out {out}", quoted(&topology.project), nodes.join(" "));
    let faults = if given.exists() { told(&faults) } else { "  there is no such directory".to_owned() };
    let remedy = format!(
        "This makes them all, with the addresses that the nodes have:\n  {command}\nThen walk with --keys {out}"
    );
    Err(KeyFaults { directory, faults, remedy })
}

/// What is wrong with the keys of a node.
struct Fault {
    part: Part,
    words: String,
    /// The others' may be good all the same.
    is_of_one: bool,
}

/// The project whose keys of one node are in that directory.
fn project_around(node: &Path) -> Option<String> {
    let nodes = node.parent().filter(|nodes| nodes.ends_with("nodes"))?;
    let project = nodes.parent().filter(|_| node.join("node.pem").exists())?;
    Some(quoted(&if project.as_os_str().is_empty() { Path::new(".") } else { project }.display().to_string()))
}

/// Nodes whose keys are good by themselves and of another authority than those of the first: they would wait for each other in vain.
fn strangers(topology: &Topology) -> Vec<Fault> {
    let read = |part: Part, name: &str| {
        let keys = topology.node_config(part).security.keys;
        keys.and_then(|keys| std::fs::read(keys.join(name)).ok())
    };
    let Some((first, others)) = Part::ALL.split_first() else { return Vec::new() };
    let is_alike =
        |part: Part| ["ca.pem", "discovery.key"].iter().all(|name| read(part, name) == read(*first, name));
    let strange = others.iter().copied().filter(|part| !is_alike(*part));
    let told = |part| Fault {
        part,
        words: format!(
            "  {part}: its keys are of another authority, or of another time, than those of {first} (ca.pem, discovery.key)"
        ),
        is_of_one: true,
    };
    strange.map(told).collect()
}

/// The first thing that is wrong with the keys of a node, with no remedy for it alone: that may take an address from another one.
fn fault(topology: &Topology, part: Part) -> Option<Fault> {
    let config = topology.node_config(part);
    let keys = config.security.keys.as_ref()?;
    let address = config.node_address();
    let identity = Identity { project: config.project.clone(), address, name: config.name.clone() };
    let faults = Credentials::load(keys, &identity, config.security.times, UnixTime::now()).err()?;
    let first = faults.faults().first()?;
    let (words, is_of_one) = if let CredentialFault::OtherNode { certified, .. } = first {
        (format!("  {part} is to be {identity}, and its keys are of {certified}"), false)
    } else {
        (format!("  {part}: {first}"), true)
    };
    Some(Fault { part, words, is_of_one })
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

    #[test]
    fn keys_of_two_authorities_and_the_directory_of_one_node_are_told_before_anything_starts() {
        const KNEE: Part = Part::Joint(crate::joint::Joint::Knee);
        // Given: files that are alike but for those of one node
        let mut topology = for_this_host(1).unwrap();
        let directory =
            std::env::temp_dir().join(format!("exoskeleton-two-authorities-{}", std::process::id()));
        topology.keys = Some(directory.clone());
        for part in Part::ALL {
            let keys = topology.node_config(part).security.keys.expect("it was set");
            std::fs::create_dir_all(&keys).unwrap();
            let authority = if part == KNEE { "another" } else { "ours" };
            for (name, text) in [("ca.pem", authority), ("discovery.key", "of all"), ("node.pem", "its own")]
            {
                std::fs::write(keys.join(name), text).unwrap();
            }
        }
        // When, then: that node is named
        let strange = strangers(&topology);
        assert!(
            matches!(&strange[..], [one] if one.part == KNEE && one.words.contains("of another authority"))
        );
        std::fs::write(directory.join("ca.pem"), "ours").unwrap();
        let words = check(&topology, &directory).unwrap_err().to_string();
        assert!(words.contains("sinew keys issue") && !words.contains("keys init"), "{words}");
        // And: who names the directory of a node is told of the project's
        let words = check(&topology, &directory.join("nodes/hip")).unwrap_err().to_string();
        std::fs::remove_dir_all(&directory).unwrap();
        assert!(words.ends_with(&format!("--keys {}", quoted(&directory.display().to_string()))), "{words}");
        assert!(!words.contains("keys init"), "{words}");
    }
}
