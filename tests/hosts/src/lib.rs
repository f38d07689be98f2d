//! Hosts made of network namespaces: each has one interface, or one in each of several networks; those of a network are joined by a
//! bridge, in a namespace of its own, or by a [`Radio`].
//!
//! Nothing is made in the namespace of the machine itself, so nothing can leave it.

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

pub use self::radio::{Carried, Radio, Weather};

mod radio;

/// How many hosts this process has made networks of: part of their names.
static NETWORKS: AtomicU32 = AtomicU32::new(0);

/// Some hosts on one network. The namespaces are removed when this is dropped.
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
    /// Its address in the first network.
    pub address: Ipv4Addr,
    index: u8,
}

/// Which addresses the interfaces of hosts have from the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Addresses {
    /// Of IPv4, as 10.77.0.1, and that of IPv6 which the kernel makes by itself, some seconds later.
    Ipv4,
    /// Link-local ones of IPv6 alone: fe80::1 for the first host, the same in each network.
    LinkLocal,
    /// Both of these, and no further one.
    Both,
}

/// In what order a throttled host sends what waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// As it came.
    OneLine,
    /// By its priority first, as Linux does by itself where nothing else is set up (`pfifo_fast`).
    Priorities,
}

impl Hosts {
    /// Makes `count` hosts, 10.77.0.1 and up; or says why that is not possible here.
    ///
    /// # Errors
    /// A sentence: no root, no `ip` or `nsenter`, or a kernel without namespaces.
    pub fn new(count: u8) -> Result<Self, String> {
        Self::in_networks(count, 1)
    }

    /// The same with an interface in each of so many networks: 10.77.0.1 and up, 10.78.0.1 and up, and so on.
    ///
    /// # Errors
    /// As `new`.
    pub fn in_networks(count: u8, networks: u8) -> Result<Self, String> {
        Self::with_addresses(count, networks, Addresses::Ipv4)
    }

    /// The same with these addresses. Those of IPv6 can be used at once: the kernel does not ask first whether another host has them.
    ///
    /// # Errors
    /// As `new`; and a kernel without IPv6.
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

    /// Makes `count` hosts, 10.77.0.1 and up, whose network can lose and delay packets ([`set_weather`](Self::set_weather)). All chance
    /// comes from `seed`.
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

    /// From now on this happens to each frame. What became of those that were carried before is returned; what is sent, and not taken yet,
    /// meets this one.
    ///
    /// # Panics
    /// If these hosts are not on a radio.
    pub fn set_weather(&self, weather: Weather) -> Carried {
        let radio = self.radio.as_ref().expect("hosts that `on_radio` has made");
        radio.set(weather);
        radio.carried()
    }

    /// Their network carries no multicast from now on.
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

    /// Cuts a host's link to the first network: its port of the bridge goes down.
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

    /// Joins a cut host again.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn join(&self, host: usize) {
        self.set_port(host, 0, "up");
    }

    /// From now on the first network swallows what a host sends and what is for it; every interface stays up, so nobody's kernel
    /// knows.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn swallow(&self, host: usize) {
        // The port is up, and belongs to no bridge.
        self.set_port(host, 0, "nomaster");
    }

    /// Carries a host's packets again.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn carry(&self, host: usize) {
        self.set_port(host, 0, "master bridge0");
    }

    /// From now on the first network carries no packet longer than `mtu` bytes from a host nor to it; nobody's kernel knows, and no ICMP
    /// says so.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn limit_packets(&self, host: usize, mtu: u32) {
        self.set_port(host, 0, &format!("mtu {mtu}"));
    }

    /// Takes a host's own interface in a network down.
    ///
    /// # Panics
    /// If the kernel refuses.
    pub fn take_down(&self, host: usize, network: u8) {
        self.set_interface(host, network, "down");
    }

    /// Brings it up again.
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

    /// Lets so many kilobits a second out of each host. A host keeps 50 ms of what its programs send faster, and loses the rest.
    ///
    /// # Errors
    /// A sentence: no `tc`, or a kernel without that queue.
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

/// The port of a network's bridge that a host is at.
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
    /// What `ip` says.
    pub fn ip(&self, arguments: &str) -> Result<(), String> {
        self.namespace.ip(arguments)
    }

    /// Runs `work` on this host, on a thread of its own.
    ///
    /// # Panics
    /// If the host has gone, or `work` panics.
    pub fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        let namespace = self.namespace.open().unwrap_or_else(|error| panic!("{error}"));
        let work = || {
            let entered = move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network));
            entered.unwrap_or_else(|error| panic!("the namespace of {}: {error}", self.address));
            work()
        };
        thread::scope(|scope| scope.spawn(work).join())
            .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    }

    /// A command that runs `program` on this host.
    ///
    /// Not by `ip netns exec`: that also mounts a `/sys` of the namespace, and waits inside the kernel until that is seen on each CPU. Where
    /// a thread spins on one, that can take seconds. So in `/sys` a program sees the machine's own interfaces, as `sinew doctor` would.
    #[must_use]
    pub fn command(&self, program: &Path) -> Command {
        let mut command = Command::new("nsenter");
        command.arg(format!("--net={}", self.namespace.path())).arg(program);
        command
    }

    /// The same command on this host: its program, its arguments, and what it sets in the environment.
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

    /// Itself, to be entered.
    fn open(&self) -> Result<File, String> {
        File::open(self.path()).map_err(|error| format!("the namespace {}: {error}", self.0))
    }

    /// `ip` inside this namespace.
    fn ip(&self, arguments: &str) -> Result<(), String> {
        self.run("ip", arguments)
    }

    /// `tc` inside this namespace.
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
            // Nothing can be done where nobody reads it.
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
    let said = String::from_utf8_lossy(&output.stderr);
    Err(format!("`{program} {}`: {}", arguments.join(" "), said.trim()))
}
