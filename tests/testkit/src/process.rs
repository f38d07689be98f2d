//! A process of a scenario: started, observed line by line, signalled, ended.

use std::{
    io::{BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Child, ChildStdin, Command, ExitStatus, Stdio},
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    thread::JoinHandle,
    time::Instant,
};

use rustix::process::{Pid, Signal, kill_process};

use crate::{DEADLINE, until};

/// Maximum number of captured lines that were not read; a program that prints more blocks.
const LINES_MAX: usize = 10_000;

/// A running process, usually a node. It is killed on drop.
#[derive(Debug)]
pub struct NodeProcess {
    name: String,
    child: Child,
    input: Option<ChildStdin>,
    lines: Receiver<String>,
    reader: Option<JoinHandle<()>>,
    seen: Vec<String>,
    /// Lines not yet claimed by a wait, oldest first.
    unclaimed: Vec<String>,
}

/// The path of one of the workspace's programs: next to this one, or above it if this is a test.
///
/// # Panics
/// If the path of this process is unknown.
#[must_use]
pub fn program(name: &str) -> PathBuf {
    let this = std::env::current_exe().expect("a program has a path");
    let directory = this.parent().expect("it lies in a directory");
    let profile =
        if directory.ends_with("deps") { directory.parent().unwrap_or(directory) } else { directory };
    profile.join(name)
}

/// The numbers in a line of output, separated by blanks.
///
/// # Panics
/// If a word is no number.
#[must_use]
pub fn numbers(line: &str) -> Vec<u64> {
    let number = |word: &str| word.parse().unwrap_or_else(|_| panic!("{word:?} of {line:?} is no number"));
    line.split_whitespace().map(number).collect()
}

impl NodeProcess {
    /// Starts it, and captures its standard output line by line.
    ///
    /// # Panics
    /// If it cannot be started.
    #[must_use]
    pub fn start(name: &str, command: Command) -> Self {
        Self::start_with(name, command, |_| false)
    }

    /// Like [`start`](Self::start). Passes each complete line to `take` first, on a dedicated thread. A line
    /// for which `take` returns `true` is not captured.
    ///
    /// # Panics
    /// If it cannot be started.
    #[must_use]
    pub fn start_with(
        name: &str,
        mut command: Command,
        mut take: impl FnMut(&str) -> bool + Send + 'static,
    ) -> Self {
        let spawned = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child = spawned.unwrap_or_else(|error| panic!("{name} does not start: {error}"));
        let (input, output) = (child.stdin.take(), child.stdout.take().expect("its output is a pipe"));
        let (put, lines) = sync_channel(LINES_MAX);
        let reader = std::thread::spawn(move || {
            let (mut output, mut line) = (BufReader::new(output), String::new());
            while output.read_line(&mut line).is_ok_and(|length| length > 0) {
                // A line without an end was cut off by a kill.
                let is_taken = line.ends_with('\n') && take(line.trim_end_matches(['\n', '\r']));
                // The scenario may have ended.
                if !is_taken && put.send(line.trim_end_matches(['\n', '\r']).to_owned()).is_err() {
                    return;
                }
                line.clear();
            }
        });
        let (name, reader) = (name.to_owned(), Some(reader));
        Self { name, child, input, lines, reader, seen: Vec::new(), unclaimed: Vec::new() }
    }

