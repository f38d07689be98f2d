//! The claim: whatever somebody on a secured robot's network does, nobody gets in, nobody is lost, those who talk feel little of it, and
//! the node's memory stays within its bounds.
//!
//! Two nodes with keys on hosts of their own, each a process: `hip` asks `knee` a thousand times a second. An attacker on a third host does one
//! thing to `knee`. First live traffic is timed by turns: left alone, with that done to a decoy on `knee`'s host, and to `knee`. Then it is
//! looked who gets in and who is lost; meanwhile, where that is the question, an honest peer that `knee` does not know comes from a fourth
//! host, and a node `ankle` is started there. Hosts are network namespaces joined by veth pairs, which the program makes and removes.
//!
//! | file | what it is |
//! | --- | --- |
//! | `decoy` | the role of the one that is attacked instead of the node |
//! | `intruder` | a whole node that does not belong there |
//! | `keys` | the robot's authority, and another one |
//! | `node` | the role of each node |
//! | `rounds` | live traffic's times by turns |
//! | `robot` | the nodes, as the director sees them |
//! | `stranger` | a peer by hand: TLS, HELLO, a session |
//! | `together` | what two nodes do together while a guest is at the door of one |
//! | `tried/` | what is done, one file each |
//! | `report` | what was seen |

mod decoy;
mod intruder;
mod keys;
mod node;
mod report;
mod robot;
mod rounds;
mod stranger;
mod together;
mod tried;

use std::{
    path::PathBuf,
    process::ExitCode,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Resource, Rlimit, getrlimit, setpriority_process, setrlimit};

use self::{
    intruder::Intruder,
    keys::{Keys, Who},
    robot::{Decoys, Robot, Target},
    stranger::Stranger,
    tried::Recording,
};
pub use self::{
    report::{Report, Row},
    rounds::{Attacked, Done, Rounds},
};
use crate::{DEADLINE, Host, Hosts};

/// Which of the hosts is whose.
const HIP: usize = 0;
const KNEE: usize = 1;
const ATTACKER: usize = 2;
const NEWCOMER: usize = 3;
/// Memory that a node may grow by under attack, in bytes.
pub const GROWTH_MAX: u64 = 64 << 20;
/// How much slower live traffic may be at its 99th percentile.
pub const SLOWER_MAX: f64 = 2.0;
/// Of the answers in each second before an attack, so many are still given while it lasts: fewer is no service, on any machine, however many
/// others share it (6 % were seen while garbage was poured and compilers ran). How much live traffic feels is said by the 99th percentile, which counts on a machine at rest.
pub const ANSWERED_MIN: f64 = 0.02;
/// The same on a machine at rest, where nothing else takes them away.
pub const ANSWERED_AT_REST: f64 = 0.5;
/// Share of the questions that may be late before an attack, on a machine at rest: with more of them the ratio of times says nothing.
pub const LATE_AT_REST: f64 = 0.01;
/// Connections that a node begins to one that comes: a dial, one that crosses the other's (GNCL-4), and two side connections (GNCL-14).
const DIALS_OF_A_NEWCOMER: u64 = 4;
/// Nodes settle for so long before they are measured.
const SETTLING: Duration = Duration::from_secs(1);
/// Time between two looks at memory, and between two honest peers by hand.
const LOOK: Duration = Duration::from_millis(100);
/// Descriptors that the director needs for an attacker's connections.
const DESCRIPTORS: u64 = 16_384;

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Plan {
    /// A program whose `main` calls [`play`] first.
    pub program: PathBuf,
    /// How long each attack lasts while it is looked who gets in.
    pub lasts: Duration,
    /// How long live traffic is timed left alone, with the decoy attacked, and with the node attacked, each in all rounds together.
    pub timed: Duration,
    /// How often these three take turns: once at least.
    pub rounds: u32,
    /// The names of those that are tried; none: all.
    pub only: Vec<String>,
}

