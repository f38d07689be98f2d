//! Programs in surroundings that take something from them: a system call that the kernel does not have, a PID namespace of their own.

use std::{
    path::Path,
    process::{Command, Stdio},
};

/// Number of `pidfd_open` on every architecture.
pub const PIDFD_OPEN: u32 = 434;

/// Installs a seccomp filter that answers one system call with ENOSYS, then becomes the program of its arguments.
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

/// A command that runs `program` on a kernel without the system call of this number, its standard error on its standard output. `None`, with a
/// printed reason, where there is no Python.
#[must_use]
pub fn without_system_call(number: u32, program: &Path) -> Option<Command> {
    let mut python = Command::new("python3");
    python.args(["-c", WITHOUT_CALL, &number.to_string()]).arg(program);
    is_there(Command::new("python3").arg("--version")).then_some(python)
}

/// A command that runs `program` in a PID namespace of its own. `None`, with a printed reason, where none can be made.
#[must_use]
pub fn in_own_pid_namespace(program: &Path) -> Option<Command> {
    let unshare = || {
        let mut unshare = Command::new("unshare");
        unshare.args(["--pid", "--fork", "--kill-child", "--mount-proc"]);
        unshare
    };
    let mut command = unshare();
    command.arg(program);
    is_there(unshare().arg("true")).then_some(command)
}

fn is_there(trial: &mut Command) -> bool {
    let trial = trial.stdin(Stdio::null()).stdout(Stdio::null());
    let is_there = trial.status().is_ok_and(|status| status.success());
    if !is_there {
        println!("skipped: this does not work here: {trial:?}");
    }
    is_there
}
