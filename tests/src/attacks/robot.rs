//! The nodes of a robot on their hosts, as the director sees them.

use std::{
    collections::BTreeMap,
    fs::{self, Permissions},
    net::{Ipv4Addr, SocketAddr},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::Command,
    sync::{
        Mutex, MutexGuard, PoisonError,
        mpsc::{Receiver, sync_channel},
    },
    time::Duration,
};

use sinew::{NodeAddress, Tid};

use super::{
    Attack, decoy,
    keys::{self, Keys, PROJECT, Who},
};
use crate::{
    DEADLINE, Host,
    clients::{
        Held, Performer,
        hostile::{GRANTED, GUEST, VISITORS},
    },
    own_group,
};

/// Ports that the attacked nodes listen at: each has a host of its own.
const GNCL_PORT: u16 = 7_700;
pub(super) const NDL_PORT: u16 = 7_701;
/// How often they ask each other whether they are there.
pub(super) const NDL_PERIOD: Duration = Duration::from_millis(100);

/// How long answers took.
#[derive(Clone, Copy, Debug, Default)]
pub struct Window {
    /// Answers.
    pub count: u64,
    /// Questions without one.
    pub failed: u64,
    /// Questions that were asked late, because the one before had no answer.
    pub late: u64,
    /// Questions that were due and had no answer at the end.
    pub waiting: u64,
    /// Half of the answers took no longer, from the moment on at which their question was due. A question that still has none
    /// counts as long as it has waited.
    pub p50: Duration,
    /// 99 of 100.
    pub p99: Duration,
    /// The longest.
    pub max: Duration,
    /// How long all that was measured.
    pub lasted: Duration,
}

impl Window {
    /// Answers in a second.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.count as f64 / self.lasted.as_secs_f64().max(f64::MIN_POSITIVE)
    }

    /// Questions that were due.
    #[must_use]
    pub const fn asked(&self) -> u64 {
        self.count + self.waiting + self.failed
    }

    /// Questions that were not asked in time, or had no answer.
    #[must_use]
    pub const fn missed(&self) -> u64 {
        self.late + self.waiting + self.failed
    }
}

/// What a node has seen of others, by the last byte of their addresses.
#[derive(Clone, Debug, Default)]
pub(super) struct Seen {
    /// How often each was lost.
    pub(super) lost: BTreeMap<u8, u64>,
    /// How often each was found.
    pub(super) found: BTreeMap<u8, u64>,
    /// Messages that nobody of the robot sends and that say that they are from there.
    pub(super) sent: BTreeMap<u8, u64>,
}

impl Seen {
    /// What of it was not there before.
    pub(super) fn since(mut self, before: &Self) -> Self {
        for (now, before) in
            [(&mut self.lost, &before.lost), (&mut self.found, &before.found), (&mut self.sent, &before.sent)]
        {
            now.iter_mut().for_each(|(node, count)| *count -= before.get(node).copied().unwrap_or_default());
        }
        self
    }
}

/// Who is attacked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Is {
    Node,
    /// It answers nothing but what TLS wants.
    Decoy,
}

/// Whom an attack is against.
#[derive(Clone, Copy, Debug)]
pub(super) struct Target {
    pub(super) is: Is,
    /// Where it takes connections.
    pub(super) connections: SocketAddr,
    /// Where it takes datagrams of discovery, where the one in the other node's place does, and the group.
    pub(super) datagrams: [SocketAddr; 3],
}

/// Decoys on the hosts of both nodes, which may be attacked instead of the nodes.
pub(super) struct Decoys {
    group: Ipv4Addr,
    members: [Member; 2],
}

impl Decoys {
    /// Starts both, and returns when they can be attacked. The group is one that no node hears.
    pub(super) fn start(program: &Path, hosts: &[Host], keys: &Keys) -> Self {
        let group = *own_group().ip();
        let start = |who: Who, host: usize| {
            let mut command = Command::new(program);
            command.args(["--role", "decoy", who.name]).arg(keys.of(who)).arg(group.to_string());
            let member = Member::start(hosts[host].moved(&command), "decoy");
            member.answer("up");
            member
        };
        Self { group, members: [start(keys::KNEE, super::KNEE), start(keys::HIP, super::HIP)] }
    }

    /// The decoy in the place of the attacked node, as its attackers see it.
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

/// What a node refused, for each cause.
pub(super) type Refused = BTreeMap<String, u64>;

/// A node in its process.
pub(super) struct Member {
    performer: Mutex<Performer>,
    /// Nobody but the director reads them; attackers look at the rest of the robot.
    answers: Mutex<Receiver<String>>,
}

impl Member {
    fn start(command: Command, role: &str) -> Self {
        let (say, answers) = sync_channel(16);
        let hear = move |line: &str| {
            // Nobody waits for its answers any more when the director is done.
            let _ = say.send(line.to_owned());
        };
        Self {
            performer: Mutex::new(Performer::start_command(command, role, hear)),
            answers: Mutex::new(answers),
        }
    }

