//! Configuration of a node: one struct per layer, safe defaults, all faults reported together.
//!
//! It comes from code ([`NodeConfig::new`]) or from TOML ([`NodeConfig::from_toml`],
//! [`NodeConfig::from_file`]); `docs/book/src/reference/node.toml` is a complete file. The same check
//! validates both.

mod app_settings;
mod check;
mod command;
mod contracts;
mod faults;
mod file;
mod interfaces;
mod log_level;
mod real_time;
mod record;
mod seeds;
mod stop;
#[cfg(test)]
mod tests;
mod time_policy;
mod watch_group;

pub use check::fault;
pub use faults::quoted;
pub use faults::{ConfigError, ConfigFault};
pub use file::{line_of, shown, syntax_fault};
pub use interfaces::{Families, Interface, InterfaceError, Interfaces};
pub use seeds::{Seed, SeedError};

use std::{
    net::{Ipv4Addr, Ipv6Addr, SocketAddrV4, SocketAddrV6},
    path::PathBuf,
    time::Duration,
};

use sinew_runtime::{
    supervision::{self, Flags, Intensity},
    tid::NodeAddress,
};

pub use self::{
    app_settings::AppSettings,
    command::CommandConfig,
    contracts::ContractsConfig,
    log_level::LogLevel,
    real_time::RtConfig,
    record::{RecordCompression, RecordConfig},
    stop::StopConfig,
    time_policy::TimePolicy,
    watch_group::WatchGroup,
};

/// All settings of a node.
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
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct NodeConfig {
    /// Name of the node, for users: `knee`. 1 to 63 bytes, no control characters. No default.
    pub name: String,
    /// Project of the node; nodes of other projects are ignored. 1 to 63 bytes, no control characters. Default `sinew`.
    pub project: String,
    /// Address of the node, unique in the project: not 0.0.0.0 (here) and not 255.255.255.255 (every node).
    /// Default: the address of the first [`NdlConfig::interface`]. Set it if several nodes share a host, or
    /// if that interface is chosen by its name.
    pub address: Option<NodeAddress>,
    /// Directory for the state that the node keeps from one start to the next: the addresses at which its peers
    /// answered, kept parameters, and the presses of the stop; 1 to 4,096 bytes. It is created if only itself is
    /// missing, with mode 0700. Nodes of one user may share one. Default: none, the node keeps nothing.
    pub state: Option<PathBuf>,
    /// Maximum number of messages in an application's mailbox, per class. 1 to 65,536; default 256.
    pub mailbox_capacity: usize,
    /// Maximum bytes of their payloads, per class; an empty class accepts one message of any length. 4 KiB to
    /// 1 GiB; default 4 MiB. Memory: three times this for each application, at the very worst.
    pub mailbox_bytes: usize,
    /// Longest payload in bytes. 64 to 64 MiB; default 1 MiB. A peer can make the node hold this much per
    /// connection. All nodes of a project should use the same value.
    pub payload_max: usize,
    /// Local Node Communication Layer.
    pub lncl: LnclConfig,
    /// Global Node Communication Layer.
    pub gncl: GnclConfig,
    /// Node Discovery Layer.
    pub ndl: NdlConfig,
    /// Sync manager.
    pub sync: SyncConfig,
    /// Limits on restarts.
    pub supervision: SupervisionConfig,
    /// Authentication of other nodes.
    pub security: SecurityConfig,
    /// The node's logging.
    pub log: LogConfig,
    /// The recording of messages.
    pub record: RecordConfig,
    /// The measurement of the node's real-time behaviour.
    pub rt: RtConfig,
    /// The stop of the whole system.
    pub stop: StopConfig,
    /// The contracts of applications.
    pub contracts: ContractsConfig,
    /// The programs that the node starts and supervises. Default: none.
    pub commands: Vec<CommandConfig>,
    /// The settings of applications: the tables `[app.NAME]` of its file, which [`NodeConfig::app`] reads.
    /// Default: none.
    pub app_settings: AppSettings,
}

