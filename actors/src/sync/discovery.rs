//! Why a required name may be missing: discovery finds no other node, or only nodes of another project.

use crate::stores::{Stores, lock};

/// Nodes of other projects that are named at most.
const NAMED_MAX: usize = 3;

/// Returns this reason as the end of a sentence; an empty text where other nodes of the project are known.
pub(super) fn in_words(stores: &Stores) -> String {
    let core = lock(&stores.ndl);
    if core.knows_others() {
        return String::new();
    }
    let neighbours = core.neighbours();
    drop(core);
    let ndl = &stores.config.ndl;
    let groups = ndl.asked_groups();
    let place = if ndl.interface.are_loopback() { " (its own host alone)" } else { "" };
    let groups = if groups.is_empty() {
        "without multicast".to_owned()
    } else {
        format!("in the multicast group {}", groups.join(" and "))
    };
    let seeds = if ndl.seeds.is_empty() { "" } else { ", and at its seeds" };
    let project = &stores.config.project;
    let foreign = neighbours.iter().take(NAMED_MAX).map(|(at, other)| {
        format!("; node {} at {at} is of project '{}', this one of '{project}'", other.name, other.project)
    });
    let foreign: String = foreign.collect();
    format!(
        ", and no other node is found: this one looks at {}{place} {groups}{seeds}{foreign}",
        ndl.interface
    )
}
