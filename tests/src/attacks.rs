//! The claim: no attack from the network of a secured robot lets an unauthorized peer in or makes a node
//! lost. Live traffic is hardly slowed down, and the node's memory stays within its bounds.
//!
//! Two nodes with keys run as processes on hosts of their own: `hip` sends a request to `knee` a thousand
//! times a second. An attacker on a third host runs one attack against `knee`.
//!
//! - First, live traffic is timed in alternating rounds: without an attack, with the attack on a decoy on
//!   `knee`'s host, and with the attack on `knee`.
//! - Then the test checks for intrusions and lost nodes. If the attack concerns newcomers, an honest peer
//!   unknown to `knee` connects from a fourth host meanwhile, and a node `ankle` is started there.
//!
//! Hosts are network namespaces connected by veth pairs, which the program creates and removes.
//!
//! | file | content |
//! | --- | --- |
//! | `decoy` | the role of the process that is attacked instead of the node |
//! | `intruder` | a whole node that does not belong to the robot |
//! | `keys` | the robot's authority, and another one |
//! | `node` | the role of each node |
//! | `rounds` | latencies of live traffic in alternating rounds |
//! | `robot` | the nodes, as the scenario sees them |
//! | `raw_peer` | a hand-written peer: TLS, HELLO, a session |
//! | `together` | joint work of two nodes while a guest is connected to one of them |
//! | `tried/` | the attacks, one file each |
//! | `report` | the results |

mod decoy;
mod intruder;
mod keys;
mod node;
mod raw_peer;
mod report;
mod robot;
mod rounds;
mod together;
mod tried;

use sinew_testkit::SetOnDrop;
use sinew_testkit::join;
use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Resource, Rlimit, getrlimit, setpriority_process, setrlimit};

use self::{
    intruder::Intruder,
    keys::{Keys, TestNode},
    raw_peer::RawPeer,
    robot::{Decoys, Robot, Target},
    tried::Recording,
};
pub use self::{
    report::{Report, Row},
    rounds::{Attacked, Done, Rounds},
};
use sinew_testkit::{DEADLINE, Host, Hosts};

/// Indices of the hosts.
const HIP: usize = 0;
const KNEE: usize = 1;
const ATTACKER: usize = 2;
const NEWCOMER: usize = 3;
/// Maximum growth of a node's memory under attack, in bytes.
pub const GROWTH_MAX: u64 = 64 << 20;
/// Maximum slowdown of live traffic at its 99th percentile.
pub const SLOWER_MAX: f64 = 2.0;
/// Minimum answer rate during an attack, as a fraction of the rate before it. Below this there is no service,
/// on any machine, even a shared one (6 % were seen while garbage was sent and compilers ran). The slowdown
/// of live traffic is measured by the 99th percentile, which is judged only on an idle machine.
pub const ANSWERED_MIN: f64 = 0.02;
/// The same on an idle machine, where no other load takes CPU time.
pub const ANSWERED_AT_REST: f64 = 0.5;
/// Maximum fraction of requests sent late before an attack, on an idle machine. Above this the latency ratio
/// is meaningless.
pub const LATE_AT_REST: f64 = 0.01;
/// Connections that a node opens to a newcomer: a dial, a dial that crosses the peer's (GNCL-4), and two side
/// connections (GNCL-14).
const DIALS_OF_A_NEWCOMER: u64 = 4;
/// Settling time of the nodes before a measurement.
const SETTLING: Duration = Duration::from_secs(1);
/// Interval between two memory samples, and between two honest hand-written peers.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// File descriptors that the scenario needs for an attacker's connections.
const DESCRIPTORS: u64 = 16_384;

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Duration of each attack while the test checks for intrusions.
    pub lasts: Duration,
    /// Measuring time of live traffic in each of the three states (no attack, decoy attacked, node attacked),
    /// summed over all rounds.
    pub timed: Duration,
    /// Number of rounds over these three states: at least one.
    pub rounds: u32,
    /// Names of the attacks to run; empty: all.
    pub only: Vec<String>,
}

