//! A whole node that does not belong to the robot, and tries to join as a node does: by discovery, and by
//! dialling the nodes that it finds.

use super::{ATTACKER, Happened, Scene, keys, tried};
use sinew_testkit::NodeProcess;

/// The credentials of an intruder.
#[derive(Clone, Copy, Debug)]
pub(super) enum Intruder {
    /// A certificate of another authority with the same project name.
    OfOthers,
    /// None: it is an open node.
    WithoutKeys,
}

/// A running intruder.
pub(super) struct Intruding {
    node: NodeProcess,
}

impl Intruder {
    /// Starts it, and returns when it runs.
    pub(super) fn start(self, scene: &Scene<'_>) -> Intruding {
        let keys = match self {
            Self::OfOthers => Some(scene.keys.of_others(keys::MALLORY)),
            Self::WithoutKeys => None,
        };
        let command = scene.robot.foreign_node(&scene.hosts[ATTACKER], keys.as_deref());
        let mut node = NodeProcess::start("a foreign node that is to try to get in", command);
        node.expect("runs");
        Intruding { node }
    }
}

impl Intruding {
    /// Ends it, and checks whether it has joined: it prints `up` in that case.
    pub(super) fn end(mut self) -> Happened {
        self.node.kill();
        let has_got_in = |line: &String| format!("a foreign node has got in, and says {line:?}");
        Happened {
            let_in: self.node.output().iter().skip(1).map(has_got_in).collect(),
            // Only a whole node speaks discovery: a refused datagram proves that it has tried.
            refused: vec![(tried::NOT_OURS, 1)],
            ..Happened::new("a whole node was started".to_owned(), Vec::new())
        }
    }
}
