//! Starts the processes one by one or all at once, holds one back, kills them, and waits until they meet.

use std::{
    net::SocketAddrV4,
    sync::{Arc, Mutex, MutexGuard},
};

use sinew::{Time, app::Requirement};
use sinew_runtime::lock;

use super::{
    node::{COME, DIRECTORY, KEPT_BACK, STAY_AWAY, UP},
    verdict::{Event, Incarnation, Verdict},
};
use crate::role;
use sinew_testkit::{NodeProcess, own_group, until};

/// The parties, and the start requirements of each: a name, any of two, a number of matches of a pattern and
/// a name.
pub const PARTIES: [(&str, &[&str]); 4] = [
    ("leg.hip", &[]),
    ("leg.knee", &["leg.hip"]),
    ("leg.ankle", &["leg.hip | leg.knee"]),
    ("central", &["3 of leg.*"]),
];

/// A process and its output.
#[derive(Debug)]
struct Party {
    process: NodeProcess,
    /// Its record, and its other lines.
    printed: Arc<Mutex<(Incarnation, Vec<String>)>>,
}

/// The four parties, with all their incarnations.
#[derive(Debug)]
pub struct Scenario {
    group: SocketAddrV4,
    present: [Option<Party>; PARTIES.len()],
    former: Vec<Vec<Incarnation>>,
    /// Violations found before the judge evaluates all records.
    violations: Vec<String>,
}

/// Every order of four.
#[must_use]
pub fn permutations() -> Vec<[usize; PARTIES.len()]> {
    let all = (0..256).map(|number| [number >> 6 & 3, number >> 4 & 3, number >> 2 & 3, number & 3]);
    all.filter(|order| (0..4).all(|index| order.contains(&index))).collect()
}

impl Default for Scenario {
    fn default() -> Self {
        Self::new()
    }
}

impl Scenario {
    /// A scenario without processes, on a network of its own.
    #[must_use]
    pub fn new() -> Self {
        Self {
            group: own_group(),
            present: [const { None }; PARTIES.len()],
            former: vec![Vec::new(); PARTIES.len()],
            violations: Vec::new(),
        }
    }

    /// Starts all four parties, each once the previous ones are up, know each other, and have started if
    /// their requirements are met. Returns when they have met once.
    ///
    /// # Panics
    /// If a party is not up in time.
    #[must_use]
    pub fn one_by_one(order: [usize; PARTIES.len()]) -> Self {
        let mut scenario = Self::new();
        for present in 1..=order.len() {
            let newcomer = order[present - 1];
            scenario.start(newcomer);
            scenario.wait_until_up(newcomer);
            scenario.wait_for_one_directory();
            scenario.check_who_waits(&order[..present]);
        }
        scenario.wait_until_passed(0);
        scenario
    }

    /// Starts all four parties without a pause, and returns when they have met once.
    ///
    /// # Panics
    /// If a party is not up in time.
    #[must_use]
    pub fn at_once() -> Self {
        let mut scenario = Self::new();
        (0..PARTIES.len()).for_each(|index| scenario.start(index));
        scenario.wait_until_passed(0);
        scenario.wait_for_one_directory();
        scenario
    }

