//! Applications in processes of their own, children of the node's: the same code, chosen by placement.
//!
//! ```text
//!   node                                             child
//!   mailbox of the TID ─ window ─┐               ┌─ inbox ── actor
//!                                ├─ socket pair ─┤
//!   router ◄─────────────────────┘               └─ outlet ◄─ Sender
//! ```
//!
//! The node starts its own program again. In that process the builder of the node hosts the one application and starts
//! nothing else. The TID and its mailbox stay in the node; the child is the actor. The two talk over a pair of sockets
//! that nobody else can reach; what they say is in `docs/protocol/process.md`.
//!
//! | file | side | what it is |
//! | --- | --- | --- |
//! | `words` | both | what the two say to each other |
//! | `window` | node | which messages the child has, and what becomes of them when it dies; pure |
//! | `link` | node | carries messages to the child from any thread |
//! | `names` | node | which names the child wants to know |
//! | `life` | node | the child under supervision: started, listened to, stopped, killed |
//! | `group` | node | a process and what it has started: killed together, reaped |
//! | `held` | node | one process by its descriptor: killed, waited for, and how it ended |
//! | `predecessor` | node | the process before: the next one waits for its end |
//! | `spawn` | node | starts processes and reaps them |
//! | `role` | child | whether this process is a node or such a child |
//! | `host` | child | runs the application |
//! | `inbox` | child | where the application's messages come from |
//! | `wire` | child | reads what the node says |

#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod group;
mod held;
mod host;
mod inbox;
mod life;
mod link;
mod names;
mod predecessor;
mod role;
mod spawn;
mod window;
mod wire;
mod words;

pub(crate) use link::Link;

use role::{Role, role};
pub(crate) use spawn::check_kernel;

use crate::{config::NodeConfig, node::SupervisorSpec};

/// What the builder of a node does instead of starting it, if this process hosts an application. Returns whether it
/// is to do nothing; does not return if it is to host.
pub(crate) fn is_bystander(config: &NodeConfig, tree: &mut SupervisorSpec) -> bool {
    match role(config) {
        Role::Node => {
            if tree.apps().iter().any(|app| app.place().own_process) {
                // Now, so that processes inherit priority and CPUs of the caller and not of one of the node's threads.
                spawn::begin_spawning();
            }
            false
        }
        Role::Bystander => true,
        Role::Host(hosting) => {
            let tree = std::mem::replace(tree, SupervisorSpec::new(""));
            host::host(config, tree.into_apps(), hosting)
        }
    }
}
