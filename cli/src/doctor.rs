//! `sinew doctor`: whether this machine gives a node what it needs; each finding with the command that mends it.
//!
//! Every check tries the thing itself, and undoes it.

use std::{
    io,
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    path::{Path, PathBuf},
    time::Duration,
};

use rustix::{
    fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create},
    process::{Resource, getrlimit},
};
use serde_json::{Value, json};
use socket2::{Domain, Protocol, SockAddr, Socket, Type};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use crate::{
    Said, door,
    table::{Table, clean},
};

/// Open files that a node with all its clients and their rings may need.
const FILES_WANTED: u64 = 4_096;
/// Time for a datagram to come back from this machine's own interface.
const HEARD_WITHIN: Duration = Duration::from_millis(500);
/// The group of the trial; nothing of Sinew's is there.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 255, 77);

/// What was tried.
struct Check {
    name: &'static str,
    /// What is so, in words.
    seen: String,
    /// What mends it; `None` where nothing is wrong.
    mend: Option<String>,
}

impl Check {
    const fn fine(name: &'static str, seen: String) -> Self {
        Self { name, seen, mend: None }
    }

    fn finding(name: &'static str, seen: String, mend: impl Into<String>) -> Self {
        Self { name, seen, mend: Some(mend.into()) }
    }
}

/// Tries everything; multicast at the interface that has this address.
pub(crate) fn show(interface: Ipv4Addr, socket: Option<&Path>) -> Said {
    let checks =
        [multicast(interface), open_files(), real_time(), shared_memory(), socket_directory(), node(socket)];
    let is_fine = checks.iter().all(|check| check.mend.is_none());
    let json = json!({ "checks": checks.iter().map(check_json).collect::<Vec<_>>() });
    let mut table = Table::new(["CHECK", "", "WHAT IS SO"]);
    for check in &checks {
        let state = if check.mend.is_none() { "fine" } else { "FINDING" };
        table.row([check.name.to_owned(), state.to_owned(), check.seen.clone()]);
    }
    let mends = checks.iter().filter_map(|check| Some((check.name, check.mend.as_ref()?)));
    let mends: String = mends.map(|(name, mend)| format!("{name}: {}\n", clean(mend))).collect();
    let text = if is_fine { table.text() } else { format!("{}\nWhat mends it\n{mends}", table.text()) };
    Said { text, json, is_fine }
}

fn check_json(check: &Check) -> Value {
    json!({ "check": check.name, "fine": check.mend.is_none(), "seen": check.seen, "mend": check.mend })
}

fn multicast(interface: Ipv4Addr) -> Check {
    const NAME: &str = "multicast";
    let mend = || {
        let device = if interface.is_loopback() { "lo" } else { "DEVICE" };
        format!(
            "sudo ip link set dev {device} multicast on && sudo ip route add 239.0.0.0/8 dev {device}; or do without it: [ndl] multicast = \
             false, seeds = [..]"
        )
    };
    match hears_itself(interface) {
        Ok(true) => Check::fine(NAME, format!("a datagram to a group came back at {interface}")),
        Ok(false) => {
            let seen =
                format!("a datagram to a group at {interface} did not come back within {HEARD_WITHIN:?}");
            Check::finding(NAME, seen, mend())
        }
        Err(error) => Check::finding(NAME, format!("no group can be joined at {interface}: {error}"), mend()),
    }
}

/// Whether what is sent to a group at this interface comes back, never farther than this link.
fn hears_itself(interface: Ipv4Addr) -> io::Result<bool> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.bind(&SockAddr::from(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0)))?;
    socket.set_multicast_if_v4(&interface)?;
    // Not even beyond this machine.
    socket.set_multicast_ttl_v4(0)?;
    socket.set_multicast_loop_v4(true)?;
    socket.join_multicast_v4(&GROUP, &interface)?;
    let socket = UdpSocket::from(socket);
    socket.set_read_timeout(Some(HEARD_WITHIN))?;
    let said = std::process::id().to_le_bytes();
    socket.send_to(&said, SocketAddrV4::new(GROUP, socket.local_addr()?.port()))?;
    let mut heard = [0; 8];
    match socket.recv_from(&mut heard) {
        Ok((length, _)) => Ok(heard[..length] == said),
        Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {
            Ok(false)
        }
        Err(error) => Err(error),
    }
}

