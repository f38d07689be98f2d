//! The six paths, and how their processes are started and ended.

use std::path;

use sinew_figures::process::Process;

use crate::{callgrind::Counted, nodes::At};

/// Round trips of the two runs of a path. Links are made within the first ones.
const FEW: u32 = 200;
const MANY: u32 = 1_000;

/// A path of a message of 1000 bytes, there and back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Path {
    /// Two applications on one thread of a node.
    SameThread,
    /// Two applications of a node, each on a thread of its own.
    TwoThreads,
    /// Two processes with a direct link.
    Direct,
    /// Two processes, through their node.
    ThroughNode,
    /// Two nodes, with the applications on the IO threads.
    NodesIo,
    /// Two nodes, with the applications on threads of their own.
    NodesOwn,
}

impl Path {
    pub(crate) const ALL: [Self; 6] =
        [Self::SameThread, Self::TwoThreads, Self::Direct, Self::ThroughNode, Self::NodesIo, Self::NodesOwn];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::SameThread => "same_thread",
            Self::TwoThreads => "two_threads",
            Self::Direct => "direct",
            Self::ThroughNode => "through_node",
            Self::NodesIo => "nodes_io_thread",
            Self::NodesOwn => "nodes_own_thread",
        }
    }

    /// Returns the path of this name.
    ///
    /// # Panics
    /// If there is none.
    pub(crate) fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|path| path.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// Counts the instructions of a round trip, of all processes together. Callgrind's files stay in the directory
    /// `kept`, if there is one.
    ///
    /// # Errors
    /// Valgrind does not run, or a process fails.
    pub(crate) fn instructions(self, kept: Option<&path::Path>) -> Result<u64, String> {
        let [few, many] = [self.total(FEW, kept)?, self.total(MANY, kept)?];
        Ok(many.saturating_sub(few) / u64::from(MANY - FEW))
    }

    fn total(self, rounds: u32, kept: Option<&path::Path>) -> Result<u64, String> {
        let mut counted = Counted::new(kept.map(|kept| kept.join(format!("{}-{rounds}", self.name()))))?;
        let name = self.name();
        match self {
            Self::SameThread | Self::TwoThreads => counted.run(&format!("{name} {rounds}"))?,
            Self::Direct | Self::ThroughNode => {
                let socket = counted.directory().join("socket").display().to_string();
                let node = counted.start(&format!("node {socket}"));
                let echo = counted.start(&format!("echo_endpoint {name} {socket}"));
                counted.run(&format!("ping_endpoint {name} {socket} {rounds}"))?;
                end("echo", echo)?;
                end("node", node)?;
            }
            Self::NodesIo | Self::NodesOwn => {
                let at = At::loopback();
                let echo = counted.start(&format!("echo_node {name} {}", at.host(2)));
                counted.run(&format!("ping_node {name} {at} {rounds}"))?;
                end("echo", echo)?;
            }
        }
        counted.total()
    }
}

fn end(what: &str, process: Process) -> Result<(), String> {
    process.end().then_some(()).ok_or_else(|| format!("the process `{what}` failed under valgrind"))
}
