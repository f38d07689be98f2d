//! The compared paths, by the names of the bench and those for readers.

/// Paths that are compared with each other.
pub(crate) struct PathGroup {
    pub(crate) title: &'static str,
    pub(crate) cpus: &'static str,
    /// The bare path: the floor of the others.
    pub(crate) bare: &'static str,
    /// The other middleware.
    pub(crate) peer: &'static str,
    /// Name of each in the bench, and for readers.
    pub(crate) paths: &'static [(&'static str, &'static str)],
}

pub(crate) const BACK_TO_BACK: &str = "back_to_back";
pub(crate) const EVERY_MILLISECOND: &str = "1khz";

pub(crate) const ONE_HOST: PathGroup = PathGroup {
    title: "two processes of one host, woken, on one CPU",
    cpus: "one_cpu",
    bare: "bare_futex",
    peer: "iceoryx2_event",
    paths: &[
        ("bare_futex", "bare ring and futex"),
        ("unix_stream", "Unix stream"),
        ("iceoryx2_event", "iceoryx2, event"),
        ("sinew_default", "Sinew, default"),
        ("sinew_direct", "Sinew, direct link"),
        ("sinew_task_direct", "Sinew, direct link, tasks"),
        ("sinew_ring", "Sinew, through the node"),
        ("sinew_task_ring", "Sinew, through the node, tasks"),
    ],
};

pub(crate) const POLLED: PathGroup = PathGroup {
    title: "two processes of one host, polled, a CPU each",
    cpus: "one_cpu_each",
    bare: "bare_poll",
    peer: "iceoryx2_poll",
    paths: &[
        ("bare_poll", "bare ring, polled"),
        ("iceoryx2_poll", "iceoryx2, polled"),
        ("sinew_direct_spin", "Sinew, direct link, spinning"),
    ],
};

pub(crate) const BETWEEN_NODES: PathGroup = PathGroup {
    title: "two nodes by the loopback interface, on one CPU",
    cpus: "one_cpu",
    bare: "tcp",
    peer: "zenoh",
    paths: &[
        ("tcp", "TCP"),
        ("zenoh", "Zenoh"),
        ("sinew_nodes_io_thread", "Sinew, on the I/O thread"),
        ("sinew_nodes_own_thread", "Sinew, on threads of their own"),
    ],
};

/// Carriers of a flood.
pub(crate) const FLOODS: [(&str, &str); 5] = [
    ("raw_tcp", "TCP, one write a message"),
    ("raw_tcp_together", "TCP, 32 messages a write"),
    ("zenoh", "Zenoh, batching"),
    ("confirmed", "Sinew, confirmed"),
    ("unconfirmed", "Sinew, unconfirmed"),
];
/// Placement of the shown floods.
pub(crate) const FLOOD_CPUS: &str = "one_cpu_each";

/// Paths of the counted instructions.
const COUNTED: [(&str, &str); 6] = [
    ("same_thread", "one thread"),
    ("two_threads", "two threads of a node"),
    ("direct", "two processes, direct link"),
    ("through_node", "two processes, through the node"),
    ("nodes_io_thread", "two nodes, on the I/O thread"),
    ("nodes_own_thread", "two nodes, on own threads"),
];

/// Returns the readers' name of a path of counted instructions.
pub(crate) fn counted(name: &str) -> &str {
    COUNTED.iter().find(|(known, _)| *known == name).map_or(name, |(_, label)| label)
}
