//! Starts the process of a node, which outlives this program.
//!
//! This program starts itself once more. The new process leaves the session of its caller, takes the limits of the
//! node, and then becomes the node's program, with the same process id. Until then it holds a pipe, by which it
//! reports a failure. The pipe closes when the program is executed.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Read as _, Write as _},
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, ExitCode, Stdio},
};

use rustix::{
    io::fcntl_dupfd_cloexec,
    process::{Resource, Rlimit, getrlimit, setpriority_process, setrlimit, setsid},
    thread::{CpuSet, sched_setaffinity},
};
use serde::{Deserialize, Serialize};

use super::super::{order::NodeOrder, robot::Limits};

/// The option by which this program becomes the program of a node.
pub(super) const LAUNCH: &str = "--launch";
/// Longest order, and longest report, in bytes.
const ORDER_BYTES_MAX: u64 = 1 << 20;
const REPORT_BYTES_MAX: u64 = 4 << 10;
/// The first number of a descriptor that is no standard stream.
const FIRST_DESCRIPTOR: i32 = 3;
/// Variables that reach the program from the environment of the caller.
const KEPT_VARIABLES: [&str; 7] = ["PATH", "HOME", "USER", "LOGNAME", "LANG", "TZ", "XDG_RUNTIME_DIR"];

/// The process that is to become a node.
#[derive(Debug, Serialize, Deserialize)]
struct Launch {
    folder: PathBuf,
    program: PathBuf,
    arguments: Vec<String>,
    environment: BTreeMap<String, String>,
    limits: Limits,
}

/// Starts the program of a node in its folder. Returns once the program is executed.
///
/// # Errors
/// The process could not take its limits, or the system cannot execute the program.
pub(super) fn start(order: &NodeOrder, program: &Path, folder: &Path, log: File) -> Result<Child, String> {
    let launch = Launch {
        folder: folder.to_owned(),
        program: program.to_owned(),
        arguments: order.arguments.clone(),
        environment: order.environment.clone(),
        limits: order.limits.clone(),
    };
    let failed = |error: io::Error| format!("{} cannot be started: {error}", program.display());
    let own = std::env::current_exe().map_err(failed)?;
    let mut command = Command::new(own);
    command.args(["host", LAUNCH]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log);
    let mut child = command.spawn().map_err(failed)?;
    let report = report_of(&mut child, &launch).map_err(failed)?;
    if report.is_empty() {
        return Ok(child);
    }
    // It ends now, as it has reported.
    let _ = child.wait();
    Err(format!("{}: {report}", program.display()))
}

/// Sends the order to the new process, and returns its report: an empty one after its program was executed.
fn report_of(child: &mut Child, launch: &Launch) -> io::Result<String> {
    let (input, output) = (child.stdin.take(), child.stdout.take());
    let (Some(mut input), Some(output)) = (input, output) else {
        return Err(io::Error::other("the new process has no pipes"));
    };
    input.write_all(&serde_json::to_vec(launch)?)?;
    drop(input);
    let mut report = String::new();
    output.take(REPORT_BYTES_MAX).read_to_string(&mut report)?;
    Ok(report)
}

/// Becomes the program of a node, by the order on standard input. Returns only if that fails.
pub(super) fn launched() -> ExitCode {
    let pipe = fcntl_dupfd_cloexec(io::stdout(), FIRST_DESCRIPTOR);
    let Ok(pipe) = pipe else { return ExitCode::FAILURE };
    let why = become_program();
    // The caller may have ended.
    let _ = File::from(pipe).write_all(why.as_bytes());
    ExitCode::FAILURE
}

/// Returns why this process is still this program.
fn become_program() -> String {
    let launch: Launch = match serde_json::from_reader(io::stdin().take(ORDER_BYTES_MAX)) {
        Ok(launch) => launch,
        Err(error) => {
            return format!("the order is not readable: {error}; both programs have to be of one version");
        }
    };
    if let Err(why) = take_limits(&launch.limits) {
        return why;
    }
    // Standard error is the log already.
    let log = fcntl_dupfd_cloexec(io::stderr(), FIRST_DESCRIPTOR);
    let log = match log {
        Ok(log) => log,
        Err(error) => return format!("the log cannot be used: {error}; raise `ulimit -n`"),
    };
    let kept = KEPT_VARIABLES.iter().filter_map(|name| Some((name, std::env::var_os(name)?)));
    let mut command = Command::new(&launch.program);
    command.args(&launch.arguments).current_dir(&launch.folder).stdin(Stdio::null()).stdout(log);
    command.env_clear().envs(kept).envs(&launch.environment);
    let error = command.exec();
    let remedy = match error.raw_os_error().map(rustix::io::Errno::from_raw_os_error) {
        Some(rustix::io::Errno::NOEXEC) => "; it is of another processor or system: build it for this host",
        Some(rustix::io::Errno::NOENT) => "; is it there, and the interpreter or loader that it names?",
        Some(_) | None => "",
    };
    format!("it cannot be executed: {error}{remedy}")
}

fn take_limits(limits: &Limits) -> Result<(), String> {
    // The session of the caller may end, by which its processes get SIGHUP.
    setsid().map_err(|error| format!("no session of its own: {error}"))?;
    let Limits { realtime_priority_max, lock_memory, nice, cpus } = limits;
    if *realtime_priority_max > 0 {
        raise(Resource::Rtprio, Some((*realtime_priority_max).into()), "realtime_priority_max")?;
    }
    if *lock_memory {
        raise(Resource::Memlock, None, "lock_memory")?;
    }
    if *nice != 0 {
        setpriority_process(None, (*nice).into()).map_err(|error| {
            format!("nice = {nice} is not permitted: {error}; run as root, or raise `nice` in /etc/security/limits.d")
        })?;
    }
    if !cpus.is_empty() {
        let mut set = CpuSet::new();
        cpus.iter().for_each(|cpu| set.set((*cpu).into()));
        sched_setaffinity(None, &set).map_err(|error| {
            format!("cpus = {cpus:?} is not possible: {error}; `nproc` counts those of this host")
        })?;
    }
    Ok(())
}

/// Raises a limit, if it is lower. `None` is no limit.
fn raise(resource: Resource, wanted: Option<u64>, key: &str) -> Result<(), String> {
    let now = getrlimit(resource);
    let is_enough = |has: Option<u64>| has.is_none_or(|has| wanted.is_some_and(|wanted| has >= wanted));
    if is_enough(now.current) {
        return Ok(());
    }
    let maximum = if is_enough(now.maximum) { now.maximum } else { wanted };
    setrlimit(resource, Rlimit { current: wanted, maximum }).map_err(|error| {
        let hard = now.maximum.unwrap_or(u64::MAX);
        format!(
            "{key} is not permitted: {error}; the hard limit of this user is {hard}: raise it in /etc/security/limits.d, \
             or run as root"
        )
    })
}