    /// Waits for a line that contains all these words. Each line satisfies one wait; different lines may come
    /// in any order.
    ///
    /// # Panics
    /// If there is none in time, with the output so far.
    #[track_caller]
    pub fn wait_for(&mut self, words: &[&str]) -> String {
        let is_it = |line: &String| words.iter().all(|word| line.contains(word));
        if let Some(at) = self.unclaimed.iter().position(is_it) {
            return self.unclaimed.remove(at);
        }
        let end = Instant::now() + DEADLINE;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            let Ok(line) = self.lines.recv_timeout(left) else {
                panic!(
                    "{} printed no line with {words:?} within {DEADLINE:?}; its output:\n{}",
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

    /// Waits for the next line that starts with this word, and returns the rest of it.
    ///
    /// # Panics
    /// If there is none in time, or another line comes first.
    #[track_caller]
    pub fn expect(&mut self, word: &str) -> String {
        let line = self.wait_for(&[]);
        let rest = line.strip_prefix(word);
        rest.unwrap_or_else(|| panic!("{}: {line:?} instead of {word:?}", self.name)).trim().to_owned()
    }

    /// Sends a question, and returns the next line.
    ///
    /// # Panics
    /// If there is no answer in time.
    #[track_caller]
    pub fn ask(&mut self, question: &str) -> String {
        self.send_line(question);
        self.wait_for(&[])
    }

    /// Its captured output, as far as waits have read it.
    #[must_use]
    pub fn output(&self) -> &[String] {
        &self.seen
    }

    /// Reads and returns its captured output so far.
    pub fn poll_output(&mut self) -> &[String] {
        for line in self.lines.try_iter() {
            self.seen.push(line.clone());
            self.unclaimed.push(line);
        }
        &self.seen
    }

    /// The process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Writes a line to its standard input.
    ///
    /// # Panics
    /// If it has ended.
    pub fn send_line(&mut self, line: &str) {
        let input = self.input.as_mut().expect("its input is a pipe until it is stopped");
        writeln!(input, "{line}").unwrap_or_else(|error| panic!("{} does not read: {error}", self.name));
    }

    /// Sends it a signal.
    ///
    /// # Panics
    /// If the process no longer exists.
    pub fn signal(&self, signal: Signal) {
        let id = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).unwrap_or_else(|error| panic!("{} gets no {signal:?}: {error}", self.name));
    }

    /// Pauses it with SIGSTOP, and returns when all its threads stand still.
    ///
    /// # Panics
    /// If the process no longer exists.
    pub fn pause(&self) {
        self.signal(Signal::STOP);
        wait_until_paused(self.child.id());
    }

    /// Kills it, and returns when it has exited and its output was read completely. Returns whether it was
    /// alive until then.
    ///
    /// # Panics
    /// If the state of the process is unknown.
    pub fn kill(&mut self) -> bool {
        let was_alive = self.child.try_wait().expect("a child can be waited for").is_none();
        // The process may have exited already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.read_to_end();
        was_alive
    }

    /// Closes its standard input, and waits until it has exited and its output was read completely.
    ///
    /// # Panics
    /// If it does not exit in time.
    #[track_caller]
    pub fn stop(mut self) -> ExitStatus {
        drop(self.input.take());
        self.wait_for_status()
    }

    /// Waits until it has exited and its output was read completely. Returns its exit code, or `None` if a
    /// signal ended it.
    ///
    /// # Panics
    /// If it does not exit in time, with the output so far.
    #[track_caller]
    pub fn wait_for_exit(&mut self) -> Option<i32> {
        self.wait_for_status().code()
    }

    fn wait_for_status(&mut self) -> ExitStatus {
        let end = Instant::now() + DEADLINE;
        loop {
            // The end of its output precedes its exit.
            match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(line) => self.seen.push(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {
                    panic!(
                        "{} did not end within {DEADLINE:?}; its output:\n{}",
                        self.name,
                        self.seen.join("\n")
                    )
                }
            }
        }
        let (name, child) = (&self.name, &mut self.child);
        let exited = || child.try_wait().expect("a child can be waited for");
        let status = until(&format!("{name} exits"), exited);
        self.read_to_end();
        status
    }

    /// Reads the rest of the output of a process that has exited.
    fn read_to_end(&mut self) {
        self.seen.extend(self.lines.iter());
        if let Some(reader) = self.reader.take() {
            // The message of a panic is on the terminal.
            let _ = reader.join();
        }
    }
}

impl Drop for NodeProcess {
    fn drop(&mut self) {
        if std::thread::panicking() {
            // Its last lines may show the reason.
            let output = self.poll_output().join("\n");
            eprintln!("{} printed:\n{output}", self.name);
        }
        // The process may have exited already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until every thread of a process that was sent `SIGSTOP` stands still. Each thread takes the signal
/// at its own time, possibly after the call that sends it has returned.
///
/// # Panics
/// If they do not within [`DEADLINE`].
pub fn wait_until_paused(process: u32) {
    until("all its threads stand still", || is_paused(process).then_some(()));
}

fn is_paused(process: u32) -> bool {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).expect("the process exists");
    tasks.flatten().all(|task| is_in_state(&task.path(), 'T'))
}

/// Waits until a thread of this process, given by its kernel id, sleeps: its work before the wait is done.
///
/// # Panics
/// If it does not within [`DEADLINE`].
pub fn wait_until_asleep(thread: i32) {
    let task = Path::new("/proc/self/task").join(thread.to_string());
    until("the thread sleeps", || is_in_state(&task, 'S').then_some(()));
}

fn is_in_state(task: &Path, state: char) -> bool {
    let status = std::fs::read_to_string(task.join("stat")).unwrap_or_default();
    status.rsplit_once(')').is_some_and(|(_, rest)| rest.trim_start().starts_with(state))
}
