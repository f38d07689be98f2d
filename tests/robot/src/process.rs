//! A program of the robot in a test: a folder of its own, priority over compilers, a deadline.

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

/// Time for a program to end.
pub const DEADLINE: Duration = Duration::from_secs(600);

/// Folder of the nodes' sockets in a test's folder: `sinew` searches there when the folder is its
/// `XDG_RUNTIME_DIR`.
pub const SOCKETS: &str = "sinew";

/// Creates a folder for this test. Its name is short: paths of sockets in it have at most 100 bytes.
///
/// # Panics
/// The folder cannot be created.
#[must_use]
pub fn folder(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("exo-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(folder.join(SOCKETS)).expect("a folder for this test");
    folder
}

/// Starts a program in the folder of a test, with these variables in its environment. Its sockets are there,
/// too: in `/tmp` a test of `sinew` that runs beside this one would find them. A leg at 1 kHz does not walk
/// behind compilers, so it has priority over them, as on a robot: by the priority of the thread that starts
/// it, if that is granted.
///
/// # Panics
/// The program does not start.
#[must_use]
pub fn start(program: &str, folder: &Path, arguments: &[&str], variables: &[(&str, &str)]) -> Child {
    let mut command = Command::new(program);
    command.args(arguments).current_dir(folder).env("TMPDIR", folder.join(SOCKETS));
    command.envs(variables.iter().copied());
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let started = std::thread::spawn(move || {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::RoundRobin);
        let priority = ThreadPriority::Crossplatform(1.try_into().expect("1 is one of 0 to 99"));
        // Not granted: then the machine has to be idle.
        let _ = set_thread_priority_and_policy(thread_native_id(), priority, policy);
        command.spawn().expect("the program that was just built starts")
    });
    started.join().expect("the program that was just built starts")
}

/// Closes the child's standard input and waits for its end.
///
/// # Panics
/// It does not end within [`DEADLINE`].
#[must_use]
pub fn end(child: Child, what: &str) -> Output {
    let id = Pid::from_child(&child);
    let (sender, receiver) = sync_channel(1);
    std::thread::spawn(move || sender.send(child.wait_with_output()));
    receiver.recv_timeout(DEADLINE).map(|output| output.expect("its output")).unwrap_or_else(|_| {
        let _ = kill_process(id, Signal::KILL);
        panic!("{what} within {DEADLINE:?}");
    })
}

/// Held by a test with a walking robot: parallel robots would only show that two CPUs are not enough for
/// them.
pub fn alone() -> MutexGuard<'static, ()> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    // A test that failed has released its robot.
    ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)
}
