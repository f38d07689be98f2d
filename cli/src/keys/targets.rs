//! Which nodes are meant on the command line, and which address each has.

use std::{
    collections::BTreeMap,
    net::Ipv4Addr,
    path::{Path, PathBuf},
};

use sinew::{NodeAddress, NodeConfig, security::Identity};

use super::project::Issued;
use crate::system::Fault;

/// A node that is to have a certificate.
#[derive(Debug)]
pub(super) struct Wanted {
    pub(super) identity: Identity,
    pub(super) address_from: AddressFrom,
}

/// How the address of a node was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum AddressFrom {
    /// On the command line.
    Said,
    /// In its configuration.
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
pub(super) fn wanted(project: &str, nodes: &[String]) -> Result<Vec<Named>, Fault> {
    nodes.iter().map(|node| named(project, node)).collect()
}

fn named(project: &str, node: &str) -> Result<Named, Fault> {
    let (name, address) = if let Some((name, address)) = node.split_once('=') {
        let ip: Ipv4Addr = address.parse().map_err(|_| {
            Fault::Usage(format!(
                "'{node}': '{address}' is no address; write NAME=ADDRESS as in {name}=192.168.0.11"
            ))
        })?;
        (name.to_owned(), Some((NodeAddress::from(ip), AddressFrom::Said)))
    } else if node.ends_with(".toml") {
        let (name, address) = configured(project, Path::new(node))?;
        (name, Some(address))
    } else {
        (node.to_owned(), beside(project, node)?)
    };
    if name.contains('/') || name.starts_with(['.', '-']) {
        return Err(Fault::Usage(format!(
            "'{name}' cannot be the name of a directory; give the node a name without '/', that begins with a letter"
        )));
    }
    Ok(Named { project: project.to_owned(), name, address })
}

/// The address in `NAME.toml`, where there is such a file here.
fn beside(project: &str, name: &str) -> Result<Option<(NodeAddress, AddressFrom)>, Fault> {
    let file = PathBuf::from(format!("{name}.toml"));
    if name.contains('/') || !file.exists() {
        return Ok(None);
    }
    let (inside, address) = configured(project, &file)?;
    if inside != name {
        return Err(Fault::Usage(format!(
            "{} is the configuration of a node called '{inside}'; write {name}=ADDRESS, or correct node.name there",
            file.display()
        )));
    }
    Ok(Some(address))
}

fn configured(project: &str, file: &Path) -> Result<(String, (NodeAddress, AddressFrom)), Fault> {
    let config = NodeConfig::from_file(file)
        .map_err(|faults| Fault::Usage(format!("this is no configuration of a node:\n{faults}")))?;
    if config.project != project {
        return Err(Fault::Usage(format!(
            "{} is of project '{}', and these keys are of '{project}'; correct node.project there",
            file.display(),
            config.project
        )));
    }
    let address = config.node_address();
    Ok((config.name, (address, AddressFrom::File(file.to_owned()))))
}

/// Gives an address to each that has none, and refuses an address or a name that two have. `counting` are those of `all` earlier ones that count
/// still.
pub(super) fn placed(named: Vec<Named>, counting: &[Issued], all: &[Issued]) -> Result<Vec<Wanted>, Fault> {
    // They come by their age: of several certificates of a node the newest says where it is, and of those that count before all others. A
    // node that has none any more, as they are revoked or have ended, is where it was.
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
            return Err(Fault::Usage(if other == *name {
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
            return Err(Fault::Usage(format!("'{}' is named twice; a node has one key", named.name)));
        }
        let identity = Identity { project: named.project, address, name: named.name };
        check(&identity)?;
        wanted.push(Wanted { identity, address_from });
    }
    Ok(wanted)
}

/// The next address for one more node of this machine. Where all others are elsewhere, so will it be: then it has to be said where.
fn next_free(name: &str, taken: &BTreeMap<NodeAddress, String>) -> Result<(NodeAddress, AddressFrom), Fault> {
    let is_here = |address: &NodeAddress| Ipv4Addr::from(address.bits()).is_loopback();
    if let Some((address, other)) = taken.first_key_value().filter(|_| !taken.keys().any(is_here)) {
        return Err(Fault::Usage(format!(
            "which address '{name}' has is not known, and the others have addresses of a network, as '{other}' has {address}: write {name}=ADDRESS \
             with that of its machine, or with one from 127.0.0.1 on if it is to run on this one alone"
        )));
    }
    let first = u32::from(Ipv4Addr::LOCALHOST);
    let mut all = (first..).map(NodeAddress::new);
    let free = all.find(|address| !taken.contains_key(address));
    Ok((free.unwrap_or_else(|| NodeAddress::new(first)), AddressFrom::Order))
}

/// A node with this project, name and address could be configured.
fn check(identity: &Identity) -> Result<(), Fault> {
    let mut config = NodeConfig::new(&*identity.name);
    config.project.clone_from(&identity.project);
    config.address = Some(identity.address);
    config.validate().map_err(|faults| Fault::Usage(faults.to_string()))
}
