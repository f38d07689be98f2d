//! What mends a system call that has failed: each error has a remedy of its own.

use std::io;

use rustix::io::Errno;

/// What was asked of the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// A descriptor: a socket, a pipe, a timer, an epoll instance.
    Descriptor,
    /// A thread.
    Thread,
    /// A thread with a runtime, which has descriptors.
    Reactor,
    /// A process.
    Process,
}

/// The remedy for `error`.
#[must_use]
pub fn remedy(wanted: Wanted, error: &io::Error) -> &'static str {
    let Some(errno) = Errno::from_io_error(error) else { return "see the error" };
    match errno {
        Errno::MFILE => "raise `ulimit -n`",
        Errno::NFILE => "the host has no descriptor left: raise the sysctl `fs.file-max`",
        Errno::NOMEM => "memory is short: see the limits of the container or cgroup, and `ulimit -v`",
        Errno::AGAIN if wanted != Wanted::Descriptor => {
            "raise `ulimit -u`, or `pids.max` of the container or cgroup"
        }
        Errno::NOSYS => {
            "this kernel does not have the call, or a seccomp filter hides it: Sinew needs Linux 5.4 or newer, and a seccomp profile that \
             allows the call; `sinew doctor` says which"
        }
        Errno::PERM | Errno::ACCESS => {
            "the system forbids it: see the seccomp profile, the rights of the user, and SELinux or AppArmor"
        }
        Errno::NOENT => "something that it needs is not there: is /proc mounted?",
        _ => "see the error",
    }
}

/// Whether the same call fails again until this program is started elsewhere: a retry is of no use.
#[must_use]
pub fn is_permanent(error: &io::Error) -> bool {
    matches!(
        Errno::from_io_error(error),
        Some(Errno::NOSYS | Errno::PERM | Errno::ACCESS | Errno::INVAL | Errno::OPNOTSUPP)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(wanted: Wanted, errno: Errno) -> &'static str {
        remedy(wanted, &errno.into())
    }

    #[test]
    fn only_a_lack_of_descriptors_is_mended_by_the_limit_of_open_files() {
        for wanted in [Wanted::Descriptor, Wanted::Thread, Wanted::Reactor, Wanted::Process] {
            assert!(of(wanted, Errno::MFILE).contains("ulimit -n"));
            for errno in [
                Errno::NFILE,
                Errno::NOMEM,
                Errno::AGAIN,
                Errno::NOSYS,
                Errno::PERM,
                Errno::ACCESS,
                Errno::NOENT,
            ] {
                assert!(!of(wanted, errno).contains("ulimit -n"), "{wanted:?} {errno:?}");
            }
        }
        assert!(of(Wanted::Thread, Errno::AGAIN).contains("ulimit -u"));
        assert!(of(Wanted::Process, Errno::NOSYS).contains("Linux 5.4"));
    }

    #[test]
    fn a_missing_call_is_permanent_and_a_short_resource_is_not() {
        let is = |errno: Errno| is_permanent(&errno.into());
        assert!(is(Errno::NOSYS) && is(Errno::PERM));
        assert!(!is(Errno::MFILE) && !is(Errno::NOMEM) && !is(Errno::AGAIN));
    }
}
