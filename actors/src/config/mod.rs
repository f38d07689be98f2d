//! Configuration of a node: one struct a layer, safe defaults, every fault reported together.
//!
//! It comes from code ([`NodeConfig::new`]) or from TOML ([`NodeConfig::from_toml`], [`NodeConfig::from_file`]);
//! `docs/CONFIGURATION.md` has a complete file. Whichever way it came, the same check decides whether it is legal.

mod app_settings;
mod check;
mod faults;
mod file;
mod interfaces;
mod seeds;
#[cfg(test)]
mod tests;

pub(crate) use check::fault;
pub(crate) use faults::quoted;
pub use faults::{ConfigFault, ConfigFaults};
pub(crate) use file::{line_of, shown, syntax_fault};
pub use interfaces::{Families, Interface, Interfaces, NoInterface};
pub use seeds::{NoSeed, Seed};

use std::{
    net::{Ipv4Addr, Ipv6Addr, SocketAddrV4, SocketAddrV6},
    path::PathBuf,
    time::Duration,
};

use sinew_runtime::{
    app::matches,
    supervision::{self, Flags, Intensity},
    tid::NodeAddress,
};

pub use self::app_settings::AppSettings;
use crate::security::TimePolicy;

/// Everything that can be set about a node.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// config.project = "left-leg".to_owned();
/// config.ndl.interface = [10, 0, 0, 3].into();
/// config.validate()?;
/// assert_eq!(config.node_address(), [10, 0, 0, 3].into());
/// # Ok::<(), sinew::config::ConfigFaults>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct NodeConfig {
    /// Name of the node, for people: `knee`. 1 to 63 bytes, no control characters. No default.
    pub name: String,
    /// Project that the node belongs to; nodes of other projects are not seen. 1 to 63 bytes, no control characters.
    /// Default `sinew`.
    pub project: String,
    /// Address of the node, unique in the project: not 0.0.0.0 (here) and not 255.255.255.255 (every node). Default: the
    /// address of [`NdlConfig::interface`], the first one's; set it by hand where several nodes share a host, or where that one is
    /// chosen by its name.
    pub address: Option<NodeAddress>,
    /// Directory for what the node keeps from one start to the next, which is where its peers answered; 1 to 4,096 bytes. It is made if only
    /// itself is missing, with mode 0700. Nodes of one user may share one. Default: none, the node keeps nothing.
    pub state: Option<PathBuf>,
    /// Messages that an application's mailbox holds at most, each class by itself. 1 to 65,536; default 256.
    pub mailbox_capacity: usize,
    /// Bytes of the payloads in it at most, each class by itself; one message is held where nothing else waits, however
    /// long it is. 4 KiB to 1 GiB; default 4 MiB. Memory: three times this for each application, at the very worst.
    pub mailbox_bytes: usize,
    /// Longest payload in bytes. 64 to 64 MiB; default 1 MiB. A peer can make the node hold this much a connection. All
    /// nodes of a project should have the same.
    pub payload_max: usize,
    /// Local Node Communication Layer.
    pub lncl: LnclConfig,
    /// Global Node Communication Layer.
    pub gncl: GnclConfig,
    /// Node Discovery Layer.
    pub ndl: NdlConfig,
    /// Sync manager.
    pub sync: SyncConfig,
    /// How many restarts are too many.
    pub supervision: SupervisionConfig,
    /// Who other nodes are, proven.
    pub security: SecurityConfig,
    /// What the node logs.
    pub log: LogConfig,
    /// Settings of the user's own: the tables `[app.NAME]` of its file, which [`NodeConfig::app`] reads. Default: none.
    pub app_settings: AppSettings,
}

/// The node's log: lines on the standard error, in a program that has installed no subscriber of `tracing`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogConfig {
    /// The most detailed level that is written; the environment variables `SINEW_LOG` and `RUST_LOG` override it. The nodes of one process
    /// share a log: the one that starts last sets its level. Default [`LogLevel::Info`].
    pub level: LogLevel,
}

