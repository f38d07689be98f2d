//! The nodes of a robot on their hosts, as the scenario sees them.

use std::{
    collections::BTreeMap,
    fs::{self, Permissions},
    net::{Ipv4Addr, SocketAddr},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::Command,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use sinew::{NodeAddress, Tid};
use sinew_runtime::lock;

use super::{
    Attack, decoy,
    keys::{self, Keys, PROJECT, TestNode},
};
use crate::{
    clients::hostile::{GRANTED, GUEST, VISITORS},
    role,
};
use sinew_testkit::{Host, NodeProcess, Resources, numbers, own_group, sandbox::after_shell};

/// Ports of the attacked nodes; each node has its own host.
const GNCL_PORT: u16 = 7_700;
pub(super) const NDL_PORT: u16 = 7_701;
/// Period of the liveliness requests between them.
pub(super) const NDL_PERIOD: Duration = Duration::from_millis(100);

/// Latencies of answers.
#[derive(Clone, Copy, Debug, Default)]
pub struct Window {
    /// Number of answers.
    pub count: u64,
    /// Requests that failed.
    pub failed: u64,
    /// Requests that were sent late, because the previous one had no answer.
    pub late: u64,
    /// Requests that were due but unanswered at the end.
    pub waiting: u64,
    /// Median latency, from the due time of the request. An unanswered request counts with its waiting time
    /// so far.
    pub p50: Duration,
    /// 99th percentile.
    pub p99: Duration,
    /// Maximum.
    pub max: Duration,
    /// Duration of the measurement.
    pub lasted: Duration,
}

impl Window {
    /// Answers per second.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.count as f64 / self.lasted.as_secs_f64().max(f64::MIN_POSITIVE)
    }

    /// Number of requests that were due.
    #[must_use]
    pub const fn asked(&self) -> u64 {
        self.count + self.waiting + self.failed
    }

    /// Requests that were sent late or not answered.
    #[must_use]
    pub const fn missed(&self) -> u64 {
        self.late + self.waiting + self.failed
    }
}

/// A node's view of other nodes, by the last byte of their addresses.
#[derive(Clone, Debug, Default)]
pub(super) struct Seen {
    /// Number of times that each node was lost.
    pub(super) lost: BTreeMap<u8, u64>,
    /// Number of times that each node was found.
    pub(super) found: BTreeMap<u8, u64>,
    /// Messages with this source that no node of the robot sends.
    pub(super) sent: BTreeMap<u8, u64>,
}

impl Seen {
    /// The difference to an earlier view.
    pub(super) fn since(mut self, before: &Self) -> Self {
        for (now, before) in
            [(&mut self.lost, &before.lost), (&mut self.found, &before.found), (&mut self.sent, &before.sent)]
        {
            now.iter_mut().for_each(|(node, count)| *count -= before.get(node).copied().unwrap_or_default());
        }
        self
    }
}

/// The kind of target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Is {
    Node,
    /// It answers only as TLS requires.
    Decoy,
}

/// The target of an attack.
#[derive(Clone, Copy, Debug)]
pub(super) struct Target {
    pub(super) is: Is,
    /// The address for connections.
    pub(super) connections: SocketAddr,
    /// The addresses for discovery datagrams: of the target, of its counterpart in the other node's place,
    /// and of the group.
    pub(super) datagrams: [SocketAddr; 3],
}

/// Decoys on the hosts of both nodes, which may be attacked instead of the nodes.
pub(super) struct Decoys {
    group: Ipv4Addr,
    members: [Member; 2],
}

impl Decoys {
    /// Starts both, and returns when they can be attacked. They use a group that no node has joined.
    pub(super) fn start(hosts: &[Host], keys: &Keys) -> Self {
        let group = *own_group().ip();
        let start = |node: TestNode, host: usize| {
            let mut command = role("decoy");
            command.arg(node.name).arg(keys.of(node)).arg(group.to_string());
            Member::start(hosts[host].moved(&command), "decoy")
        };
        Self { group, members: [start(keys::KNEE, super::KNEE), start(keys::HIP, super::HIP)] }
    }

