//! The nodes named on the command line, and their addresses.

use std::{
    collections::BTreeMap,
    net::Ipv4Addr,
    path::{Path, PathBuf},
};

use sinew::{NodeAddress, NodeConfig, name::check_node_name, security::Identity};

use super::project::Issued;
use crate::{system::SystemError, table::short};

/// A node that gets a certificate.
#[derive(Debug)]
pub(super) struct Wanted {
    pub(super) identity: Identity,
    pub(super) address_from: AddressFrom,
}

/// How the address of a node was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum AddressFrom {
    /// On the command line.
    Given,
    /// In its configuration file.
    File(PathBuf),
    /// In its last certificate, revoked or not.
    Before,
    /// The next free one of this machine.
    Order,
}

/// A node as it was named.
pub(super) struct Named {
    project: String,
    name: String,
    address: Option<(NodeAddress, AddressFrom)>,
}

/// Reads `NAME=ADDRESS`, `FILE.toml` or `NAME`.
pub(super) fn wanted(project: &str, nodes: &[String]) -> Result<Vec<Named>, SystemError> {
    checked("project", project)?;
    nodes.iter().map(|node| named(project, node)).collect()
}

/// Refuses an invalid name of a node or project: directories and files are named after it.
fn checked(what: &str, name: &str) -> Result<(), SystemError> {
    check_node_name(name)
        .map_err(|why| SystemError::Usage(format!("no {what} can be called `{}`: {why}", short(name))))
}

fn named(project: &str, node: &str) -> Result<Named, SystemError> {
    let (name, address) = if let Some((name, address)) = node.rsplit_once('=') {
        let ip: Ipv4Addr = address.parse().map_err(|_| {
            SystemError::Usage(format!(
                "'{node}': '{address}' is no address; write NAME=ADDRESS as in {name}=192.168.0.11"
            ))
        })?;
        (name.to_owned(), Some((NodeAddress::from(ip), AddressFrom::Given)))
    } else if node.ends_with(".toml") {
        let (name, address) = configured(project, Path::new(node))?;
        (name, Some(address))
    } else {
        checked("node", node)?;
        (node.to_owned(), beside(project, node)?)
    };
    checked("node", &name)?;
    Ok(Named { project: project.to_owned(), name, address })
}

/// Returns the address in `NAME.toml`, if this directory has such a file.
fn beside(project: &str, name: &str) -> Result<Option<(NodeAddress, AddressFrom)>, SystemError> {
    let file = PathBuf::from(format!("{name}.toml"));
    if !file.exists() {
        return Ok(None);
    }
    let (inside, address) = configured(project, &file)?;
    if inside != name {
        return Err(SystemError::Usage(format!(
            "{} is the configuration of a node called '{inside}'; write {name}=ADDRESS, or correct node.name there",
            file.display()
        )));
    }
    Ok(Some(address))
}

fn configured(project: &str, file: &Path) -> Result<(String, (NodeAddress, AddressFrom)), SystemError> {
    let config = NodeConfig::from_file(file)
        .map_err(|faults| SystemError::Usage(format!("this is no configuration of a node:\n{faults}")))?;
    if config.project != project {
        return Err(SystemError::Usage(format!(
            "{} is of project '{}', and these keys are of '{project}'; correct node.project there",
            file.display(),
            config.project
        )));
    }
    let address = config.node_address();
    Ok((config.name, (address, AddressFrom::File(file.to_owned()))))
}

/// Assigns an address to each node without one, and refuses duplicate addresses and names. `counting` contains those of
/// `all` earlier certificates that are still valid.
pub(super) fn placed(
    named: Vec<Named>,
    counting: &[Issued],
    all: &[Issued],
) -> Result<Vec<Wanted>, SystemError> {
    // Sorted by age: of several certificates of a node the newest defines its address, and valid ones precede all
    // others. A node keeps its address even if all its certificates are revoked or have ended.
    let newest: BTreeMap<_, _> = all
        .iter()
        .chain(counting)
        .map(|issued| (issued.identity.name.clone(), issued.identity.address))
        .collect();
    let mut taken: BTreeMap<NodeAddress, String> = BTreeMap::new();
    let is_wanted = |name: &str| named.iter().any(|named| named.name == name);
    let others = counting.iter().filter(|issued| !is_wanted(&issued.identity.name));
    taken.extend(others.map(|issued| (issued.identity.address, issued.identity.name.clone())));
    let known = |named: &Named| {
        let earlier = newest.get(&named.name).map(|address| (*address, AddressFrom::Before));
        named.address.clone().or(earlier)
    };
    for (address, name) in named.iter().filter_map(|named| Some((known(named)?.0, &named.name))) {
        if let Some(other) = taken.insert(address, name.clone()) {
            return Err(SystemError::Usage(if other == *name {
                format!("'{name}' is named twice; a node has one key")
            } else {
                format!(
                    "'{other}' and '{name}' have the same address, {address}; it is what tells nodes apart: write \
                     {name}=ADDRESS with another one, or revoke '{other}' first"
                )
            }));
        }
    }
    let mut wanted: Vec<Wanted> = Vec::new();
    for named in named {
        let (address, address_from) = match known(&named) {
            Some(known) => known,
            None => next_free(&named.name, &taken)?,
        };
        taken.insert(address, named.name.clone());
        if wanted.iter().any(|wanted| wanted.identity.name == named.name) {
            return Err(SystemError::Usage(format!("'{}' is named twice; a node has one key", named.name)));
        }
        let identity = Identity { project: named.project, address, name: named.name };
        check(&identity)?;
        wanted.push(Wanted { identity, address_from });
    }
    Ok(wanted)
}

/// Returns the next address for one more node of this machine. If all others are on other machines, the address must be
/// given explicitly.
fn next_free(
    name: &str,
    taken: &BTreeMap<NodeAddress, String>,
) -> Result<(NodeAddress, AddressFrom), SystemError> {
    let is_here = |address: &NodeAddress| Ipv4Addr::from(address.bits()).is_loopback();
    if let Some((address, other)) = taken.first_key_value().filter(|_| !taken.keys().any(is_here)) {
        return Err(SystemError::Usage(format!(
            "which address '{name}' has is not known, and the others have addresses of a network, as '{other}' has {address}: write {name}=ADDRESS \
             with that of its machine, or with one from 127.0.0.1 on if it is to run on this one alone"
        )));
    }
    let first = u32::from(Ipv4Addr::LOCALHOST);
    let mut all = (first..).map(NodeAddress::new);
    let free = all.find(|address| !taken.contains_key(address));
    Ok((free.unwrap_or_else(|| NodeAddress::new(first)), AddressFrom::Order))
}

/// Checks that a node with this project, name and address could be configured.
fn check(identity: &Identity) -> Result<(), SystemError> {
    let mut config = NodeConfig::new(&*identity.name);
    config.project.clone_from(&identity.project);
    config.address = Some(identity.address);
    config.validate().map_err(|faults| SystemError::Usage(faults.to_string()))
}
