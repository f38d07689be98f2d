//! Discovery through multicast DNS (RFC 6762, RFC 6763): the node's service is published, those of others are found.
//!
//! What mDNS says is a hint where to ask, never a membership: records outlive the process that published them.
//! Each of the node's paths has a service of its own: the address there, and the port that its socket has there. So what is found is where
//! it was heard of, and one that goes takes nothing of another one with it. mdns-sd has a thread of its own for each, which ends when its
//! [`Mdns`] is dropped.

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
use sinew_runtime::{time::Time, wire::fnv1a};
use socket2::{Domain, Socket, Type};
use tokio::sync::oneshot;

use super::{address::seen_from, datagram::Announcement};
use crate::{nicer::give_way, refusals::Refusals};

/// The type of Sinew's service.
pub(super) const SERVICE: &str = "_sinew._udp.local.";
/// Addresses of one service that are asked, at most.
const ADDRESSES_MAX: usize = 4;
/// Bytes of a node's name in the service's instance name, which has 63 at most.
const NAME_MAX: usize = 38;
/// Time after which it is said that it does not begin.
const SLOW: Duration = Duration::from_secs(10);

/// Time between two looks at how much mdns-sd keeps.
const LOOK_GAP: Duration = Duration::from_secs(1);

/// What mdns-sd has in memory of what others sent. It sets no bound to that itself, and whoever is on the network sends what he likes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Kept {
    /// Records, some hundred bytes each as a rule, and 9,000 at most.
    records: usize,
    /// When they are looked at: two for each time that one was heard, also again, until it would be out of date, 16 bytes each.
    timers: usize,
}

impl Kept {
    /// What may be kept where there are `nodes_max` nodes: four records for each of their addresses, and as many of other projects.
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

/// The node's presence in multicast DNS on one of its paths; ends when dropped.
pub(super) struct Mdns {
    daemon: ServiceDaemon,
    fullname: String,
    project: String,
    /// As its services on other paths say, too.
    own: [(&'static str, String); 2],
    /// Our address, where the service is published.
    here: SocketAddr,
}

/// Why multicast DNS did not start.
pub(super) type MdnsError = mdns_sd::Error;

impl Mdns {
    /// Publishes the node's service at `udp` and no other interface, through the given mDNS port. Whoever does not wait for it to the end
    /// has no service.
    pub(super) async fn start(port: u16, udp: SocketAddr, me: Announcement) -> Result<Self, MdnsError> {
        made(move || Self::publish(port, udp, &me)).await
    }

    fn publish(port: u16, udp: SocketAddr, me: &Announcement) -> Result<Self, MdnsError> {
        let service = service(udp, me)?;
        can_have(port, udp).map_err(|error| MdnsError::Msg(error.to_string()))?;
        let daemon = ServiceDaemon::new_with_port(port)?;
        let (fullname, project) = (service.get_fullname().to_owned(), me.project.clone());
        let mdns = Self { daemon, fullname, project, own: life(me), here: udp };
        // Commands are obeyed in order: nothing leaves by another interface.
        mdns.daemon.disable_interface(IfKind::All)?;
        mdns.daemon.enable_interface(interface(udp))?;
        mdns.daemon.register(service)?;
        Ok(mdns)
    }

    /// Begins to look for others. The receiver ends if nobody reads it for long; then look again.
    pub(super) fn browse(&self) -> Result<Receiver<ServiceEvent>, MdnsError> {
        self.daemon.browse(SERVICE)
    }

    /// What the daemon has to say about itself. The receiver ends with the daemon, which it can be had from no more then.
    pub(super) fn monitor(&self) -> Result<Receiver<DaemonEvent>, MdnsError> {
        self.daemon.monitor()
    }

    /// Waits until the daemon has ended, and counts what it says that failed meanwhile.
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
                Err(error) => failures.count(Time::now(), "mDNS says nothing of itself", &error),
            }
            tokio::time::sleep(LOOK_GAP).await;
        }
    }