/// How much is written to the log.
///
/// # Examples
///
/// ```
/// use sinew::config::{LogLevel, NodeConfig};
///
/// let config = NodeConfig::from_toml("[node]\nname = 'knee'\n[log]\nlevel = 'warn'\n")?;
/// assert_eq!(config.log.level, LogLevel::Warn);
/// # Ok::<(), sinew::config::ConfigFaults>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogLevel {
    /// Nothing, except panics of actors.
    Off,
    /// Failures.
    Error,
    /// Also conditions that need attention.
    Warn,
    /// Also starts, stops, and changes of members.
    #[default]
    Info,
    /// Also details for the search of a fault.
    Debug,
    /// Everything.
    Trace,
}

/// Local Node Communication Layer: the applications of this host.
///
/// # Examples
///
/// ```
/// use sinew::NodeConfig;
///
/// let mut config = NodeConfig::new("knee");
/// config.lncl.socket = Some("/run/sinew/knee.sock".into()); // for programs apart
/// config.lncl.clients_max = 16;
/// # config.validate().expect("it is legal");
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct LnclConfig {
    /// Path of the unix socket for applications in other processes; 1 to 100 bytes. Default: none, no such door.
    pub socket: Option<PathBuf>,
    /// Connections of other processes at most, one for each registered address. 1 to 4,096; default 256. Users whom only the access list
    /// lets in have half of them at most, one such user a quarter, one at least.
    pub clients_max: usize,
    /// Those of one process at most. 1 to 4,096; default 64: one process leaves room for others.
    pub clients_per_process_max: usize,
    /// Connections that have not said yet who they are, at most, beside those. 1 to 1,024; default 128. Each may take 2 s.
    pub strangers_max: usize,
    /// Those of one process at most. 1 to 1,024; default 32.
    pub strangers_per_process_max: usize,
    /// Short frames in a second that are read of all users together whom only the access list lets in; of one such user half of it. Each 16 KiB
    /// of a frame count as one more, a frame to another node counts four times. 100 to 1,000,000; default 20,000.
    pub guest_frames_per_s: usize,
    /// Bytes of payloads that wait for all clients together at most; a quarter of it for those of one process. 64 KiB to
    /// 64 GiB; default 256 MiB. Beside [`NodeConfig::mailbox_bytes`], which each of them has.
    pub clients_bytes: usize,
    /// Applications of the node at most, in all its processes. 1 to 65,536; default 1,024.
    pub apps_max: usize,
    /// Bytes of the ring in shared memory for each direction of a connection of another process; the next power of two
    /// is taken. Half of it is the longest message that goes in one piece, and the whole is what a client that does not
    /// read costs. 4 KiB to 16 MiB; default 256 KiB.
    pub ring_bytes: usize,
}

/// Global Node Communication Layer: connections between nodes.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// config.gncl.port = 6912; // a fixed one, for the firewall
/// config.gncl.give_up = Duration::from_millis(500);
/// # config.validate().expect("it is legal");
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct GnclConfig {
    /// TCP port to listen on, at [`NdlConfig::interface`], where that is several at each. Default 0: any free one; NDL tells the others which.
    pub port: u16,
    /// Where the others reach the listener, if not where it listens: the outer side of a forwarded port. Default: none, where it
    /// listens.
    pub announce: Option<SocketAddrV4>,
    /// Further addresses of this host at which GNCL listens, one for each interface beside [`NdlConfig::interface`], the one that is
    /// preferred first; at most 7. The others dial all of them, and again when a link breaks. Default: none.
    pub further: Vec<Ipv4Addr>,
    /// Messages that wait for one peer at most, each class by itself. 1 to 65,536; default 1,024. So many confirmed ones of one destination, and
    /// eight times as many of all of a class, may be without an outcome; and no more than the peer has room for the outcomes of, which is
    /// eight times its own capacity, 8,192 at least; of one destination than an eighth of that.
    pub queue_capacity: usize,
    /// Bytes of their payloads at most, each class by itself; one message waits however long it is. 4 KiB to 1 GiB;
    /// default 16 MiB.
    pub queue_bytes: usize,
    /// Connections whose peer has not said who it is, at most; for a further one one of them is closed, first from where most
    /// come. 1 to 1,024; default 64.
    pub strangers_max: usize,
    /// Time for a handshake. 10 ms to 60 s; default 2 s. Who floods the port has newcomers wait for a second until they are accepted: with less
    /// than about 1.1 s none of them is linked as long as a flood lasts.
    pub handshake: Duration,
    /// First wait before dialling again; doubles to [`redial_max`](Self::redial_max). 1 ms to 10 s; default 10 ms.
    pub redial_min: Duration,
    /// Longest wait before dialling again. `redial_min` to 60 s; default 1 s.
    pub redial_max: Duration,
    /// Time after which a connection ends whose other side takes nothing of what was written (TCP_USER_TIMEOUT). 100 ms to 10 min;
    /// default 5 s.
    pub give_up: Duration,
    /// Whether packets say which class they carry, so that switches, access points and this host's own queues send Control first:
    /// DSCP EF, AF41 and AF11 for Control, Stream and Bulk (RFC 4594), `SO_PRIORITY` 6, 0 and 2; CS6 and 6 for NDL's datagrams.
    /// Default `true`.
    pub marks: bool,
    /// Whether values of class Stream go to other nodes by UDP where that gets through, so that a packet that is lost holds up nothing but
    /// itself; else, and what is longer than 1,112 bytes, by TCP. Both nodes must have it so. Default `true`.
    pub datagrams: bool,
    /// How long the IO thread stays awake after a message of a peer, so that the next one need not wake it: costs a core, and
    /// saves the wake of an idle one, 10 to 50 us, for applications on the IO thread. 0 to 10 ms; default 0, it sleeps at once.
    pub spin: Duration,
}