    /// The decoy of the attacked node, as its attackers see it.
    pub(super) fn target(&self) -> Target {
        let datagrams = [keys::KNEE.address(), keys::HIP.address(), self.group];
        let connections = (keys::KNEE.address(), decoy::CONNECTIONS_PORT).into();
        let datagrams = datagrams.map(|to| SocketAddr::from((to, decoy::DATAGRAMS_PORT)));
        Target { is: Is::Decoy, connections, datagrams }
    }

    /// Ends both in order.
    pub(super) fn end(self) {
        self.members.into_iter().for_each(Member::end);
    }
}

/// Refusals of a node, by cause.
pub(super) type Refused = BTreeMap<String, u64>;

/// A node in its process.
pub(super) struct Member(Mutex<NodeProcess>);

impl Member {
    /// Starts it, and returns when it is up.
    fn start(command: Command, role: &str) -> Self {
        let mut process = NodeProcess::start(role, command);
        process.expect("up");
        Self(Mutex::new(process))
    }

    fn process(&self) -> MutexGuard<'_, NodeProcess> {
        lock(&self.0)
    }

    /// Ends it in order.
    pub(super) fn end(self) {
        let status = self.0.into_inner().unwrap_or_else(PoisonError::into_inner).stop();
        assert!(status.success(), "a node ended with {status}");
    }

    /// Connections that its host has opened since the host was created.
    fn dials(&self) -> u64 {
        let path = format!("/proc/{}/net/snmp", self.process().id());
        let text = fs::read_to_string(path).expect("the kernel counts what hosts do");
        let mut lines = text.lines().filter(|line| line.starts_with("Tcp:"));
        let [names, counts] = [lines.next(), lines.next()].map(|line| line.unwrap_or_default().split(' '));
        let (_, count) =
            names.zip(counts).find(|(name, _)| *name == "ActiveOpens").expect("it counts connections");
        count.parse().expect("a number")
    }

    /// Sends a command and returns the answer.
    pub(super) fn ask(&self, question: &str) -> String {
        self.process().ask(question)
    }

    fn seen(&self) -> Seen {
        let (line, mut seen) = (self.ask("seen"), Seen::default());
        let words: Vec<&str> = line.split_whitespace().skip(1).collect();
        for entry in words.chunks_exact(3) {
            let which = match entry[0] {
                "lost" => &mut seen.lost,
                "found" => &mut seen.found,
                "sent" => &mut seen.sent,
                other => panic!("{other} is nothing that a node has seen"),
            };
            which.insert(entry[1].parse().expect("a node"), entry[2].parse().expect("a number"));
        }
        seen
    }

    fn refused(&self) -> Refused {
        let line = self.ask("refused");
        let words: Vec<&str> = line.split('\t').skip(1).collect();
        let entry = |entry: &[&str]| (entry[0].to_owned(), entry[1].parse().expect("a number"));
        words.chunks_exact(2).map(entry).collect()
    }
}

/// The two communicating nodes, one of which is attacked.
pub(super) struct Robot {
    directory: PathBuf,
    group: std::net::SocketAddrV4,
    hip: Member,
    knee: Member,
    knee_config: PathBuf,
    newcomer_keys: PathBuf,
    echo: Tid,
}

