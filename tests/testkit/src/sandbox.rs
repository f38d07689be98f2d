//! Programs in a restricted environment: a missing system call, or a PID, time or user namespace of their own.

use std::process::{Command, Stdio};

/// Number of `pidfd_open` on every architecture.
pub const PIDFD_OPEN: u32 = 434;

/// Installs a seccomp filter that answers one system call with ENOSYS, then executes the program in its
/// arguments.
const WITHOUT_CALL: &str = r#"
import ctypes, os, struct, sys
ENOSYS, ALLOW, ERRNO = 38, 0x7fff0000, 0x00050000
code = [(0x20, 0, 0, 0), (0x15, 0, 1, int(sys.argv[1])), (0x06, 0, 0, ERRNO | ENOSYS), (0x06, 0, 0, ALLOW)]
text = b"".join(struct.pack("HBBI", *one) for one in code)
class Filter(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("code", ctypes.c_char_p)]
libc = ctypes.CDLL(None, use_errno=True)
if libc.prctl(38, 1, 0, 0, 0) or libc.prctl(22, 2, ctypes.byref(Filter(len(code), text)), 0, 0):
    sys.exit("no seccomp filter: " + os.strerror(ctypes.get_errno()))
os.dup2(1, 2)
os.execv(sys.argv[2], sys.argv[2:])
"#;

/// The same command after a line of shell, such as `ulimit -n 96`.
#[must_use]
pub fn after_shell(line: &str, command: &Command) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!(r#"{line} && exec "$0" "$@""#)]);
    append(shell, command)
}

/// Appends the program, its arguments and its environment variables.
fn append(mut outer: Command, command: &Command) -> Command {
    outer.arg(command.get_program()).args(command.get_args());
    outer.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    outer
}

/// The same command on a kernel without the system call of this number, with its standard error on its
/// standard output. `None`, with a printed reason, if there is no Python.
#[must_use]
pub fn without_system_call(number: u32, command: &Command) -> Option<Command> {
    let mut python = Command::new("python3");
    python.args(["-c", WITHOUT_CALL, &number.to_string()]);
    is_there(Command::new("python3").arg("--version")).then(|| append(python, command))
}

/// The same command in a PID namespace of its own. `None`, with a printed reason, if none can be created.
#[must_use]
pub fn in_own_pid_namespace(command: &Command) -> Option<Command> {
    unshared(&["--pid", "--fork", "--kill-child", "--mount-proc"], command)
}

/// The same command in a time namespace of its own: its monotonic clocks are ahead of the host's by these seconds.
/// `None`, with a printed reason, if none can be created.
#[must_use]
pub fn in_own_time_namespace(command: &Command, ahead_s: u64) -> Option<Command> {
    let clocks = [format!("--monotonic={ahead_s}"), format!("--boottime={ahead_s}")];
    unshared(&["--time", "--fork", "--kill-child", &clocks[0], &clocks[1]], command)
}

/// The same command as the user `user` of a user namespace that maps no other user. `None`, with a printed
/// reason, if none can be created.
#[must_use]
pub fn in_own_user_namespace(command: &Command, user: u32) -> Option<Command> {
    unshared(&["--user", &format!("--map-user={user}"), &format!("--map-group={user}")], command)
}

fn unshared(namespaces: &[&str], command: &Command) -> Option<Command> {
    let unshare = || {
        let mut unshare = Command::new("unshare");
        unshare.args(namespaces);
        unshare
    };
    is_there(unshare().arg("true")).then(|| append(unshare(), command))
}

fn is_there(trial: &mut Command) -> bool {
    let trial = trial.stdin(Stdio::null()).stdout(Stdio::null());
    let is_there = trial.status().is_ok_and(|status| status.success());
    if !is_there {
        println!("skipped: this does not work here: {trial:?}");
    }
    is_there
}