    fn performer(&self) -> MutexGuard<'_, Performer> {
        self.performer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn answer(&self, to: &str) -> String {
        let answer = self.answers.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(DEADLINE);
        answer.unwrap_or_else(|_| panic!("a node did not answer `{to}` within {DEADLINE:?}"))
    }

    /// Ends it in order.
    pub(super) fn end(self) {
        let status = self.performer.into_inner().unwrap_or_else(PoisonError::into_inner).end();
        assert!(status.success(), "a node ended with {status}");
    }

    /// How often its host has begun a connection since there is one.
    fn dials(&self) -> u64 {
        let path = format!("/proc/{}/net/snmp", self.performer().id());
        let text = fs::read_to_string(path).expect("the kernel counts what hosts do");
        let mut lines = text.lines().filter(|line| line.starts_with("Tcp:"));
        let [names, counts] = [lines.next(), lines.next()].map(|line| line.unwrap_or_default().split(' '));
        let (_, count) =
            names.zip(counts).find(|(name, _)| *name == "ActiveOpens").expect("it counts connections");
        count.parse().expect("a number")
    }

    /// What it says to this.
    pub(super) fn ask(&self, question: &str) -> String {
        let mut performer = self.performer();
        performer.tell(question);
        self.answer(question)
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

fn numbers(line: &str) -> Vec<u64> {
    line.split_whitespace().map(|word| word.parse().expect("a number")).collect()
}

/// The two nodes that talk, of which one is attacked.
pub(super) struct Robot {
    program: PathBuf,
    directory: PathBuf,
    group: std::net::SocketAddrV4,
    hip: Member,
    knee: Member,
    knee_config: PathBuf,
    newcomer_keys: PathBuf,
    echo: Tid,
}

impl Robot {
    /// Starts both, and returns when they talk. The attacked one is as this attack has it.
    pub(super) fn start(program: &Path, hosts: &[Host], keys: &Keys, attack: &Attack) -> Self {
        let (group, directory) = (own_group(), keys.path(""));
        let config =
            |who: Who, further| configuration(&directory, group, (who, Some(&keys.of(who))), further);
        let security = if attack.guests { access_list(&directory) } else { String::new() };
        // With as many strangers as are allowed by default, descriptors would never run out.
        let gncl = if attack.descriptors.is_some() { "strangers_max = 1024\n" } else { "" };
        let knee_config = config(keys::KNEE, Further { gncl, security: &security });
        let (knee, echo) = start_knee(program, &hosts[super::KNEE], &knee_config, attack.descriptors);
        let hip_config = config(keys::HIP, Further::default());
        let hip =
            Member::start(hosts[super::HIP].moved(&as_role(program, &hip_config, &["asks"])), "robot-node");
        hip.answer("up");
        let newcomer_keys = keys.of(keys::ANKLE);
        Self { program: program.to_owned(), directory, group, hip, knee, knee_config, newcomer_keys, echo }
    }

    /// Ends the attacked node in order, and starts its next life; returns when both talk again.
    pub(super) fn with_knee_anew(self, host: &Host) -> Self {
        self.knee.end();
        let (knee, echo) = start_knee(&self.program, host, &self.knee_config, None);
        let robot = Self { knee, echo, ..self };
        assert!(robot.answers_again(), "the next life of the attacked node gives no answer");
        robot
    }

    /// A node of the robot's that was not there; returns when it has an answer of the attacked one.
    pub(super) fn start_newcomer(&self, host: &Host) -> Member {
        let ankle = (keys::ANKLE, Some(&*self.newcomer_keys));
        let config = configuration(&self.directory, self.group, ankle, Further::default());
        let asks = as_role(&self.program, &config, &["asks"]);
        let ankle = Member::start(host.moved(&asks), "robot-node");
        ankle.answer("up");
        ankle
    }

    /// A command that starts a whole node there, with keys that it should not have, or none.
    pub(super) fn foreign_node(&self, host: &Host, keys: Option<&Path>) -> Command {
        let config = configuration(&self.directory, self.group, (keys::MALLORY, keys), Further::default());
        host.moved(&as_role(&self.program, &config, &["tries"]))
    }

    #[expect(clippy::unused_self, reason = "it is the robot's, whichever is attacked")]
    pub(super) fn knee_address(&self) -> NodeAddress {
        keys::KNEE.node()
    }

    /// The attacked node, as its attackers see it.
    pub(super) fn target(&self) -> Target {
        let [knee, hip] = [keys::KNEE, keys::HIP].map(|who| SocketAddr::from((who.address(), NDL_PORT)));
        let connections = (keys::KNEE.address(), GNCL_PORT).into();
        Target { is: Is::Node, connections, datagrams: [knee, hip, self.group.into()] }
    }

    /// Both, for what they do together: `hip`, and `knee`.
    pub(super) const fn talkers(&self) -> [&Member; 2] {
        [&self.hip, &self.knee]
    }

    /// How often each of both has begun a connection, since there is its host.
    pub(super) fn dials(&self) -> [u64; 2] {
        [self.hip.dials(), self.knee.dials()]
    }

    pub(super) const fn group(&self) -> std::net::SocketAddrV4 {
        self.group
    }

    /// The socket of the attacked node's door.
    pub(super) fn door(&self) -> PathBuf {
        self.directory.join(format!("{}.sock", keys::KNEE.name))
    }

    /// The TID of the application that is asked: everybody who has been a member knows it.
    pub(super) const fn echo(&self) -> Tid {
        self.echo
    }

    /// What the asking node measured since the last one: from now on a part of all that is called so, which is returned.
    pub(super) fn window(&self, name: &str) -> Window {
        let line = self.hip.ask(&format!("window {name}"));
        let [count, failed, late, waiting, p50, p99, max, lasted] = numbers(&line)[..] else {
            panic!("eight numbers")
        };
        let [p50, p99, max, lasted] = [p50, p99, max, lasted].map(Duration::from_nanos);
        Window { count, failed, late, waiting, p50, p99, max, lasted }
    }

    /// Whether a question that is asked from now on is answered in time.
    pub(super) fn answers_again(&self) -> bool {
        self.hip.ask("again") == "1"
    }

    /// What the attacked node refused in its life.
    pub(super) fn refused(&self) -> Refused {
        self.knee.refused()
    }

    /// What both have seen since then.
    pub(super) fn seen_since(&self, before: &[Seen; 2]) -> [Seen; 2] {
        let [hip, knee] = self.seen();
        [hip.since(&before[0]), knee.since(&before[1])]
    }

    /// What both have seen.
    pub(super) fn seen(&self) -> [Seen; 2] {
        [self.hip.seen(), self.knee.seen()]
    }

    /// Memory of the attacked node, in bytes.
    pub(super) fn held_bytes(&self) -> u64 {
        Held::of(self.knee.performer().id()).own_kib << 10
    }

    /// Ends both in order.
    pub(super) fn end(self) {
        [self.hip, self.knee].into_iter().for_each(Member::end);
    }
}

/// The attacked node with so many descriptors, and its application that answers.
fn start_knee(program: &Path, host: &Host, config: &Path, descriptors: Option<u32>) -> (Member, Tid) {
    let knee = as_role(program, config, &[]);
    let knee = match descriptors {
        Some(descriptors) => limited(&knee, descriptors),
        None => knee,
    };
    let knee = Member::start(host.moved(&knee), "robot-node");
    knee.answer("up");
    let echo = Tid::from_bits(numbers(&knee.ask("tid"))[0]);
    (knee, echo)
}

fn as_role(program: &Path, config: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(program);
    command.args(["--role", "robot-node"]).arg(config).args(more);
    command
}

/// The same command with so many descriptors.
fn limited(command: &Command, descriptors: u32) -> Command {
    let mut limited = Command::new("sh");
    limited.args(["-c", r#"ulimit -n $0 && exec "$@""#, &descriptors.to_string()]);
    limited.arg(command.get_program()).args(command.get_args());
    limited
}

/// Further lines of tables of a configuration.
#[derive(Clone, Copy, Default)]
struct Further<'a> {
    gncl: &'a str,
    security: &'a str,
}

/// Writes an access list that lets everything be said, a guest in with names and one group of its own, and visitors with names and any group,
/// where they can get at the door beside it. Returns the line that names it.
fn access_list(directory: &Path) -> String {
    let path = directory.join("access.toml");
    let visitor = |uid: u32| format!("[[client]]\nuid = {uid}\nnames = ['visitor.*']\ngroups = ['*']\n");
    let visitors = VISITORS.map(visitor).concat();
    let text = format!(
        "[[rule]]\nfrom = ['*']\nto = ['*']\n[[client]]\nuid = {GUEST}\nnames = ['guest.*']\ngroups = ['{GRANTED}']\n{visitors}"
    );
    let written = fs::write(&path, text);
    // Whatever umask there is: nobody else writes there, and everybody comes to what is there for him.
    let opened = fs::set_permissions(directory, Permissions::from_mode(0o755));
    written.and(opened).expect("the scene's own directory");
    format!("access = {path:?}\n")
}

/// Writes one.
fn configuration(
    directory: &Path,
    group: std::net::SocketAddrV4,
    (who, keys): (Who, Option<&Path>),
    Further { gncl, security }: Further<'_>,
) -> PathBuf {
    let path = directory.join(format!("{}.toml", who.name));
    let (name, address, socket) = (who.name, who.address(), directory.join(format!("{}.sock", who.name)));
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
