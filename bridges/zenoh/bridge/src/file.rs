//! The configuration file of the bridge.
//!
//! `bridges/zenoh/README.md` lists the keys. A key that is not in the list is a fault, and so is each rule that could
//! mean something else than its author wants.

mod faults;
mod routes;
#[cfg(test)]
mod tests;

use std::{
    fmt, fs,
    io::Read as _,
    path::{Path, PathBuf},
    time::Duration,
};

use serde::Deserialize;
use sinew::{
    AppAddress,
    name::{check_name, check_node_name},
};

use crate::Rules;
use faults::Faults;
use routes::{InFile, OutFile};

/// Maximum bytes of the configuration file.
const FILE_MAX: u64 = 1 << 20;
/// Maximum number of endpoints of Zenoh.
const ENDPOINTS_MAX: usize = 16;
/// Maximum number of patterns of shown applications.
const SHOWN_MAX: usize = 64;
/// Maximum number of names for Zenoh programs: each is a client of the node.
pub const PROGRAMS_MAX: usize = 16;
/// Maximum number of groups that the bridge joins.
const GROUPS_MAX: usize = 128;

/// The keys of the file. Unknown ones are refused.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    project: String,
    socket: PathBuf,
    #[serde(default = "name")]
    name: String,
    address: Option<u32>,
    #[serde(default = "requests")]
    requests: u8,
    #[serde(default = "queue")]
    queue: usize,
    #[serde(default)]
    zenoh: Zenoh,
    #[serde(default)]
    liveness: Liveness,
    #[serde(default, rename = "in")]
    inward: Vec<InFile>,
    #[serde(default, rename = "out")]
    outward: Vec<OutFile>,
}

/// The side of Zenoh.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Zenoh {
    /// A client of a router, or a peer.
    pub mode: Mode,
    /// Endpoints to connect to. A client uses one of them at a time.
    pub connect: Vec<String>,
    /// Endpoints at which a peer listens.
    pub listen: Vec<String>,
    /// Whether peers are searched for by multicast.
    pub scouting: bool,
    /// Time without a sign of life after which a router or a peer counts as lost, in ms.
    pub lease_ms: u64,
    /// Certificates for endpoints with `tls/`, as paths of PEM files.
    pub tls: Tls,
}

/// The part of the bridge in the network of Zenoh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// A client of one router.
    #[default]
    Client,
    /// A peer, which other peers may connect to.
    Peer,
}

/// Certificates, as paths of PEM files.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// Authority of the others' certificates; left out: the public authorities.
    pub root_ca_certificate: Option<String>,
    /// Certificate of the bridge for endpoints that it connects to.
    pub connect_certificate: Option<String>,
    /// Private key of that certificate.
    pub connect_private_key: Option<String>,
    /// Certificate of the bridge for endpoints at which it listens.
    pub listen_certificate: Option<String>,
    /// Private key of that certificate.
    pub listen_private_key: Option<String>,
}

impl Default for Zenoh {
    fn default() -> Self {
        Self {
            mode: Mode::Client,
            connect: vec!["tcp/127.0.0.1:7447".to_owned()],
            listen: Vec::new(),
            scouting: false,
            lease_ms: 2_000,
            tls: Tls::default(),
        }
    }
}

/// The nodes and applications with a liveliness token.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Liveness {
    apps: Vec<String>,
    nodes: bool,
}

fn name() -> String {
    "zenoh".to_owned()
}

const fn requests() -> u8 {
    4
}

const fn queue() -> usize {
    256
}

/// A checked configuration.
#[derive(Clone, Debug)]
pub struct Config {
    /// The node's socket.
    pub socket: PathBuf,
    /// The name of the bridge at the node.
    pub name: String,
    /// Its fixed address at the node, for guards of protected commands; `None`: the node chooses one.
    pub address: Option<AppAddress>,
    /// Number of requests and confirmed messages at the same time. Each has a client of its own.
    pub requests: u8,
    /// Room of each queue between both sides, in messages.
    pub queue: usize,
    /// The side of Zenoh.
    pub zenoh: Zenoh,
    /// The rules of both directions.
    pub rules: Rules,
    /// Faults that do not keep the bridge from starting.
    pub warnings: Vec<String>,
}

