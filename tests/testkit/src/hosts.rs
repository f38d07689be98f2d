//! Hosts made of network namespaces. Each host has one interface, or one in each of several networks. The
//! interfaces of a network are connected by a bridge in its own namespace, or by a [`Radio`].
//!
//! Nothing is created in the namespace of the machine itself, so no traffic leaves it.

use std::{
    fs::File,
    net::Ipv4Addr,
    os::fd::AsFd,
    path::Path,
    process::Command,
    sync::atomic::{AtomicU32, Ordering},
    thread,
};

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::join;

pub use self::radio::{Carried, Radio, Weather};

mod radio;

/// Number of host sets that this process has created: part of the namespace names.
static NETWORKS: AtomicU32 = AtomicU32::new(0);

/// Several hosts on one network. Dropping this value removes the namespaces.
#[derive(Debug)]
pub struct Hosts {
    bridge: Namespace,
    hosts: Vec<Host>,
    radio: Option<Radio>,
}

/// One host.
#[derive(Debug)]
pub struct Host {
    namespace: Namespace,
    /// Address in the first network.
    pub address: Ipv4Addr,
    index: u8,
}

/// Initial addresses of the host interfaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Addresses {
    /// An IPv4 address such as 10.77.0.1, and the IPv6 address that the kernel adds by itself some seconds
    /// later.
    Ipv4,
    /// Only link-local IPv6 addresses: fe80::1 for the first host, the same in each network.
    LinkLocal,
    /// Both of the above, and no further address.
    Both,
}

/// The order in which a throttled host sends its queued packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// First in, first out.
    OneLine,
    /// By priority, as Linux does by default (`pfifo_fast`).
    Priorities,
}

impl Hosts {
    /// Creates `count` hosts, 10.77.0.1 and up, or explains why that is not possible here.
    ///
    /// # Errors
    /// A sentence: no root, no `ip` or `nsenter`, or a kernel without namespaces.
    pub fn new(count: u8) -> Result<Self, String> {
        Self::in_networks(count, 1)
    }

    /// Like `new`, with an interface in each of `networks` networks: 10.77.0.1 and up, 10.78.0.1 and up, and
    /// so on.
    ///
    /// # Errors
    /// As `new`.
    pub fn in_networks(count: u8, networks: u8) -> Result<Self, String> {
        Self::with_addresses(count, networks, Addresses::Ipv4)
    }

    /// Like `in_networks`, with these addresses. IPv6 addresses are usable at once: duplicate address
    /// detection is off.
    ///
    /// # Errors
    /// As `new`; also a kernel without IPv6.
    pub fn with_addresses(count: u8, networks: u8, addresses: Addresses) -> Result<Self, String> {
        run("nsenter", &["--version"])?;
        let number = format!("{}-{}-", std::process::id(), NETWORKS.fetch_add(1, Ordering::Relaxed));
        let bridge = Namespace::new(format!("sw{number}br"))?;
        for network in 0..networks {
            bridge.ip(&format!("link add bridge{network} type bridge"))?;
            bridge.ip(&format!("link set bridge{network} up"))?;
        }
        let host = |index| Host::new(&number, index, &bridge, (networks, addresses));
        let hosts = (1..=count).map(host).collect::<Result<_, _>>()?;
        Ok(Self { bridge, hosts, radio: None })
    }

    /// Creates `count` hosts, 10.77.0.1 and up, on a network that can lose and delay packets
    /// ([`set_weather`](Self::set_weather)). `seed` seeds all random decisions.
    ///
    /// # Errors
    /// A sentence: no root, no `ip` or `nsenter`, or a kernel without namespaces or TAP devices.
    pub fn on_radio(count: u8, seed: u64) -> Result<Self, String> {
        let mut hosts = Self::in_networks(count, 0)?;
        let namespaces =
            hosts.hosts.iter().map(|host| host.namespace.open()).collect::<Result<Vec<_>, _>>()?;
        hosts.radio = Some(Radio::between(&namespaces, "eth0", seed)?);
        for host in &hosts.hosts {
            host.namespace.ip(&format!("address add {}/24 dev eth0", host.address))?;
            host.namespace.ip("link set eth0 up")?;
        }
        Ok(hosts)
    }