    /// Waits until mdns-sd keeps more than `most`. It is not asked again before it has answered: one that is flooded without a pause, or gets
    /// no processor, does so when it comes to it.
    pub(super) async fn keeps_more_than(&self, most: Kept) -> Kept {
        loop {
            tokio::time::sleep(LOOK_GAP).await;
            let Ok(asked) = self.daemon.get_metrics() else { continue };
            let Ok(metrics) = asked.recv_async().await else { continue };
            let kept = Kept::of(&metrics);
            if kept.records > most.records || kept.timers > most.timers {
                return kept;
            }
        }
    }

    /// Where the node of a resolved service can be asked, by the family in which it was looked for; nothing if it is our own or of another
    /// project.
    pub(super) fn addresses(&self, service: &ResolvedService) -> Vec<SocketAddr> {
        let is_own =
            self.own.iter().all(|(key, value)| service.get_property_val_str(key) == Some(value.as_str()));
        if is_own || service.get_property_val_str("project") != Some(self.project.as_str()) {
            return Vec::new();
        }
        let mut addresses: Vec<IpAddr> = service.get_addresses().iter().map(ScopedIp::to_ip_addr).collect();
        addresses.retain(|ip| ip.is_ipv4() == self.here.is_ipv4());
        // From a hash set: in an order that a failure can be repeated with.
        addresses.sort_unstable();
        addresses.truncate(ADDRESSES_MAX);
        let at = |ip| seen_from(self.here, (ip, service.get_port()).into());
        addresses.into_iter().map(at).collect()
    }
}

impl Drop for Mdns {
    fn drop(&mut self) {
        // A daemon whose queue of a hundred commands is full, or that is gone, cannot be told; nothing else is left.
        let _ = self.daemon.unregister(&self.fullname);
        let _ = self.daemon.shutdown();
    }
}

/// mdns-sd's thread begins with the priority of who makes it, and takes no rest: under NDL's own, which is a real-time one, whoever floods its
/// port would hold up all that is none. So a thread that gives way makes it, for which NDL's never stands still: it would be as late as that
/// one is, and lose members that are there.
async fn made(make: impl FnOnce() -> Result<Mdns, MdnsError> + Send + 'static) -> Result<Mdns, MdnsError> {
    let (give, mut given) = oneshot::channel();
    let maker = thread::Builder::new().name("ndl-mdns".to_owned()).spawn(move || {
        give_way();
        // Where nobody waits any more it is dropped here, which ends its daemon.
        drop(give.send(make()));
    });
    maker.map_err(|error| MdnsError::Msg(format!("there is no thread for it: {error}")))?;
    let panicked = |_| Err(MdnsError::Msg("mdns-sd panicked".to_owned()));
    if let Ok(made) = tokio::time::timeout(SLOW, &mut given).await {
        return made.unwrap_or_else(panicked);
    }
    crate::log::warn!(
        "mDNS has not begun after {SLOW:?}: its thread, which gives way to others, gets no processor; see which thread takes it (`top -H`)"
    );
    given.await.unwrap_or_else(panicked)
}