/// The faults for which a configuration is refused, all of them.
#[derive(Debug)]
pub struct ConfigError {
    path: PathBuf,
    faults: Vec<String>,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.faults.join("\n  "))
    }
}

impl std::error::Error for ConfigError {}

impl Config {
    /// Reads and checks the file.
    ///
    /// # Errors
    /// Returns each fault of the file, with its place and the remedy.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let refused = |faults| ConfigError { path: path.to_owned(), faults };
        let text = read(path).map_err(|fault| refused(vec![fault]))?;
        Self::parse(&text).map_err(refused)
    }

    /// Checks the text of a file.
    ///
    /// # Errors
    /// Returns each fault, with its place and the remedy.
    pub fn parse(text: &str) -> Result<Self, Vec<String>> {
        // It names the line, and the keys that the part of the file may have.
        let file: File = toml::from_str(text).map_err(|error| vec![error.to_string()])?;
        let mut faults = Faults::default();
        if let Err(why) = check_node_name(&file.project) {
            faults.add("project", format_args!("{why}"));
        }
        if let Err(why) = check_name(&file.name) {
            faults.add("name", format_args!("{why}"));
        }
        let address = file.address.map(AppAddress::new);
        let is_fixed = address.is_none_or(AppAddress::is_fixed);
        faults.check(is_fixed, "address", "0x1000 to 0x7fffffff, such as 0x2001");
        faults.check((1..=32).contains(&file.requests), "requests", "1 to 32");
        faults.check((1..=65_536).contains(&file.queue), "queue", "1 to 65536 messages");
        file.zenoh.check(&mut faults);
        let mut rules = Rules::new(&file.project);
        file.liveness.apply(&mut rules, &mut faults);
        routes::apply(&file.inward, &file.outward, &mut rules, &mut faults);
        let groups = rules.groups().len();
        faults.check(groups <= GROUPS_MAX, "[[out]]", "at most 128 groups; start a second bridge");
        let programs = rules.programs().count();
        faults.check(programs <= PROGRAMS_MAX, "[[out]]", "at most 16 names; start a second bridge");
        let takes_name = rules.programs().any(|program| is_own_name(&program.name, &file.name));
        faults.check(!takes_name, "[[out]]", "`name` is the bridge's own name; choose another one");
        let warnings = warnings(&file.zenoh, &rules);
        faults.end().map(|()| Self {
            socket: file.socket,
            name: file.name,
            address,
            requests: file.requests,
            queue: file.queue,
            zenoh: file.zenoh,
            rules,
            warnings,
        })
    }
}