    /// Applies this weather to every frame from now on, and returns the counts of the frames carried so far.
    /// A frame that is sent but not yet read by the radio gets the new weather.
    ///
    /// # Panics
    /// If these hosts are not on a radio.
    pub fn set_weather(&self, weather: Weather) -> Carried {
        let radio = self.radio.as_ref().expect("hosts that `on_radio` has made");
        radio.set(weather);
        radio.carried()
    }

    /// Drops all multicast on their network from now on.
    ///
    /// # Panics
    /// If these hosts are not on a radio.
    pub fn drop_multicast(&self) {
        self.radio.as_ref().expect("hosts that `on_radio` has made").drop_multicast();
    }

    /// The hosts.
    #[must_use]
    pub fn all(&self) -> &[Host] {
        &self.hosts
    }

    /// Cuts a host's link to the first network: its bridge port goes down.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn cut(&self, host: usize) {
        self.cut_in(host, 0);
    }

    /// Cuts a host's link to a network.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn cut_in(&self, host: usize, network: u8) {
        self.set_port(host, network, "down");
    }

    /// Reconnects a host after `cut`.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn join(&self, host: usize) {
        self.set_port(host, 0, "up");
    }

    /// Drops all packets from and to a host in the first network from now on. Every interface stays up, so no
    /// kernel notices.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn swallow(&self, host: usize) {
        // The port is up but belongs to no bridge.
        self.set_port(host, 0, "nomaster");
    }

    /// Forwards a host's packets again after `swallow`.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn carry(&self, host: usize) {
        self.set_port(host, 0, "master bridge0");
    }

    /// Drops packets longer than `mtu` bytes from and to a host in the first network from now on. No kernel
    /// notices, and no ICMP message reports it.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn limit_packets(&self, host: usize, mtu: u32) {
        self.set_port(host, 0, &format!("mtu {mtu}"));
    }

    /// Takes down a host's own interface in a network.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn take_down(&self, host: usize, network: u8) {
        self.set_interface(host, network, "down");
    }

    /// Brings up that interface again.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn bring_up(&self, host: usize, network: u8) {
        self.set_interface(host, network, "up");
    }

    fn set_interface(&self, host: usize, network: u8, state: &str) {
        let set = self.hosts[host].namespace.ip(&format!("link set eth{network} {state}"));
        set.unwrap_or_else(|error| panic!("eth{network} {state}: {error}"));
    }

    /// Limits the egress rate of each host, in kilobits per second. A host queues 50 ms of excess traffic and
    /// drops the rest.
    ///
    /// # Errors
    /// A sentence: no `tc`, or a kernel without that queueing discipline.
    pub fn throttle(&self, kbit_per_s: u32, queue: Queue) -> Result<(), String> {
        for Host { namespace, .. } in &self.hosts {
            let bucket = format!("tbf rate {kbit_per_s}kbit burst 16kb latency 50ms");
            namespace.tc(&format!("qdisc replace dev eth0 root handle 1: {bucket}"))?;
            match queue {
                Queue::OneLine => {}
                Queue::Priorities => namespace.tc("qdisc add dev eth0 parent 1:1 handle 10: pfifo_fast")?,
            }
        }
        Ok(())
    }

    fn set_port(&self, host: usize, network: u8, state: &str) {
        let port = port(self.hosts[host].index, network);
        self.bridge
            .ip(&format!("link set {port} {state}"))
            .unwrap_or_else(|error| panic!("{port} {state}: {error}"));
    }
}

/// The name of a host's bridge port in a network.
fn port(host: u8, network: u8) -> String {
    format!("port{host}-{network}")
}