/// Something that is done to a node.
struct Attack {
    /// Its name, for `--only`.
    name: &'static str,
    /// What is tried, in words.
    tried: &'static str,
    /// Descriptors of the attacked node; `None`: as many as the system allows.
    descriptors: Option<u32>,
    /// The attacker hears the robot's datagrams before it begins; meanwhile `ankle` comes and goes, and the attacked node is started again.
    records: bool,
    /// Others want to come in meanwhile.
    others_come: bool,
    /// He is a process of the attacked node's host: what that one dials is his doing, too.
    inside: bool,
    /// The attacked node has an access list that lets everything be said, and a user of its host in with a few names and a group.
    guests: bool,
    /// A whole node that tries to get in meanwhile.
    intruder: Option<Intruder>,
    /// In whose name he may speak: his own.
    own: Who,
    /// Does it until the scene is over.
    run: fn(&Scene<'_>) -> Happened,
    /// What of it goes on all the time, and can be done to a decoy, for times; `None`: all of it.
    goes_on: Option<fn(&Scene<'_>) -> Happened>,
}

/// What came of it, as far as the attacker knows.
#[derive(Default)]
struct Happened {
    /// In words.
    what: String,
    /// What must not have been: for so long a time as the whole of an attack takes.
    broken: Vec<String>,
    /// What must not have been for however short a time: who was let in, and what of the robot's own did not get through.
    let_in: Vec<String>,
    /// What the node must have refused meanwhile, by cause, and how often at least: an attack that never reached it shows nothing.
    refused: Vec<(&'static str, u64)>,
    /// Messages that were sent in the sender's own name, and are to arrive.
    own_sent: u64,
    /// The same on a link that broke: some of them may arrive.
    own_perhaps: u64,
    /// How often what was done.
    done: Done,
}

impl Happened {
    fn new(what: String, broken: Vec<String>) -> Self {
        Self { what, broken, ..Self::default() }
    }

    /// Both this and that.
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

/// Where an attack takes place.
#[derive(Clone, Copy)]
struct Scene<'a> {
    robot: &'a Robot,
    target: Target,
    keys: &'a Keys,
    hosts: &'a [Host],
    program: &'a PathBuf,
    lasts: Duration,
    /// Datagrams of the robot that the attacker has heard before.
    recorded: &'a Recording,
    over: &'a AtomicBool,
}

impl Scene<'_> {
    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }

    /// Waits, but not longer than the scene.
    fn rest(&self, time: Duration) {
        let until = Instant::now() + time;
        while !self.is_over() && Instant::now() < until {
            thread::sleep(time.min(Duration::from_millis(10)));
        }
    }

    /// Does this on the attacker's host until the scene is over, on so many threads, which are nicer than all nodes: the CPUs are shared.
    fn on_threads<R: Send>(&self, threads: usize, work: impl Fn(usize) -> R + Sync) -> Vec<R> {
        self.hosts[ATTACKER].run(|| {
            give_way();
            thread::scope(|scope| {
                let work = &work;
                let running: Vec<_> = (0..threads).map(|number| scope.spawn(move || work(number))).collect();
                running
                    .into_iter()
                    .map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
                    .collect()
            })
        })
    }
}

/// On a machine whose CPUs the attacker shares with the nodes, he has what they leave.
fn give_way() {
    const NICEST: i32 = 19;
    // It goes on as it is where the system refuses it.
    let _ = setpriority_process(None, NICEST);
}

/// Plays the role that this process was started for; `None` if it is the director.
#[must_use]
pub fn play() -> Option<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match &arguments[..] {
        [flag, role, rest @ ..] if flag == "--role" && role == "robot-node" => node::play(rest),
        [flag, role, rest @ ..] if flag == "--role" && role == "decoy" => decoy::play(rest),
        // That of a client at the door.
        _ => return crate::clients::play(),
    }
    Some(ExitCode::SUCCESS)
}

/// The names of all attacks, and what each tries.
#[must_use]
pub fn known() -> Vec<(&'static str, &'static str)> {
    tried::ATTACKS.iter().map(|attack| (attack.name, attack.tried)).collect()
}

/// Attacks a robot in all ways of the plan, one after the other, each a new robot.
///
/// # Errors
/// A sentence: why no hosts can be made here, or which attack is not known.
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

/// For connections that are held by thousands.
fn allow_descriptors() {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = maximum.map_or(DESCRIPTORS, |maximum| maximum.min(DESCRIPTORS));
    if current.is_some_and(|current| current < wanted) {
        // With fewer, fewer are held, and the report says how many.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum });
    }
}

/// One attack on a robot of its own.
fn one(attack: &Attack, plan: &Plan, hosts: &Hosts) -> Row {
    let hosts = hosts.all();
    let keys = Keys::make();
    let mut robot = Robot::start(&plan.program, hosts, &keys, attack);
    // Nobody stands in for the door.
    let decoys = (!attack.inside).then(|| Decoys::start(&plan.program, hosts, &keys));
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
        program: &plan.program,
        lasts: plan.lasts,
        recorded: &recorded,
        over: &over,
    };
    let rounds = rounds::play(attack, plan, &scene, decoys.as_ref());
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

