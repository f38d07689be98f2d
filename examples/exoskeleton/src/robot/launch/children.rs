//! The processes of a run: started, watched, killed and stopped, only by their own process IDs.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::SyncSender;
use std::time::Duration;

use exoskeleton_model::part::Part;
use rustix::process::{Pid, Signal, kill_process};
use sinew::Time;
use sinew_figures::stalls::{CpuTimes, process_seconds};

use super::LaunchError;
use crate::output;
use crate::robot::role::Role;
use crate::robot::topology::Topology;

/// Time limit for a process to stop in order.
const STOP_PATIENCE: Duration = Duration::from_secs(5);
const STOP_LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Lines of a log that are shown when its process died.
const LAST_LINES: usize = 8;

/// Five processes at most, one of each role.
#[derive(Debug)]
pub struct Children {
    program: PathBuf,
    topology: PathBuf,
    folder: PathBuf,
    /// Sockets of the nodes, to remove when they have ended.
    sockets: Vec<PathBuf>,
    running: BTreeMap<Role, Child>,
}

impl Children {
    /// Creates an empty set. `file` is the path where `topology` is written for the processes.
    ///
    /// # Errors
    /// The path of this program is unknown.
    pub fn new(topology: &Topology, file: PathBuf, folder: PathBuf) -> io::Result<Self> {
        let program = std::env::current_exe()?;
        let sockets = Part::ALL.into_iter().filter_map(|part| topology.place(part).socket.clone()).collect();
        Ok(Self { program, topology: file, folder, sockets, running: BTreeMap::new() })
    }

    /// Starts a process by `spawn`: this program's command `node`. It stops when its standard input ends,
    /// which is when this process ends for any reason.
    ///
    /// # Errors
    /// The system cannot start it, or cannot open its log.
    pub fn start(
        &mut self,
        role: Role,
        line_sender: &SyncSender<String>,
        spawn: impl FnOnce(&mut Command) -> io::Result<Child>,
    ) -> io::Result<()> {
        let log = File::options().create(true).append(true).open(self.log(role))?;
        let mut command = Command::new(&self.program);
        command.args(["node", role.name(), "--stop-with-stdin", "--topology"]).arg(&self.topology);
        command.arg("--run-dir").arg(&self.folder);
        let is_plant = role == Role::Plant;
        let stdout = if is_plant { Stdio::piped() } else { Stdio::null() };
        command.stdin(Stdio::piped()).stdout(stdout).stderr(log);
        let mut child = spawn(&mut command)?;
        if let Some(out) = child.stdout.take() {
            let line_sender = line_sender.clone();
            std::thread::Builder::new().name("plant-lines".to_owned()).spawn(move || {
                // Ends with the plant. A launcher that has closed the channel is about to stop the plant.
                BufReader::new(out)
                    .lines()
                    .map_while(Result::ok)
                    .for_each(|line| drop(line_sender.try_send(line)));
            })?;
        }
        self.running.insert(role, child);
        Ok(())
    }

    /// Checks that all of them still run.
    ///
    /// # Errors
    /// One has ended.
    pub fn check(&mut self) -> Result<(), LaunchError> {
        for (role, child) in &mut self.running {
            if let Some(status) = child.try_wait()? {
                let (role, log) = (*role, self.folder.join(format!("{role}.log")));
                let text = fs::read_to_string(&log).unwrap_or_default();
                let lines: Vec<&str> = text.lines().collect();
                let lines = lines[lines.len().saturating_sub(LAST_LINES)..].join("\n");
                let log = log.display().to_string();
                return Err(LaunchError::Died { role, status: status.to_string(), log, lines });
            }
        }
        Ok(())
    }

    /// Kills a process as a power cut would; returns the time.
    pub fn kill(&mut self, role: Role) -> Time {
        let at = Time::now();
        if let Some(mut child) = self.running.remove(&role) {
            // It may have ended by itself in this moment.
            let _ = child.kill();
            let _ = child.wait();
        }
        at
    }

    /// The ID of a process, if it runs.
    #[must_use]
    pub fn process_id(&self, role: Role) -> Option<u32> {
        self.running.get(&role).map(Child::id)
    }

    /// CPU seconds used so far, including this process.
    pub(super) fn cpu_times(&self) -> CpuTimes {
        let children = self.running.iter().map(|(role, child)| (role.name(), child.id()));
        let all = children.chain([("launcher", std::process::id())]);
        (Time::now().as_nanos(), all.filter_map(|(name, id)| Some((name, process_seconds(id)?))).collect())
    }

    /// Stops the nodes, then the plant. Kills those that do not end in time, and removes their sockets.
    pub fn stop(&mut self) {
        let plant = self.running.remove(&Role::Plant);
        let mut nodes: Vec<Child> = std::mem::take(&mut self.running).into_values().collect();
        stop_all(&mut nodes);
        stop_all(&mut plant.into_iter().collect::<Vec<_>>());
        self.sockets.iter().for_each(|socket| remove_if_dead(socket));
    }

    fn log(&self, role: Role) -> PathBuf {
        self.folder.join(format!("{role}.log"))
    }
}

impl Drop for Children {
    fn drop(&mut self) {
        self.stop();
    }
}

fn stop_all(children: &mut Vec<Child>) {
    for child in children.iter() {
        // It may have ended by itself.
        let _ = kill_process(Pid::from_child(child), Signal::TERM);
    }
    let deadline = Time::now() + STOP_PATIENCE;
    while !children.is_empty() && Time::now() < deadline {
        children.retain_mut(|child| matches!(child.try_wait(), Ok(None)));
        std::thread::sleep(STOP_LOOK_PERIOD);
    }
    for child in children.iter_mut() {
        let id = child.id();
        output::note(format_args!("process {id} did not end within {STOP_PATIENCE:?}; it is killed"));
        let _ = child.kill();
        let _ = child.wait();
    }
    children.clear();
}

/// Removes the socket of a killed node. A node that ends in order does so itself; no later run has the same
/// name.
fn remove_if_dead(socket: &Path) {
    // If a process listens there, it is another's, as of a run in another container with the same process ID.
    if UnixStream::connect(socket).is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused) {
        // Another process may have removed it meanwhile.
        let _ = fs::remove_file(socket);
    }
}

#[cfg(test)]
#[path = "../../../tests/unit/children.rs"]
mod tests;
