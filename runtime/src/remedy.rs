//! Remedies for failed system calls: each error has its own.

use std::{borrow::Cow, io};

use rustix::io::Errno;

/// The resource that was requested from the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted<'a> {
    /// A descriptor: a socket, a pipe, a timer, an epoll instance.
    Descriptor,
    /// A thread.
    Thread,
    /// A thread with a runtime, which has descriptors.
    Reactor,
    /// A process.
    Process,
    /// A socket bound to an address of `ndl.interface`, with the port of this configuration key.
    Port(&'a str),
}

/// Returns the remedy for `error`.
#[must_use]
pub fn remedy(wanted: Wanted<'_>, error: &io::Error) -> Cow<'static, str> {
    let errno = Errno::from_io_error(error);
    if let Wanted::Port(key) = wanted
        && let Some(remedy) = remedy_of_port(key, errno)
    {
        return remedy;
    }
    let Some(errno) = errno else { return "see the error".into() };
    let remedy = match errno {
        Errno::MFILE => {
            "this process has no file descriptor left: raise its limit (`ulimit -n`, `LimitNOFILE=` of systemd)"
        }
        Errno::NFILE => "this host has no file descriptor left: raise `sysctl fs.file-max`",
        Errno::NOMEM | Errno::NOBUFS => {
            "memory is short: see the limits of the container or cgroup (`MemoryMax=` of systemd), and `ulimit -v`"
        }
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
    };
    remedy.into()
}

/// Returns the remedy for an error that only a bound socket has; `None` if any descriptor can have it.
fn remedy_of_port(key: &str, errno: Option<Errno>) -> Option<Cow<'static, str>> {
    Some(match errno {
        Some(Errno::ADDRINUSE) => format!(
            "is another node using this port? Set `{key}` to a free one (0 takes any); `ss -tulpn` lists the programs and their ports"
        )
        .into(),
        Some(Errno::ADDRNOTAVAIL) => {
            "this host does not have this address: give it to an interface (`ip address add`), or set `ndl.interface` to an address or an \
             interface of this host"
                .into()
        }
        Some(Errno::ACCESS | Errno::PERM) => format!(
            "this process may not use this port: set `{key}` to 1024 or above (0 takes any free one), or grant CAP_NET_BIND_SERVICE"
        )
        .into(),
        Some(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT) => {
            "this kernel does not have the address family: choose addresses of the other one in `ndl.interface` (/ipv4 or /ipv6 behind a name)"
                .into()
        }
        Some(Errno::NODEV | Errno::NXIO) => {
            "the interface is not there: `ip link` lists those of this host; set `ndl.interface` to one of them".into()
        }
        Some(Errno::MFILE | Errno::NFILE | Errno::NOMEM | Errno::NOBUFS | Errno::AGAIN | Errno::NOSYS) => return None,
        // For any other error only the origin of the address and of the port is known.
        Some(_) | None => format!("the address comes from `ndl.interface`, and the port from `{key}`").into(),
    })
}

/// Returns whether this host lacks the address of a socket: it may get it later.
#[must_use]
pub fn may_come_later(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::AddrNotAvailable
}

/// Returns whether the same call fails again until this program is started elsewhere: a retry is useless.
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

    fn of(wanted: Wanted<'_>, errno: Errno) -> Cow<'static, str> {
        remedy(wanted, &errno.into())
    }

    #[test]
    fn only_descriptor_shortage_has_the_open_files_remedy() {
        let port = Wanted::Port("ndl.port");
        for wanted in [Wanted::Descriptor, Wanted::Thread, Wanted::Reactor, Wanted::Process, port] {
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
    fn each_bind_error_has_its_own_remedy() {
        for (errno, word) in [
            (Errno::ADDRINUSE, "another node using this port? Set `ndl.port`"),
            (Errno::ADDRNOTAVAIL, "does not have this address"),
            (Errno::MFILE, "`ulimit -n`"),
            (Errno::NFILE, "`sysctl fs.file-max`"),
            (Errno::ACCESS, "`ndl.port` to 1024"),
            (Errno::AFNOSUPPORT, "address family"),
            (Errno::NODEV, "`ip link`"),
            (Errno::NOBUFS, "memory"),
            (Errno::INVAL, "`ndl.interface`"),
        ] {
            let remedy = of(Wanted::Port("ndl.port"), errno);
            assert!(remedy.contains(word), "{errno}: {remedy}");
            assert_eq!(remedy.contains("another node"), errno == Errno::ADDRINUSE, "{errno}: {remedy}");
        }
    }

    #[test]
    fn missing_call_is_permanent_and_shortage_is_not() {
        let is = |errno: Errno| is_permanent(&errno.into());
        assert!(is(Errno::NOSYS) && is(Errno::PERM));
        assert!(!is(Errno::MFILE) && !is(Errno::NOMEM) && !is(Errno::AGAIN));
    }
}