/// What was seen while the whole of an attack took place.
struct Meanwhile {
    happened: Happened,
    by_hand: Option<Knocked>,
    /// Until the node that was started in the middle of it had an answer.
    came: Option<Duration>,
    /// Connections that each node had begun, and when they were counted.
    dials: [u64; 2],
    dialled_by: Instant,
    held_most: u64,
}

/// The whole of an attack, with those who want to come in meanwhile.
fn go_through(attack: &Attack, scene: &Scene<'_>) -> Meanwhile {
    let Scene { robot, hosts, lasts, over, .. } = *scene;
    let intruding = attack.intruder.map(|intruder| intruder.start(scene));
    let (mut held_most, mut came) = (robot.held_bytes(), None);
    thread::scope(|scope| {
        let _ends = EndsIt(over);
        let attacking = scope.spawn(|| (attack.run)(scene));
        let knocking = attack.others_come.then(|| scope.spawn(|| knock(scene)));
        let until = Instant::now() + lasts;
        let ankle = attack.others_come.then(|| {
            // In the middle of it.
            thread::sleep(lasts / 4);
            let began = Instant::now();
            let ankle = robot.start_newcomer(&hosts[NEWCOMER]);
            came = Some(began.elapsed());
            ankle
        });
        while Instant::now() < until {
            held_most = held_most.max(robot.held_bytes());
            thread::sleep(LOOK);
        }
        // Who goes is dialled again until it is lost: that is no attacker's doing.
        let (dials, dialled_by) = (robot.dials(), Instant::now());
        drop(ankle);
        over.store(true, Ordering::Relaxed);
        let mut happened = attacking.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        if let Some(intruding) = intruding {
            happened = happened.and(intruding.end());
        }
        let by_hand =
            knocking.map(|knocking| knocking.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        Meanwhile { happened, by_hand, came, dials, dialled_by, held_most }
    })
}

/// What the robot says of discovery while `ankle` comes and goes, and the attacked node goes and comes again.
fn record(robot: Robot, hosts: &[Host]) -> (Robot, Recording) {
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let _ends = EndsIt(&over);
        let (group, over) = (robot.group(), &over);
        let hearing = scope.spawn(move || hosts[KNEE].run(|| tried::listen(group, over)));
        let ankle = robot.start_newcomer(&hosts[NEWCOMER]);
        thread::sleep(SETTLING);
        ankle.end();
        let robot = robot.with_knee_anew(&hosts[KNEE]);
        over.store(true, Ordering::Relaxed);
        let recorded = hearing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        (robot, recorded)
    })
}

/// How much was refused since then.
fn since(before: &robot::Refused, mut now: robot::Refused) -> robot::Refused {
    for (cause, count) in &mut now {
        *count -= before.get(cause).copied().unwrap_or_default().min(*count);
    }
    now
}

/// Ends the scene also when something panics: else nobody would hear of it.
struct EndsIt<'a>(&'a AtomicBool);

impl Drop for EndsIt<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// What honest peers that the node does not know had to do to come in.
#[derive(Clone, Debug, Default)]
struct Knocked {
    came_in: u64,
    attempts: u64,
    /// The longest time until one was in.
    longest: Duration,
    /// Why the last attempt of one failed that never came in.
    never: Option<String>,
}

/// Honest peers that the node has not heard of, with keys of the project, one after the other: each dials and says hello until it is in, as
/// a node does, and goes. The last one may need longer than the scene.
fn knock(scene: &Scene<'_>) -> Knocked {
    let tls = scene.keys.tls(keys::SPARE);
    let mut knocked = Knocked::default();
    scene.hosts[NEWCOMER].run(|| {
        while !scene.is_over() {
            let began = Instant::now();
            loop {
                knocked.attempts += 1;
                let greeted = Stranger::dial(scene.target.connections, Some(&tls))
                    .and_then(|mut stranger| stranger.hello(keys::SPARE, scene.robot.knee_address()));
                if matches!(greeted, Ok(stranger::Answer::Welcome)) {
                    break;
                }
                if began.elapsed() > DEADLINE {
                    knocked.never = Some(format!("{greeted:?}"));
                    return;
                }
                thread::sleep(LOOK);
            }
            knocked.came_in += 1;
            knocked.longest = knocked.longest.max(began.elapsed());
            scene.rest(LOOK);
        }
    });
    knocked
}
