//! How soon a node detects that another node is gone, with which reason, and that it never reports a live
//! node as lost.
//!
//! `cargo bench -p sinew --bench detection [-- [--short] [--seed=N] WORD...]` runs the cases that have every
//! WORD in their names. The exit code is 2 if there are none.
//!
//! The cases run on two hosts made of network namespaces. This needs root and `ip`; the bench reports and
//! skips cases that are not possible. Each host runs one node in its own process: the subject of the act, and
//! an observer. The standard output has JSON lines, the standard error a table. Times are in microseconds.
//! They run from the act, as reported by the acting process, until the observer's application has the event.
//! The seed (default 1) determines the moment of an act within the period. `--short` runs a tenth of the 50
//! trials. Nothing here asserts a time.
//!
//! Most cases are named `WAY-SETTING`. The settings are: nodes query each other every 500 ms, every 50 ms, or
//! every 500 ms with a group of `ndl.watch` every 10 ms (`leg_10ms`). The ways are:
//!
//! - `kill`: `kill -9`. `leave`: SIGTERM, on which the node stops in order.
//! - `stop`: SIGSTOP.
//! - `link_down`: the other end of its interface goes down. `silent_cut`: the network drops its packets, and
//!   all interfaces stay up.
//! - `stall_busy`, `stall_asleep`: its application's handler keeps its CPU busy, or sleeps, for longer than
//!   the stall bound; the node lives.
//! - `restart`: `kill -9`, and a start as soon as the process has ended; `restart_same_ports`: with
//!   configured UDP and TCP ports. `act to new life` is the time to `NodeRestarted`.
//!
//! `new-SETTING`: a node starts, and the applications of three other nodes are notified. The end of the
//! measurement is the event at the last of the three. It has two starts: the first announcement, as read by a
//! socket on one of the other hosts, and the call that starts the node. `new_unheard-SETTING`: the
//! network drops everything that the node sends until it is up. The measurement starts when packets are
//! carried, within one period.
//!
//! `app_kill`: `kill -9` of an application in its own process, until another application of its node, which
//! monitors it, has `Down`. It needs no root.
//!
//! The table has columns for p50, p99, p99.9 and the maximum. With 50 trials the 99th percentile is the
//! maximum.
//!
//! The table has these further columns:
//!
//! - `right`: trials with the right reason first (for a restart: the end or the new life).
//! - `bound_us`: the bound of the settings. For a stall it is 250 ms, one check of the node's progress, and
//!   one period.
//! - `held`: trials in which a loss or a restart reports that the silence was within its own bound.
//! - `in_time`: trials in which the application had the event within the bound, from the end of the act. NDL
//!   may have a real-time priority, the application has none.
//! - `over_us`: the largest amount by which either was missed.
//! - `surprises`: events that belong to no act.
//! - `own_stalls`: how often the observer reported that it was starved itself.
//!
//! Each trial with a wrong reason, and each that was later than all before it, is described in a line of
//! text.
//!
//! `spin-SETTING` runs only if `spin` is requested. It has four nodes, and eight processes for each CPU that
//! spin at ordinary priority, for 10 minutes (`--short`: 20 s). `spin_plain` is the same with nodes that have
//! no right to real-time priority. `lost` counts reported losses, all of them false: with one, the exit code
//! is 1. The times are the longest silence in each second, for each node at each other one, as measured by
//! the watching node. Without privileges the nodes share this host's loopback interface.

mod application;
mod newcomer;
mod observer;
mod setting;
mod spin;
mod starved;
mod subject;
mod trials;
mod way;

#[path = "../gncl/nodes.rs"]
mod nodes;

use std::process::ExitCode;

use sinew_figures::{Asked, process};

use crate::{
    newcomer::First,
    nodes::At,
    setting::Setting,
    spin::Rights,
    trials::Plan,
    way::{Ports, Way},
};

/// The seed of all random choices, unless another one is given.
const SEED: u64 = 1;
/// Trials of each case.
const TRIALS: u32 = 50;
/// How long nodes are watched while others spin.
const SPIN_SECONDS: u64 = 600;