fn open_files() -> Check {
    let limit = getrlimit(Resource::Nofile);
    let (now, most) = (limit.current.unwrap_or(u64::MAX), limit.maximum.unwrap_or(u64::MAX));
    let seen = format!(
        "a process may have {now} files open (RLIMIT_NOFILE), at most {most}; {FILES_WANTED} are enough for a full node"
    );
    if now >= FILES_WANTED {
        return Check::fine("open files", seen);
    }
    let mend = if most >= FILES_WANTED {
        format!("ulimit -n {FILES_WANTED}, or LimitNOFILE={FILES_WANTED} in the service's unit")
    } else {
        format!(
            "echo '* - nofile {FILES_WANTED}' | sudo tee /etc/security/limits.d/sinew.conf, then log in again"
        )
    };
    Check::finding("open files", seen, mend)
}

/// Tried on a thread that ends with it.
fn real_time() -> Check {
    const NAME: &str = "real-time rights";
    let trial = || {
        let level = ThreadPriorityValue::try_from(1).map_err(|_| thread_priority::Error::Priority("1"))?;
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(level), policy)
    };
    match std::thread::spawn(trial).join() {
        Ok(Ok(())) => Check::fine(NAME, "a thread got SCHED_FIFO".to_owned()),
        Ok(Err(error)) => Check::finding(
            NAME,
            format!("a thread did not get SCHED_FIFO: {error:?}"),
            "echo \"$USER - rtprio 80\" | sudo tee -a /etc/security/limits.d/sinew.conf, then log in again; or sudo setcap \
             cap_sys_nice+ep PROGRAM",
        ),
        Err(_) => Check::finding(NAME, "the trial panicked".to_owned(), "report it, please"),
    }
}

fn shared_memory() -> Check {
    const NAME: &str = "shared memory";
    let trial = || -> rustix::io::Result<()> {
        let file = memfd_create("sinew-doctor", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        ftruncate(&file, 4_096)?;
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)
    };
    match trial() {
        Ok(()) => Check::fine(NAME, "memfd_create and its seals work".to_owned()),
        Err(error) => Check::finding(
            NAME,
            format!(
                "no sealed memory: {error}; other processes are reached through sockets, which is slower"
            ),
            "allow memfd_create in the container's seccomp profile, as podman run --security-opt seccomp=unconfined ..",
        ),
    }
}

fn socket_directory() -> Check {
    const NAME: &str = "socket directory";
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(|directory| PathBuf::from(directory).join("sinew"));
    let places: Vec<_> = own.iter().cloned().chain(["/run/sinew".into()]).collect();
    match places.iter().find(|place| is_writable(place)) {
        Some(place) => Check::fine(NAME, format!("{} is there and can be written to", place.display())),
        None => {
            let shown =
                places.iter().map(|place| place.display().to_string()).collect::<Vec<_>>().join(" nor ");
            let mend = if own.as_ref().and_then(|own| own.parent()).is_some_and(is_writable) {
                "mkdir -p \"$XDG_RUNTIME_DIR/sinew\""
            } else {
                "sudo install -d -o \"$USER\" /run/sinew"
            };
            Check::finding(NAME, format!("neither {shown} can be written to"), mend)
        }
    }
}

fn is_writable(directory: &Path) -> bool {
    directory.is_dir() && rustix::fs::access(directory, rustix::fs::Access::WRITE_OK).is_ok()
}

fn node(socket: Option<&Path>) -> Check {
    match door::find(socket) {
        Ok((path, _)) => Check::fine("node", format!("one lets us in at {}", path.display())),
        Err(error) => Check::finding("node", "none lets us in".to_owned(), error.to_string()),
    }
}
