//! The node that a recording is played into: one of the command's own, or a running one.

use std::{
    fs,
    os::unix::fs::DirBuilderExt as _,
    path::{Path, PathBuf},
};

use sinew::{
    Node, NodeApi, StartError,
    config::{LogLevel, NodeConfig},
    node::NodeEnd,
};

use super::{Order, sources::SOURCES_MAX};
use crate::{
    arguments::Arguments,
    system::{System, SystemError},
    table::clean,
};

/// The name of the own node.
const NAME: &str = "sinew-play";
/// The address of the own node. Nodes of users on loopback have those that begin with 127.0.0.
const ADDRESS: [u8; 4] = [127, 0, 83, 119];
/// Connections to the own node: one for each source, and some for the command itself and for others.
const CLIENTS_MAX: usize = SOURCES_MAX + 56;
/// Longest payload at the own node: the longest one that any node accepts.
const PAYLOAD_MAX: usize = 64 << 20;

/// The node, and the connection of the command to it.
pub(crate) struct Target {
    pub(crate) system: System,
    /// The project of the node.
    pub(crate) project: String,
    /// The node, if it is the command's own.
    own: Option<Node>,
}

impl Target {
    /// Starts the own node, or connects to the running one.
    pub(crate) fn open(order: &Order, arguments: &Arguments) -> Result<Self, SystemError> {
        if order.live {
            let mut system = System::enter(arguments.socket.as_deref(), arguments.within())?;
            let project = system.here()?.project;
            return Ok(Self { system, project, own: None });
        }
        let socket = socket()?;
        let project = order.project.clone();
        let configure = |config: &mut NodeConfig| {
            config.project.clone_from(&project);
            config.log.level = LogLevel::Off;
            config.payload_max = PAYLOAD_MAX;
            config.lncl.clients_max = CLIENTS_MAX;
            config.lncl.clients_per_process_max = CLIENTS_MAX;
            config.lncl.socket = Some(socket.clone());
        };
        let node = Node::builder(NAME).address(ADDRESS).configure(configure).start();
        let node = node.map_err(|why| {
            if let StartError::AddressTaken(words) = &why {
                gave_up(&project, words)
            } else {
                SystemError::Bag(format!("the node for the recording did not start: {why}"))
            }
        })?;
        match System::enter(Some(&socket), arguments.within()) {
            Ok(system) => Ok(Self { system, project, own: Some(node) }),
            Err(why) => Err(match node.stop() {
                NodeEnd::GaveUp(reason) => gave_up(&project, &reason),
                NodeEnd::Stopped => why,
            }),
        }
    }

    /// Returns whether the node is the command's own.
    pub(crate) const fn is_own(&self) -> bool {
        self.own.is_some()
    }

    /// Returns another way to the node.
    pub(crate) fn api(&self) -> Result<NodeApi, SystemError> {
        let path = &self.system.path;
        NodeApi::connect(Path::new(path)).map_err(|why| SystemError::NotRegistered(path.clone(), why))
    }

    /// Disconnects, and stops the own node. Returns the error if that had given up before.
    pub(crate) fn close(self) -> Option<SystemError> {
        self.system.leave();
        match self.own?.stop() {
            NodeEnd::GaveUp(reason) => Some(gave_up(&self.project, &reason)),
            NodeEnd::Stopped => None,
        }
    }
}

/// Returns the error of an own node that gave up. A node learns some seconds after its start that another one has its
/// address: all commands of a project give their nodes the same name and address.
fn gave_up(project: &str, reason: &str) -> SystemError {
    let reason = clean(reason);
    if !reason.contains(&format!("'{NAME}'")) {
        return SystemError::Bag(format!("the node for the recording has given up: {reason}"));
    }
    // The remedy behind it is that of a node with a configuration.
    let place = reason.split(';').next().unwrap_or_default();
    SystemError::Bag(format!(
        "another `sinew play` runs in the project {project}: {place}; choose another project, as in --project \
         {project}-2, or end the other command"
    ))
}

/// Returns the path of the own node's socket, where other commands find it.
fn socket() -> Result<PathBuf, SystemError> {
    let name = format!("play-{}.sock", std::process::id());
    let Some(runtime) = std::env::var_os("XDG_RUNTIME_DIR").filter(|path| !path.is_empty()) else {
        return Ok(std::env::temp_dir().join(format!("sinew-{name}")));
    };
    let folder = PathBuf::from(runtime).join("sinew");
    let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(&folder);
    made.map_err(|why| {
        let folder = folder.display();
        SystemError::Bag(format!(
            "{folder}, the folder for the socket, cannot be made: {why}; set XDG_RUNTIME_DIR to another one"
        ))
    })?;
    Ok(folder.join(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_command_is_named_with_a_remedy() {
        let reason = "node address 127.0.83.119 is used already by 'sinew-play' at 127.0.0.1:7; give this node another \
                      `node.address`, or end the other one";
        let error = gave_up("replay", reason).to_string();
        let expected = "another `sinew play` runs in the project replay: node address 127.0.83.119 is used already by \
                        'sinew-play' at 127.0.0.1:7; choose another project, as in --project replay-2, or end the \
                        other command";
        assert_eq!(error, expected);
        let other = gave_up("replay", "layers: no interface").to_string();
        assert!(other.contains("layers: no interface") && !other.contains("--project"), "{other}");
    }
}
