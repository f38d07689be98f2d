//! Applications in their own processes, children of the node: the same code, chosen by placement.
//!
//! ```text
//!   node                                             child
//!   mailbox of the TID ─ window ─┐               ┌─ inbox ── actor
//!                                ├─ socket pair ─┤
//!   router ◄─────────────────────┘               └─ outlet ◄─ Sender
//! ```
//!
//! The node starts its own program again. In that process the builder of the node hosts the one application
//! and starts nothing else. The TID and its mailbox stay in the node; the child runs the actor. Both
//! communicate over a socket pair that no other process can reach; `docs/protocol/process.md` specifies the
//! protocol.
//!
//! | file | side | purpose |
//! | --- | --- | --- |
//! | `protocol` | both | the protocol between the two |
//! | `window` | node | the messages that the child holds, and their outcomes when it dies; pure |
//! | `link` | node | carries messages to the child from any thread |
//! | `names` | node | the child's copy of the directory |
//! | `supervision` | node | the supervised child: started, read from, stopped, killed |
//! | `group` | node | a process and its descendants: killed together, reaped |
//! | `child_process` | node | one process by its pidfd: killed, waited for, and its exit status |
//! | `predecessor` | node | the former process: the next one waits for its end |
//! | `spawn` | node | starts processes and reaps them |
//! | `command` | node | the supervised process of a command, which is a client of LNCL |
//! | `program` | child | becomes the program of a command |
//! | `role` | child | whether this process is a node or such a child |
//! | `host` | child | runs the application |
//! | `inbox` | child | the application's received messages |
//! | `child_link` | child | the child's end of the connection |

mod child_link;
mod child_process;
mod command;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod group;
mod host;
mod inbox;
mod link;
mod names;
mod predecessor;
mod program;
mod protocol;
mod role;
mod spawn;
mod supervision;
mod window;

pub(crate) use command::Command;
pub(crate) use link::Link;

use role::{Role, role};
pub(crate) use spawn::check_kernel;

use sinew_model::config::NodeConfig;

use crate::{NodeState, SupervisorSpec};

/// Returns the environment variable by which this program, started again, knows its application.
fn variable(state: &NodeState, app: &str) -> String {
    let (parent, node) = (std::process::id(), state.ctx.node.bits());
    // No name contains a newline.
    format!("{parent}\n{node}\n{}\n{app}", state.ctx.config.name)
}

/// Handles the builder of a node in a process that hosts an application. Returns whether the builder must not
/// start the node. Does not return if this process hosts one of its applications.
pub(crate) fn hosts_other_node(config: &NodeConfig, tree: &mut SupervisorSpec) -> bool {
    match role(config) {
        Role::Node => {
            if tree.apps().iter().any(|app| app.place().own_process) {
                // Started here, so that processes inherit priority and CPUs of the caller and not of one of
                // the node's threads.
                spawn::begin_spawning();
            }
            false
        }
        Role::OtherNode => true,
        Role::Host(hosting) => {
            let tree = std::mem::replace(tree, SupervisorSpec::new(""));
            host::host(config, tree.into_apps(), hosting)
        }
    }
}