/// An attack on a node.
struct Attack {
    /// The name, for `--only`.
    name: &'static str,
    /// A description of the attack.
    tried: &'static str,
    /// File descriptor limit of the attacked node; `None`: the limit of the system.
    descriptors: Option<u32>,
    /// The attacker records the robot's datagrams before it starts. During the recording `ankle` joins and
    /// leaves, and the attacked node is restarted.
    records: bool,
    /// Honest newcomers connect during the attack.
    others_come: bool,
    /// The attacker is a process on the attacked node's host, so the dials of that host include its own.
    inside: bool,
    /// The attacked node has an access list that allows all messages, and admits a user of its host with a
    /// few names and a group.
    guests: bool,
    /// A whole node that tries to join during the attack.
    intruder: Option<Intruder>,
    /// The node identity that the attacker may legitimately use: its own.
    own: TestNode,
    /// Runs the attack until the scene is over.
    run: fn(&Scene<'_>) -> Happened,
    /// The continuous part of the attack, for latency measurements; it also runs against a decoy. `None`: all
    /// of it.
    goes_on: Option<fn(&Scene<'_>) -> Happened>,
}

/// The result, as far as the attacker knows it.
#[derive(Default)]
struct Happened {
    /// A description.
    what: String,
    /// Violations that are counted only if an attack runs for its full duration.
    broken: Vec<String>,
    /// Violations that count however short the attack is: intruders that were admitted, and legitimate
    /// traffic of the robot that was blocked.
    let_in: Vec<String>,
    /// Minimum number of refusals by the node, per cause. An attack that never reached the node proves
    /// nothing.
    refused: Vec<(&'static str, u64)>,
    /// Messages sent in the sender's own name, which must arrive.
    own_sent: u64,
    /// The same on a link that broke: some of them may arrive.
    own_perhaps: u64,
    /// Number of times that each action was done.
    done: Done,
}

impl Happened {
    fn new(what: String, broken: Vec<String>) -> Self {
        Self { what, broken, ..Self::default() }
    }

    /// Combines both results.
    fn and(mut self, that: Self) -> Self {
        let Self { what, broken, let_in, refused, own_sent, own_perhaps, done } = that;
        self.what = format!("{}; {what}", self.what);
        self.broken.extend(broken);
        self.let_in.extend(let_in);
        for (cause, count) in refused {
            match self.refused.iter_mut().find(|(known, _)| *known == cause) {
                Some((_, known)) => *known += count,
                None => self.refused.push((cause, count)),
            }
        }
        self.own_sent += own_sent;
        self.own_perhaps += own_perhaps;
        for (what, count) in done {
            *self.done.entry(what).or_default() += count;
        }
        self
    }
}

/// The environment of an attack.
#[derive(Clone, Copy)]
struct Scene<'a> {
    robot: &'a Robot,
    target: Target,
    keys: &'a Keys,
    hosts: &'a [Host],
    lasts: Duration,
    /// Datagrams of the robot that the attacker recorded before.
    recorded: &'a Recording,
    over: &'a AtomicBool,
}

impl Scene<'_> {
    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }

    /// Sleeps, at most until the scene is over.
    fn rest(&self, time: Duration) {
        let until = Instant::now() + time;
        while !self.is_over() && Instant::now() < until {
            thread::sleep(time.min(Duration::from_millis(10)));
        }
    }

    /// Runs `work` on the attacker's host in `threads` threads until the scene is over. Their priority is
    /// below that of all nodes, because the CPUs are shared.
    fn on_threads<R: Send>(&self, threads: usize, work: impl Fn(usize) -> R + Sync) -> Vec<R> {
        self.hosts[ATTACKER].run(|| {
            lower_priority();
            thread::scope(|scope| {
                let work = &work;
                let running: Vec<_> = (0..threads).map(|number| scope.spawn(move || work(number))).collect();
                running.into_iter().map(join).collect()
            })
        })
    }
}

/// Lowers the priority of the attacker: on a machine shared with the nodes it gets only the CPU time that
/// they leave.
fn lower_priority() {
    const NICEST: i32 = 19;
    // If the system refuses, the priority stays as it is.
    let _ = setpriority_process(None, NICEST);
}

/// Runs the role of a robot's node.
pub(crate) fn run_node(arguments: &[String]) {
    node::run(arguments);
}