impl Robot {
    /// Starts both, and returns when they communicate. The attack determines the configuration of the
    /// attacked node.
    pub(super) fn start(hosts: &[Host], keys: &Keys, attack: &Attack) -> Self {
        let (group, directory) = (own_group(), keys.path(""));
        let config =
            |node: TestNode, further| configuration(&directory, group, (node, Some(&keys.of(node))), further);
        let security = if attack.guests { access_list(&directory) } else { String::new() };
        // With the default limit of unauthenticated connections, the node would never run out of file
        // descriptors.
        let gncl = if attack.descriptors.is_some() { "strangers_max = 1024\n" } else { "" };
        let knee_config = config(keys::KNEE, Further { gncl, security: &security });
        let (knee, echo) = start_knee(&hosts[super::KNEE], &knee_config, attack.descriptors);
        let hip_config = config(keys::HIP, Further::default());
        let hip = Member::start(hosts[super::HIP].moved(&robot_node(&hip_config, &["asks"])), "robot-node");
        let newcomer_keys = keys.of(keys::ANKLE);
        Self { directory, group, hip, knee, knee_config, newcomer_keys, echo }
    }

    /// Ends the attacked node in order and starts its next incarnation. Returns when both communicate again.
    pub(super) fn with_knee_anew(self, host: &Host) -> Self {
        self.knee.end();
        let (knee, echo) = start_knee(host, &self.knee_config, None);
        let robot = Self { knee, echo, ..self };
        assert!(robot.answers_again(), "the next incarnation of the attacked node gives no answer");
        robot
    }

    /// Starts a new node of the robot, and returns when it has an answer from the attacked one.
    pub(super) fn start_newcomer(&self, host: &Host) -> Member {
        let ankle = (keys::ANKLE, Some(&*self.newcomer_keys));
        let config = configuration(&self.directory, self.group, ankle, Further::default());
        let asks = robot_node(&config, &["asks"]);
        Member::start(host.moved(&asks), "robot-node")
    }

    /// A command that starts a whole node on this host, with unauthorized keys or none.
    pub(super) fn foreign_node(&self, host: &Host, keys: Option<&Path>) -> Command {
        let config = configuration(&self.directory, self.group, (keys::MALLORY, keys), Further::default());
        host.moved(&robot_node(&config, &["tries"]))
    }

    #[expect(clippy::unused_self, reason = "it is the robot's, whichever is attacked")]
    pub(super) fn knee_address(&self) -> NodeAddress {
        keys::KNEE.node()
    }

    /// The attacked node, as its attackers see it.
    pub(super) fn target(&self) -> Target {
        let [knee, hip] = [keys::KNEE, keys::HIP].map(|node| SocketAddr::from((node.address(), NDL_PORT)));
        let connections = (keys::KNEE.address(), GNCL_PORT).into();
        Target { is: Is::Node, connections, datagrams: [knee, hip, self.group.into()] }
    }

    /// Both nodes, for their joint work: `hip` and `knee`.
    pub(super) const fn talkers(&self) -> [&Member; 2] {
        [&self.hip, &self.knee]
    }

    /// Connections that each of both hosts has opened since it was created.
    pub(super) fn dials(&self) -> [u64; 2] {
        [self.hip.dials(), self.knee.dials()]
    }

    pub(super) const fn group(&self) -> std::net::SocketAddrV4 {
        self.group
    }

    /// The path of the attacked node's client socket.
    pub(super) fn socket(&self) -> PathBuf {
        self.directory.join(format!("{}.sock", keys::KNEE.name))
    }

    /// The TID of the application that answers: every former member knows it.
    pub(super) const fn echo(&self) -> Tid {
        self.echo
    }

    /// Measurements of the requesting node since the last call. They are added to the window with this name,
    /// and the sum is returned.
    pub(super) fn window(&self, name: &str) -> Window {
        let line = self.hip.ask(&format!("window {name}"));
        let [count, failed, late, waiting, p50, p99, max, lasted] = numbers(&line)[..] else {
            panic!("eight numbers")
        };
        let [p50, p99, max, lasted] = [p50, p99, max, lasted].map(Duration::from_nanos);
        Window { count, failed, late, waiting, p50, p99, max, lasted }
    }

    /// Returns whether a request sent from now on is answered in time.
    pub(super) fn answers_again(&self) -> bool {
        self.hip.ask("again") == "1"
    }

