//! The keys of a robot file: one row for each, which the reader, the reference and the JSON Schema share.

/// One key of a robot file.
#[cfg_attr(not(test), expect(dead_code, reason = "the reference, which a test writes, has all of it"))]
pub(super) struct Row {
    /// Its table.
    pub(super) table: Table,
    /// Its name in the table.
    pub(super) key: &'static str,
    /// Its type and its legal values.
    pub(super) kind: Kind,
    /// Its value where it is missing, as text; empty if it is required.
    pub(super) default: &'static str,
    /// Its effect, in one sentence.
    pub(super) effect: &'static str,
    /// Its cost, or a note, in one more sentence; empty if there is none.
    pub(super) note: &'static str,
}

/// The tables of a robot file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Table {
    /// `[robot]`.
    Robot,
    /// `[host.NAME]`.
    Host,
    /// `[node.NAME]`.
    Node,
}

impl Table {
    /// All of them, in the order of the reference.
    pub(super) const ALL: [Self; 3] = [Self::Robot, Self::Host, Self::Node];

    /// Returns its name in the file.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Robot => "robot",
            Self::Host => "host",
            Self::Node => "node",
        }
    }
}

/// The type of a key, with its legal values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// The name of a robot, a host or a node.
    Name,
    /// A text of 1 to this many bytes.
    Text(usize),
    /// `true` or `false`.
    Truth,
    /// A whole number of this range, with its unit.
    Number(i64, i64, &'static str),
    /// At most so many texts, each of at most [`TEXT_BYTES_MAX`] bytes.
    Texts(usize),
    /// At most so many names.
    Names(usize),
    /// At most so many whole numbers of this range.
    Numbers(usize, i64, i64),
    /// At most so many variables of the environment: names with texts.
    Variables(usize),
}

impl Kind {
    /// Returns the legal values, as text.
    pub(super) fn legal(self) -> String {
        match self {
            Self::Name => "a name of 1 to 63 bytes, without `/`, `=` or `*`".to_owned(),
            Self::Text(max) => format!("a text of 1 to {max} bytes"),
            Self::Truth => "true or false".to_owned(),
            Self::Number(low, high, "") => format!("{low} to {high}"),
            Self::Number(low, high, unit) => format!("{low} to {high} {unit}"),
            Self::Texts(max) => format!("at most {max} texts of 1 to {TEXT_BYTES_MAX} bytes"),
            Self::Names(max) => format!("at most {max} names of 1 to 63 bytes"),
            Self::Numbers(max, low, high) => format!("at most {max} numbers of {low} to {high}"),
            Self::Variables(max) => format!("at most {max} names, each with a text"),
        }
    }

    /// Returns a value, as it is written in the file.
    pub(super) fn example(self) -> String {
        match self {
            Self::Name | Self::Text(_) => "\"knee\"".to_owned(),
            Self::Truth => "true".to_owned(),
            Self::Number(low, _, _) => low.max(1).to_string(),
            Self::Texts(_) | Self::Names(_) => "[\"knee\", \"hip\"]".to_owned(),
            Self::Numbers(..) => "[2, 3]".to_owned(),
            Self::Variables(_) => "{ SINEW_LOG = \"info\" }".to_owned(),
        }
    }
}

/// Longest text in bytes: PATH_MAX of Linux.
pub(super) const TEXT_BYTES_MAX: usize = 4_096;
/// Maximum number of hosts of a robot.
pub(in crate::up) const HOSTS_MAX: usize = 64;
/// Maximum number of nodes of a robot.
pub(in crate::up) const NODES_MAX: usize = 256;
/// Maximum number of files, arguments or variables of a node.
pub(super) const LIST_MAX: usize = 64;