impl Host {
    fn new(
        number: &str,
        index: u8,
        bridge: &Namespace,
        (networks, addresses): (u8, Addresses),
    ) -> Result<Self, String> {
        let namespace = Namespace::new(format!("sw{number}h{index}"))?;
        namespace.ip("link set lo up")?;
        for network in 0..networks {
            let (port, name) = (port(index, network), format!("eth{network}"));
            bridge.ip(&format!("link add {port} type veth peer name {name} netns {}", namespace.0))?;
            bridge.ip(&format!("link set {port} master bridge{network}"))?;
            bridge.ip(&format!("link set {port} up"))?;
            if addresses != Addresses::LinkLocal {
                namespace.ip(&format!("address add {}/24 dev {name}", address(index, network)))?;
            }
            if addresses != Addresses::Ipv4 {
                namespace.ip(&format!("link set {name} addrgenmode none"))?;
            }
            namespace.ip(&format!("link set {name} up"))?;
            if addresses != Addresses::Ipv4 {
                namespace.ip(&format!("address add fe80::{index}/64 dev {name} nodad"))?;
            }
        }
        Ok(Self { namespace, address: address(index, 0), index })
    }

    /// Runs `ip` with these arguments on this host: `address add fd00::1/64 dev eth0 nodad`.
    ///
    /// # Errors
    /// The error output of `ip`.
    pub fn ip(&self, arguments: &str) -> Result<(), String> {
        self.namespace.ip(arguments)
    }

    /// Runs `work` on this host, in a dedicated thread.
    ///
    /// # Panics
    /// If the host no longer exists, or `work` panics.
    pub fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        let namespace = self.namespace.open().unwrap_or_else(|error| panic!("{error}"));
        let work = || {
            let entered = move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network));
            entered.unwrap_or_else(|error| panic!("the namespace of {}: {error}", self.address));
            work()
        };
        thread::scope(|scope| join(scope.spawn(work)))
    }

    /// A command that runs `program` on this host.
    ///
    /// It does not use `ip netns exec`: that also mounts a `/sys` for the namespace, and waits inside the
    /// kernel until each CPU has seen the mount. If a thread spins on a CPU, this can take seconds. As a
    /// consequence, a program such as `sinew doctor` sees the machine's own interfaces in `/sys`.
    #[must_use]
    pub fn command(&self, program: &Path) -> Command {
        let mut command = Command::new("nsenter");
        command.arg(format!("--net={}", self.namespace.path())).arg(program);
        command
    }

    /// The same command on this host, with the same program, arguments and environment variables.
    #[must_use]
    pub fn moved(&self, command: &Command) -> Command {
        let mut moved = self.command(Path::new(command.get_program()));
        moved.args(command.get_args());
        moved.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
        moved
    }
}

/// The address of a host in a network.
const fn address(host: u8, network: u8) -> Ipv4Addr {
    Ipv4Addr::new(10, 77 + network, 0, host)
}

#[derive(Debug)]
struct Namespace(String);

impl Namespace {
    fn new(name: String) -> Result<Self, String> {
        run("ip", &["netns", "add", &name])?;
        Ok(Self(name))
    }

    fn path(&self) -> String {
        format!("/run/netns/{}", self.0)
    }

    /// Opens the namespace, to be entered.
    fn open(&self) -> Result<File, String> {
        File::open(self.path()).map_err(|error| format!("the namespace {}: {error}", self.0))
    }

    /// Runs `ip` inside this namespace.
    fn ip(&self, arguments: &str) -> Result<(), String> {
        self.run("ip", arguments)
    }

    /// Runs `tc` inside this namespace.
    fn tc(&self, arguments: &str) -> Result<(), String> {
        self.run("tc", arguments)
    }

    fn run(&self, program: &str, arguments: &str) -> Result<(), String> {
        let mut all = vec!["-n", &self.0];
        all.extend(arguments.split(' '));
        run(program, &all)
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        if let Err(error) = run("ip", &["netns", "del", &self.0]) {
            // A failure to write the message cannot be reported.
            let _ = std::io::Write::write_fmt(
                &mut std::io::stderr(),
                format_args!("the namespace {} stays: {error}\n", self.0),
            );
        }
    }
}

fn run(program: &str, arguments: &[&str]) -> Result<(), String> {
    let output = Command::new(program).args(arguments).output();
    let output = output.map_err(|error| format!("no `{program}` command: {error}"))?;
    if output.status.success() {
        return Ok(());
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    Err(format!("`{program} {}`: {}", arguments.join(" "), stderr.trim()))
}
