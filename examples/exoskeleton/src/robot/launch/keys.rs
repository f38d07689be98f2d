//! Checks that the keys of all four nodes exist and match, before any part of the robot is started or
//! written.

use std::path::{Path, PathBuf};

use exoskeleton_model::part::Part;
use sinew::security::{CredentialError, Credentials, Identity, UnixTime};
use thiserror::Error;

use crate::robot::topology::Topology;

/// Maximum number of names tried for a new directory.
const NAMES_MAX: u32 = 1_000;

/// Keys that are not those of this robot's nodes. The user is at fault; nothing was started.
#[derive(Debug, Error)]
#[error("the keys in {directory} are not good for this robot's nodes:\n{faults}\n{remedy}")]
pub struct KeysError {
    directory: String,
    /// The first fault of each node, one per line.
    faults: String,
    remedy: String,
}

/// Checks the keys of each node, which are in the directory that the user calls `given`.
pub(super) fn check(topology: &Topology, given: &Path) -> Result<(), KeysError> {
    let mut faults: Vec<Fault> = Part::ALL.into_iter().filter_map(|part| fault(topology, part)).collect();
    if faults.is_empty() {
        faults.extend(strangers(topology));
    }
    if faults.is_empty() {
        return Ok(());
    }
    let directory = given.display().to_string();
    let mut lines = faults.iter().map(|fault| fault.text.as_str()).collect::<Vec<_>>().join("\n");
    let remedy = if let Some(project) = project_around(given) {
        format!("This is the directory of one node; name that of the project: --keys {project}")
    } else if given.join("ca.pem").exists() && faults.iter().all(|fault| fault.is_of_one) {
        let parts: Vec<_> = faults.iter().map(|fault| fault.part.to_string()).collect();
        let command = format!("sinew keys issue {} --keys {}", parts.join(" "), quoted(&directory));
        format!("Where no line gives a remedy, this creates the keys of these nodes anew:\n  {command}")
    } else {
        if !given.exists() {
            "  there is no such directory".clone_into(&mut lines);
        }
        let nodes = Part::ALL.map(|part| format!("{part}={}", topology.place(part).address));
        let out = quoted(&free(given).display().to_string());
        let command =
            format!("sinew keys init {} {} --out {out}", quoted(&topology.project), nodes.join(" "));
        format!(
            "This makes them all, with the addresses that the nodes have:\n  {command}\nThen walk with --keys {out}"
        )
    };
    Err(KeysError { directory, faults: lines, remedy })
}

/// A fault in the keys of a node.
struct Fault {
    part: Part,
    text: String,
    /// The keys of the other nodes may still be good.
    is_of_one: bool,
}

/// The project directory, if `node` is the directory of one node's keys in it.
fn project_around(node: &Path) -> Option<String> {
    let nodes = node.parent().filter(|nodes| nodes.ends_with("nodes"))?;
    let project = nodes.parent().filter(|_| node.join("node.pem").exists())?;
    Some(quoted(&if project.as_os_str().is_empty() { Path::new(".") } else { project }.display().to_string()))
}

/// Nodes with keys that are valid by themselves but of another authority than those of the first: the nodes
/// would wait for each other in vain.
fn strangers(topology: &Topology) -> Vec<Fault> {
    let read = |part: Part, name: &str| {
        let keys = topology.node_config(part).security.keys;
        keys.and_then(|keys| std::fs::read(keys.join(name)).ok())
    };
    let Some((first, others)) = Part::ALL.split_first() else { return Vec::new() };
    let is_alike =
        |part: Part| ["ca.pem", "discovery.key"].iter().all(|name| read(part, name) == read(*first, name));
    let strange = others.iter().copied().filter(|part| !is_alike(*part));
    let fault_of = |part| Fault {
        part,
        text: format!(
            "  {part}: its keys are of another authority, or of another time, than those of {first} (ca.pem, discovery.key)"
        ),
        is_of_one: true,
    };
    strange.map(fault_of).collect()
}

/// The first fault in the keys of a node, without a remedy for it alone: that may take an address from
/// another one.
fn fault(topology: &Topology, part: Part) -> Option<Fault> {
    let config = topology.node_config(part);
    let keys = config.security.keys.as_ref()?;
    let address = config.node_address();
    let identity = Identity { project: config.project.clone(), address, name: config.name.clone() };
    let faults = Credentials::load(keys, &identity, config.security.times, UnixTime::now()).err()?;
    let first = faults.faults().first()?;
    let (text, is_of_one) = if let CredentialError::OtherNode { certified, .. } = first {
        (format!("  {part} is to be {identity}, and its keys are of {certified}"), false)
    } else {
        (format!("  {part}: {first}"), true)
    };
    Some(Fault { part, text, is_of_one })
}

/// A directory that `sinew keys init` creates or fills: it replaces nothing.
fn free(given: &Path) -> PathBuf {
    // Without a slash at its end.
    let given: PathBuf = given.components().collect();
    let is_free = |path: &Path| match std::fs::read_dir(path) {
        Ok(mut inside) => inside.next().is_none(),
        Err(_) => !path.exists(),
    };
    let numbered = (2..=NAMES_MAX).map(|number| PathBuf::from(format!("{}-{number}", given.display())));
    let free = std::iter::once(given.clone()).chain(numbered).find(|path| is_free(path));
    // If that many robots exist without keys, the command itself reports the conflict.
    free.unwrap_or(given)
}

/// One word for the shell.
fn quoted(word: &str) -> String {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "/._-".contains(sign);
    if word.chars().all(is_plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

#[cfg(test)]
#[path = "../../../tests/unit/keys.rs"]
mod tests;
