//! The reasons for a missing required name: discovery finds no other node, or only nodes of another project.

use crate::State;

/// Maximum number of nodes of other projects that are listed.
const NAMED_MAX: usize = 3;

/// Returns the reason as the end of a sentence. Returns an empty text if other nodes of the project are
/// known.
pub(super) fn in_words(state: &State) -> String {
    let neighbours = state.ctx.ports.members().and_then(|members| members.strangers_if_alone());
    let Some(neighbours) = neighbours else { return String::new() };
    let ndl = &state.ctx.config.ndl;
    let groups = ndl.asked_groups();
    let place = if ndl.interface.are_loopback() { " (its own host alone)" } else { "" };
    let groups = if groups.is_empty() {
        "without multicast".to_owned()
    } else {
        format!("in the multicast group {}", groups.join(" and "))
    };
    let seeds = if ndl.seeds.is_empty() { "" } else { ", and at its seeds" };
    let project = &state.ctx.config.project;
    let foreign = neighbours.iter().take(NAMED_MAX).map(|other| {
        format!(
            "; node {} at {} is of project '{}', this one of '{project}'",
            other.name, other.at, other.project
        )
    });
    let foreign: String = foreign.collect();
    format!(
        ", and no other node is found: this one looks at {}{place} {groups}{seeds}{foreign}",
        ndl.interface
    )
}
