//! The places of the robot's nodes: `topology.toml`, read once, with all its faults reported together.

mod file;
mod free;

use std::fmt;
use std::net::{SocketAddr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::time::Duration;

use exoskeleton_model::joint::PerJoint;
use exoskeleton_model::part::Part;
use exoskeleton_recording::flight::FlightFolders;
use serde::{Deserialize, Serialize};
use sinew::config::{Interfaces, Seed};
use sinew::{NodeAddress, NodeConfig};
use thiserror::Error;

pub use free::for_this_host;

/// Bytes of the newest messages that a node keeps while it is recorded: some seconds, and little of `/dev/shm`.
const RECORD_KEEP_BYTES: usize = 8 << 20;
/// Time before a fault that a node freezes, and time after it. A node writes up to 2 MB/s, so its journal has four
/// seconds at least.
const FROZEN_KEEP: Duration = Duration::from_secs(2);
const FROZEN_AFTER: Duration = Duration::from_secs(1);
/// Maximum number of spans that a node freezes in one run, of at most [`RECORD_KEEP_BYTES`] each. A host that stalls
/// makes inputs late, which is a fault, too: these spans must not take the place of that of a killed node.
const FROZEN_MAX: usize = 16;
/// Port of multicast DNS (RFC 6762).
const MDNS_PORT: u16 = 5353;

/// The places of all parts of one robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Topology {
    /// Name that separates this robot's nodes from those of others. 1 to 63 bytes.
    pub project: String,
    /// How nodes find each other.
    pub discovery: Discovery,
    /// How the control loops run.
    pub control: Control,
    /// The flight recorder of the nodes; `None`: they freeze nothing.
    pub record: Option<FlightRecorder>,
    /// The central node.
    pub central: NodePlace,
    /// The joint nodes.
    pub joints: PerJoint<NodePlace>,
    /// Directory of the robot's keys, as `sinew keys init` makes it; `None`: links between nodes are open.
    pub keys: Option<PathBuf>,
    /// The plant.
    pub plant: PlantPlace,
}

/// How nodes find each other.
#[derive(Debug, Clone, PartialEq)]
pub struct Discovery {
    /// Group and port of the cyclic query; `None`: off.
    pub multicast: Option<SocketAddrV4>,
    /// Whether multicast DNS is used, too.
    pub mdns: bool,
    /// Time between two queries. 10 ms to 60 s; default 500 ms.
    pub period: Duration,
    /// Missed answers in a row after which a node counts as lost. 2 to 100; default 3.
    pub missed_max: u32,
}

/// The thread that a node's control loops run on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum ControlThread {
    /// The thread that reads the node's sockets: no thread wake between the network and the loop. The
    /// default.
    #[default]
    #[value(help = "On the thread that reads the node's sockets")]
    Io,
    /// A thread of its own: the network cannot delay the loop, for one more wake per message.
    #[value(help = "On a thread of their own")]
    Own,
}

/// How the control loops run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Control {
    /// On which thread.
    pub thread: ControlThread,
    /// `SCHED_FIFO` priority of that thread, 1 to 89; only for a thread of its own.
    pub realtime_priority: Option<u8>,
    /// The source of the release to walk.
    pub release: ReleaseBy,
    /// Whether each drive also sends its ticks, for a recording that can be replayed. Default: no.
    pub record: bool,
}

/// The flight recorder of the nodes: each one keeps its newest messages, and around a fault all freeze the same span.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightRecorder {
    /// Folder in memory, as `/dev/shm/my-leg`. Each node creates a folder of its name there for its journal, of 8 MiB,
    /// and removes it when it ends in order. That of a killed node stays for its next incarnation.
    pub folder: PathBuf,
    /// Folder of the frozen spans: at most 16 of each node, of at most 8 MiB. Each node creates it if needed. It may
    /// lie on a disk.
    pub frozen_folder: PathBuf,
}

impl From<&FlightFolders> for FlightRecorder {
    fn from(folders: &FlightFolders) -> Self {
        Self { folder: folders.journals().to_owned(), frozen_folder: folders.frozen().to_owned() }
    }
}

/// The source of the release to walk, at the start and after the loss of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ReleaseBy {
    /// The coordinator presses the button half a second after all drives have started, and after a loss the
    /// walk continues by itself: for a simulation.
    Itself,
    /// A person at central, each time. The default.
    #[default]
    Operator,
}