/// Node Discovery Layer: who is there, who is gone.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// config.ndl.interface = [10, 0, 0, 3].into();
/// config.ndl.seeds = vec![([10, 0, 0, 2], 6911).into()]; // for a network without multicast
/// (config.ndl.period, config.ndl.missed_max) = (Duration::from_millis(20), 3); // lost within 80 ms
/// # config.validate().expect("it is legal");
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct NdlConfig {
    /// Network interfaces that the node uses, at most 8, the one that it prefers first: by addresses of this host (not 0.0.0.0 nor ::), by
    /// names, or all, each of these two with its addresses of IPv4, of IPv6, or both. Other nodes are asked over each, and are there as long as they answer over any. Default: loopback, so that
    /// nothing leaves the host; beside others, loopback is used where it is listed.
    pub interface: Interfaces,
    /// UDP port for queries and answers. Default 0: any free one; set it where other nodes list this one as a seed.
    pub port: u16,
    /// Multicast group (224.0.0.0 to 239.255.255.255) and port of the cyclic query; `None` switches it off. Default
    /// 239.255.83.119:6910, never routed (time to live 1).
    pub multicast: Option<SocketAddrV4>,
    /// Multicast group (ff02::/16 or ff12::/16) and port of the same query where an interface has IPv6 addresses; `None` switches it off, and so
    /// does `None` above. Default `[ff12::8000:5377]:6910`, which stays on its link.
    pub multicast6: Option<SocketAddrV6>,
    /// Port of multicast DNS; `None` switches it off. Default 5353, the port of RFC 6762.
    pub mdns_port: Option<u16>,
    /// UDP addresses of nodes to ask in any case, for networks without multicast. At most 256, each with a port;
    /// default none.
    pub seeds: Vec<Seed>,
    /// Time between two queries. 10 ms to 60 s; default 500 ms, the paper's. Detection takes `period` times
    /// `missed_max`, and up to one period more.
    pub period: Duration,
    /// Answers missed in a row after which a node counts as lost. 2 to 100; default 3.
    pub missed_max: u32,
    /// Nodes that are watched at a pace of their own, as [`period`](Self::period) and [`missed_max`](Self::missed_max) are that of all
    /// others; of several groups that cover a node the first one counts. At most 16; default none.
    pub watch: Vec<WatchGroup>,
    /// Nodes known at most. 1 to 65,536; default 1,024.
    pub nodes_max: usize,
}

/// Nodes whose loss is to be known sooner, or may be known later, than that of others. Each node decides for itself how it watches others;
/// those answer whoever asks.
///
/// # Examples
///
/// ```
/// use sinew::{config::WatchGroup, prelude::*};
///
/// let mut config = NodeConfig::new("central");
/// // The loss of a leg is known within 40 ms, that of others in the default's 2 s.
/// let legs = WatchGroup { nodes: vec!["leg.*".into()], period: Duration::from_millis(10), missed_max: 3 };
/// config.ndl.watch.push(legs);
/// # config.validate().expect("it is legal");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WatchGroup {
    /// Names of nodes; `*` stands for any text: `leg.*`. 1 to 64 names of 1 to 63 bytes.
    pub nodes: Vec<String>,
    /// Time between two queries to each of them. 10 ms to 60 s. Shorter costs a datagram each way for every node and period.
    pub period: Duration,
    /// Answers missed in a row after which one of them counts as lost. 2 to 100.
    pub missed_max: u32,
}

