//! The rows of the reference, in the order of the reader's keys.

use super::*;
use crate::config::LogLevel;

/// One row per key; a test compares them with the keys that the reader accepts.
pub(super) const ROWS: &[Row] = &[
    Row {
        key: "node.name",
        kind: Kind::Name,
        value: |config| json!(config.name),
        effect: "Name of the node, for people, requirements and the file names of its keys.",
        note: "It has no `/`, `=` or `*`, no `-` or `.` at its beginning, and no `.toml` at its end.",
    },
    Row {
        key: "node.project",
        kind: Kind::Name,
        value: |config| json!(config.project),
        effect: "Project that the node belongs to; nodes of other projects are ignored.",
        note: "The rules of `name` apply.",
    },
    Row {
        key: "node.address",
        kind: Kind::NodeAddress,
        value: |config| json!(config.address.map(|address| address.to_string())),
        effect: "Address of the node, unique in the project.",
        note: "Set it where several nodes share a host, or where `ndl.interface` does not begin with an IPv4 address.",
    },
    Row {
        key: "node.state",
        kind: Kind::PathOrFalse(DIRECTORY_BYTES_MAX),
        value: |config| path(config.state.as_deref()),
        effect: "Directory in which the node keeps the addresses of its peers between two starts; `false` keeps none.",
        note: "The node creates the directory itself, with mode 0700, but not its parents.",
    },
    Row {
        key: "node.mailbox_capacity",
        kind: Kind::Number(MAILBOX_CAPACITY),
        value: |config| json!(config.mailbox_capacity),
        effect: "Messages that wait for one application, for each class.",
        note: "With events of the layers, an application holds at most four times this number.",
    },
    Row {
        key: "node.mailbox_bytes",
        kind: Kind::Number(MAILBOX_BYTES),
        value: |config| json!(config.mailbox_bytes),
        effect: "Payload bytes that wait for one application, for each class; a single message of any length always fits.",
        note: "The worst case is three times this for each application, or twelve times with payload lengths chosen to waste buffers.",
    },
    Row {
        key: "node.payload_max",
        kind: Kind::Number(PAYLOAD_MAX),
        value: |config| json!(config.payload_max),
        effect: "Longest payload of a message; set the same value on all nodes of a project.",
        note: "A peer can make the node hold this much for each connection.",
    },
    Row {
        key: "lncl.socket",
        kind: Kind::PathOrFalse(SOCKET_BYTES_MAX),
        value: |config| path(config.lncl.socket.as_deref()),
        effect: "Path of the client socket, through which programs that the node did not start register; `false` opens none.",
        note: "It serves the node's own user, root, and the users of a `[[client]]` in `security.access`.",
    },
    Row {
        key: "lncl.clients_max",
        kind: Kind::Number(CLIENTS_MAX),
        value: |config| json!(config.lncl.clients_max),
        effect: "Connections of other processes, one for each registered address.",
        note: "Guests share half of it; one guest user has a quarter, at least one.",
    },
    Row {
        key: "lncl.clients_per_process_max",
        kind: Kind::Number(CLIENTS_PER_PROCESS_MAX),
        value: |config| json!(config.lncl.clients_per_process_max),
        effect: "Connections of one process, so that one process leaves room for others.",
        note: "",
    },
    Row {
        key: "lncl.strangers_max",
        kind: Kind::Number(LNCL_STRANGERS_MAX),
        value: |config| json!(config.lncl.strangers_max),
        effect: "Connections, besides those of clients, that have not registered yet.",
        note: "Each has 2 s to register. Guests share half of it; one guest user has a quarter.",
    },
    Row {
        key: "lncl.strangers_per_process_max",
        kind: Kind::Number(STRANGERS_PER_PROCESS_MAX),
        value: |config| json!(config.lncl.strangers_per_process_max),
        effect: "Connections of one process that have not registered yet.",
        note: "",
    },
    Row {
        key: "lncl.guest_frames_per_s",
        kind: Kind::Number(GUEST_FRAMES),
        value: |config| json!(config.lncl.guest_frames_per_s),
        effect: "Short frames per second that the node reads from all guests together, and half of it from one guest user.",
        note: "Each 16 KiB counts as a further frame, and a frame to another node as four. Lower it on networks slower than 1 Gbit/s.",
    },
    Row {
        key: "lncl.clients_bytes",
        kind: Kind::Number(CLIENTS_BYTES),
        value: |config| json!(config.lncl.clients_bytes),
        effect: "Payload bytes that wait for all clients together; the clients of one process have a quarter.",
        note: "`node.mailbox_bytes` limits each client as well. Four processes that read nothing can fill all of it.",
    },
    Row {
        key: "lncl.apps_max",
        kind: Kind::Number(APPS_MAX),
        value: |config| json!(config.lncl.apps_max),
        effect: "Applications of the node, in all processes.",
        note: "",
    },
    Row {
        key: "lncl.ring_bytes",
        kind: Kind::Number(RING_BYTES),
        value: |config| json!(config.lncl.ring_bytes),
        effect: "Shared memory for each direction of a client's connection, rounded up to a power of two.",
        note: "A message longer than half of it is sent in several pieces.",
    },
    Row {
        key: "gncl.port",
        kind: Kind::Number(GNCL_PORT),
        value: |config| json!(config.gncl.port),
        effect: "TCP port of the listener, at every address of `ndl.interface`.",
        note: "Discovery announces the port. Fix it for a firewall.",
    },
    Row {
        key: "gncl.announce",
        kind: Kind::EndpointOrFalse { legal: "IPv4 `address:port`", pattern: IPV4_PORT },
        value: |config| endpoint(config.gncl.announce),
        effect: "Address and port that other nodes dial instead of the listener's own, behind a port forwarding.",
        note: "It is of IPv4 only; IPv6 addresses are announced as `ndl.interface` selects them.",
    },
    Row {
        key: "gncl.further",
        kind: Kind::Addresses(FURTHER_MAX),
        value: |config| json!(config.gncl.further),
        effect: "Further IPv4 addresses of this host at which the listener accepts, the preferred one first.",
        note: "It counts together with the further addresses of `ndl.interface`, which must all be IPv4 addresses.",
    },
    Row {
        key: "gncl.queue_capacity",
        kind: Kind::Number(QUEUE_CAPACITY),
        value: |config| json!(config.gncl.queue_capacity),
        effect: "Messages that wait for one peer, for each class.",
        note: "It also limits confirmed messages without an outcome: this many for each destination, eight times as many for each class.",
    },
    Row {
        key: "gncl.queue_bytes",
        kind: Kind::Number(QUEUE_BYTES),
        value: |config| json!(config.gncl.queue_bytes),
        effect: "Payload bytes that wait for one peer, for each class; a single message of any length always fits.",
        note: "",
    },
    Row {
        key: "gncl.strangers_max",
        kind: Kind::Number(STRANGERS_MAX),
        value: |config| json!(config.gncl.strangers_max),
        effect: "Connections of peers that have not finished the handshake.",
        note: "A further connection closes one of them, first from the address that has most.",
    },
    Row {
        key: "gncl.handshake_ms",
        kind: Kind::Number(HANDSHAKE),
        value: |config| millis(config.gncl.handshake),
        effect: "Time for a handshake, at both ends.",
        note: "While a flood of connections lasts, a new one waits a second: below about 1100 ms no new peer connects then.",
    },
    Row {
        key: "gncl.redial_min_ms",
        kind: Kind::Number(REDIAL_MIN),
        value: |config| millis(config.gncl.redial_min),
        effect: "First wait before dialling again; it doubles up to `redial_max_ms`.",
        note: "",
    },
    Row {
        key: "gncl.redial_max_ms",
        kind: Kind::Number(REDIAL_MAX),
        value: |config| millis(config.gncl.redial_max),
        effect: "Longest wait before dialling again.",
        note: "It is not shorter than `redial_min_ms`.",
    },
    Row {
        key: "gncl.give_up_ms",
        kind: Kind::Number(GIVE_UP),
        value: |config| millis(config.gncl.give_up),
        effect: "Time after which a connection ends if the peer acknowledges nothing (TCP_USER_TIMEOUT).",
        note: "It also ends a connection of which only one direction is cut.",
    },
    Row {
        key: "gncl.marks",
        kind: Kind::Truth,
        value: |config| json!(config.gncl.marks),
        effect: "Whether packets carry DSCP marks: EF, AF41 and AF11 for Control, Stream and Bulk, CS6 for discovery.",
        note: "Switches, access points and the host's own queues can then send Control first.",
    },
    Row {
        key: "gncl.datagrams",
        kind: Kind::Truth,
        value: |config| json!(config.gncl.datagrams),
        effect: "Whether Stream messages of at most 1,112 bytes use UDP, so that a lost packet delays nothing else.",
        note: "Both nodes need it, and no keys. The UDP port is that of `port` if it is free and not `ndl.port`.",
    },
    Row {
        key: "gncl.spin_ms",
        kind: Kind::Number(SPIN),
        value: |config| millis(config.gncl.spin),
        effect: "Time that the IO thread polls after a peer's message before it sleeps; 0 sleeps at once.",
        note: "It occupies one core, and saves applications on the IO thread a wake-up of 10 to 50 us.",
    },
    Row {
        key: "ndl.interface",
        kind: Kind::Interfaces,
        value: |config| {
            let mut texts: Vec<_> = config.ndl.interface.iter().map(|one| json!(one.to_string())).collect();
            if texts.len() == 1 { texts.remove(0) } else { texts.into() }
        },
        effect: "Network interfaces that the node uses, by address, by name (`eth0`), or `all` but loopback, the preferred one first.",
        note: "The default is loopback: no other host is reached. See the section on interfaces.",
    },
    Row {
        key: "ndl.port",
        kind: Kind::Number(NDL_PORT),
        value: |config| json!(config.ndl.port),
        effect: "UDP port for discovery queries and answers.",
        note: "Fix it where other nodes list this node as a seed.",
    },
    Row {
        key: "ndl.multicast",
        kind: Kind::EndpointOrFalse { legal: "a multicast group and a port", pattern: IPV4_PORT },
        value: |config| endpoint(config.ndl.multicast),
        effect: "IPv4 multicast group of the cyclic query, the same on all nodes; `false` switches multicast off, for IPv6 too.",
        note: "Its time to live is 1: no router forwards it.",
    },
    Row {
        key: "ndl.multicast6",
        kind: Kind::EndpointOrFalse { legal: "a link-local multicast group and a port", pattern: IPV6_PORT },
        value: |config| endpoint(config.ndl.multicast6),
        effect: "IPv6 multicast group (ff02:: or ff12::) of the same query, the same on all nodes.",
        note: "Loopback (`::1`) has no multicast groups: nodes there need seeds.",
    },
    Row {
        key: "ndl.mdns_port",
        kind: Kind::NumberOrFalse(MDNS_PORT),
        value: |config| config.ndl.mdns_port.map_or(Value::Bool(false), Value::from),
        effect: "UDP port of multicast DNS; `false` switches it off.",
        note: "Keys do not protect it: switch it off on nodes with keys beyond loopback.",
    },
    Row {
        key: "ndl.seeds",
        kind: Kind::Seeds(SEEDS_MAX),
        value: |config| json!(config.ndl.seeds.iter().map(ToString::to_string).collect::<Vec<_>>()),
        effect: "UDP addresses of nodes to query in any case, for networks without multicast.",
        note: "IPv6 addresses have brackets (`[fd00::7]:6911`); link-local ones name their interface (`[fe80::7%eth0]:6911`).",
    },
    Row {
        key: "ndl.period_ms",
        kind: Kind::Number(PERIOD),
        value: |config| millis(config.ndl.period),
        effect: "Time between two queries; a silent node is lost after `period_ms` times `missed_max`, and at most one period more.",
        note: "Each period costs one datagram each way for every node.",
    },
    Row {
        key: "ndl.missed_max",
        kind: Kind::Number(MISSED_MAX),
        value: |config| json!(config.ndl.missed_max),
        effect: "Consecutive missed answers after which a node counts as lost.",
        note: "A low value mistakes a lossy network for a lost node.",
    },
    Row {
        key: "ndl.watch",
        kind: Kind::Watch,
        value: |config| {
            let group = |group: &WatchGroup| json!({ "nodes": group.nodes, "period_ms": millis(group.period), "missed_max": group.missed_max });
            config.ndl.watch.iter().map(group).collect()
        },
        effect: "Groups of nodes, by name with `*` for any text, that this node queries with a period of their own.",
        note: "Each group has `nodes`, `period_ms` and `missed_max`. The first group that covers a node applies.",
    },
    Row {
        key: "ndl.nodes_max",
        kind: Kind::Number(NODES_MAX),
        value: |config| json!(config.ndl.nodes_max),
        effect: "Nodes that this node knows.",
        note: "On a small machine, lower it to the number of nodes that exist: it multiplies the memory that peers can use.",
    },
    Row {
        key: "sync.layer_deadline_ms",
        kind: Kind::Number(LAYER_DEADLINE),
        value: |config| millis(config.sync.layer_deadline),
        effect: "Time for each layer to become ready; after it the start fails.",
        note: "",
    },
    Row {
        key: "sync.requirement_deadline_ms",
        kind: Kind::Number(REQUIREMENT_DEADLINE),
        value: |config| millis(config.sync.requirement_deadline),
        effect: "Time for an application's requirements; each time it passes, the log names what is missing, since when and why.",
        note: "The application continues to wait.",
    },
    Row {
        key: "supervision.layer_restarts_max",
        kind: Kind::Number(LAYER_RESTARTS_MAX),
        value: |config| json!(config.supervision.layer_restarts_max),
        effect: "Restarts of failed layers, all together, in one window; one more stops the node in order.",
        note: "",
    },
    Row {
        key: "supervision.layer_window_ms",
        kind: Kind::Number(LAYER_WINDOW),
        value: |config| millis(config.supervision.layer_window),
        effect: "Window for the restarts of layers.",
        note: "A layer that ran longer than this starts its back-off anew.",
    },
    Row {
        key: "supervision.app_restarts_max",
        kind: Kind::Number(APP_RESTARTS_MAX),
        value: |config| json!(config.supervision.app_restarts_max),
        effect: "Restarts of failed applications, all together, in one window; one more stops the node in order.",
        note: "It applies to applications directly under the node; a `SupervisorSpec` has its own intensity.",
    },
    Row {
        key: "supervision.app_window_ms",
        kind: Kind::Number(APP_WINDOW),
        value: |config| millis(config.supervision.app_window),
        effect: "Window for the restarts of applications.",
        note: "",
    },
    Row {
        key: "security.keys",
        kind: Kind::PathOrFalse(DIRECTORY_BYTES_MAX),
        value: |config| path(config.security.keys.as_deref()),
        effect: "Directory with the node's keys, as `sinew keys` creates it; `false` leaves connections between nodes open to everybody.",
        note: "With keys, Stream messages use TCP. Without, every user of the host can join, also on loopback.",
    },
    Row {
        key: "security.times",
        kind: Kind::OneOf(&["until-set", "strict", "ignored"]),
        value: |config| json!(config.security.times.word()),
        effect: "How the validity times of certificates count while the clock of the host may be wrong.",
        note: "See the section on keys.",
    },
    Row {
        key: "security.access",
        kind: Kind::PathOrFalse(DIRECTORY_BYTES_MAX),
        value: |config| path(config.security.access.as_deref()),
        effect: "File with the access list; `false` lets every application send to every other one.",
        note: "With a list there are no direct links between processes.",
    },
    Row {
        key: "log.level",
        kind: Kind::OneOf(&["off", "error", "warn", "info", "debug", "trace"]),
        value: |config| {
            json!(match config.log.level {
                LogLevel::Off => "off",
                LogLevel::Error => "error",
                LogLevel::Warn => "warn",
                LogLevel::Info => "info",
                LogLevel::Debug => "debug",
                LogLevel::Trace => "trace",
            })
        },
        effect: "Most detailed level of the default log on standard error, in a program without a `tracing` subscriber.",
        note: "The environment variables `SINEW_LOG` and `RUST_LOG` override it.",
    },
    Row {
        key: "record.folder",
        kind: Kind::PathOrFalse(DIRECTORY_BYTES_MAX),
        value: |config| path(config.record.folder.as_deref()),
        effect: "Folder of the file with the newest messages, which outlives the node; `false` records only while a program asks.",
        note: "In memory (`/dev/shm`): on a disk the system may stop a sender while it stores a page.",
    },
    Row {
        key: "record.keep_bytes",
        kind: Kind::Number(KEEP_BYTES),
        value: |config| json!(config.record.keep_bytes),
        effect: "Bytes of the newest records that are kept, rounded up to a power of two; also while a program records.",
        note: "Memory, allocated when the recording begins.",
    },
    Row {
        key: "record.keep_ms",
        kind: Kind::Number(KEEP),
        value: |config| millis(config.record.keep),
        effect: "Time before a trigger that is frozen, as far as `record.keep_bytes` reaches.",
        note: "Not less than `record.after_ms`. A span has the times of its trigger's node on all nodes.",
    },
    Row {
        key: "record.after_ms",
        kind: Kind::Number(AFTER),
        value: |config| millis(config.record.after),
        effect: "Time after a trigger that is frozen, too; triggers within this time of one another have one span.",
        note: "A span can be fetched after this time.",
    },
    Row {
        key: "record.frozen_max",
        kind: Kind::Number(FROZEN_MAX),
        value: |config| json!(config.record.frozen_max),
        effect: "Frozen spans that are kept; the oldest stay until they are fetched, further ones are not frozen; `0` freezes none.",
        note: "Memory or disk: each is at most as large as the ring.",
    },
    Row {
        key: "record.frozen_folder",
        kind: Kind::PathOrFalse(DIRECTORY_BYTES_MAX),
        value: |config| path(config.record.frozen_folder.as_deref()),
        effect: "Folder of frozen spans; `false`: they lie in `record.folder`.",
        note: "It may lie on a disk: no sender writes there.",
    },
    Row {
        key: "record.apps",
        kind: Kind::Names(RECORDED_MAX),
        value: |config| json!(config.record.apps),
        effect: "Applications of the node of which messages are recorded; `*` matches any text; none: all.",
        note: "A name gets its address when its application registers; messages of the next 100 ms may be missing.",
    },
    Row {
        key: "record.types",
        kind: Kind::Names(RECORDED_MAX),
        value: |config| json!(config.record.types),
        effect: "Payload types that are recorded; `*` matches any text; none: all.",
        note: "A `*` matches types that applications of the project handle.",
    },
];

fn millis(duration: Duration) -> Value {
    u64::try_from(duration.as_millis()).expect("a time of this configuration").into()
}

fn path(path: Option<&Path>) -> Value {
    path.map_or(Value::Bool(false), |path| json!(path.to_string_lossy()))
}

fn endpoint(endpoint: Option<impl ToString>) -> Value {
    endpoint.map_or(Value::Bool(false), |endpoint| json!(endpoint.to_string()))
}