/// The place of a node.
#[derive(Debug, Clone, PartialEq)]
pub struct NodePlace {
    /// Its address in the project.
    pub address: NodeAddress,
    /// The network interface that it uses, by address or by name.
    pub interface: Interfaces,
    /// UDP port of its discovery; 0: any free one. Set it if others list this node as a seed.
    pub port: u16,
    /// UDP addresses of nodes to query in any case.
    pub seeds: Vec<Seed>,
    /// Path of the unix socket for processes of its host: the status screen (at central) and the `sinew`
    /// tool. 1 to 100 bytes; `None`: no socket.
    pub socket: Option<PathBuf>,
    /// Directory of its state, which outlives it: with it a node that was stopped by `sinew stop` comes up
    /// stopped. `None`: no state.
    pub state: Option<PathBuf>,
    /// The process in which the drive of a joint runs; without meaning at central.
    pub drive: DrivePlace,
}

/// The process in which the drive of a joint runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DrivePlace {
    /// In its node's process, on the thread of the control loops. The default: the lowest latency.
    #[default]
    Node,
    /// In a process of its own, a child of the node: if it fails, the sensor beside it continues.
    Process,
}

/// The place of the plant, and its person.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantPlace {
    /// UDP address of its devices.
    pub address: SocketAddr,
    /// Silence after which a device damps by itself; `None`: it holds its last torque forever.
    pub device_watchdog: Option<Duration>,
    /// Seed of stride variation and sensor noise.
    pub seed: u64,
    /// A recorded trial to walk; `None`: the built-in curves.
    pub trial: Option<PathBuf>,
}

/// All faults of a topology. The user is at fault; nothing was started.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub struct TopologyError(pub Vec<String>);

impl fmt::Display for TopologyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let faults = if self.0.len() == 1 { "fault" } else { "faults" };
        write!(f, "the topology has {} {faults}:", self.0.len())?;
        self.0.iter().try_for_each(|fault| write!(f, "\n  - {fault}"))
    }
}

impl Topology {
    /// Reads a topology file.
    ///
    /// # Errors
    /// All its faults, each with its place and a remedy.
    pub fn read(path: &Path) -> Result<Self, TopologyError> {
        let text = std::fs::read_to_string(path)
            .map_err(|e| TopologyError(vec![format!("{} cannot be read: {e}", path.display())]))?;
        Self::parse(&text)
    }

    /// Parses a topology from its text.
    ///
    /// # Errors
    /// All its faults, each with its place and a remedy.
    pub fn parse(text: &str) -> Result<Self, TopologyError> {
        file::parse(text)
    }

    /// Returns the text that reads back as this topology.
    #[must_use]
    pub fn to_toml(&self) -> String {
        file::write(self)
    }

    /// Returns the place of a node.
    #[must_use]
    pub const fn place(&self, part: Part) -> &NodePlace {
        match part {
            Part::Central => &self.central,
            Part::Joint(joint) => &self.joints[joint.index()],
        }
    }

    /// Returns the configuration of a node.
    #[must_use]
    pub fn node_config(&self, part: Part) -> NodeConfig {
        let place = self.place(part);
        let mut config = NodeConfig::new(part.name());
        config.project.clone_from(&self.project);
        config.address = Some(place.address);
        config.ndl.interface = place.interface.clone();
        config.ndl.port = place.port;
        config.ndl.seeds.clone_from(&place.seeds);
        config.ndl.multicast = self.discovery.multicast;
        config.ndl.mdns_port = self.discovery.mdns.then_some(MDNS_PORT);
        config.ndl.period = self.discovery.period;
        config.ndl.missed_max = self.discovery.missed_max;
        config.security.keys = self.keys.as_ref().map(|keys| keys.join("nodes").join(part.name()));
        config.lncl.socket.clone_from(&place.socket);
        config.state.clone_from(&place.state);
        config.record.keep_bytes = RECORD_KEEP_BYTES;
        if let Some(FlightRecorder { folder, frozen_folder }) = &self.record {
            config.record.folder = Some(folder.join(part.name()));
            config.record.frozen_folder = Some(frozen_folder.clone());
            (config.record.keep, config.record.after) = (FROZEN_KEEP, FROZEN_AFTER);
            config.record.frozen_max = FROZEN_MAX;
        }
        config
    }
}
