//! The configuration file of the program.

use std::{
    collections::BTreeSet,
    fmt, fs,
    net::{Ipv4Addr, SocketAddrV4},
    path::{Path, PathBuf},
    time::Duration,
};

use serde::Deserialize;
use sinew_zenoh_link::{ProjectKey, Settings};

/// Maximum bytes of the configuration file and of a key file.
const FILE_MAX: u64 = 65_536;
/// Maximum number of routers, and of ports.
const ROUTERS_MAX: usize = 16;
const PORTS_MAX: usize = 64;

/// The keys of the file. Unknown ones are refused.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    project: String,
    address: String,
    #[serde(default = "interface")]
    interface: String,
    ports: Vec<u16>,
    routers: Vec<String>,
    key: OptionOff<PathBuf>,
    #[serde(default = "group")]
    group: OptionOff<SocketAddrV4>,
    #[serde(default = "group_every_ms")]
    group_every_ms: u64,
    #[serde(default = "lease_ms")]
    lease_ms: u64,
    #[serde(default)]
    tls: Tls,
}

/// A value, or `false`.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum OptionOff<T> {
    Some(T),
    Off(bool),
}

/// Certificates for routers with `tls/` addresses, as paths of PEM files.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// Authority of the routers' certificates; left out: the public authorities.
    pub root_ca_certificate: Option<String>,
    /// Certificate of this host, for routers that require one.
    pub connect_certificate: Option<String>,
    /// Private key of that certificate.
    pub connect_private_key: Option<String>,
}

fn interface() -> String {
    "zenoh".to_owned()
}

const fn group() -> OptionOff<SocketAddrV4> {
    OptionOff::Some(SocketAddrV4::new(Ipv4Addr::new(239, 255, 83, 119), 6_910))
}

const fn group_every_ms() -> u64 {
    1_000
}

const fn lease_ms() -> u64 {
    2_000
}

/// A checked configuration.
#[derive(Debug)]
pub struct Config {
    /// Settings of the link.
    pub settings: Settings,
    /// Name of the TUN device.
    pub interface: String,
    /// Zenoh endpoints of the routers. One is used at a time.
    pub routers: Vec<String>,
    /// Time without a sign of life after which a router counts as lost.
    pub lease: Duration,
    /// Certificates for the connection with the router.
    pub tls: Tls,
}

/// The causes for which a configuration is refused, all of them.
#[derive(Debug)]
pub struct ConfigError {
    path: PathBuf,
    faults: Vec<String>,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.faults.join("; "))
    }
}

impl std::error::Error for ConfigError {}

impl Config {
    /// Reads and checks the file.
    ///
    /// # Errors
    /// Returns each fault of the file, with its key and the remedy.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let refused = |faults| ConfigError { path: path.to_owned(), faults };
        let text = read(path).map_err(|fault| refused(vec![fault]))?;
        let text = String::from_utf8(text).map_err(|_| refused(vec!["it is no UTF-8 text".to_owned()]))?;
        Self::parse(&text).map_err(refused)
    }

    /// Checks the text of a file. A relative path of a key file is taken from the working directory.
    fn parse(text: &str) -> Result<Self, Vec<String>> {
        let file: File = toml::from_str(text).map_err(|error| vec![error.to_string()])?;
        let mut faults = Vec::new();
        let mut check = |is_good: bool, fault: &str| {
            if !is_good {
                faults.push(fault.to_owned());
            }
        };
        check((1..=63).contains(&file.project.len()), "project: 1 to 63 bytes, as in the nodes' files");
        check(
            (1..=15).contains(&file.interface.len()),
            "interface: 1 to 15 bytes, the name of the TUN device",
        );
        check(
            (1..=PORTS_MAX).contains(&file.ports.len()),
            "ports: 1 to 64, each node's ndl.port and gncl.port",
        );
        check(!file.ports.contains(&0), "ports: 0 is no port; give each node fixed ones");
        check(
            (1..=ROUTERS_MAX).contains(&file.routers.len()),
            "routers: 1 to 16, such as tcp/192.0.2.7:7447",
        );
        check((100..=60_000).contains(&file.group_every_ms), "group_every_ms: 100 to 60000");
        check((100..=60_000).contains(&file.lease_ms), "lease_ms: 100 to 60000");
        let network = network(&file.address);
        check(network.is_some(), "address: an IPv4 address and its prefix, such as 10.99.0.2/16");
        let group = match file.group {
            OptionOff::Some(group) => {
                check(
                    group.ip().is_multicast() && group.port() != 0,
                    "group: the nodes' ndl.multicast, or false",
                );
                Some(group)
            }
            OptionOff::Off(is_on) => {
                check(!is_on, "group: the nodes' ndl.multicast, or false");
                None
            }
        };
        let key = match file.key {
            OptionOff::Some(path) => read_key(&path).map_err(|fault| check(false, &fault)).ok(),
            OptionOff::Off(is_on) => {
                check(!is_on, "key: the path of discovery.key, or false for nodes without keys");
                None
            }
        };
        let Some((address, prefix)) = network.filter(|_| faults.is_empty()) else { return Err(faults) };
        let settings = Settings {
            project: file.project,
            address,
            prefix,
            ports: BTreeSet::from_iter(file.ports),
            group,
            group_every: Duration::from_millis(file.group_every_ms),
            key,
        };
        let lease = Duration::from_millis(file.lease_ms);
        Ok(Self { settings, interface: file.interface, routers: file.routers, lease, tls: file.tls })
    }
}

