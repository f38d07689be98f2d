//! Live nodes on an overloaded machine: which nodes are reported as lost, and how long each was silent.

use std::{
    thread,
    time::{Duration, Instant},
};

use rustix::thread::{CapabilitySet, capabilities, set_capabilities};
use sinew::{NodeHandle, prelude::*};
use sinew_figures::{
    Alone, Figures,
    process::{self, Process, await_end, print_ready},
};
use sinew_testkit::Hosts;

use crate::{nodes::At, observer::Observer, setting::Setting, starved};

/// Nodes, and processes that spin for each CPU: the machine has eight times as much to do as it can.
const NODES: u8 = 4;
const SPINNERS_PER_CPU: usize = 8;
/// A node stays this much longer than it watches, so that no other node sees it leave.
const STAY: Duration = Duration::from_secs(5);
/// The shortest pause between two polls; a tenth of the period if that is longer.
const LOOK_MIN: Duration = Duration::from_millis(5);
/// The longest silence is recorded for each interval of this length.
const PART: Duration = Duration::from_secs(1);

/// The privileges of the nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rights {
    /// The privileges of this process.
    Same,
    /// No real-time priority, as for a user without privileges.
    Plain,
}

impl Rights {
    pub(crate) const ALL: [Self; 2] = [Self::Same, Self::Plain];

    /// The name as part of the names of cases.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Same => "spin",
            Self::Plain => "spin_plain",
        }
    }

    pub(crate) fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|rights| rights.name() == name);
        found.expect("a name that this program wrote itself")
    }
}

/// Observations of one node about the others.
#[derive(Default)]
struct Seen {
    lost: u64,
    own_stalls: u64,
    late_ms: u64,
    missed: u64,
    silences: Figures,
}

/// Starts nodes and spinning processes, and reports the nodes' observations. Returns whether no node was
/// reported as lost.
pub(crate) fn measure(case: &str, rights: Rights, setting: Setting, seconds: u64) -> bool {
    let hosts = Hosts::new(NODES).inspect_err(|why| eprintln!("{case}: on one host: {why}")).ok();
    let at = At::loopback();
    let member = |index: u8| {
        let host = hosts.as_ref().map(|hosts| &hosts.all()[usize::from(index)]);
        let at = host.map_or_else(|| at.host(index + 1), |host| at.on(host.address));
        let role = format!("member {} {} {seconds} {at}", rights.name(), setting.name());
        let command = process::command(&role);
        let command = host.map_or_else(|| process::command(&role), |host| host.moved(&command));
        Process::start_command(command, &role)
    };
    let members: Vec<Process> = (0..NODES).map(member).collect();
    let cpus = thread::available_parallelism().map_or(1, usize::from);
    let spinners: Vec<Process> = (0..cpus * SPINNERS_PER_CPU).map(|_| Process::start("spinner")).collect();
    let mut all = Seen::default();
    for member in members {
        let said = member.wait();
        all.add(&Seen::read(&said).unwrap_or_else(|| panic!("{case}: a node failed, it said {said:?}")));
    }
    let counts = [
        ("lost", all.lost),
        ("own_stalls", all.own_stalls),
        ("late_ms", all.late_ms),
        ("missed", all.missed),
        ("spinners", spinners.len() as u64),
        ("seconds", seconds),
    ];
    let figure = "longest silence of a second";
    Alone { bench: "detection", case, figure, seen: &all.silences, counts: &counts }.report();
    all.lost == 0
}

impl Seen {
    fn add(&mut self, other: &Self) {
        self.lost += other.lost;
        self.own_stalls += other.own_stalls;
        self.late_ms = self.late_ms.max(other.late_ms);
        self.missed = self.missed.max(other.missed);
        self.silences.add(&other.silences);
    }

    fn say(&self) {
        println!("{} {} {} {}", self.lost, self.own_stalls, self.late_ms, self.missed);
        self.silences.hand_over();
    }

    fn read(said: &str) -> Option<Self> {
        let (counts, silences) = said.split_once('\n')?;
        let counts: Vec<u64> = counts.split(' ').map_while(|count| count.parse().ok()).collect();
        let [lost, own_stalls, late_ms, missed] = counts[..] else { return None };
        Some(Self { lost, own_stalls, late_ms, missed, silences: Figures::taken(silences)? })
    }
}

/// A node that watches the others for so long.
pub(crate) fn member(rights: Rights, setting: Setting, seconds: u64, at: At) {
    starved::listen();
    if rights == Rights::Plain {
        give_up_real_time();
    }
    // The process that started this one may be killed.
    thread::spawn(|| {
        await_end();
        std::process::exit(0);
    });
    let observer = Observer::start(setting, at);
    print_ready();
    let mut found = 0;
    while found < NODES - 1 {
        let told = observer.next("another node");
        assert!(matches!(told.event, NodeEvent::NodeFound { .. }), "found first: {told:?}");
        found += 1;
    }
    let mut seen = watch(&observer.handle(), setting, Duration::from_secs(seconds));
    for event in observer.rest() {
        if let NodeEvent::NodeLost { .. } = event {
            eprintln!("{at}: a false loss: {event:?}");
            seen.lost += 1;
        }
    }
    thread::sleep(STAY);
    seen.say();
}

fn watch(node: &NodeHandle, setting: Setting, lasts: Duration) -> Seen {
    let (pause, began) = (LOOK_MIN.max(setting.asked_every() / 10), Instant::now());
    let mut seen = Seen::default();
    let (before, _) = starved::told();
    while began.elapsed() < lasts {
        let part = Instant::now();
        let mut longest = std::collections::BTreeMap::<NodeAddress, Duration>::new();
        while part.elapsed() < PART {
            thread::sleep(pause);
            let (members, now) = (node.members(), Time::now());
            for member in members {
                seen.missed = seen.missed.max(u64::from(member.missed));
                let silence = longest.entry(member.node).or_default();
                *silence = (*silence).max(now.since(member.heard));
            }
        }
        longest.into_values().for_each(|silence| seen.silences.record(silence));
    }
    let (stalls, late_ms) = starved::told();
    (seen.own_stalls, seen.late_ms) = (stalls - before, late_ms);
    seen
}

/// Removes the right to real-time priority from this thread and its later child threads.
fn give_up_real_time() {
    let sets = capabilities(None).and_then(|mut sets| {
        sets.effective.remove(CapabilitySet::SYS_NICE);
        sets.permitted.remove(CapabilitySet::SYS_NICE);
        sets.inheritable.remove(CapabilitySet::SYS_NICE);
        set_capabilities(None, sets)
    });
    sets.expect("whoever has a right may give it up");
}

/// Spins until the process that started it ends it, or ends.
pub(crate) fn spinner() {
    thread::spawn(|| {
        loop {
            std::hint::spin_loop();
        }
    });
    print_ready();
    await_end();
}
