//! A host for each process of a robot, made of network namespaces: one network for the nodes, another for the
//! devices.
//!
//! Nothing is created in the namespace of the machine itself, so nothing can leave it. The namespaces have
//! names only while they are created. Then descriptors and the processes in them hold them, and they vanish
//! with the last of these: after a killed launcher there is nothing to clean up.

use std::fs::File;
use std::io::{self, Write};
use std::net::Ipv4Addr;
use std::os::fd::AsFd;
use std::process::{Child, Command, Stdio};

use exoskeleton::output;
use exoskeleton::robot::role::Role;
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use sinew_testkit::{Carried, Radio, Weather};

/// The network of the nodes, and that of the devices.
const NETWORKS: [&str; 2] = ["nodes", "devices"];

/// The hosts. Their links go up and down on request.
#[derive(Debug)]
pub(crate) struct Hosts {
    /// The namespace of each process, in the order of [`Role::ALL`].
    namespaces: Vec<File>,
    /// The namespace of the bridges, which exists as long as a process holds it.
    _bridges: File,
    between: Between,
}

/// The connection between the nodes.
#[derive(Debug)]
enum Between {
    /// A bridge with ports that go up and down.
    Bridge(Switch),
    /// A network that loses and delays packets.
    Radio(Radio),
}

/// The requested connection between the nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Network {
    /// A cable each.
    Cables,
    /// A network that can lose and delay packets; this seed determines all chance.
    Radio(u64),
}

/// Whether a host is connected to the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Link {
    Up,
    Down,
}

impl Hosts {
    /// Creates a host for each process, with the nodes connected by `network`.
    ///
    /// # Errors
    /// A sentence why that is not possible here: no root, no `ip`, or a kernel without namespaces.
    pub(crate) fn new(network: Network) -> Result<Self, String> {
        let bridges = Named::new("bridges")?;
        for network in NETWORKS {
            bridges.ip(&format!("link add {network} type bridge"))?;
            bridges.ip(&format!("link set {network} up"))?;
        }
        let hosts = Role::ALL.map(|role| Self::host(role, &bridges, network));
        let hosts = hosts.into_iter().collect::<Result<Vec<_>, _>>()?;
        let namespaces = hosts.iter().map(Named::open).collect::<Result<Vec<_>, _>>()?;
        let between = match network {
            Network::Cables => Between::Bridge(Switch::start(&bridges)?),
            Network::Radio(seed) => Between::Radio(Radio::between(&namespaces, NETWORKS[0], seed)?),
        };
        for (role, host) in Role::ALL.into_iter().zip(&hosts) {
            for (index, network) in NETWORKS.into_iter().enumerate() {
                host.ip(&format!("address add {}/24 dev {network}", address(index, role)))?;
                host.ip(&format!("link set {network} up"))?;
            }
        }
        Ok(Self { namespaces, _bridges: bridges.open()?, between })
    }

    /// Address of a process's host among the nodes.
    pub(crate) fn address_of(role: Role) -> Ipv4Addr {
        address(0, role)
    }

    /// Address of a process's host among the devices.
    pub(crate) fn device_address_of(role: Role) -> Ipv4Addr {
        address(1, role)
    }

    /// Creates a host with its cables to both networks, or to the devices only.
    fn host(role: Role, bridges: &Named, nodes: Network) -> Result<Named, String> {
        let host = Named::new(role.name())?;
        host.ip("link set lo up")?;
        let cables = if nodes == Network::Cables { &NETWORKS[..] } else { &NETWORKS[1..] };
        for network in cables.iter().copied() {
            let port = port(network, role);
            bridges.ip(&format!("link add {port} type veth peer name {network} netns {}", host.0))?;
            bridges.ip(&format!("link set {port} master {network}"))?;
            bridges.ip(&format!("link set {port} up"))?;
        }
        Ok(host)
    }

    /// Starts a process on its host.
    pub(crate) fn spawn(&self, role: Role, command: &mut Command) -> io::Result<Child> {
        spawn_in(&self.namespaces[index(role)], command)
    }