impl NdlConfig {
    /// The groups that are asked: none of either family where multicast is off, and none from loopback of IPv6.
    pub(crate) fn asked_groups(&self) -> Vec<String> {
        let Some(ipv4) = self.multicast else { return Vec::new() };
        let beyond: Vec<_> =
            self.interface.iter().filter(|interface| !interface.is_loopback()).cloned().collect();
        let ipv4 = self.interface.have_ipv4().then(|| ipv4.to_string());
        let ipv6 = self.multicast6.filter(|_| Interfaces::from(beyond).have_ipv6());
        ipv4.into_iter().chain(ipv6.map(|group| group.to_string())).collect()
    }
}

impl WatchGroup {
    /// Whether the node called `name` is in this group.
    ///
    /// # Examples
    ///
    /// ```
    /// # use sinew::config::WatchGroup;
    /// let legs = WatchGroup { nodes: vec!["leg.*".into(), "hip".into()], period: std::time::Duration::from_millis(10), missed_max: 3 };
    /// assert!(legs.covers("leg.left") && legs.covers("hip") && !legs.covers("hip.left"));
    /// ```
    #[must_use]
    pub fn covers(&self, name: &str) -> bool {
        self.nodes.iter().any(|pattern| matches(pattern, name))
    }
}

/// Sync manager: start-up barriers.
#[derive(Clone, Debug, PartialEq)]
pub struct SyncConfig {
    /// Time for each layer to become ready. 10 ms to 10 min; default 10 s. After it the start fails.
    pub layer_deadline: Duration,
    /// Time for an application's requirements to be met. 10 ms to 24 h; default 60 s. After it, and every time that
    /// it passes again, the missing names are reported; the application goes on waiting.
    pub requirement_deadline: Duration,
}

/// Restart intensity: how many restarts are too many, for the layers and for the applications that the node supervises.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// // More than 3 restarts of applications in a minute: the node ends in order.
/// (config.supervision.app_restarts_max, config.supervision.app_window) = (3, Duration::from_secs(60));
/// # config.validate().expect("it is legal");
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct SupervisionConfig {
    /// Restarts of layers that failed, all together, in one window; at one more the node ends in order. 0 to 1,000,000;
    /// default 5. More keeps a node alive that does not get better.
    pub layer_restarts_max: usize,
    /// The window for layers. 1 ms to 1 h; default 10 s. A layer that lived longer than this begins its back-off anew: a
    /// short one restarts what fails rarely at once.
    pub layer_window: Duration,
    /// The same for applications. 0 to 1,000,000; default 5.
    pub app_restarts_max: usize,
    /// The window for applications. 1 ms to 1 h; default 10 s.
    pub app_window: Duration,
}

/// Security: who other nodes are ([`security`](crate::security)), and who may send what to whom.
///
/// # Examples
///
/// ```
/// use sinew::NodeConfig;
///
/// let mut config = NodeConfig::new("knee");
/// config.security.keys = Some("/etc/sinew/keys".into()); // as `sinew keys` makes them
/// config.security.access = Some("/etc/sinew/access.toml".into());
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct SecurityConfig {
    /// Directory of the node's keys, as `sinew keys` makes it ([`security::files`](crate::security::files)); 1 to 4,096 bytes. Default:
    /// none, links between nodes are open to everybody on the network.
    pub keys: Option<PathBuf>,
    /// What the times of certificates are good for while the clock may be wrong. Default [`TimePolicy::UntilSet`].
    pub times: TimePolicy,
    /// File with the access list of the node: who may send what to whom; 1 to 4,096 bytes. It can be read again while the node runs; whether
    /// there is one cannot be changed then. Default: none, everybody may send everything.
    pub access: Option<PathBuf>,
}

impl SupervisionConfig {
    /// How the layers are supervised: each stands on those before it.
    pub(crate) fn layers(&self) -> Flags {
        flags(supervision::Strategy::RestForOne, self.layer_restarts_max, self.layer_window)
    }

