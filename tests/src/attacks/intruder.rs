//! A whole node that does not belong to the robot, and tries to get in as a node does: by discovery, and by what it finds with it.

use std::sync::mpsc::{Receiver, sync_channel};

use super::{ATTACKER, Happened, Scene, keys, tried};
use crate::{DEADLINE, clients::Performer};

/// What it shows.
#[derive(Clone, Copy, Debug)]
pub(super) enum Intruder {
    /// A certificate of another authority of the same project name.
    OfOthers,
    /// Nothing: it is an open node.
    WithoutKeys,
}

/// One that tries.
pub(super) struct Intruding {
    node: Performer,
    said: Receiver<String>,
}

impl Intruder {
    /// Starts it, and returns when it runs.
    pub(super) fn start(self, scene: &Scene<'_>) -> Intruding {
        let keys = match self {
            Self::OfOthers => Some(scene.keys.of_others(keys::MALLORY)),
            Self::WithoutKeys => None,
        };
        let command = scene.robot.foreign_node(&scene.hosts[ATTACKER], keys.as_deref());
        let (say, said) = sync_channel(16);
        let node = Performer::start_command(command, "robot-node", move |line| {
            // What it says beyond that is not needed: one word is enough.
            let _ = say.try_send(line.to_owned());
        });
        let runs = said.recv_timeout(DEADLINE);
        assert_eq!(
            runs.as_deref(),
            Ok("runs"),
            "a foreign node that is to try to get in, within {DEADLINE:?}"
        );
        Intruding { node, said }
    }
}

impl Intruding {
    /// Ends it, and looks whether it had got in: it says `up` then.
    pub(super) fn end(self) -> Happened {
        drop(self.node);
        let has_got_in = |line| format!("a foreign node has got in, and says {line:?}");
        Happened {
            let_in: self.said.iter().map(has_got_in).collect(),
            // Only a whole node speaks discovery: it has truly tried if that was refused.
            refused: vec![(tried::NOT_OURS, 1)],
            ..Happened::new("a whole node was started".to_owned(), Vec::new())
        }
    }
}
