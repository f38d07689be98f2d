//! Faults on real nodes: what happens, and what does not. One binary, one module a theme.

mod ends;
mod groups;
mod hangs;
mod layers;
mod load;
mod mailboxes;
mod panics;
mod points;
mod processes;

use sinew::fault::Fault;

/// A fault, as one would write it.
fn fault(text: &str) -> Fault {
    text.parse().unwrap_or_else(|error| panic!("{error}"))
}