/// Whether mdns-sd can have its socket, which is bound as it binds its own. It says nothing of one that it does not get, and runs on without.
///
/// # Errors
/// Why it cannot.
fn can_have(port: u16, here: SocketAddr) -> io::Result<()> {
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

/// 127.0.0.0/8 is one interface with one address, whichever of its addresses the node has. Two interfaces may have one link-local address.
fn interface(here: SocketAddr) -> IfKind {
    match here {
        here if here.ip().is_ipv4() && here.ip().is_loopback() => IfKind::LoopbackV4,
        here if here.ip().is_loopback() => IfKind::LoopbackV6,
        SocketAddr::V6(here) if here.scope_id() != 0 => IfKind::IndexV6(here.scope_id()),
        SocketAddr::V4(_) | SocketAddr::V6(_) => IfKind::Addr(here.ip()),
    }
}

/// Which life of which node it is.
fn life(me: &Announcement) -> [(&'static str, String); 2] {
    [("node", me.node.to_string()), ("incarnation", me.incarnation.to_string())]
}

fn service(udp: SocketAddr, me: &Announcement) -> Result<ServiceInfo, MdnsError> {
    let cut = (0..=NAME_MAX.min(me.name.len())).rev().find(|at| me.name.is_char_boundary(*at)).unwrap_or(0);
    // Node addresses are unique in a project; its hash keeps projects apart, and that of the address the node's services on one link.
    let at = match udp {
        SocketAddr::V4(udp) => udp.ip().to_string(),
        SocketAddr::V6(udp) => format!("{}%{}", udp.ip(), udp.scope_id()),
    };
    let (project, path) = (fnv1a(me.project.as_bytes()), fnv1a(at.as_bytes()));
    let unique = format!("{:08x}{project:08x}{path:08x}", me.node.bits());
    let mut properties = HashMap::from([("project".to_owned(), me.project.clone())]);
    properties.extend(life(me).map(|(key, value)| (key.to_owned(), value)));
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
            claim: crate::ndl::datagram::Claim::Held,
        }
    }

    /// A port that can be shared, and stays open as long as the socket, so that nobody else is given it meanwhile.
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

    /// The daemon says nothing more, as it has ended.
    fn ends(events: &Receiver<DaemonEvent>) {
        while let Ok(event) = events.recv_timeout(WATCHDOG) {
            assert!(!matches!(event, DaemonEvent::Error(_)), "{event:?}");
        }
        assert!(events.is_disconnected(), "waited 60 s for the daemon to end");
    }

    #[test]
    fn whoever_waits_for_a_maker_that_is_held_up_does_something_else_meanwhile() {
        run(async {
            // given
            let (open, gate) = mpsc::sync_channel::<()>(1);
            let making = made(move || {
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
    fn a_daemon_that_nobody_waits_for_any_more_ends() {
        // given
        let (open, gate) = mpsc::sync_channel::<()>(1);
        let (tell, told) = mpsc::sync_channel(1);
        run(async {
            let making = made(move || {
                let mdns = published()?;
                tell.send(mdns.monitor()?).expect("the test waits");
                gate.recv_timeout(WATCHDOG).expect("the gate is opened");
                Ok(mdns)
            });
            // when
            assert!(making.now_or_never().is_none());
        });
        let events = told.recv_timeout(WATCHDOG).expect("the daemon runs");
        open.send(()).unwrap();
        // then
        ends(&events);
    }

    #[test]
    fn a_port_that_somebody_has_for_himself_is_said_not_to_be_had() {
        let taken = UdpSocket::bind("0.0.0.0:0").unwrap();
        let port = taken.local_addr().unwrap().port();
        let error = publish(port).err().expect("it is taken").to_string();
        assert!(error.contains("in use"), "{error}");
    }

    #[test]
    fn a_port_that_others_share_can_be_had() {
        let (_shared, port) = shared_port();
        assert!(publish(port).is_ok());
    }

    #[test]
    fn that_the_daemon_has_ended_by_itself_is_seen() {
        let mdns = started();
        run(async {
            let mut ended = Box::pin(mdns.ended());
            assert!(ended.as_mut().now_or_never().is_none(), "it runs");
            mdns.daemon.shutdown().unwrap();
            tokio::time::timeout(WATCHDOG, ended).await.expect("waited 60 s for its end to be seen");
        });
    }

    #[test]
    fn the_daemons_thread_ends_when_its_owner_does() {
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
    fn the_daemons_thread_gives_way_to_those_that_carry_messages() {
        let mdns = started();
        // It has done something: it runs, and has its name.
        let said = mdns.daemon.status().unwrap().recv_timeout(WATCHDOG);
        assert!(said.is_ok(), "waited 60 s for the daemon");
        // Of all threads of this process, and of other tests' daemons the ones that were made so.
        let niceness = |task: std::fs::DirEntry| {
            let read = |what| std::fs::read_to_string(task.path().join(what)).ok();
            let stat = read("stat").filter(|_| read("comm").is_some_and(|name| name.starts_with("mDNS")))?;
            // Behind the name, which may have spaces: field 19 of proc_pid_stat(5), of which the third is the first here.
            stat.rsplit_once(") ")?.1.split(' ').nth(16)?.parse::<i32>().ok()
        };
        let own = rustix::process::getpriority_process(None).unwrap();
        let tasks = std::fs::read_dir("/proc/self/task").unwrap();
        let seen: Vec<_> = tasks.flatten().filter_map(niceness).collect();
        assert!(seen.iter().any(|nice| *nice > own || own == 19), "{seen:?}, and this one has {own}");
    }
}
