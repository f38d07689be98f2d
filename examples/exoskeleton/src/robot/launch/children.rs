//! The processes of a run: started, watched, killed, stopped, by their ids and nobody else's.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::SyncSender;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use sinew::Time;

use super::LaunchError;
use sinew_hosts::{Carried, Weather};

use super::hosts::{Hosts, Link};
use crate::output;
use crate::part::Part;
use crate::robot::role::Role;
use crate::robot::topology::Topology;

/// Time that a process has for its orderly end.
const STOP_PATIENCE: Duration = Duration::from_secs(5);
const STOP_LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Lines of a log that are shown when its process died.
const LAST_WORDS: usize = 8;
/// The unit of CPU times in `/proc`; the same on every architecture that Linux shows to programs today.
const CLOCK_TICKS_PER_S: f64 = 100.0;

/// When it was looked, and the CPU seconds that each process had used.
pub(super) type CpuTimes = (Time, BTreeMap<&'static str, f64>);

/// Five processes at most, one of each role.
pub(super) struct Children {
    program: PathBuf,
    topology: PathBuf,
    folder: PathBuf,
    /// Those of the nodes, which are to go when they have ended.
    sockets: Vec<PathBuf>,
    /// None: all of them on this host.
    hosts: Option<Hosts>,
    running: BTreeMap<Role, Child>,
}

impl Children {
    /// None of them runs yet. `file` is where `topology` is written, for them to read.
    pub(super) fn new(
        topology: &Topology,
        file: PathBuf,
        folder: PathBuf,
        hosts: Option<Hosts>,
    ) -> io::Result<Self> {
        let program = std::env::current_exe()?;
        let sockets = Part::ALL.into_iter().filter_map(|part| topology.place(part).socket.clone()).collect();
        Ok(Self { program, topology: file, folder, sockets, hosts, running: BTreeMap::new() })
    }

    /// Starts a process. It stops when its standard input ends, which is when this process ends, however it does.
    pub(super) fn start(&mut self, role: Role, say_line: &SyncSender<String>) -> Result<(), LaunchError> {
        let log = File::options().create(true).append(true).open(self.log(role))?;
        let mut command = Command::new(&self.program);
        command.args(["node", role.name(), "--stop-with-stdin", "--topology"]).arg(&self.topology);
        command.arg("--run-dir").arg(&self.folder);
        let is_plant = role == Role::Plant;
        let stdout = if is_plant { Stdio::piped() } else { Stdio::null() };
        command.stdin(Stdio::piped()).stdout(stdout).stderr(log);
        let mut child = match &self.hosts {
            Some(hosts) => hosts.spawn(role, &mut command)?,
            None => command.spawn()?,
        };
        if let Some(out) = child.stdout.take() {
            let say_line = say_line.clone();
            std::thread::Builder::new().name("plant-lines".to_owned()).spawn(move || {
                // Ends with the plant. A launcher that does not listen any more is about to stop it.
                BufReader::new(out)
                    .lines()
                    .map_while(Result::ok)
                    .for_each(|line| drop(say_line.try_send(line)));
            })?;
        }
        self.running.insert(role, child);
        Ok(())
    }

    /// Whether all still run.
    pub(super) fn check(&mut self) -> Result<(), LaunchError> {
        for (role, child) in &mut self.running {
            if let Some(status) = child.try_wait()? {
                let (role, log) = (*role, self.folder.join(format!("{role}.log")));
                let text = fs::read_to_string(&log).unwrap_or_default();
                let lines: Vec<&str> = text.lines().collect();
                let words = lines[lines.len().saturating_sub(LAST_WORDS)..].join("\n");
                let log = log.display().to_string();
                return Err(LaunchError::Died { role, status: status.to_string(), log, words });
            }
        }
        Ok(())
    }

    /// Kills a process as a power cut would; returns when.
    pub(super) fn kill(&mut self, role: Role) -> Time {
        let at = Time::now();
        if let Some(mut child) = self.running.remove(&role) {
            // It may have ended by itself in this moment.
            let _ = child.kill();
            let _ = child.wait();
        }
        at
    }

    /// Cuts the host of a process off from the other nodes, or joins it again; returns when.
    ///
    /// # Errors
    /// All processes share this host, or its switch is gone.
    pub(super) fn set_link(&mut self, role: Role, link: Link) -> io::Result<Time> {
        let Some(hosts) = &mut self.hosts else {
            return Err(io::Error::other("all processes share this host: there is no link between them"));
        };
        let at = Time::now();
        hosts.set(role, link)?;
        Ok(at)
    }

    /// From now on this happens to what the nodes send each other; when, and what became of it before.
    ///
    /// # Errors
    /// The nodes are not on a radio.
    pub(super) fn set_weather(&self, weather: Weather) -> io::Result<(Time, Carried)> {
        let Some(hosts) = &self.hosts else {
            return Err(io::Error::other("all processes share this host: there is no network between them"));
        };
        let at = Time::now();
        Ok((at, hosts.set_weather(weather)?))
    }

    /// The processes that a process of the run has started itself: those of its node's applications.
    pub(super) fn children_of(&self, role: Role) -> Vec<Pid> {
        let Some(parent) = self.running.get(&role).map(Child::id) else { return Vec::new() };
        let Ok(entries) = fs::read_dir("/proc") else { return Vec::new() };
        let ids = entries.flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
        ids.filter(|id| parent_of(*id) == Some(parent)).filter_map(Pid::from_raw).collect()
    }

    /// CPU seconds used so far, by this process too.
    pub(super) fn cpu_times(&self) -> CpuTimes {
        let children = self.running.iter().map(|(role, child)| (role.name(), child.id()));
        let all = children.chain([("launcher", std::process::id())]);
        (Time::now(), all.filter_map(|(name, id)| Some((name, cpu_seconds(id)?))).collect())
    }

    /// Stops the nodes, then the plant. What does not end in time is killed. Their sockets go too.
    pub(super) fn stop(&mut self) {
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

/// Who ends in order takes its socket away; one that was killed leaves it, and no later run has its name.
fn remove_if_dead(socket: &Path) {
    // Where somebody listens it is another's, as of a run in another container with the same process id.
    if UnixStream::connect(socket).is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused) {
        // Somebody may have tidied up meanwhile.
        let _ = fs::remove_file(socket);
    }
}

/// From `/proc/PID/stat`: the fourth field.
fn parent_of(id: i32) -> Option<u32> {
    let text = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    text.rsplit_once(')')?.1.split_ascii_whitespace().nth(1)?.parse().ok()
}

/// From `/proc/PID/stat`: user and system time, the 14th and 15th fields; the second is the name, in parentheses.
fn cpu_seconds(id: u32) -> Option<f64> {
    let text = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    let after_name = text.rsplit_once(')')?.1;
    let mut fields = after_name.split_ascii_whitespace().skip(11);
    let ticks = |field: Option<&str>| field?.parse::<f64>().ok();
    Some((ticks(fields.next())? + ticks(fields.next())?) / CLOCK_TICKS_PER_S)
}

/// CPU time of the whole machine since its start, hundredths of a second of all its CPUs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct HostCpu {
    /// All of it, idle or not.
    pub(super) total: f64,
    /// Used by programs and the kernel.
    pub(super) busy: f64,
    /// Taken by the hypervisor, where it says so.
    pub(super) stolen: f64,
}

impl HostCpu {
    /// As `/proc/stat` has it now.
    pub(super) fn now() -> Option<Self> {
        Self::parse(&fs::read_to_string("/proc/stat").ok()?)
    }

    /// user, nice, system, idle, iowait, irq, softirq, steal.
    fn parse(text: &str) -> Option<Self> {
        let fields = text.lines().next()?.strip_prefix("cpu ")?.split_ascii_whitespace();
        let ticks: Vec<f64> = fields.take(8).map_while(|field| field.parse().ok()).collect();
        let [user, nice, system, idle, iowait, irq, softirq, stolen] = ticks.try_into().ok()?;
        let busy = user + nice + system + irq + softirq;
        Some(Self { total: busy + idle + iowait + stolen, busy, stolen })
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn cpu_time_of_a_process_is_read() {
        assert!(cpu_seconds(std::process::id()).is_some_and(|seconds| seconds < 10_000.0));
        assert_eq!(cpu_seconds(u32::MAX), None);
    }

    #[test]
    fn cpu_time_of_the_machine_is_read() {
        let text = "cpu  1 2 3 40 5 6 7 8 9 10\ncpu0 1 2 3\n";
        assert_eq!(HostCpu::parse(text), Some(HostCpu { total: 72.0, busy: 19.0, stolen: 8.0 }));
        assert_eq!(HostCpu::parse("intr 1"), None);
        assert!(HostCpu::now().is_some_and(|cpu| cpu.total > 0.0));
    }

    #[test]
    fn socket_of_a_killed_node_goes_and_one_where_somebody_listens_stays() {
        // Given: a socket that somebody listens at, and one whose listener ended without a word
        let id = std::process::id();
        let [dead, living] =
            ["dead", "living"].map(|name| std::env::temp_dir().join(format!("exo-{name}-{id}.s")));
        drop(UnixListener::bind(&dead).unwrap());
        let listener = UnixListener::bind(&living).unwrap();
        assert!(dead.exists() && living.exists());
        // When
        remove_if_dead(&dead);
        remove_if_dead(&living);
        // Then
        assert!(!dead.exists() && living.exists());
        drop(listener);
        remove_if_dead(&living);
        assert!(!living.exists());
    }
}