    /// Refusals counted by the attacked node in this incarnation.
    pub(super) fn refused(&self) -> Refused {
        self.knee.refused()
    }

    /// Observations of both nodes since then.
    pub(super) fn seen_since(&self, before: &[Seen; 2]) -> [Seen; 2] {
        let [hip, knee] = self.seen();
        [hip.since(&before[0]), knee.since(&before[1])]
    }

    /// Observations of both nodes.
    pub(super) fn seen(&self) -> [Seen; 2] {
        [self.hip.seen(), self.knee.seen()]
    }

    /// Memory of the attacked node, in bytes.
    pub(super) fn held_bytes(&self) -> u64 {
        Resources::of(self.knee.process().id()).own_kib << 10
    }

    /// Ends both in order.
    pub(super) fn end(self) {
        [self.hip, self.knee].into_iter().for_each(Member::end);
    }
}

/// Starts the attacked node with this file descriptor limit. Returns it, and the TID of its application that
/// answers.
fn start_knee(host: &Host, config: &Path, descriptors: Option<u32>) -> (Member, Tid) {
    let knee = robot_node(config, &[]);
    let knee = match descriptors {
        Some(descriptors) => after_shell(&format!("ulimit -n {descriptors}"), &knee),
        None => knee,
    };
    let knee = Member::start(host.moved(&knee), "robot-node");
    let echo = Tid::from_bits(numbers(&knee.ask("tid"))[0]);
    (knee, echo)
}

fn robot_node(config: &Path, more: &[&str]) -> Command {
    let mut command = role("robot-node");
    command.arg(config).args(more);
    command
}

/// Additional lines for tables of a configuration.
#[derive(Clone, Copy, Default)]
struct Further<'a> {
    gncl: &'a str,
    security: &'a str,
}

/// Writes an access list that allows all messages. It admits a guest with names and one group of its own, and
/// visitors with names and any group. They can reach the client socket in this directory. Returns the
/// configuration line that names the list.
fn access_list(directory: &Path) -> String {
    let path = directory.join("access.toml");
    let visitor = |uid: u32| format!("[[client]]\nuid = {uid}\nnames = ['visitor.*']\ngroups = ['*']\n");
    let visitors = VISITORS.map(visitor).concat();
    let text = format!(
        "[[rule]]\nfrom = ['*']\nto = ['*']\n[[client]]\nuid = {GUEST}\nnames = ['guest.*']\ngroups = ['{GRANTED}']\n{visitors}"
    );
    let written = fs::write(&path, text);
    // Independent of the umask: only the owner writes here, and each user can reach the files intended for
    // it.
    let opened = fs::set_permissions(directory, Permissions::from_mode(0o755));
    written.and(opened).expect("the scene's own directory");
    format!("access = {path:?}\n")
}

/// Writes a configuration file.
fn configuration(
    directory: &Path,
    group: std::net::SocketAddrV4,
    (node, keys): (TestNode, Option<&Path>),
    Further { gncl, security }: Further<'_>,
) -> PathBuf {
    let path = directory.join(format!("{}.toml", node.name));
    let (name, address, socket) = (node.name, node.address(), directory.join(format!("{}.sock", node.name)));
    let keys = keys.map_or_else(|| "false".to_owned(), |keys| format!("{keys:?}"));
    let period = NDL_PERIOD.as_millis();
    let text = format!(
        "[node]\nname = \"{name}\"\naddress = \"{address}\"\nproject = \"{PROJECT}\"\n[lncl]\nsocket = {socket:?}\n\
         [gncl]\nport = {GNCL_PORT}\n{gncl}[ndl]\ninterface = \"{address}\"\nport = {NDL_PORT}\nmulticast = \"{group}\"\n\
         mdns_port = false\nperiod_ms = {period}\n[security]\nkeys = {keys}\n{security}"
    );
    fs::write(&path, text).expect("the scene's own directory");
    path
}