const fn row(
    table: Table,
    key: &'static str,
    kind: Kind,
    default: &'static str,
    [effect, note]: [&'static str; 2],
) -> Row {
    Row { table, key, kind, default, effect, note }
}

const WITHIN: Kind = Kind::Number(100, 600_000, "ms");
const PATH: Kind = Kind::Text(TEXT_BYTES_MAX);
const NODE: Table = Table::Node;

/// One row per key.
pub(super) const ROWS: &[Row] = &[
    row(
        Table::Robot,
        "name",
        Kind::Name,
        "",
        [
            "Name of the robot: its folder on each host, and its units, are named after it.",
            "The rules of `node.name` apply.",
        ],
    ),
    row(
        Table::Robot,
        "keys",
        PATH,
        "none",
        [
            "Directory of `sinew keys init`; each node gets the folder `nodes/NAME` of it as `keys`, and nothing else.",
            "The configurations need `[security] keys = \"keys\"`.",
        ],
    ),
    row(
        Table::Robot,
        "ready_within_ms",
        WITHIN,
        "`30000`",
        [
            "Time in which the nodes that others wait for have to be ready, and at the end all of them.",
            "At its end `sinew up` names the applications that wait, and their reasons.",
        ],
    ),
    row(
        Table::Robot,
        "stop_within_ms",
        WITHIN,
        "`15000`",
        [
            "Time in which a node has to end after SIGTERM; then it is killed.",
            "Waiting messages have 3 s to leave a node, and an application 500 ms to stop, by default.",
        ],
    ),
    row(
        Table::Host,
        "ssh",
        Kind::Text(255),
        "",
        [
            "Destination of the system's `ssh`, as in `robot@10.0.0.2`, or a `Host` of its configuration.",
            "It has to log in without a question: with a key, and with the host known.",
        ],
    ),
    row(
        Table::Host,
        "ssh_options",
        Kind::Texts(LIST_MAX),
        "`[]`",
        ["Options for `ssh`, each word a text, as in `[\"-p\", \"2222\"]`.", ""],
    ),
    row(
        Table::Host,
        "folder",
        PATH,
        "`~/.local/state/sinew`",
        [
            "Absolute path of the folder on that host in which each robot has its files.",
            "The table `[host.here]` sets it for this host.",
        ],
    ),
    row(
        Table::Host,
        "sinew",
        PATH,
        "this program",
        [
            "The command `sinew` for that host, where it has another processor or system than this one.",
            "It is copied there, as nodes' programs are.",
        ],
    ),
    row(
        Table::Host,
        "user",
        Kind::Text(32),
        "root",
        ["User of the nodes in units of systemd.", "The keys and files have to belong to it."],
    ),
    row(
        NODE,
        "host",
        Kind::Name,
        "`here`",
        ["Host on which the node runs: the name of a `[host]`, or `here`.", ""],
    ),
    row(
        NODE,
        "program",
        PATH,
        "none",
        ["Program of the node, which is copied to its host.", "Set either this or `installed`."],
    ),
    row(
        NODE,
        "installed",
        PATH,
        "none",
        [
            "Absolute path of a program that is on the host already, as in `/usr/bin/python3`.",
            "A change of this program is not noticed.",
        ],
    ),
    row(
        NODE,
        "config",
        PATH,
        "none",
        [
            "Configuration of the node, which is checked before anything is started, and copied to its host.",
            "Its `node.name` has to be this node's name.",
        ],
    ),
    row(
        NODE,
        "arguments",
        Kind::Texts(LIST_MAX),
        "the file of `config`",
        [
            "Arguments of the program.",
            "Files are named relative to the node's folder, in which the program runs.",
        ],
    ),
    row(
        NODE,
        "files",
        Kind::Texts(LIST_MAX),
        "`[]`",
        ["Further files of the node, which are copied into its folder, each under its own file name.", ""],
    ),
    row(
        NODE,
        "environment",
        Kind::Variables(LIST_MAX),
        "`{}`",
        [
            "Variables of the program's environment, beside PATH, HOME, USER, LOGNAME, LANG, TZ and XDG_RUNTIME_DIR.",
            "No other variable of the caller reaches the program.",
        ],
    ),
    row(
        NODE,
        "socket",
        Kind::Text(100),
        "`lncl.socket` of `config`",
        [
            "Client socket of the node, at which it is asked whether its applications are ready.",
            "A process without one counts as ready while it runs.",
        ],
    ),
    row(
        NODE,
        "after",
        Kind::Names(NODES_MAX),
        "`[]`",
        [
            "Nodes that have to be ready before this one is started.",
            "Requirements of applications need no order: all nodes may start at once.",
        ],
    ),
    row(
        NODE,
        "ready",
        Kind::Names(LIST_MAX),
        "all named ones",
        [
            "Applications that have to be ready before the node counts as ready.",
            "Name the clients that register later, and leave out those that wait for later nodes.",
        ],
    ),
    row(
        NODE,
        "keys",
        Kind::Truth,
        "`true`",
        ["Whether the node gets its part of `robot.keys`.", "Without effect for a robot without keys."],
    ),
    row(
        NODE,
        "realtime_priority_max",
        Kind::Number(0, 99, "(0: none)"),
        "`0`",
        [
            "Highest real-time priority that threads of the node may ask for (RLIMIT_RTPRIO).",
            "The watchdog asks for 95, and `safe-output` for 90.",
        ],
    ),
    row(
        NODE,
        "lock_memory",
        Kind::Truth,
        "`false`",
        ["Whether the node may lock any amount of memory (RLIMIT_MEMLOCK).", ""],
    ),
    row(
        NODE,
        "nice",
        Kind::Number(-20, 19, ""),
        "`0`",
        ["Niceness of the ordinary threads of the node.", "A negative one needs root, or CAP_SYS_NICE."],
    ),
    row(
        NODE,
        "cpus",
        Kind::Numbers(LIST_MAX, 0, 1_023),
        "all",
        [
            "CPUs on which the threads of the node begin.",
            "The watchdog and `safe-output` run on every CPU of the process's cpuset.",
        ],
    ),
];
