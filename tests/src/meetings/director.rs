//! Starts the processes one after the other or all at once, keeps one back, kills them, and waits until they meet.

use std::{
    io::{BufRead, BufReader, Write},
    net::SocketAddrV4,
    path::Path,
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex, PoisonError},
};

use sinew::{Time, app::Requirement};

use super::{
    node::{COME, DIRECTORY, KEPT_BACK, STAY_AWAY, UP},
    verdict::{Event, Life, Verdict},
};
use crate::{own_group, until};

/// The parties, and what each requires before it starts: a name, any of two, so many of a pattern and a name.
pub const PARTIES: [(&str, &[&str]); 4] = [
    ("leg.hip", &[]),
    ("leg.knee", &["leg.hip"]),
    ("leg.ankle", &["leg.hip | leg.knee"]),
    ("central", &["3 of leg.*"]),
];

/// A process and what it has said.
#[derive(Debug)]
struct Process {
    child: Child,
    said: Arc<Mutex<(Life, Vec<String>)>>,
    reader: Option<std::thread::JoinHandle<()>>,
}

/// The four parties, with all their lives.
#[derive(Debug)]
pub struct Cast {
    group: SocketAddrV4,
    present: [Option<Process>; PARTIES.len()],
    former: Vec<Vec<Life>>,
    /// What was seen to be wrong before the judge reads everything.
    violations: Vec<String>,
}

/// Every order of four.
#[must_use]
pub fn permutations() -> Vec<[usize; PARTIES.len()]> {
    let all = (0..256).map(|number| [number >> 6 & 3, number >> 4 & 3, number >> 2 & 3, number & 3]);
    all.filter(|order| (0..4).all(|index| order.contains(&index))).collect()
}

impl Default for Cast {
    fn default() -> Self {
        Self::new()
    }
}

impl Cast {
    /// Nobody yet, on a network of its own.
    #[must_use]
    pub fn new() -> Self {
        Self {
            group: own_group(),
            present: [const { None }; PARTIES.len()],
            former: vec![Vec::new(); PARTIES.len()],
            violations: Vec::new(),
        }
    }

    /// All four, each started when those before it are up, know each other, and have started where they may; they have met once.
    ///
    /// # Panics
    /// If somebody is not there in time.
    #[must_use]
    pub fn one_by_one(program: &Path, order: [usize; PARTIES.len()]) -> Self {
        let mut cast = Self::new();
        for present in 1..=order.len() {
            let newcomer = order[present - 1];
            cast.start(program, newcomer);
            cast.wait_until_up(newcomer);
            cast.wait_for_one_directory();
            cast.check_who_waits(&order[..present]);
        }
        cast.wait_until_passed(0);
        cast
    }

    /// All four, started without a wait between; they have met once.
    ///
    /// # Panics
    /// If somebody is not there in time.
    #[must_use]
    pub fn at_once(program: &Path) -> Self {
        let mut cast = Self::new();
        (0..PARTIES.len()).for_each(|index| cast.start(program, index));
        cast.wait_until_passed(0);
        cast.wait_for_one_directory();
        cast
    }