/// A measurement.
#[derive(Clone, Copy, Debug)]
enum Case {
    Gone(Way, Setting),
    New(First, Setting),
    AppKill,
    Spin(Rights, Setting),
}

impl Case {
    fn all() -> Vec<Self> {
        let gone = Setting::ALL.iter().flat_map(|setting| Way::ALL.map(|way| Self::Gone(way, *setting)));
        let spin = [Setting::Relaxed, Setting::Brisk]
            .into_iter()
            .flat_map(|setting| Rights::ALL.map(|rights| Self::Spin(rights, setting)));
        let new = [Setting::Relaxed, Setting::Brisk]
            .into_iter()
            .flat_map(|setting| First::ALL.map(|first| Self::New(first, setting)));
        gone.chain(new).chain([Self::AppKill]).chain(spin).collect()
    }

    fn name(self) -> String {
        match self {
            Self::Gone(way, setting) => format!("{}-{}", way.name(), setting.name()),
            Self::New(first, setting) => format!("{}-{}", first.name(), setting.name()),
            Self::AppKill => "app_kill".to_owned(),
            Self::Spin(rights, setting) => format!("{}-{}", rights.name(), setting.name()),
        }
    }

    fn is_long(self) -> bool {
        match self {
            Self::Gone(..) | Self::New(..) | Self::AppKill => false,
            Self::Spin(..) => true,
        }
    }

    /// Runs it in a process of its own. Returns whether that went well.
    fn run(self, is_short: bool, seed: u64) -> bool {
        let worked =
            process::has_run(process::command(&format!("measure {is_short} {seed} {}", self.name())));
        if !worked {
            eprintln!("{}: failed", self.name());
        }
        worked
    }

    /// Returns whether that went well.
    fn measure(self, is_short: bool, seed: u64) -> bool {
        let (name, part) = (self.name(), if is_short { 10 } else { 1 });
        match self {
            Self::Gone(way, setting) => {
                trials::measure(&name, Plan { way, setting, trials: TRIALS / part, seed })
            }
            Self::New(first, setting) => newcomer::measure(&name, (first, setting), TRIALS / part, seed),
            Self::AppKill => application::measure(&name, TRIALS / part, seed),
            Self::Spin(rights, setting) => {
                let seconds = if is_short { 20 } else { SPIN_SECONDS };
                spin::measure(&name, rights, setting, seconds)
            }
        }
    }
}

fn main() -> ExitCode {
    if let Some(role) = process::role() {
        return play(&role);
    }
    let asked = Asked::read(include_str!("main.rs"), &["--short", "--seed="]);
    let is_short = asked.is_short();
    let seed = match asked.value("--seed=").map_or(Ok(SEED), str::parse) {
        Ok(seed) => seed,
        Err(error) => {
            eprintln!("--seed= is followed by a whole number, such as --seed=7: {error}");
            return ExitCode::from(2);
        }
    };
    let offered = Case::all().into_iter().filter(|case| !case.is_long() || asked.names("spin"));
    let wanted = asked.wanted(offered, |case| case.name());
    sinew_figures::head();
    let failed = wanted.into_iter().filter(|case| !case.run(is_short, seed)).count();
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs the role that another process of this program assigned to this one.
fn play(role: &str) -> ExitCode {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["measure", is_short, seed, name] => {
            let case = Case::all().into_iter().find(|case| case.name() == name);
            let case = case.expect("a name that this program wrote itself");
            if !case.measure(is_short == "true", number(seed)) {
                return ExitCode::FAILURE;
            }
        }
        ["subject", ports, setting, at] => {
            return subject::run(Ports::named(ports), Setting::named(setting), At::read(at));
        }
        ["member", rights, setting, seconds, at] => {
            spin::member(Rights::named(rights), Setting::named(setting), number(seconds), At::read(at));
        }
        ["spinner"] => spin::spinner(),
        _ => {
            eprintln!("no such role: {role}");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}

fn number(word: &str) -> u64 {
    word.parse().expect("a number that this program wrote itself")
}
