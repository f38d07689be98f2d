//! Discovery through multicast DNS (RFC 6762, RFC 6763): publishes the node's service, and finds those of other nodes.
//!
//! An mDNS record is a hint to query an address, never a membership: records outlive the process that
//! published them. Each path of the node has a service of its own, with the path's address and port. So a
//! service is found on the network of its path, and the removal of one does not affect the others. mdns-sd
//! has a thread for each, which ends when its [`Mdns`] is dropped.

use std::{
    collections::HashMap,
    fmt, io,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr},
    thread,
    time::Duration,
};

use mdns_sd::{
    DaemonEvent, IfKind, Metrics, Receiver, ResolvedService, ScopedIp, ServiceDaemon, ServiceEvent,
    ServiceInfo,
};
use sinew_model::{address::seen_from, refusals::Refusals, thread_priority::lower_priority};
use sinew_runtime::{time::Time, wire::fnv1a};
use socket2::{Domain, Socket, Type};
use tokio::sync::oneshot;

use super::{datagram::Announcement, grid::until_next};

/// Type of Sinew's service.
pub(super) const SERVICE: &str = "_sinew._udp.local.";
/// Maximum number of queried addresses of one service.
const ADDRESSES_MAX: usize = 4;
/// Maximum number of bytes of a node's name in the service's instance name, which has 63 at most.
const NAME_MAX: usize = 38;
/// Time after which a slow start is logged.
const SLOW: Duration = Duration::from_secs(10);

/// Maximum time between two checks of the memory use of mdns-sd.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// The memory use of mdns-sd for data received from other hosts. mdns-sd sets no bound itself, and any host
/// on the network can send any amount.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Kept {
    /// Number of records, of usually some hundred bytes each, and 9,000 at most.
    records: usize,
    /// Number of timers, with 16 bytes each. Each receipt of a record, also a repeated one, adds two that
    /// remain until the record would expire.
    timers: usize,
}

impl Kept {
    /// Returns the limit for `nodes_max` nodes: four records for each of their addresses, and as many of
    /// other projects.
    pub(super) const fn most(nodes_max: usize) -> Self {
        Self { records: 256 + nodes_max.saturating_mul(16), timers: 1 << 22 }
    }

    fn of(metrics: &Metrics) -> Self {
        let count = |of: &str| metrics.get(of).map_or(0, |count| usize::try_from(*count).unwrap_or(0));
        let records = metrics.keys().filter(|what| what.starts_with("cached-")).map(|what| count(what)).sum();
        Self { records, timers: count("timer") }
    }
}

impl fmt::Display for Kept {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} records, {} timers", self.records, self.timers)
    }
}