/// Runs the role of the process that is attacked instead of a node.
pub(crate) fn run_decoy(arguments: &[String]) {
    decoy::run(arguments);
}

/// Names and descriptions of all attacks.
#[must_use]
pub fn known() -> Vec<(&'static str, &'static str)> {
    tried::ATTACKS.iter().map(|attack| (attack.name, attack.tried)).collect()
}

/// Runs all attacks of the plan, one after the other, each against a new robot.
///
/// # Errors
/// A sentence: the reason why no hosts can be created here, or the name of an unknown attack.
///
/// # Panics
/// If a node does not start, or does not answer.
pub fn run(plan: &Plan) -> Result<Report, String> {
    if let Some(name) = plan.only.iter().find(|name| known().iter().all(|(known, _)| known != name)) {
        let names: Vec<_> = known().iter().map(|(name, _)| *name).collect();
        return Err(format!("there is no attack {name}; there are: {}", names.join(", ")));
    }
    let hosts = Hosts::new(4)?;
    allow_descriptors();
    let is_meant =
        |attack: &&Attack| plan.only.is_empty() || plan.only.iter().any(|name| name == attack.name);
    let rows = tried::ATTACKS.iter().filter(is_meant).map(|attack| one(attack, plan, &hosts)).collect();
    Ok(Report { rows, timed: plan.timed, rounds: plan.rounds })
}

/// Raises the file descriptor limit, for thousands of open connections.
fn allow_descriptors() {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = maximum.map_or(DESCRIPTORS, |maximum| maximum.min(DESCRIPTORS));
    if current.is_some_and(|current| current < wanted) {
        // With a lower limit fewer connections are held, and the report says how many.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum });
    }
}

/// Runs one attack on a new robot.
fn one(attack: &Attack, plan: &Plan, hosts: &Hosts) -> Row {
    let hosts = hosts.all();
    let keys = Keys::make();
    let mut robot = Robot::start(hosts, &keys, attack);
    // A decoy has no client socket, so it cannot replace the node for an attack from inside.
    let decoys = (!attack.inside).then(|| Decoys::start(hosts, &keys));
    thread::sleep(SETTLING);
    let mut recorded = Recording::default();
    if attack.records {
        (robot, recorded) = record(robot, hosts);
        thread::sleep(SETTLING);
    }
    let (seen_before, dials_before, held_before) = (robot.seen(), robot.dials(), robot.held_bytes());
    let began = Instant::now();
    let over = AtomicBool::new(false);
    let scene = Scene {
        robot: &robot,
        target: robot.target(),
        keys: &keys,
        hosts,
        lasts: plan.lasts,
        recorded: &recorded,
        over: &over,
    };
    let rounds = rounds::measure(attack, plan, &scene, decoys.as_ref());
    let (held_then, refused_before) = (robot.held_bytes(), robot.refused());
    robot.window(rounds::BETWEEN);
    let meanwhile = go_through(attack, &scene);
    let lived = robot.window("whole");
    let held_most =
        [held_then, meanwhile.held_most, robot.held_bytes()].into_iter().max().unwrap_or_default();
    let mut happened = meanwhile.happened;
    happened.own_sent += rounds.own_sent;
    happened.own_perhaps += rounds.own_perhaps;
    happened.let_in.extend_from_slice(&rounds.let_in);
    let outcome = report::Outcome {
        happened,
        rounds,
        lived,
        answers_again: robot.answers_again(),
        growth: held_most.saturating_sub(held_before),
        refused: since(&refused_before, robot.refused()),
        seen: robot.seen_since(&seen_before),
        dials: [0, 1].map(|node| meanwhile.dials[node] - dials_before[node]),
        dialled_for: meanwhile.dialled_by - began,
        came: meanwhile.came,
        by_hand: meanwhile.by_hand,
    };
    robot.end();
    decoys.into_iter().for_each(Decoys::end);
    Row::of(attack, outcome)
}

/// Observations during the full attack.
struct Meanwhile {
    happened: Happened,
    by_hand: Option<Knocked>,
    /// Time until the node started during the attack received an answer.
    came: Option<Duration>,
    /// Connections opened by each node, and the time of the count.
    dials: [u64; 2],
    dialled_by: Instant,
    held_most: u64,
}