    /// Starts a party's process: `program` with a role.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(&mut self, program: &Path, index: usize) {
        let mut command = Command::new(program);
        command.args(["--role", &index.to_string(), &self.group.to_string()]);
        let spawned = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child = spawned.unwrap_or_else(|error| panic!("{program:?} does not start: {error}"));
        let output = child.stdout.take().expect("its output is a pipe");
        let said = Arc::new(Mutex::new((Life::default(), Vec::new())));
        let noted = said.clone();
        let reader = std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let mut noted = noted.lock().unwrap_or_else(PoisonError::into_inner);
                match Event::read(&line) {
                    Some(event) => noted.0.events.push(event),
                    None => noted.1.push(line),
                }
            }
        });
        self.present[index] = Some(Process { child, said, reader: Some(reader) });
    }

    /// Kills a party's process, at once (`kill -9`), and keeps what it said.
    pub fn kill(&mut self, index: usize) {
        let Some(mut process) = self.present[index].take() else { return };
        let killed = Time::now().as_nanos();
        process.end();
        let mut life = process.said().0.clone();
        life.killed = Some(killed);
        self.former[index].push(life);
    }

    /// A party that waits is killed while another one keeps away; that one comes when everybody knows of the loss. Nobody may go on
    /// before the next life of the killed one, which the judge is to see. All four live afterwards, and meet.
    ///
    /// # Panics
    /// If somebody does not do in time what is waited for.
    pub fn kill_who_waits(&mut self, program: &Path, killed: usize, away: usize) {
        if let Some(process) = &self.present[away] {
            // What it said when it was told so before is no answer.
            process.said().1.clear();
        }
        self.tell(away, STAY_AWAY);
        self.wait_for_word(away, KEPT_BACK);
        let generation = self.generation();
        let waits = |process: &Process| {
            let life = &process.said().0;
            matches!(life.events.last(), Some(Event::Arrived(_)))
                && passed(life).unwrap_or_default() >= generation
        };
        until(&format!("{} waits for generation {}", PARTIES[killed].0, generation + 1), || {
            self.present[killed].as_ref().is_some_and(waits).then_some(())
        });
        self.kill(killed);
        // From then on it must not count.
        self.wait_until_unknown(killed);
        if let Some(life) = self.former[killed].last_mut() {
            life.unknown = Some(Time::now().as_nanos());
        }
        self.tell(away, COME);
        let arrived = |process: &Process| matches!(process.said().0.events.last(), Some(Event::Arrived(_)));
        until(&format!("{} has come", PARTIES[away].0), || {
            self.present[away].as_ref().is_some_and(arrived).then_some(())
        });
        self.start(program, killed);
        self.wait_until_passed(generation);
    }

    /// The highest generation that anybody has passed.
    #[must_use]
    pub fn generation(&self) -> u64 {
        let lives = self.present.iter().flatten().map(|process| process.said().0.clone());
        lives
            .filter_map(|life| passed(&life))
            .chain(self.former.iter().flatten().filter_map(passed))
            .max()
            .unwrap_or_default()
    }

    /// Waits until all four have passed a generation higher than this one.
    ///
    /// # Panics
    /// If they do not in time, with what each has said.
    pub fn wait_until_passed(&self, generation: u64) {
        for (index, process) in self.present.iter().enumerate() {
            let process = process.as_ref().expect("all four live");
            let what =
                || format!("{} passes more than {generation}: {:?}", PARTIES[index].0, process.said().1);
            until(&what(), || passed(&process.said().0).filter(|passed| *passed > generation));
        }
    }

    /// Waits until all who live say the same of who is there, and that those are ready whose requirements are met.
    ///
    /// # Panics
    /// If they do not in time.
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

    /// Waits until nobody who lives has this party in its directory.
    fn wait_until_unknown(&mut self, lost: usize) {
        let entry = format!("{}=", PARTIES[lost].0);
        let living: Vec<usize> = (0..PARTIES.len()).filter(|index| self.present[*index].is_some()).collect();
        for index in living {
            until(&format!("{} knows that {} is lost", PARTIES[index].0, PARTIES[lost].0), || {
                (!self.directory_of(index).split(' ').any(|known| known.starts_with(&entry))).then_some(())
            });
        }
    }

    /// What a party's node has of all, as it says when it is asked now.
    fn directory_of(&mut self, index: usize) -> String {
        let answers = |process: &Process| -> Vec<String> {
            let lines = &process.said().1;
            lines.iter().filter_map(|line| line.strip_prefix("directory ")).map(str::to_owned).collect()
        };
        let process = self.present[index].as_ref().expect("it lives");
        let before = answers(process).len();
        self.tell(index, DIRECTORY);
        let process = self.present[index].as_ref().expect("it lives");
        until(&format!("{} says its directory", PARTIES[index].0), || {
            answers(process).into_iter().nth(before)
        })
    }

    fn wait_until_up(&self, index: usize) {
        self.wait_for_word(index, UP);
    }

    /// Waits until a party has said this.
    fn wait_for_word(&self, index: usize, word: &str) {
        until(&format!("{} says that it is {word}", PARTIES[index].0), || {
            self.present[index].as_ref()?.said().1.iter().any(|line| line == word).then_some(())
        });
    }

    fn tell(&mut self, index: usize, word: &str) {
        let process = self.present[index].as_mut().expect("it lives");
        let told = process.child.stdin.as_mut().map(|input| writeln!(input, "{word}"));
        assert!(matches!(told, Some(Ok(()))), "{} cannot be told {word}: {told:?}", PARTIES[index].0);
    }

    /// Nobody has started whose requirements are not met yet, and as long as one of the four is missing nobody has gone on.
    fn check_who_waits(&mut self, present: &[usize]) {
        let may_start = who_may_start(present);
        let there: Vec<&str> = present.iter().map(|index| PARTIES[*index].0).collect();
        for index in present {
            let Some(process) = &self.present[*index] else { continue };
            let life = process.said().0.clone();
            let name = PARTIES[*index].0;
            if life.started().is_some() != may_start.contains(index) {
                let has = if life.started().is_some() { "has started" } else { "has not started" };
                self.violations.push(format!("{name} {has} when {there:?} are there"));
            }
            if passed(&life).is_some() && present.len() < PARTIES.len() {
                self.violations.push(format!("{name} has gone on when {there:?} are there"));
            }
        }
    }

    /// Ends all and judges what they wrote down.
    #[must_use]
    pub fn judge(mut self) -> Verdict {
        for index in 0..PARTIES.len() {
            let Some(mut process) = self.present[index].take() else { continue };
            process.end();
            let life = process.said().0.clone();
            self.former[index].push(life);
        }
        let mut verdict = Verdict::of(&self.former);
        verdict.violations.splice(0..0, self.violations);
        verdict
    }
}

/// Those of these whose requirements are met by others of these that start.
fn who_may_start(present: &[usize]) -> Vec<usize> {
    let mut start: Vec<usize> = Vec::new();
    let is_met = |start: &[usize], text: &&str| {
        let requirement: Requirement = text.parse().expect("they are written by us");
        start.iter().filter(|other| requirement.counts(PARTIES[**other].0)).count() >= requirement.count()
    };
    // Each round lets at least one more start, or was the last.
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

fn passed(life: &Life) -> Option<u64> {
    life.events
        .iter()
        .rev()
        .find_map(|event| if let Event::Passed(_, generation) = event { Some(*generation) } else { None })
}

impl Process {
    fn said(&self) -> std::sync::MutexGuard<'_, (Life, Vec<String>)> {
        self.said.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Kills it and reads its last words.
    fn end(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if let Some(reader) = self.reader.take() {
            reader.join().expect("it only reads");
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.end();
    }
}