/// The node's presence in multicast DNS on one of its paths. It ends when dropped.
pub(super) struct Mdns {
    daemon: ServiceDaemon,
    fullname: String,
    project: String,
    /// Properties that identify this incarnation, the same in its services on other paths.
    own: [(&'static str, String); 2],
    /// Local address at which the service is published.
    here: SocketAddr,
}

/// The error of a failed start of multicast DNS.
pub(super) type MdnsError = mdns_sd::Error;

impl Mdns {
    /// Publishes the node's service at `udp` and on no other interface, through the given mDNS port. If the
    /// future is dropped before its end, no service remains.
    pub(super) async fn start(port: u16, udp: SocketAddr, me: Announcement) -> Result<Self, MdnsError> {
        created(move || Self::publish(port, udp, &me)).await
    }

    fn publish(port: u16, udp: SocketAddr, me: &Announcement) -> Result<Self, MdnsError> {
        let service = service(udp, me)?;
        can_bind(port, udp).map_err(|error| MdnsError::Msg(error.to_string()))?;
        let daemon = ServiceDaemon::new_with_port(port)?;
        let (fullname, project) = (service.get_fullname().to_owned(), me.project.clone());
        let mdns = Self { daemon, fullname, project, own: identity(me), here: udp };
        // Commands are executed in order: nothing is sent on another interface.
        mdns.daemon.disable_interface(IfKind::All)?;
        mdns.daemon.enable_interface(interface(udp))?;
        mdns.daemon.register(service)?;
        Ok(mdns)
    }

    /// Starts to browse for other nodes. The receiver ends if it is not read for long; then browse again.
    pub(super) fn browse(&self) -> Result<Receiver<ServiceEvent>, MdnsError> {
        self.daemon.browse(SERVICE)
    }

    /// Returns the events of the daemon about itself. The receiver ends with the daemon, and no new one can
    /// be obtained then.
    pub(super) fn monitor(&self) -> Result<Receiver<DaemonEvent>, MdnsError> {
        self.daemon.monitor()
    }

    /// Waits until the daemon has ended, and counts the failures that it reports meanwhile.
    pub(super) async fn ended(&self) {
        let failures = Refusals::default();
        loop {
            match self.monitor() {
                Ok(events) => {
                    while let Ok(event) = events.recv_async().await {
                        if let DaemonEvent::Error(error) = event {
                            failures.count(Time::now(), "mDNS reports a fault", &error);
                        }
                    }
                }
                Err(MdnsError::DaemonShutdown) => return,
                Err(error) => failures.count(Time::now(), "mDNS reports nothing about itself", &error),
            }
            tokio::time::sleep(CHECK_INTERVAL).await;
        }
    }

    /// Waits until mdns-sd uses more memory than `most`. Each request waits for the answer to the former one.
    /// A daemon that is flooded continuously or not scheduled answers late.
    pub(super) async fn keeps_more_than(&self, most: Kept) -> Kept {
        loop {
            tokio::time::sleep(until_next(Time::now(), CHECK_INTERVAL)).await;
            let Ok(answer) = self.daemon.get_metrics() else { continue };
            let Ok(metrics) = answer.recv_async().await else { continue };
            let kept = Kept::of(&metrics);
            if kept.records > most.records || kept.timers > most.timers {
                return kept;
            }
        }
    }

    /// Returns the addresses at which the node of a resolved service can be queried, of the family of this
    /// path. Returns none for this node's own service or one of another project.
    pub(super) fn addresses(&self, service: &ResolvedService) -> Vec<SocketAddr> {
        let is_own =
            self.own.iter().all(|(key, value)| service.get_property_val_str(key) == Some(value.as_str()));
        if is_own || service.get_property_val_str("project") != Some(self.project.as_str()) {
            return Vec::new();
        }
        let mut addresses: Vec<IpAddr> = service.get_addresses().iter().map(ScopedIp::to_ip_addr).collect();
        addresses.retain(|ip| ip.is_ipv4() == self.here.is_ipv4());
        // The addresses are from a hash set; sorting makes a failure reproducible.
        addresses.sort_unstable();
        addresses.truncate(ADDRESSES_MAX);
        let at = |ip| seen_from(self.here, (ip, service.get_port()).into());
        addresses.into_iter().map(at).collect()
    }
}

impl Drop for Mdns {
    fn drop(&mut self) {
        // A daemon that is gone, or has a full queue of a hundred commands, cannot be notified. There is no other way
        // to do so.
        let _ = self.daemon.unregister(&self.fullname);
        let _ = self.daemon.shutdown();
    }
}

/// Creates the mDNS instance on a low-priority thread. mdns-sd's thread inherits the priority of its creator,
/// and never yields. With NDL's own real-time priority, a flood of its port would block all threads without
/// one. NDL's thread does not wait for the creating thread. Otherwise it would be as late as that one, and
/// lose members that are present.
async fn created(make: impl FnOnce() -> Result<Mdns, MdnsError> + Send + 'static) -> Result<Mdns, MdnsError> {
    let (sender, mut receiver) = oneshot::channel();
    let maker = thread::Builder::new().name("ndl-mdns".to_owned()).spawn(move || {
        lower_priority();
        // Without a receiver the instance is dropped here, which ends its daemon.
        drop(sender.send(make()));
    });
    maker.map_err(|error| MdnsError::Msg(format!("there is no thread for it: {error}")))?;
    let panicked = |_| Err(MdnsError::Msg("mdns-sd panicked".to_owned()));
    if let Ok(made) = tokio::time::timeout(SLOW, &mut receiver).await {
        return made.unwrap_or_else(panicked);
    }
    sinew_runtime::log::warn!(
        "mDNS has not started after {SLOW:?}: its low-priority thread gets no CPU time; find the thread that uses it (`top -H`)"
    );
    receiver.await.unwrap_or_else(panicked)
}

/// Checks that mdns-sd can bind its socket, by a bind with the same options. mdns-sd does not report a failed
/// bind, and runs on without the socket.
///
/// # Errors
/// Returns why the socket cannot be bound.
fn can_bind(port: u16, here: SocketAddr) -> io::Result<()> {
    let any = match here {
        SocketAddr::V4(_) => IpAddr::from(Ipv4Addr::UNSPECIFIED),
        SocketAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
    };
    let socket = Socket::new(Domain::for_address(here), Type::DGRAM, None)?;
    if here.is_ipv6() {
        socket.set_only_v6(true)?;
    }
    socket.set_reuse_address(true)?;
    #[cfg(unix)]
    socket.set_reuse_port(true)?;
    socket.bind(&SocketAddr::new(any, port).into())
}

/// Returns the interface of an address. 127.0.0.0/8 is one interface with one address, also if the node has
/// another of its addresses. Two interfaces may have the same link-local address.
fn interface(here: SocketAddr) -> IfKind {
    match here {
        here if here.ip().is_ipv4() && here.ip().is_loopback() => IfKind::LoopbackV4,
        here if here.ip().is_loopback() => IfKind::LoopbackV6,
        SocketAddr::V6(here) if here.scope_id() != 0 => IfKind::IndexV6(here.scope_id()),
        SocketAddr::V4(_) | SocketAddr::V6(_) => IfKind::Addr(here.ip()),
    }
}

/// Returns the properties that identify the incarnation of a node.
fn identity(me: &Announcement) -> [(&'static str, String); 2] {
    [("node", me.node.to_string()), ("incarnation", me.incarnation.to_string())]
}

fn service(udp: SocketAddr, me: &Announcement) -> Result<ServiceInfo, MdnsError> {
    let cut = (0..=NAME_MAX.min(me.name.len())).rev().find(|at| me.name.is_char_boundary(*at)).unwrap_or(0);
    // Node addresses are unique in a project. The project's hash distinguishes projects, and the address's
    // hash the node's services on one link.
    let at = match udp {
        SocketAddr::V4(udp) => udp.ip().to_string(),
        SocketAddr::V6(udp) => format!("{}%{}", udp.ip(), udp.scope_id()),
    };
    let (project, path) = (fnv1a(me.project.as_bytes()), fnv1a(at.as_bytes()));
    let unique = format!("{:08x}{project:08x}{path:08x}", me.node.bits());
    let mut properties = HashMap::from([("project".to_owned(), me.project.clone())]);
    properties.extend(identity(me).map(|(key, value)| (key.to_owned(), value)));
    let instance = format!("{} {unique}", &me.name[..cut]);
    let host = format!("sinew-{unique}.local.");
    let mut service = ServiceInfo::new(SERVICE, &instance, &host, udp.ip(), udp.port(), properties)?;
    // The name is unique already; probing for it would take 0.9 s.
    service.set_requires_probe(false);
    Ok(service)
}

#[cfg(test)]
mod tests {
    use std::{net::UdpSocket, sync::mpsc};

    use futures_util::FutureExt as _;
    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;

    const WATCHDOG: Duration = Duration::from_secs(60);

    fn me() -> Announcement {
        Announcement {
            project: "sinew".to_owned(),
            node: NodeAddress::new(1),
            // Cut to its 38 bytes within a character.
            name: "x".to_owned() + &"ä".repeat(31),
            incarnation: Incarnation(1),
            boot_nonce: 1,
            gncl_ip: 0,
            gncl_port: 0,
            period_us: 0,
            gncl_further: Vec::new(),
            ndl: Vec::new(),
            ndl6: Vec::new(),
            gncl_port6: 0,
            claim: crate::datagram::Claim::Held,
        }
    }

    /// Returns a port that can be shared, and stays open as long as the socket, so that the system gives it to no other
    /// process.
    fn shared_port() -> (Socket, u16) {
        let shared = Socket::new(Domain::IPV4, Type::DGRAM, None).unwrap();
        shared.set_reuse_address(true).unwrap();
        #[cfg(unix)]
        shared.set_reuse_port(true).unwrap();
        shared.bind(&SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)).into()).unwrap();
        let port = shared.local_addr().unwrap().as_socket().unwrap().port();
        (shared, port)
    }

    fn published() -> Result<Mdns, MdnsError> {
        let (_shared, port) = shared_port();
        publish(port)
    }

    fn publish(port: u16) -> Result<Mdns, MdnsError> {
        Mdns::publish(port, "127.0.0.1:9".parse().unwrap(), &me())
    }

    fn run<T>(future: impl Future<Output = T>) -> T {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(future)
    }

    fn started() -> Mdns {
        let (_shared, port) = shared_port();
        run(Mdns::start(port, "127.0.0.1:9".parse().unwrap(), me())).unwrap()
    }

    /// Checks that the daemon reports nothing more, as it has ended.
    fn ends(events: &Receiver<DaemonEvent>) {
        while let Ok(event) = events.recv_timeout(WATCHDOG) {
            assert!(!matches!(event, DaemonEvent::Error(_)), "{event:?}");
        }
        assert!(events.is_disconnected(), "waited 60 s for the daemon to end");
    }

    #[test]
    fn waiting_for_a_blocked_maker_blocks_no_task() {
        run(async {
            // given
            let (open, gate) = mpsc::sync_channel::<()>(1);
            let making = created(move || {
                gate.recv_timeout(WATCHDOG).expect("the gate is opened");
                published()
            });
            tokio::pin!(making);
            // when
            let held_up = making.as_mut().now_or_never();
            // then
            assert!(held_up.is_none(), "it waited for the gate, which nobody had opened");
            open.send(()).unwrap();
            assert!(making.await.is_ok());
        });
    }

    #[test]
    fn daemon_without_any_waiter_ends() {
        // given
        let (open, gate) = mpsc::sync_channel::<()>(1);
        let (sender, receiver) = mpsc::sync_channel(1);
        run(async {
            let making = created(move || {
                let mdns = published()?;
                sender.send(mdns.monitor()?).expect("the test waits");
                gate.recv_timeout(WATCHDOG).expect("the gate is opened");
                Ok(mdns)
            });
            // when
            assert!(making.now_or_never().is_none());
        });
        let events = receiver.recv_timeout(WATCHDOG).expect("the daemon runs");
        open.send(()).unwrap();
        // then
        ends(&events);
    }

    #[test]
    fn exclusively_bound_port_is_reported_unavailable() {
        let taken = UdpSocket::bind("0.0.0.0:0").unwrap();
        let port = taken.local_addr().unwrap().port();
        let error = publish(port).err().expect("it is taken").to_string();
        assert!(error.contains("in use"), "{error}");
    }

    #[test]
    fn shared_port_is_available() {
        let (_shared, port) = shared_port();
        assert!(publish(port).is_ok());
    }

    #[test]
    fn end_of_the_daemon_is_detected() {
        let mdns = started();
        run(async {
            let mut ended = Box::pin(mdns.ended());
            assert!(ended.as_mut().now_or_never().is_none(), "it runs");
            mdns.daemon.shutdown().unwrap();
            tokio::time::timeout(WATCHDOG, ended).await.expect("waited 60 s for its end to be seen");
        });
    }

    #[test]
    fn daemon_thread_ends_when_its_owner_does() {
        // given
        let mdns = started();
        let events = mdns.monitor().unwrap();
        // when
        drop(mdns);
        // then
        ends(&events);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn daemon_thread_has_lower_priority_than_message_threads() {
        let mdns = started();
        // It has done something: it runs, and its thread has its name.
        let status = mdns.daemon.status().unwrap().recv_timeout(WATCHDOG);
        assert!(status.is_ok(), "waited 60 s for the daemon");
        // Checks all threads of this process, including those of other tests' daemons that were created in the same
        // way.
        let niceness = |task: std::fs::DirEntry| {
            let read = |what| std::fs::read_to_string(task.path().join(what)).ok();
            let stat = read("stat").filter(|_| read("comm").is_some_and(|name| name.starts_with("mDNS")))?;
            // After the name, which may have spaces: field 19 of proc_pid_stat(5); the first one here is its third.
            stat.rsplit_once(") ")?.1.split(' ').nth(16)?.parse::<i32>().ok()
        };
        let own = rustix::process::getpriority_process(None).unwrap();
        let tasks = std::fs::read_dir("/proc/self/task").unwrap();
        let seen: Vec<_> = tasks.flatten().filter_map(niceness).collect();
        assert!(seen.iter().any(|nice| *nice > own || own == 19), "{seen:?}, and this one has {own}");
    }
}
