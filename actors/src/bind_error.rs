//! The remedy for a socket that cannot be bound: it fits the error, and names the keys of the configuration.

use std::io;

use rustix::io::Errno;

/// The remedy for `error`, where the port comes from the key `port_key` and the address from `ndl.interface`.
pub(crate) fn remedy(error: &io::Error, port_key: &str) -> String {
    match Errno::from_io_error(error) {
        Some(Errno::ADDRINUSE) => format!(
            "is another node using this port? Set `{port_key}` to a free one (0 takes any); `ss -tulpn` lists the programs and their ports"
        ),
        Some(Errno::ADDRNOTAVAIL) => {
            "this host does not have this address: give it to an interface (`ip address add`), or set `ndl.interface` to an address or an \
             interface of this host"
                .to_owned()
        }
        Some(Errno::MFILE) => {
            "this process has no file descriptor left: raise its limit (`ulimit -n`, `LimitNOFILE=` of systemd)".to_owned()
        }
        Some(Errno::NFILE) => "this host has no file descriptor left: raise `sysctl fs.file-max`".to_owned(),
        Some(Errno::NOBUFS | Errno::NOMEM) => {
            "the kernel has no memory for a further socket: end other programs, or give this one more memory (`MemoryMax=` of systemd)".to_owned()
        }
        Some(Errno::ACCESS | Errno::PERM) => format!(
            "this process may not use this port: set `{port_key}` to 1024 or above (0 takes any free one), or grant CAP_NET_BIND_SERVICE"
        ),
        Some(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT) => {
            "this kernel does not have the address family: choose addresses of the other one in `ndl.interface` (/ipv4 or /ipv6 behind a name)"
                .to_owned()
        }
        Some(Errno::NODEV | Errno::NXIO) => {
            "the interface is not there: `ip link` lists those of this host; set `ndl.interface` to one of them".to_owned()
        }
        // Of an error that nobody foresaw nothing better is known than where the address and the port come from.
        Some(_) | None => format!("the address comes from `ndl.interface`, and the port from `{port_key}`"),
    }
}

/// Whether this host does not have the address: it may have it later.
pub(crate) fn may_come_later(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::AddrNotAvailable
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_error_has_a_remedy_of_its_own() {
        let remedy = |errno: Errno| remedy(&errno.into(), "ndl.port");
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
            let said = remedy(errno);
            assert!(said.contains(word), "{errno}: {said}");
            assert_eq!(said.contains("another node"), errno == Errno::ADDRINUSE, "{errno}: {said}");
        }
    }
}
