//! Starts the processes, kills them, and waits until they meet.

use std::{
    io::{BufRead, BufReader, Write},
    net::SocketAddrV4,
    path::Path,
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex, PoisonError},
};

use sinew::Time;

use super::verdict::{Event, Life, Verdict};
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
        Self { group: own_group(), present: [const { None }; 4], former: vec![Vec::new(); PARTIES.len()] }
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

    /// Waits until all four say the same of who is there, and that all are ready.
    ///
    /// # Panics
    /// If they do not in time.
    pub fn wait_for_one_directory(&mut self) {
        let mut names = PARTIES.map(|(name, _)| name);
        names.sort_unstable();
        let expected = names.map(|name| format!("{name}=true")).join(" ");
        for process in self.present.iter_mut().flatten() {
            until(&format!("the directory is {expected}"), || {
                process.child.stdin.as_mut().and_then(|input| writeln!(input, "directory").ok())?;
                let said = process.said();
                let last = said.1.iter().rev().find_map(|line| line.strip_prefix("directory "))?;
                (last == expected).then_some(())
            });
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
        Verdict::of(&self.former)
    }
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