    /// How the applications are supervised.
    pub(crate) fn apps(&self) -> Flags {
        flags(supervision::Strategy::OneForOne, self.app_restarts_max, self.app_window)
    }
}

fn flags(strategy: supervision::Strategy, restarts_max: usize, window: Duration) -> Flags {
    Flags {
        strategy,
        intensity: Intensity { restarts_max, window, ..Intensity::default() },
        ..Flags::default()
    }
}

impl NodeConfig {
    /// The defaults for the node called `name`: loopback only.
    #[must_use]
    pub fn new(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            project: "sinew".to_owned(),
            address: None,
            state: None,
            mailbox_capacity: 256,
            mailbox_bytes: 4 << 20,
            payload_max: 1 << 20,
            lncl: LnclConfig {
                socket: None,
                clients_max: 256,
                clients_per_process_max: 64,
                strangers_max: 128,
                strangers_per_process_max: 32,
                guest_frames_per_s: 20_000,
                clients_bytes: 256 << 20,
                apps_max: 1_024,
                ring_bytes: 256 * 1_024,
            },
            gncl: GnclConfig {
                port: 0,
                announce: None,
                further: Vec::new(),
                queue_capacity: 1_024,
                queue_bytes: 16 << 20,
                strangers_max: 64,
                handshake: Duration::from_secs(2),
                redial_min: Duration::from_millis(10),
                marks: true,
                datagrams: true,
                spin: Duration::ZERO,
                redial_max: Duration::from_secs(1),
                give_up: Duration::from_secs(5),
            },
            ndl: NdlConfig {
                interface: Interfaces::default(),
                port: 0,
                multicast: Some(SocketAddrV4::new(Ipv4Addr::new(239, 255, 83, 119), 6910)),
                // Link-local and transient (RFC 4291, section 2.7), with a number that is free to choose (RFC 3307, section 4.3).
                multicast6: Some(SocketAddrV6::new(
                    Ipv6Addr::new(0xff12, 0, 0, 0, 0, 0, 0x8000, 0x5377),
                    6910,
                    0,
                    0,
                )),
                mdns_port: Some(5353),
                seeds: Vec::new(),
                period: Duration::from_millis(500),
                missed_max: 3,
                watch: Vec::new(),
                nodes_max: 1_024,
            },
            sync: SyncConfig {
                layer_deadline: Duration::from_secs(10),
                requirement_deadline: Duration::from_secs(60),
            },
            supervision: SupervisionConfig {
                layer_restarts_max: 5,
                layer_window: Duration::from_secs(10),
                app_restarts_max: 5,
                app_window: Duration::from_secs(10),
            },
            security: SecurityConfig { keys: None, times: TimePolicy::UntilSet, access: None },
            log: LogConfig::default(),
            app_settings: AppSettings::default(),
        }
    }

    /// The node's address: as set, or that of its first interface. One that is chosen by its name has none to give: 0.0.0.0.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeConfig;
    ///
    /// let mut config = NodeConfig::new("knee");
    /// config.ndl.interface = [10, 0, 0, 3].into();
    /// assert_eq!(config.node_address().to_string(), "10.0.0.3");
    /// config.address = Some([10, 0, 0, 33].into());
    /// assert_eq!(config.node_address().to_string(), "10.0.0.33");
    /// ```
    #[must_use]
    pub fn node_address(&self) -> NodeAddress {
        let interface = || self.ndl.interface.first_address().unwrap_or(Ipv4Addr::UNSPECIFIED);
        self.address.unwrap_or_else(|| NodeAddress::from(interface()))
    }

    /// Where GNCL listens besides: at the other interfaces that are chosen by their addresses, and where it is told to.
    pub(crate) fn gncl_further(&self) -> Vec<Ipv4Addr> {
        let mut further: Vec<_> = self.ndl.interface.addresses().skip(1).collect();
        further.extend(&self.gncl.further);
        further
    }

    /// Whether others than programs of this host may reach the node: where it looks for others, or GNCL listens or is announced besides.
    pub(crate) fn is_beyond_host(&self) -> bool {
        let mut besides = self.gncl.further.iter().chain(self.gncl.announce.as_ref().map(SocketAddrV4::ip));
        !self.ndl.interface.are_loopback() || besides.any(|ip| !ip.is_loopback())
    }
}