/// The node's log: lines on the standard error, in a program that has installed no subscriber of `tracing`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogConfig {
    /// The most detailed level that is written; the environment variables `SINEW_LOG` and `RUST_LOG` override
    /// it. The nodes of one process share a log: the last one to start sets its level. Default
    /// [`LogLevel::Info`].
    pub level: LogLevel,
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
    /// Path of the unix socket for applications in other processes; 1 to 100 bytes. Default: none, no such socket.
    pub socket: Option<PathBuf>,
    /// Maximum number of connections of other processes, one for each registered address. 1 to 4,096; default
    /// 256. Users that only the access list admits have at most half of them, one such user a quarter, at
    /// least one.
    pub clients_max: usize,
    /// Maximum number of connections per process. 1 to 4,096; default 64: one process leaves room for others.
    pub clients_per_process_max: usize,
    /// Maximum number of unauthenticated connections, in addition to those. 1 to 1,024; default 128. Each may take 2 s.
    pub strangers_max: usize,
    /// Maximum number of unauthenticated connections per process. 1 to 1,024; default 32.
    pub strangers_per_process_max: usize,
    /// Maximum number of short frames per second that are read from all users that only the access list
    /// admits; half of it from one such user. Each 16 KiB of a frame count as one more, a frame to another
    /// node counts four times. 100 to 1,000,000; default 20,000.
    pub guest_frames_per_s: usize,
    /// Maximum bytes of payloads that wait for all clients together; a quarter of it for those of one
    /// process. 64 KiB to 64 GiB; default 256 MiB. In addition to [`NodeConfig::mailbox_bytes`], which each
    /// of them has.
    pub clients_bytes: usize,
    /// Maximum number of applications of the node, in all its processes. 1 to 65,536; default 1,024.
    pub apps_max: usize,
    /// Bytes of the ring in shared memory for each direction of another process's connection, rounded up to a
    /// power of two. Half of it is the longest message that is sent in one piece, and the whole is the cost
    /// of a client that does not read. 4 KiB to 16 MiB; default 256 KiB.
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
    /// TCP port to listen on, at each [`NdlConfig::interface`]. Default 0: any free one; NDL announces it.
    pub port: u16,
    /// The address at which other nodes reach the listener, if it differs: the outer side of a forwarded
    /// port. Default: none, the listening address.
    pub announce: Option<SocketAddrV4>,
    /// Further addresses of this host at which GNCL listens, one for each interface in addition to
    /// [`NdlConfig::interface`], the preferred one first; at most 7. The others dial all of them, and again
    /// when a link breaks. Default: none.
    pub further: Vec<Ipv4Addr>,
    /// Maximum number of messages queued for one peer, per class. 1 to 65,536; default 1,024. At most this
    /// many confirmed messages per destination, and eight times as many per class, may be without an outcome.
    /// The peer's room for outcomes is a further limit: eight times its own capacity, at least 8,192, and an
    /// eighth of that per destination.
    pub queue_capacity: usize,
    /// Maximum bytes of their payloads, per class; one message is queued regardless of its length. 4 KiB to 1
    /// GiB; default 16 MiB.
    pub queue_bytes: usize,
    /// Maximum number of unauthenticated connections. For a further one another one is closed, first of the
    /// source with the most. 1 to 1,024; default 64.
    pub strangers_max: usize,
    /// Time limit for a handshake. 10 ms to 60 s; default 2 s. A flood of the port delays the accept of new
    /// nodes by a second. With less than about 1.1 s none of them is linked as long as a flood lasts.
    pub handshake: Duration,
    /// First wait before dialling again; doubles to [`redial_max`](Self::redial_max). 1 ms to 10 s; default 10 ms.
    pub redial_min: Duration,
    /// Longest wait before dialling again. `redial_min` to 60 s; default 1 s.
    pub redial_max: Duration,
    /// Time without acknowledgement of written data after which a connection ends (TCP_USER_TIMEOUT). 100 ms
    /// to 10 min; default 5 s.
    pub give_up: Duration,
    /// Whether packets are marked with their class, so that switches, access points and this host's own
    /// queues send Control first. The marks of Control, Stream and Bulk are DSCP EF, AF41 and AF11 (RFC
    /// 4594), and `SO_PRIORITY` 6, 0 and 2. NDL's datagrams have CS6 and 6. Default `true`.
    pub marks: bool,
    /// Whether values of class Stream are sent to other nodes by UDP if it works, so that a lost packet
    /// delays only itself. Otherwise, and for values longer than 1,112 bytes, TCP is used. Both nodes must
    /// enable it. Default `true`.
    pub datagrams: bool,
    /// How long the IO thread spins after a message of a peer, so that the next one need not wake it. This
    /// costs a core, and saves the wake of an idle one, 10 to 50 us, for applications on the IO thread. 0 to
    /// 10 ms; default 0, it sleeps at once.
    pub spin: Duration,
}

/// Node Discovery Layer: discovery of nodes, and detection of their loss.
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
    /// Network interfaces that the node uses, at most 8, the preferred one first: by addresses of this host
    /// (not 0.0.0.0 nor ::), by names, or all. Names and all are each used with their IPv4 addresses, IPv6
    /// addresses, or both. Other nodes are queried over each, and are up as long as they answer over any.
    /// Default: loopback, so that nothing leaves the host; with other interfaces, loopback is used only if it
    /// is listed.
    pub interface: Interfaces,
    /// UDP port for queries and answers. Default 0: any free one; set it where other nodes list this one as a seed.
    pub port: u16,
    /// Multicast group (224.0.0.0 to 239.255.255.255) and port of the cyclic query; `None` switches it off. Default
    /// 239.255.83.119:6910, never routed (time to live 1).
    pub multicast: Option<SocketAddrV4>,
    /// Multicast group (ff02::/16 or ff12::/16) and port of the same query where an interface has IPv6
    /// addresses; `None` switches it off, and so does `None` above. Default `[ff12::8000:5377]:6910`, which
    /// stays on its link.
    pub multicast6: Option<SocketAddrV6>,
    /// Port of multicast DNS; `None` switches it off. Default 5353, the port of RFC 6762.
    pub mdns_port: Option<u16>,
    /// UDP addresses of nodes that are always queried, for networks without multicast. At most 256, each with
    /// a port; default none.
    pub seeds: Vec<Seed>,
    /// Time between two queries. 10 ms to 60 s; default 500 ms, as in the paper. Detection takes `period`
    /// times `missed_max`, and up to one period more.
    pub period: Duration,
    /// Consecutive missed answers after which a node counts as lost. 2 to 100; default 3.
    pub missed_max: u32,
    /// Nodes with their own detection times, instead of [`period`](Self::period) and
    /// [`missed_max`](Self::missed_max); the first group that covers a node counts. At most 16; default none.
    pub watch: Vec<WatchGroup>,
    /// Maximum number of known nodes. 1 to 65,536; default 1,024.
    pub nodes_max: usize,
}