    /// Cuts a host off from the other nodes, or reconnects it; it reaches its device all the time.
    pub(crate) fn set(&mut self, role: Role, link: Link) -> io::Result<()> {
        let state = match link {
            Link::Up => "up",
            Link::Down => "down",
        };
        match &mut self.between {
            Between::Bridge(switch) => switch.order(&format!("link set {} {state}", port(NETWORKS[0], role))),
            Between::Radio(_) => Err(io::Error::other("nodes on a radio have no cable to pull")),
        }
    }

    /// Applies this weather to the traffic of the nodes. Returns the counts so far.
    pub(crate) fn set_weather(&self, weather: Weather) -> io::Result<Carried> {
        match &self.between {
            Between::Radio(radio) => {
                radio.set(weather);
                Ok(radio.carried())
            }
            Between::Bridge(_) => Err(io::Error::other("cables have no weather")),
        }
    }
}

/// Two networks, with the hosts of both in the order of [`Role::ALL`].
fn address(network: usize, role: Role) -> Ipv4Addr {
    Ipv4Addr::new(10, 77, network as u8, index(role) as u8 + 1)
}

fn index(role: Role) -> usize {
    Role::ALL.iter().position(|other| *other == role).expect("all roles are in the list")
}

/// A host's port of a bridge.
fn port(network: &str, role: Role) -> String {
    format!("{network}-{role}")
}

/// An `ip` process in the namespace of the bridges that waits for commands: a link goes down at the command,
/// without the start of another process.
#[derive(Debug)]
struct Switch(Child);

impl Switch {
    fn start(bridges: &Named) -> Result<Self, String> {
        let mut command = Command::new("ip");
        command.args(["-batch", "-"]).stdin(Stdio::piped());
        spawn_in(&bridges.open()?, &mut command)
            .map(Self)
            .map_err(|error| format!("no `ip` for the links: {error}"))
    }

    fn order(&mut self, words: &str) -> io::Result<()> {
        let input = self.0.stdin.as_mut().expect("its input is a pipe, and nobody takes it");
        writeln!(input, "{words}")?;
        input.flush()
    }
}

impl Drop for Switch {
    fn drop(&mut self) {
        // It ends by itself when its input does; a broken one is not waited for.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A namespace that has a name; dropping it removes the name.
#[derive(Debug)]
struct Named(String);

impl Named {
    fn new(what: &str) -> Result<Self, String> {
        let name = format!("exoskeleton-{}-{what}", std::process::id());
        run(&["netns", "add", &name])?;
        Ok(Self(name))
    }

    /// Runs `ip` inside this namespace.
    fn ip(&self, arguments: &str) -> Result<(), String> {
        let inside = ["-n", &self.0].into_iter();
        run(&inside.chain(arguments.split(' ')).collect::<Vec<_>>())
    }

    /// Returns the descriptor that keeps it without its name.
    fn open(&self) -> Result<File, String> {
        File::open(format!("/run/netns/{}", self.0)).map_err(|error| format!("{}: {error}", self.0))
    }
}

impl Drop for Named {
    fn drop(&mut self) {
        if let Err(error) = run(&["netns", "del", &self.0]) {
            output::note(format_args!("the namespace {} keeps its name: {error}", self.0));
        }
    }
}

/// Starts a process in a namespace: a thread enters it, and its child process stays there.
fn spawn_in(namespace: &File, command: &mut Command) -> io::Result<Child> {
    let start = || {
        move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network))?;
        command.spawn()
    };
    std::thread::scope(|scope| {
        let started = scope.spawn(start).join();
        started.unwrap_or_else(|_| Err(io::Error::other("the thread that was to start it panicked")))
    })
}

fn run(arguments: &[&str]) -> Result<(), String> {
    let output = Command::new("ip").args(arguments).stdin(Stdio::null()).output();
    let output = output.map_err(|error| format!("no `ip` command: {error}"))?;
    if output.status.success() {
        return Ok(());
    }
    let words = String::from_utf8_lossy(&output.stderr);
    Err(format!("`ip {}`: {}", arguments.join(" "), words.trim()))
}