fn network(text: &str) -> Option<(Ipv4Addr, u8)> {
    let (address, prefix) = text.split_once('/')?;
    Some((address.parse().ok()?, prefix.parse().ok().filter(|prefix| (1..=30).contains(prefix))?))
}

fn read_key(path: &Path) -> Result<ProjectKey, String> {
    let text = read(path).map_err(|error| format!("key: {}: {error}", path.display()))?;
    let fault = || format!("key: {} is no discovery.key: 64 hexadecimal digits", path.display());
    ProjectKey::parse(&text).ok_or_else(fault)
}

/// Reads a file of bounded length.
fn read(path: &Path) -> Result<Vec<u8>, String> {
    let length = fs::metadata(path).map_err(|error| error.to_string())?.len();
    if length > FILE_MAX {
        return Err(format!("it has {length} bytes, more than {FILE_MAX}"));
    }
    fs::read(path).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEAST: &str = "project = \"leg\"\naddress = \"10.99.0.2/16\"\nports = [6911, 6912]\n\
                         routers = [\"tcp/192.0.2.7:7447\"]\nkey = false\n";

    #[test]
    fn least_file_has_the_defaults() {
        let config = Config::parse(LEAST).expect("a good file");
        assert_eq!(config.interface, "zenoh");
        assert_eq!(config.settings.address, Ipv4Addr::new(10, 99, 0, 2));
        assert_eq!(config.settings.prefix, 16);
        assert_eq!(config.settings.group, Some("239.255.83.119:6910".parse().expect("an address")));
        assert_eq!(config.lease, Duration::from_secs(2));
        assert!(config.settings.key.is_none());
    }

    #[test]
    fn all_faults_are_reported_together() {
        let text = LEAST.replace("/16", "").replace("6911", "0") + "lease_ms = 1\ngroup = true\n";
        let faults = Config::parse(&text).expect_err("four faults");
        for key in ["address", "ports", "lease_ms", "group"] {
            assert!(faults.iter().any(|fault| fault.starts_with(key)), "{key}: {faults:?}");
        }
        assert_eq!(faults.len(), 4);
    }

    #[test]
    fn key_must_be_chosen_and_unknown_keys_are_refused() {
        assert!(Config::parse(&LEAST.replace("key = false\n", "")).is_err());
        assert!(Config::parse(&(LEAST.to_owned() + "router = []\n")).is_err());
        let absent = LEAST.replace("key = false", "key = \"/nonexistent/discovery.key\"");
        assert!(Config::parse(&absent).expect_err("there is no such file")[0].starts_with("key: "));
    }
}
