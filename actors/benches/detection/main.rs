//! How soon a node learns that another one is gone, and why; and that it learns of none that is not.
//!
//! `cargo bench -p sinew --bench detection [-- [--short] [--seed=N] WORD...]` runs the cases whose name holds every WORD; exit code 2 if
//! there is none. Two hosts made of
//! network namespaces (needs root and `ip`; says why and skips what is not possible), on each a node in a process of its own: one to which
//! things happen, and one that watches it. JSON lines are on the standard output, a table on the standard error. Times are microseconds, from
//! the act, as told by the process that does it, until the observer's application has the event. At which moment of the period an act comes is
//! decided by the seed (1 if none is given). `--short` does a tenth of the 50 trials. Nothing here asserts a time.
//!
//! `WAY-SETTING`, where the settings are nodes that ask each other every 500 ms, every 50 ms, and every 500 ms but a group of `ndl.watch`
//! every 10 ms (`leg_10ms`); and the ways to go are
//!
//! - `kill`: `kill -9`. `leave`: SIGTERM, on which the node stops in order.
//! - `stop`: SIGSTOP.
//! - `link_down`: the other end of its interface goes down. `silent_cut`: the network swallows its packets, and all interfaces stay up.
//! - `stall_busy`, `stall_asleep`: its application's handler keeps its CPU, or sleeps, for longer than it takes to tell; the node lives.
//! - `restart`: `kill -9`, and started again as soon as the process has ended; `restart_same_ports`: with UDP and TCP ports that are configured.
//!   `act to new life` is the time to `NodeRestarted`.
//!
//! `new-SETTING`: a node starts, and the applications of three others are told; from its first announcement, as a socket on one of the other hosts
//! reads it, and from the call that starts it, until the last of the three has the event. `new_unheard-SETTING`: the network swallows all that it
//! says until it is up; from when packets are carried, within one period.
//!
//! `app_kill`: `kill -9` of an application in a process of its own, until another application of its node, which monitors it, has `Down`. It
//! needs no root.
//!
//! The table has p50, p99, p99.9 and the maximum in columns of their own; of 50 trials the 99th percentile is the maximum.
//!
//! Beside the times stand how many of the trials told the right reason first (`right`; of a restart the end or the new life), the bound of the
//! settings (`bound_us`: for a stall 250 ms, one look at the node's progress, and one period), in how many trials a loss or a restart says of itself that
//! the silence was within its own bound (`held`), in how many the application had the event within it (`in_time`, from the end of the act:
//! NDL may have a real-time priority, the application has none), by how much either was missed at worst (`over_us`), events that belong to
//! no act (`surprises`), and how often the observer said of itself that it was starved (`own_stalls`). Each trial that told a wrong reason,
//! and each that was later than all before it, is told in words.
//!
//! `spin-SETTING`, only where `spin` is asked for: four nodes, and eight processes for each CPU that spin at ordinary priority, for 10 minutes
//! (`--short`: 20 s); and the same where the nodes have no right to real-time priority (`spin_plain`). `lost` are losses told, none of which is
//! true: with one, the exit code is 1. The times are each second's longest silence of each node at each other one, as the watching node
//! knows it; without privileges the nodes share this host's loopback interface.

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

/// What all chance comes from, unless another seed is given.
const SEED: u64 = 1;
/// Trials of each case.
const TRIALS: u32 = 50;
/// How long nodes are watched while others spin.
const SPIN_SECONDS: u64 = 600;

/// What is measured.
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

/// Plays the part that another process of this program gave this one.
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