/// Returns whether this is the name of the bridge, or of one of its clients for requests.
fn is_own_name(name: &str, own: &str) -> bool {
    name.strip_prefix(own).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

impl Zenoh {
    fn check(&self, faults: &mut Faults) {
        faults.check((100..=60_000).contains(&self.lease_ms), "zenoh.lease_ms", "100 to 60000");
        let endpoints = self.connect.iter().chain(&self.listen);
        for endpoint in endpoints.filter(|endpoint| !is_endpoint(endpoint)) {
            faults.add(
                "zenoh",
                format_args!("{endpoint:?} is no endpoint: tcp/192.0.2.7:7447 or tls/router:7447"),
            );
        }
        let count = self.connect.len().max(self.listen.len());
        faults.check(count <= ENDPOINTS_MAX, "zenoh", "at most 16 endpoints in each list");
        match self.mode {
            Mode::Client => {
                faults.check(!self.connect.is_empty(), "zenoh.connect", "a client needs a router's endpoint");
                faults.check(
                    self.listen.is_empty(),
                    "zenoh.listen",
                    "a client does not listen: mode = \"peer\"",
                );
                faults.check(!self.scouting, "zenoh.scouting", "a client uses its routers: mode = \"peer\"");
            }
            Mode::Peer => {
                let reaches = !self.connect.is_empty() || !self.listen.is_empty() || self.scouting;
                faults.check(reaches, "zenoh", "a peer needs `connect`, `listen` or `scouting`");
            }
        }
        let pairs = [
            (&self.tls.connect_certificate, &self.tls.connect_private_key, "connect"),
            (&self.tls.listen_certificate, &self.tls.listen_private_key, "listen"),
        ];
        for (certificate, key, part) in pairs {
            let is_whole = certificate.is_some() == key.is_some();
            let place = format!("zenoh.tls.{part}_certificate");
            faults.check(is_whole, &place, "a certificate and its private key belong together");
        }
        let listens_tls = self.listen.iter().any(|endpoint| endpoint.starts_with("tls/"));
        let has_own = self.tls.listen_certificate.is_some();
        faults.check(!listens_tls || has_own, "zenoh.tls.listen_certificate", "tls/ in `listen` needs it");
    }

    /// Returns the certificates, with the keys that zenoh's configuration has for them.
    pub fn certificates(&self) -> impl Iterator<Item = (&'static str, &str)> {
        let tls = &self.tls;
        let all = [
            ("root_ca_certificate", &tls.root_ca_certificate),
            ("connect_certificate", &tls.connect_certificate),
            ("connect_private_key", &tls.connect_private_key),
            ("listen_certificate", &tls.listen_certificate),
            ("listen_private_key", &tls.listen_private_key),
        ];
        all.into_iter().filter_map(|(key, path)| Some((key, path.as_deref()?)))
    }

    /// Returns the lease.
    #[must_use]
    pub const fn lease(&self) -> Duration {
        Duration::from_millis(self.lease_ms)
    }
}

impl Liveness {
    fn apply(self, rules: &mut Rules, faults: &mut Faults) {
        faults.check(self.apps.len() <= SHOWN_MAX, "liveness.apps", "at most 64 names or patterns");
        for pattern in self.apps.iter().filter(|pattern| pattern.is_empty() || pattern.len() > 63) {
            faults.add("liveness.apps", format_args!("{pattern:?}: a name, or a pattern such as leg.*"));
        }
        rules.show(self.apps, self.nodes);
    }
}

fn is_endpoint(text: &str) -> bool {
    let address = text.strip_prefix("tcp/").or_else(|| text.strip_prefix("tls/"));
    let port = |address: &str| address.rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
    address.is_some_and(|address| port(address).is_some() && address.is_ascii())
}

fn is_on_loopback(endpoint: &str) -> bool {
    ["tcp/127.", "tls/127.", "tcp/localhost:", "tls/localhost:", "tcp/[::1]:", "tls/[::1]:"]
        .iter()
        .any(|start| endpoint.starts_with(start))
}

/// Returns warnings about endpoints without TLS beyond this host, and about commands of unknown age.
fn warnings(zenoh: &Zenoh, rules: &Rules) -> Vec<String> {
    let endpoints = zenoh.connect.iter().chain(&zenoh.listen);
    let open = endpoints.filter(|endpoint| endpoint.starts_with("tcp/") && !is_on_loopback(endpoint));
    let open = open.map(|endpoint| {
        format!("{endpoint}: without TLS everybody on the way reads and forges messages; use tls/ and certificates")
    });
    let old = rules.inward().iter().filter(|route| route.protection.is_some() && route.age_max.is_none());
    let old = old.map(|route| {
        format!(
            "[[in]] {}: the age of a command counts from the bridge; set `age_max_ms` if its way to the bridge can be slow",
            route.address.target
        )
    });
    open.chain(old).collect()
}

/// Reads a file of bounded length.
fn read(path: &Path) -> Result<String, String> {
    let file = fs::File::open(path).map_err(|error| error.to_string())?;
    let mut text = String::new();
    file.take(FILE_MAX + 1).read_to_string(&mut text).map_err(|error| error.to_string())?;
    if text.len() as u64 > FILE_MAX {
        return Err(format!("it has more than {FILE_MAX} bytes; is it the right file?"));
    }
    Ok(text)
}
