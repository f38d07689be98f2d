//! The hosts, the routers and the tunnels.

use std::path::{Path, PathBuf};

use sinew_testkit::{Host, Hosts, NodeProcess, TestDirectory};

pub(crate) const NAMES: [&str; 3] = ["central", "knee", "ankle"];
/// Indices of the routers among the hosts. Each has an interface in each network.
pub(crate) const ROUTERS: [usize; 2] = [3, 4];
/// A loss takes four periods: longer than a change to the other router.
const PERIOD_MS: u32 = 1_000;
/// A router is given up after this time without a sign of life.
const LEASE_MS: &str = "1000";

/// The hosts, the routers that run, and the tunnels.
pub(crate) struct Site {
    pub(crate) tunnels: Vec<NodeProcess>,
    pub(crate) routers: Vec<NodeProcess>,
    pub(crate) hosts: Hosts,
    pub(crate) directory: TestDirectory,
    pub(crate) scenarios: PathBuf,
}

/// The folder of the main workspace's programs.
pub(crate) fn scenarios() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../target/debug");
    let folder = std::env::var_os("SINEW_PROGRAMS").map_or(default, PathBuf::from);
    let path = folder.join("scenarios");
    if !path.exists() {
        println!("skipped: there is no {}: cargo build -p sinew-tests", path.display());
        return None;
    }
    Some(path)
}

impl Site {
    /// Starts routers and tunnels. `key` are the digits of the project's key, if it has one.
    pub(crate) fn start(key: Option<&str>) -> Option<Self> {
        let scenarios = scenarios()?;
        let hosts = Hosts::in_networks(5, 3);
        let hosts = hosts.inspect_err(|why| println!("skipped: no hosts can be made here: {why}")).ok()?;
        for host in 0..NAMES.len() {
            let others = (0..3_u8).filter(|network| usize::from(*network) != host);
            others.for_each(|network| hosts.take_down(host, network));
            let made = device(&hosts.all()[host], host);
            made.inspect_err(|why| println!("skipped: no TUN device can be made here: {why}")).ok()?;
        }
        let directory = TestDirectory::new();
        let mut site = Self { tunnels: Vec::new(), routers: Vec::new(), hosts, directory, scenarios };
        site.routers = ROUTERS.iter().map(|router| site.router(*router)).collect();
        site.tunnels = (0..NAMES.len()).map(|host| site.tunnel(host, key)).collect();
        for tunnel in &mut site.tunnels {
            tunnel.wait_for(&["carries 10.99.0."]);
        }
        Some(site)
    }

    pub(crate) fn router(&self, host: usize) -> NodeProcess {
        // Each reaches the other in all networks; one is enough.
        let other = ROUTERS.iter().find(|other| **other != host).expect("two routers");
        router(&self.hosts.all()[host], Some(&format!("tcp/10.77.0.{}:7447", other + 1)))
    }

    pub(crate) fn tunnel(&self, host: usize, key: Option<&str>) -> NodeProcess {
        let routers = ROUTERS.map(|router| format!("tcp/10.{}.0.{}:7447", 77 + host, router + 1));
        tunnel((&self.hosts.all()[host], host), &self.directory, key, &routers)
    }

    /// Starts a node of the scenarios on a host, in this role, with these arguments behind its configuration.
    /// `take` gets each line of its output first.
    pub(crate) fn node_with(
        &self,
        (host, role): (usize, &str),
        arguments: &[&str],
        take: impl FnMut(&str) -> bool + Send + 'static,
    ) -> NodeProcess {
        let config = configuration(&self.directory, NAMES[host], host);
        let mut command = self.hosts.all()[host].command(&self.scenarios);
        command.args(["--role", role]).arg(config).args(arguments);
        NodeProcess::start_with(NAMES[host], command, take)
    }

    /// Starts the node under test on a host.
    pub(crate) fn node(&self, host: usize, arguments: &[&str]) -> NodeProcess {
        self.node_with((host, "node_under_test"), arguments, |_| false)
    }

    /// Kills a router, and starts it again.
    pub(crate) fn restart_router(&mut self, index: usize) {
        self.routers[index].kill();
        self.routers[index] = self.router(ROUTERS[index]);
    }
}

/// Starts a router on a host, connected with another one.
pub(crate) fn router(host: &Host, other: Option<&str>) -> NodeProcess {
    let mut command = host.command(Path::new(env!("CARGO_BIN_EXE_sinew-zenoh-router")));
    command.args([LEASE_MS, "tcp/0.0.0.0:7447"]).args(other);
    let mut router = NodeProcess::start("router", command);
    router.wait_for(&["router"]);
    router
}

/// Starts the tunnel of the host with this index, which uses one of these routers.
pub(crate) fn tunnel(
    (host, index): (&Host, usize),
    directory: &TestDirectory,
    key: Option<&str>,
    routers: &[String],
) -> NodeProcess {
    let key = key.map_or_else(
        || "false".to_owned(),
        |key| format!("\"{}\"", directory.write("discovery.key", key).display()),
    );
    let text = format!(
        "project = \"hosts\"\naddress = \"10.99.0.{}/16\"\nports = [6911, 6912]\nkey = {key}\n\
         routers = [\"{}\"]\nlease_ms = {LEASE_MS}\n",
        index + 1,
        routers.join("\", \"")
    );
    let mut command = host.command(Path::new(env!("CARGO_BIN_EXE_sinew-zenoh")));
    command.arg(directory.write(&format!("link-{index}.toml"), &text));
    NodeProcess::start("sinew-zenoh", command)
}

/// Writes the configuration of a node on the host with this index.
pub(crate) fn configuration(directory: &TestDirectory, name: &str, index: usize) -> PathBuf {
    let address = index + 1;
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.99.0.{address}\"\n\
         mailbox_capacity = 65536\n\
         [gncl]\nport = 6912\nqueue_capacity = 65536\n\
         [ndl]\ninterface = \"zenoh\"\nport = 6911\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
    );
    directory.write(&format!("{name}.toml"), &text)
}

/// Makes the device of a host, as its administrator does once.
pub(crate) fn device(host: &Host, index: usize) -> Result<(), String> {
    host.ip("tuntap add dev zenoh mode tun")?;
    host.ip(&format!("address add 10.99.0.{}/16 dev zenoh", index + 1))?;
    host.ip("link set zenoh mtu 4096 up")
}
