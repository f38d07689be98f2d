//! The built program as its users run it: real processes, real time. No time is asserted of them.

mod faults;
mod output;
mod overload;
mod real_time;
mod secured;
mod sockets;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::sync_channel;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

const PROGRAM: &str = env!("CARGO_BIN_EXE_exoskeleton");
const DEADLINE: Duration = Duration::from_secs(600);

/// Where in a test's folder its nodes' sockets are: `sinew` looks there when the folder is its `XDG_RUNTIME_DIR`.
const SOCKETS: &str = "sinew";

/// A folder of this test's own. Its name is short: paths of sockets in it have 100 bytes at most.
fn folder(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("exo-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(folder.join(SOCKETS)).expect("a folder for this test");
    folder
}

/// Starts the program in the folder of a test. Its sockets are there too: in `/tmp` a test of `sinew` that runs
/// beside this one would find them. A leg at 1 kHz does not walk where compilers come first, so it comes before them,
/// as on a robot: by the priority of the thread that starts it, where that is granted.
fn start(folder: &Path, arguments: &[&str]) -> Child {
    start_in(folder, arguments, &[])
}

/// As [`start`], with these variables in its environment.
fn start_in(folder: &Path, arguments: &[&str], variables: &[(&str, &str)]) -> Child {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).current_dir(folder).env("TMPDIR", folder.join(SOCKETS));
    command.envs(variables.iter().copied());
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let started = std::thread::spawn(move || {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::RoundRobin);
        let priority = ThreadPriority::Crossplatform(1.try_into().expect("1 is one of 0 to 99"));
        // Not granted: then the machine had better be idle.
        let _ = set_thread_priority_and_policy(thread_native_id(), priority, policy);
        command.spawn().expect("the program that was just built starts")
    });
    started.join().expect("the program that was just built starts")
}

/// Runs `sinew`, which another package builds into the same directory, in the folder of a test.
fn sinew(folder: &Path, words: &[&str]) -> Output {
    let test = std::env::current_exe().expect("a test has a path");
    let program =
        test.parent().and_then(Path::parent).expect("it lies in deps/ of the profile's").join("sinew");
    assert!(program.exists(), "there is no {}; build it: cargo build -p sinew-cli", program.display());
    let mut command = Command::new(program);
    command.args(words).current_dir(folder).env("XDG_RUNTIME_DIR", folder).env_remove("SINEW_SOCKET");
    command.output().expect("the command starts")
}

/// Closes its standard input and waits for its end.
fn end(child: Child, what: &str) -> Output {
    let id = Pid::from_child(&child);
    let (say, heard) = sync_channel(1);
    std::thread::spawn(move || say.send(child.wait_with_output()));
    heard.recv_timeout(DEADLINE).map(|output| output.expect("its output")).unwrap_or_else(|_| {
        let _ = kill_process(id, Signal::KILL);
        panic!("{what} within {DEADLINE:?}");
    })
}

/// Held by a test whose robot walks: robots beside each other would only show that two CPUs are not enough for them.
fn alone() -> MutexGuard<'static, ()> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    // A test that failed has let its robot go.
    ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)
}
