//! A program of a scenario: started, watched line by line, ended.

use std::{
    io::{BufRead, BufReader, Write},
    path::Path,
    process::{Child, Command, Stdio},
    sync::mpsc::{Receiver, sync_channel},
    time::Instant,
};

use rustix::process::{Pid, Signal, kill_process};

use crate::{DEADLINE, Host};

/// Lines that wait to be looked at, at most; a program that says more than this waits.
const LINES_MAX: usize = 10_000;

/// A running program. It is killed when this is dropped.
#[derive(Debug)]
pub struct Program {
    name: String,
    child: Child,
    lines: Receiver<String>,
    seen: Vec<String>,
    /// Lines that nobody has waited for yet, oldest first.
    unclaimed: Vec<String>,
}

/// The node of the scenarios, on `host` or on this one, with the configuration in `config`.
#[must_use]
pub fn node_under_test(host: Option<&Host>, config: &Path, arguments: &[&str]) -> Program {
    let path = program("node_under_test");
    let mut command = match host {
        Some(host) => host.command(&path),
        None => Command::new(&path),
    };
    command.arg(config).args(arguments);
    Program::start(&config.display().to_string(), command)
}

/// The node of the scenarios of applications in processes of their own, with the configuration in `config`. What it says
/// on its standard error is kept, too.
#[must_use]
pub fn process_under_test(config: &Path, arguments: &[&str]) -> Program {
    let mut command = Command::new("sh");
    command.args(["-c", r#"exec "$0" "$@" 2>&1"#]).arg(program("process_under_test"));
    command.arg(config).args(arguments);
    Program::start(&config.display().to_string(), command)
}

/// The path of one of this package's programs, which lies beside the tests' own directory.
///
/// # Panics
/// If this process has no path.
#[must_use]
pub fn program(name: &str) -> std::path::PathBuf {
    let test = std::env::current_exe().expect("a test has a path");
    let deps = test.parent().expect("it lies in a directory");
    deps.parent().expect("which lies in the profile's").join(name)
}

impl Program {
    /// Starts it; what it says on its standard output is kept line by line.
    ///
    /// # Panics
    /// If it cannot be started.
    #[must_use]
    pub fn start(name: &str, mut command: Command) -> Self {
        let spawned = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child = spawned.unwrap_or_else(|error| panic!("{name} does not start: {error}"));
        let output = child.stdout.take().expect("its output is a pipe");
        let (say, lines) = sync_channel(LINES_MAX);
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                if say.send(line).is_err() {
                    return;
                }
            }
        });
        Self { name: name.to_owned(), child, lines, seen: Vec::new(), unclaimed: Vec::new() }
    }

    /// Waits for a line that has all these words. Each line can be waited for once; different lines in any order.
    ///
    /// # Panics
    /// If none comes in time, with what it said instead.
    pub fn wait_for(&mut self, words: &[&str]) -> String {
        let is_it = |line: &String| words.iter().all(|word| line.contains(word));
        if let Some(at) = self.unclaimed.iter().position(is_it) {
            return self.unclaimed.remove(at);
        }
        let until = Instant::now() + DEADLINE;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let Ok(line) = self.lines.recv_timeout(left) else {
                panic!(
                    "{} did not say {words:?} within {DEADLINE:?}; it said:\n{}",
                    self.name,
                    self.seen.join("\n")
                );
            };
            self.seen.push(line.clone());
            if is_it(&line) {
                return line;
            }
            self.unclaimed.push(line);
        }
    }

    /// Looks at all that it has said so far.
    pub fn look(&mut self) -> &[String] {
        for line in self.lines.try_iter() {
            self.seen.push(line.clone());
            self.unclaimed.push(line);
        }
        &self.seen
    }

    /// What it has said so far, as far as it was looked at.
    #[must_use]
    pub fn said(&self) -> &[String] {
        &self.seen
    }

    /// Its process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Writes a line to its standard input.
    ///
    /// # Panics
    /// If it has ended.
    pub fn tell(&mut self, line: &str) {
        let input = self.child.stdin.as_mut().expect("its input is a pipe");
        writeln!(input, "{line}").unwrap_or_else(|error| panic!("{} does not listen: {error}", self.name));
    }

    /// Sends it a signal.
    ///
    /// # Panics
    /// If it is no process any more.
    pub fn signal(&self, signal: Signal) {
        let id = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).unwrap_or_else(|error| panic!("{} takes no {signal:?}: {error}", self.name));
    }

    /// Stops it, and returns when it stands still.
    ///
    /// # Panics
    /// If it is no process any more.
    pub fn freeze(&self) {
        self.signal(Signal::STOP);
        wait_until_frozen(self.child.id());
    }

    /// Waits for its end; returns its exit code, `None` if a signal ended it.
    ///
    /// # Panics
    /// If it does not end in time.
    pub fn wait_for_end(&mut self) -> Option<i32> {
        let until = Instant::now() + DEADLINE;
        loop {
            // Its last word is the end of its output.
            match self.lines.recv_timeout(until.saturating_duration_since(Instant::now())) {
                Ok(line) => self.seen.push(line),
                Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => break,
                Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {
                    panic!(
                        "{} did not end within {DEADLINE:?}; it said:\n{}",
                        self.name,
                        self.seen.join("\n")
                    )
                }
            }
        }
        self.child.wait().expect("a child can be waited for").code()
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        if std::thread::panicking() {
            // Its last lines may say why.
            self.seen.extend(self.lines.try_iter());
            eprintln!("{} said:\n{}", self.name, self.seen.join("\n"));
        }
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until every thread of a process that was sent `SIGSTOP` stands still: each takes the signal when it comes to it,
/// not before the call that sends it returns.
///
/// # Panics
/// If they do not within [`crate::DEADLINE`].
pub fn wait_until_frozen(process: u32) {
    crate::until("all its threads stand still", || is_frozen(process).then_some(()));
}

fn is_frozen(process: u32) -> bool {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).expect("it is there");
    tasks.flatten().all(|task| is_in_state(&task.path(), 'T'))
}

/// Waits until a thread of this process, by its kernel's id, sleeps: it has done what it does before it waits.
///
/// # Panics
/// If it does not within [`crate::DEADLINE`].
pub fn wait_until_asleep(thread: i32) {
    let task = Path::new("/proc/self/task").join(thread.to_string());
    crate::until("the thread sleeps", || is_in_state(&task, 'S').then_some(()));
}

fn is_in_state(task: &Path, state: char) -> bool {
    let status = std::fs::read_to_string(task.join("stat")).unwrap_or_default();
    status.rsplit_once(')').is_some_and(|(_, rest)| rest.trim_start().starts_with(state))
}
