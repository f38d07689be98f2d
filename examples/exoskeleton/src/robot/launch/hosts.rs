//! A host for each process of a robot, made of network namespaces: one network for the nodes, another for the devices.
//!
//! Nothing is made in the namespace of the machine itself, so nothing can leave it. The namespaces have names only while
//! they are made. Then they are held by descriptors and by the processes in them, and vanish with the last of these,
//! however it ends: nothing is left to clean up after a launcher that was killed.

use std::fs::File;
use std::io::{self, Write};
use std::net::Ipv4Addr;
use std::os::fd::AsFd;
use std::process::{Child, Command, Stdio};

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use sinew_hosts::{Carried, Radio, Weather};

use crate::output;
use crate::robot::role::Role;

/// The network of the nodes, and that of the devices.
const NETWORKS: [&str; 2] = ["nodes", "devices"];

/// The hosts. Their links come and go as they are told.
#[derive(Debug)]
pub(super) struct Hosts {
    /// The namespace of each process, in the order of [`Role::ALL`].
    namespaces: Vec<File>,
    /// That of the bridges, which is there as long as somebody holds it.
    _bridges: File,
    between: Between,
}

/// What joins the nodes.
#[derive(Debug)]
enum Between {
    /// A bridge whose ports come and go.
    Bridge(Switch),
    /// A network that loses and delays packets.
    Radio(Radio),
}

/// What is to join the nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Network {
    /// A cable each.
    Cables,
    /// One that can lose and delay packets; all chance comes from this seed.
    Radio(u64),
}

/// Whether a host hears the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Link {
    Up,
    Down,
}

impl Hosts {
    /// Makes a host for each process, the nodes joined by `network`.
    ///
    /// # Errors
    /// A sentence why that is not possible here: no root, no `ip`, or a kernel without namespaces.
    pub(super) fn new(network: Network) -> Result<Self, String> {
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
    pub(super) fn address_of(role: Role) -> Ipv4Addr {
        address(0, role)
    }

    /// Address of a process's host among the devices.
    pub(super) fn device_address_of(role: Role) -> Ipv4Addr {
        address(1, role)
    }

    /// A host with its cables to both networks, or to the devices alone.
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
    pub(super) fn spawn(&self, role: Role, command: &mut Command) -> io::Result<Child> {
        spawn_in(&self.namespaces[index(role)], command)
    }

    /// Cuts a host off from the other nodes, or joins it again; it reaches its device all the time.
    pub(super) fn set(&mut self, role: Role, link: Link) -> io::Result<()> {
        let state = match link {
            Link::Up => "up",
            Link::Down => "down",
        };
        match &mut self.between {
            Between::Bridge(switch) => switch.order(&format!("link set {} {state}", port(NETWORKS[0], role))),
            Between::Radio(_) => Err(io::Error::other("nodes on a radio have no cable to pull")),
        }
    }

    /// From now on this happens to what the nodes send. What became of it so far is returned.
    pub(super) fn set_weather(&self, weather: Weather) -> io::Result<Carried> {
        match &self.between {
            Between::Radio(radio) => {
                radio.set(weather);
                Ok(radio.carried())
            }
            Between::Bridge(_) => Err(io::Error::other("cables have no weather")),
        }
    }
}

/// Two networks, the hosts of both in the order of [`Role::ALL`].
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

/// An `ip` in the namespace of the bridges that waits for orders: a link goes down when it is told, not when yet another
/// process has started.
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

/// A namespace that has a name; dropping it takes the name away.
#[derive(Debug)]
struct Named(String);

impl Named {
    fn new(what: &str) -> Result<Self, String> {
        let name = format!("exoskeleton-{}-{what}", std::process::id());
        run(&["netns", "add", &name])?;
        Ok(Self(name))
    }

    /// `ip` inside this namespace.
    fn ip(&self, arguments: &str) -> Result<(), String> {
        let inside = ["-n", &self.0].into_iter();
        run(&inside.chain(arguments.split(' ')).collect::<Vec<_>>())
    }

    /// What holds it when it has no name any more.
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

/// Starts a process in a namespace: a thread goes there, and what it starts stays.
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