    /// Starts a party's process.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(&mut self, index: usize) {
        let mut command = role("party");
        command.args([index.to_string(), self.group.to_string()]);
        let printed = Arc::new(Mutex::new((Incarnation::default(), Vec::new())));
        let record = printed.clone();
        let process = NodeProcess::start_with(PARTIES[index].0, command, move |line| {
            let mut record = lock(&record);
            match Event::read(line) {
                Some(event) => record.0.events.push(event),
                None => record.1.push(line.to_owned()),
            }
            true
        });
        self.present[index] = Some(Party { process, printed });
    }

    /// Kills a party's process at once (`kill -9`), and keeps its output.
    pub fn kill(&mut self, index: usize) {
        let Some(mut party) = self.present[index].take() else { return };
        let killed = Time::now().as_nanos();
        party.process.kill();
        let mut incarnation = party.printed().0.clone();
        incarnation.killed = Some(killed);
        self.former[index].push(incarnation);
    }

    /// Kills a waiting party while another one stays away, which arrives once all others know of the loss. No
    /// party may continue before the next incarnation of the killed one arrives; the judge checks this. All
    /// four live afterwards, and meet.
    ///
    /// # Panics
    /// If an expected event does not happen in time.
    pub fn kill_who_waits(&mut self, killed: usize, away: usize) {
        if let Some(process) = &self.present[away] {
            // An answer to an earlier command does not count.
            process.printed().1.clear();
        }
        self.send_command(away, STAY_AWAY);
        self.wait_for_word(away, KEPT_BACK);
        let generation = self.generation();
        let waits = |process: &Party| {
            let incarnation = &process.printed().0;
            matches!(incarnation.events.last(), Some(Event::Arrived(_)))
                && passed(incarnation).unwrap_or_default() >= generation
        };
        until(&format!("{} waits for generation {}", PARTIES[killed].0, generation + 1), || {
            self.present[killed].as_ref().is_some_and(waits).then_some(())
        });
        self.kill(killed);
        // From then on it must not count.
        self.wait_until_unknown(killed);
        if let Some(incarnation) = self.former[killed].last_mut() {
            incarnation.unknown = Some(Time::now().as_nanos());
        }
        self.send_command(away, COME);
        let arrived = |process: &Party| matches!(process.printed().0.events.last(), Some(Event::Arrived(_)));
        until(&format!("{} has come", PARTIES[away].0), || {
            self.present[away].as_ref().is_some_and(arrived).then_some(())
        });
        self.start(killed);
        self.wait_until_passed(generation);
    }

    /// The highest generation passed by any party.
    #[must_use]
    pub fn generation(&self) -> u64 {
        let incarnations = self.present.iter().flatten().map(|process| process.printed().0.clone());
        incarnations
            .filter_map(|incarnation| passed(&incarnation))
            .chain(self.former.iter().flatten().filter_map(passed))
            .max()
            .unwrap_or_default()
    }

    /// Waits until all four have passed a generation higher than this one.
    ///
    /// # Panics
    /// If they do not in time, with the output of each.
    pub fn wait_until_passed(&self, generation: u64) {
        for (index, process) in self.present.iter().enumerate() {
            let process = process.as_ref().expect("all four live");
            let what =
                || format!("{} passes more than {generation}: {:?}", PARTIES[index].0, process.printed().1);
            until(&what(), || passed(&process.printed().0).filter(|passed| *passed > generation));
        }
    }

    /// Waits until all live parties have the same directory, and all parties with met requirements are ready
    /// in it.
    ///
    /// # Panics
    /// If this does not happen in time.
    pub fn wait_for_one_directory(&mut self) {
        let present: Vec<usize> = (0..PARTIES.len()).filter(|index| self.present[*index].is_some()).collect();
        let ready = who_may_start(&present);
        let mut entries: Vec<String> =
            present.iter().map(|index| format!("{}={}", PARTIES[*index].0, ready.contains(index))).collect();
        entries.sort_unstable();
        let expected = entries.join(" ");
        for index in present {
            until(&format!("the directory of {} is {expected}", PARTIES[index].0), || {
                (self.directory_of(index) == expected).then_some(())
            });
        }
    }

    /// Waits until no live party has this party in its directory.
    fn wait_until_unknown(&mut self, lost: usize) {
        let entry = format!("{}=", PARTIES[lost].0);
        let living: Vec<usize> = (0..PARTIES.len()).filter(|index| self.present[*index].is_some()).collect();
        for index in living {
            until(&format!("{} knows that {} is lost", PARTIES[index].0, PARTIES[lost].0), || {
                (!self.directory_of(index).split(' ').any(|known| known.starts_with(&entry))).then_some(())
            });
        }
    }

    /// The current directory of a party's node.
    fn directory_of(&mut self, index: usize) -> String {
        let answers = |process: &Party| -> Vec<String> {
            let lines = &process.printed().1;
            lines.iter().filter_map(|line| line.strip_prefix("directory ")).map(str::to_owned).collect()
        };
        let process = self.present[index].as_ref().expect("it runs");
        let before = answers(process).len();
        self.send_command(index, DIRECTORY);
        let process = self.present[index].as_ref().expect("it runs");
        until(&format!("{} prints its directory", PARTIES[index].0), || {
            answers(process).into_iter().nth(before)
        })
    }

    fn wait_until_up(&self, index: usize) {
        self.wait_for_word(index, UP);
    }

    /// Waits until a party has printed this word.
    fn wait_for_word(&self, index: usize, word: &str) {
        until(&format!("{} prints that it is {word}", PARTIES[index].0), || {
            self.present[index].as_ref()?.printed().1.iter().any(|line| line == word).then_some(())
        });
    }

    fn send_command(&mut self, index: usize, word: &str) {
        self.present[index].as_mut().expect("it runs").process.send_line(word);
    }

    /// Checks that no party has started without its requirements, and that no party has continued while one
    /// of the four is missing.
    fn check_who_waits(&mut self, present: &[usize]) {
        let may_start = who_may_start(present);
        let there: Vec<&str> = present.iter().map(|index| PARTIES[*index].0).collect();
        for index in present {
            let Some(process) = &self.present[*index] else { continue };
            let incarnation = process.printed().0.clone();
            let name = PARTIES[*index].0;
            if incarnation.started().is_some() != may_start.contains(index) {
                let has = if incarnation.started().is_some() { "has started" } else { "has not started" };
                self.violations.push(format!("{name} {has} when {there:?} are there"));
            }
            if passed(&incarnation).is_some() && present.len() < PARTIES.len() {
                self.violations.push(format!("{name} has gone on when {there:?} are there"));
            }
        }
    }

    /// Ends all processes and judges their records.
    #[must_use]
    pub fn judge(mut self) -> Verdict {
        for index in 0..PARTIES.len() {
            let Some(mut party) = self.present[index].take() else { continue };
            party.process.kill();
            let incarnation = party.printed().0.clone();
            self.former[index].push(incarnation);
        }
        let mut verdict = Verdict::of(&self.former);
        verdict.violations.splice(0..0, self.violations);
        verdict
    }
}

/// The parties with requirements that are met by others of these parties.
fn who_may_start(present: &[usize]) -> Vec<usize> {
    let mut start: Vec<usize> = Vec::new();
    let is_met = |start: &[usize], text: &&str| {
        let requirement: Requirement = text.parse().expect("they are written by us");
        start.iter().filter(|other| requirement.counts(PARTIES[**other].0)).count() >= requirement.count()
    };
    // Each round starts at least one more party, or is the last.
    for _ in present {
        let next: Vec<usize> = present
            .iter()
            .copied()
            .filter(|index| PARTIES[*index].1.iter().all(|text| is_met(&start, text)))
            .collect();
        start = next;
    }
    start
}

fn passed(incarnation: &Incarnation) -> Option<u64> {
    incarnation
        .events
        .iter()
        .rev()
        .find_map(|event| if let Event::Passed(_, generation) = event { Some(*generation) } else { None })
}

impl Party {
    fn printed(&self) -> MutexGuard<'_, (Incarnation, Vec<String>)> {
        lock(&self.printed)
    }
}