/// Runs the full attack, with the newcomers that connect meanwhile.
fn go_through(attack: &Attack, scene: &Scene<'_>) -> Meanwhile {
    let Scene { robot, hosts, lasts, over, .. } = *scene;
    let intruding = attack.intruder.map(|intruder| intruder.start(scene));
    let (mut held_most, mut came) = (robot.held_bytes(), None);
    thread::scope(|scope| {
        let _ends = SetOnDrop(over);
        let attacking = scope.spawn(|| (attack.run)(scene));
        let knocking = attack.others_come.then(|| scope.spawn(|| knock(scene)));
        let until = Instant::now() + lasts;
        let ankle = attack.others_come.then(|| {
            // During the attack.
            thread::sleep(lasts / 4);
            let began = Instant::now();
            let ankle = robot.start_newcomer(&hosts[NEWCOMER]);
            came = Some(began.elapsed());
            ankle
        });
        while Instant::now() < until {
            held_most = held_most.max(robot.held_bytes());
            thread::sleep(POLL_INTERVAL);
        }
        // A node that leaves is redialled until it is declared lost. These dials are not caused by the
        // attacker.
        let (dials, dialled_by) = (robot.dials(), Instant::now());
        drop(ankle);
        over.store(true, Ordering::Relaxed);
        let mut happened = join(attacking);
        if let Some(intruding) = intruding {
            happened = happened.and(intruding.end());
        }
        let by_hand = knocking.map(|knocking| join(knocking));
        Meanwhile { happened, by_hand, came, dials, dialled_by, held_most }
    })
}

/// Records the robot's discovery datagrams while `ankle` joins and leaves, and the attacked node is
/// restarted.
fn record(robot: Robot, hosts: &[Host]) -> (Robot, Recording) {
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let _ends = SetOnDrop(&over);
        let (group, over) = (robot.group(), &over);
        let hearing = scope.spawn(move || hosts[KNEE].run(|| tried::listen(group, over)));
        let ankle = robot.start_newcomer(&hosts[NEWCOMER]);
        thread::sleep(SETTLING);
        ankle.end();
        let robot = robot.with_knee_anew(&hosts[KNEE]);
        over.store(true, Ordering::Relaxed);
        let recorded = join(hearing);
        (robot, recorded)
    })
}

/// The refusals counted since `before`.
fn since(before: &robot::Refused, mut now: robot::Refused) -> robot::Refused {
    for (cause, count) in &mut now {
        *count -= before.get(cause).copied().unwrap_or_default().min(*count);
    }
    now
}

/// Connection attempts of honest peers that the node does not know.
#[derive(Clone, Debug, Default)]
struct Knocked {
    came_in: u64,
    attempts: u64,
    /// The longest time until a peer was admitted.
    longest: Duration,
    /// The last error of a peer that was never admitted.
    never: Option<String>,
}

/// Connects honest peers that the node does not know, with keys of the project, one after the other. Each
/// dials and sends HELLO until it is admitted, as a node does, and then disconnects. The last one may take
/// longer than the scene.
fn knock(scene: &Scene<'_>) -> Knocked {
    let tls = scene.keys.tls(keys::SPARE);
    let mut knocked = Knocked::default();
    scene.hosts[NEWCOMER].run(|| {
        while !scene.is_over() {
            let began = Instant::now();
            loop {
                knocked.attempts += 1;
                let greeted = RawPeer::dial(scene.target.connections, Some(&tls))
                    .and_then(|mut raw_peer| raw_peer.hello(keys::SPARE, scene.robot.knee_address()));
                if matches!(greeted, Ok(raw_peer::Answer::Welcome)) {
                    break;
                }
                if began.elapsed() > DEADLINE {
                    knocked.never = Some(format!("{greeted:?}"));
                    return;
                }
                thread::sleep(POLL_INTERVAL);
            }
            knocked.came_in += 1;
            knocked.longest = knocked.longest.max(began.elapsed());
            scene.rest(POLL_INTERVAL);
        }
    });
    knocked
}