impl NdlConfig {
    /// Returns the queried multicast groups: none of either family if multicast is off, and no IPv6 group
    /// over loopback.
    pub fn asked_groups(&self) -> Vec<String> {
        let Some(ipv4) = self.multicast else { return Vec::new() };
        let beyond: Vec<_> =
            self.interface.iter().filter(|interface| !interface.is_loopback()).cloned().collect();
        let ipv4 = self.interface.have_ipv4().then(|| ipv4.to_string());
        let ipv6 = self.multicast6.filter(|_| Interfaces::from(beyond).have_ipv6());
        ipv4.into_iter().chain(ipv6.map(|group| group.to_string())).collect()
    }
}

/// Sync manager: start-up barriers.
#[derive(Clone, Debug, PartialEq)]
pub struct SyncConfig {
    /// Time for each layer to become ready. 10 ms to 10 min; default 10 s. After it the start fails.
    pub layer_deadline: Duration,
    /// Time limit for an application's requirements. 10 ms to 24 h; default 60 s. Each time it passes, the
    /// missing names are reported; the application continues to wait.
    pub requirement_deadline: Duration,
}

/// Restart intensity: the maximum number of restarts, for the layers and for the applications that the node supervises.
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
    /// Maximum number of restarts of failed layers, all together, in one window; at one more the node ends in
    /// order. 0 to 1,000,000; default 5. A larger value keeps a node alive that does not recover.
    pub layer_restarts_max: usize,
    /// The window for layers. 1 ms to 1 h; default 10 s. A layer that ran longer than this starts its
    /// back-off anew: with a short window, a layer that fails rarely is restarted at once.
    pub layer_window: Duration,
    /// The same for applications. 0 to 1,000,000; default 5.
    pub app_restarts_max: usize,
    /// The window for applications. 1 ms to 1 h; default 10 s.
    pub app_window: Duration,
}

/// Security: authentication of other nodes (`sinew::security`), and the access list for messages.
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
    /// Directory of the node's keys, as created by `sinew keys`
    /// (`sinew::security::files`); 1 to 4,096 bytes. Default: none, links between nodes
    /// are open to the whole network.
    pub keys: Option<PathBuf>,
    /// How validity times of certificates are used while the clock may be wrong. Default [`TimePolicy::UntilSet`].
    pub times: TimePolicy,
    /// File with the access list of the node, which defines the allowed messages; 1 to 4,096 bytes. It can be
    /// reloaded while the node runs; adding or removing the list needs a restart. Default: none, every
    /// message is allowed.
    pub access: Option<PathBuf>,
}

impl SupervisionConfig {
    /// Returns the supervision flags of the layers: each depends on those before it.
    pub fn layers(&self) -> Flags {
        flags(supervision::Strategy::RestForOne, self.layer_restarts_max, self.layer_window)
    }

    /// Returns the supervision flags of the applications.
    pub fn apps(&self) -> Flags {
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
    /// Returns the defaults for the node called `name`: loopback only.
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
                // Link-local and transient (RFC 4291, section 2.7), with a freely chosen number (RFC 3307,
                // section 4.3).
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
            record: RecordConfig::default(),
            rt: RtConfig::default(),
            stop: StopConfig::default(),
            contracts: ContractsConfig::default(),
            commands: Vec::new(),
            app_settings: AppSettings::default(),
        }
    }

    /// Returns the node's address: as set, or that of its first interface. An interface chosen by its name
    /// has none: 0.0.0.0.
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

    /// Returns the further addresses at which GNCL listens: at the other interfaces that are chosen by their
    /// addresses, and as configured.
    pub fn gncl_further(&self) -> Vec<Ipv4Addr> {
        let mut further: Vec<_> = self.ndl.interface.addresses().skip(1).collect();
        further.extend(&self.gncl.further);
        further
    }

    /// Returns whether programs of other hosts may reach the node: it discovers others beyond this host, or
    /// GNCL listens or is announced there.
    pub fn is_beyond_host(&self) -> bool {
        let mut besides = self.gncl.further.iter().chain(self.gncl.announce.as_ref().map(SocketAddrV4::ip));
        !self.ndl.interface.are_loopback() || besides.any(|ip| !ip.is_loopback())
    }
}
