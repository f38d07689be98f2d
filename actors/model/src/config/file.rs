//! Reads a configuration from TOML: the keys and their types. The check decides which values are legal.

mod commands;
mod reader;

#[cfg(test)]
pub(super) use self::commands::COMMAND_KEYS;

use std::{
    fs::File,
    io::Read,
    net::{SocketAddrV4, SocketAddrV6},
    ops::Range as Span,
    path::Path,
    time::Duration,
};

use sinew_runtime::tid::NodeAddress;
use toml::de::DeTable;

use self::reader::{Found, Reader};
use super::{
    ConfigError, ConfigFault, Interface, Interfaces, NodeConfig, WatchGroup,
    check::{self, fault},
};

/// Longest configuration file in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

const SECTIONS: [&str; 14] = [
    "node",
    "lncl",
    "gncl",
    "ndl",
    "sync",
    "supervision",
    "security",
    "log",
    "record",
    "rt",
    "stop",
    "contracts",
    "command",
    "app",
];

/// Every key of every section.
pub(super) const KEYS: [&str; 66] = [
    "node.name",
    "node.project",
    "node.address",
    "node.state",
    "node.mailbox_capacity",
    "node.mailbox_bytes",
    "node.payload_max",
    "lncl.socket",
    "lncl.clients_max",
    "lncl.clients_per_process_max",
    "lncl.strangers_max",
    "lncl.strangers_per_process_max",
    "lncl.guest_frames_per_s",
    "lncl.clients_bytes",
    "lncl.apps_max",
    "lncl.ring_bytes",
    "gncl.port",
    "gncl.announce",
    "gncl.further",
    "gncl.queue_capacity",
    "gncl.queue_bytes",
    "gncl.strangers_max",
    "gncl.handshake_ms",
    "gncl.redial_min_ms",
    "gncl.redial_max_ms",
    "gncl.give_up_ms",
    "gncl.marks",
    "gncl.datagrams",
    "gncl.spin_ms",
    "ndl.interface",
    "ndl.port",
    "ndl.multicast",
    "ndl.multicast6",
    "ndl.mdns_port",
    "ndl.seeds",
    "ndl.period_ms",
    "ndl.missed_max",
    "ndl.watch",
    "ndl.nodes_max",
    "sync.layer_deadline_ms",
    "sync.requirement_deadline_ms",
    "supervision.layer_restarts_max",
    "supervision.layer_window_ms",
    "supervision.app_restarts_max",
    "supervision.app_window_ms",
    "security.keys",
    "security.times",
    "security.access",
    "log.level",
    "record.folder",
    "record.keep_bytes",
    "record.keep_ms",
    "record.after_ms",
    "record.frozen_max",
    "record.frozen_folder",
    "record.apps",
    "record.types",
    "record.file",
    "record.split_bytes",
    "record.split_ms",
    "record.max_bytes",
    "record.compression",
    "rt.probe_ms",
    "stop.on_lost",
    "contracts.dry_run",
    "contracts.slack_ms",
];

impl NodeConfig {
    /// Reads and checks the configuration in the TOML `text`; missing settings have their defaults.
    ///
    /// # Errors
    /// All faults, not just the first one: keys that do not exist, values of another type, values out of range. Text
    /// that is not TOML is one fault.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::config::NodeConfig;
    /// let config = NodeConfig::from_toml("[node]\nname = 'knee'\n[ndl]\nperiod_ms = 100\n")?;
    /// assert_eq!(config.ndl.period.as_millis(), 100);
    ///
    /// let faults = NodeConfig::from_toml("[node]\nname = 'knee'\n[ndl]\nperoid_ms = 100\n").unwrap_err();
    /// assert!(faults.to_string().contains("write ndl.period_ms"));
    /// # Ok::<(), sinew::config::ConfigError>(())
    /// ```
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        let (config, faults) = Self::read(text)?;
        ConfigError::check(faults)?;
        Ok(config)
    }

    /// Reads the settings that are valid, and lists all faults of the others. The caller adds the faults of
    /// its own checks.
    fn read(text: &str) -> Result<(Self, Vec<ConfigFault>), ConfigError> {
        let table = DeTable::parse(text).map_err(|error| ConfigError::one(syntax_fault(text, &error)))?;
        let mut reader = Reader::new(text, table.get_ref());
        // A name that is not set is a fault, and the check finds it.
        let mut config = Self::new("");
        reader.read_node(&mut config);
        reader.read_lncl(&mut config);
        reader.read_gncl(&mut config);
        reader.read_ndl(&mut config);
        reader.time(&check::LAYER_DEADLINE, &mut config.sync.layer_deadline);
        reader.time(&check::REQUIREMENT_DEADLINE, &mut config.sync.requirement_deadline);
        reader.read_supervision(&mut config);
        reader.read_security(&mut config);
        reader.text(
            "log.level",
            "\"off\", \"error\", \"warn\", \"info\", \"debug\" or \"trace\"",
            &mut config.log.level,
        );
        reader.read_record(&mut config);
        reader.time(&check::PROBE, &mut config.rt.probe);
        reader.truth("stop.on_lost", &mut config.stop.on_lost);
        reader.truth("contracts.dry_run", &mut config.contracts.dry_run);
        reader.time(&check::SLACK, &mut config.contracts.slack);
        config.commands = reader.read_commands();
        config.app_settings = reader.app_settings.take().unwrap_or_default();
        let faults = reader.finish(&config).err().map(ConfigError::into_vec).unwrap_or_default();
        Ok((config, faults))
    }

    /// Reads and checks the configuration in the TOML file at `path`; at most 1 MiB.
    ///
    /// # Errors
    /// All faults, as in [`from_toml`](Self::from_toml). A file that cannot be read is one fault.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, ConfigError> {
        let (config, faults) = Self::read_file(path.as_ref());
        ConfigError::check(faults)?;
        Ok(config)
    }

    /// Reads all valid settings of the file, and returns them with all faults.
    pub fn read_file(path: &Path) -> (Self, Vec<ConfigFault>) {
        let read =
            Self::text_of(path).and_then(|text| Self::read(&text).map_err(|faults| faults.of_file(path)));
        match read {
            Ok((mut config, faults)) => {
                config.app_settings.name_file(path.to_owned());
                (
                    config,
                    ConfigError::check(faults)
                        .err()
                        .map_or_else(Vec::new, |all| all.of_file(path).into_vec()),
                )
            }
            Err(faults) => (Self::new(""), faults.into_vec()),
        }
    }

    fn text_of(path: &Path) -> Result<String, ConfigError> {
        read_bounded(path).map_err(|found| {
            let legal = "a text file of at most 1 MiB that this user may read";
            let remedy = "check its path and its permissions";
            ConfigError::one(fault(&path.display().to_string(), found, legal, remedy))
        })
    }
}

fn read_bounded(path: &Path) -> Result<String, String> {
    let file = File::open(path).map_err(|error| error.to_string())?;
    let mut text = String::new();
    file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text).map_err(|error| error.to_string())?;
    if text.len() as u64 > FILE_BYTES_MAX {
        return Err("a longer file".to_owned());
    }
    Ok(text)
}

/// Returns the fault of a text that is no TOML.
pub fn syntax_fault(text: &str, error: &toml::de::Error) -> ConfigFault {
    let line = error.span().map(|span| line_of(text, &span));
    let remedy = "correct this line; docs/book/src/reference/node.toml is a complete file";
    ConfigFault { line, ..fault("syntax", error.message().to_owned(), "TOML (https://toml.io)", remedy) }
}

/// Returns the line of `text` on which `span` starts, from 1.
pub fn line_of(text: &str, span: &Span<usize>) -> usize {
    let before = text.as_bytes().get(..span.start).unwrap_or_default();
    1 + before.iter().filter(|byte| **byte == b'\n').count()
}

/// Returns the text at `span`, cut to one line.
pub fn shown(text: &str, span: Span<usize>) -> String {
    const SHOWN_MAX: usize = 80;
    let raw = text.get(span).unwrap_or_default();
    let line: String = raw.chars().map(|c| if c.is_control() { ' ' } else { c }).take(SHOWN_MAX).collect();
    if line.len() < raw.len() { line + "..." } else { line }
}

/// The sections.
impl Reader<'_> {
    fn read_node(&mut self, config: &mut NodeConfig) {
        self.text("node.name", "\"knee\"", &mut config.name);
        self.text("node.project", "\"sinew\"", &mut config.project);
        let mut address: Found<NodeAddress> = Found(None);
        self.text("node.address", "\"10.0.0.7\"", &mut address);
        config.address = address.0;
        self.text_or_off("node.state", "\"/var/lib/sinew\" or false", &mut config.state);
        self.number(&check::MAILBOX_CAPACITY, &mut config.mailbox_capacity);
        self.number(&check::MAILBOX_BYTES, &mut config.mailbox_bytes);
        self.number(&check::PAYLOAD_MAX, &mut config.payload_max);
    }

    fn read_lncl(&mut self, config: &mut NodeConfig) {
        self.text_or_off("lncl.socket", "\"/run/sinew/knee.sock\" or false", &mut config.lncl.socket);
        let lncl = &mut config.lncl;
        self.number(&check::CLIENTS_MAX, &mut lncl.clients_max);
        self.number(&check::CLIENTS_PER_PROCESS_MAX, &mut lncl.clients_per_process_max);
        self.number(&check::LNCL_STRANGERS_MAX, &mut lncl.strangers_max);
        self.number(&check::STRANGERS_PER_PROCESS_MAX, &mut lncl.strangers_per_process_max);
        self.number(&check::GUEST_FRAMES, &mut lncl.guest_frames_per_s);
        self.number(&check::CLIENTS_BYTES, &mut lncl.clients_bytes);
        self.number(&check::APPS_MAX, &mut lncl.apps_max);
        self.number(&check::RING_BYTES, &mut lncl.ring_bytes);
    }

    fn read_gncl(&mut self, config: &mut NodeConfig) {
        let gncl = &mut config.gncl;
        self.number(&check::GNCL_PORT, &mut gncl.port);
        let example = "\"192.168.1.7:6912\" (of IPv4: those of IPv6 are announced as ndl.interface chooses them) or false";
        self.text_or_off::<SocketAddrV4>("gncl.announce", example, &mut gncl.announce);
        let remedy =
            "set gncl.further as in [\"192.168.2.7\"]; further IPv6 addresses are listed in `ndl.interface`";
        self.read_list("gncl.further", "a list of IPv4 addresses of this host", remedy, &mut gncl.further);
        self.number(&check::QUEUE_CAPACITY, &mut gncl.queue_capacity);
        self.number(&check::QUEUE_BYTES, &mut gncl.queue_bytes);
        self.number(&check::STRANGERS_MAX, &mut gncl.strangers_max);
        self.time(&check::HANDSHAKE, &mut gncl.handshake);
        self.time(&check::REDIAL_MIN, &mut gncl.redial_min);
        self.time(&check::REDIAL_MAX, &mut gncl.redial_max);
        self.time(&check::GIVE_UP, &mut gncl.give_up);
        self.truth("gncl.marks", &mut gncl.marks);
        self.truth("gncl.datagrams", &mut gncl.datagrams);
        self.time(&check::SPIN, &mut gncl.spin);
    }

    fn read_ndl(&mut self, config: &mut NodeConfig) {
        let ndl = &mut config.ndl;
        self.read_interfaces(&mut ndl.interface);
        self.number(&check::NDL_PORT, &mut ndl.port);
        let example = "\"239.255.83.119:6910\" or false";
        self.text_or_off::<SocketAddrV4>("ndl.multicast", example, &mut ndl.multicast);
        let example = "\"[ff12::8000:5377]:6910\" or false";
        self.text_or_off::<SocketAddrV6>("ndl.multicast6", example, &mut ndl.multicast6);
        if self.is_off("ndl.mdns_port") {
            ndl.mdns_port = None;
        } else if let Some(port) = &mut ndl.mdns_port {
            self.number(&check::MDNS_PORT, port);
        }
        let remedy = "set ndl.seeds as in [\"192.168.1.7:6911\", \"[fe80::7%eth0]:6911\"]";
        self.read_list("ndl.seeds", "a list of addresses with their ports", remedy, &mut ndl.seeds);
        self.time(&check::PERIOD, &mut ndl.period);
        self.number(&check::MISSED_MAX, &mut ndl.missed_max);
        self.read_watch(&mut ndl.watch);
        self.number(&check::NODES_MAX, &mut ndl.nodes_max);
    }

    /// Reads one interface, or a list of them.
    fn read_interfaces(&mut self, interfaces: &mut Interfaces) {
        const KEY: &str = "ndl.interface";
        let Some(value) = self.values.get(KEY).copied() else { return };
        let remedy =
            "set ndl.interface as in \"192.168.1.7\" or [\"eth0\", \"wlan0/ipv4\", \"fe80::7%eth1\"]";
        let mut read: Vec<Interface> = Vec::new();
        match value.get_ref().as_str().map(str::parse) {
            Some(Ok(interface)) => read.push(interface),
            Some(Err(_)) => return self.reject(KEY, value, check::INTERFACE_LEGAL, remedy),
            None => self.read_list(KEY, check::INTERFACE_LEGAL, remedy, &mut read),
        }
        if !read.is_empty() || value.get_ref().as_array().is_some_and(|list| list.is_empty()) {
            *interfaces = read.into();
        }
    }

    fn read_watch(&mut self, groups: &mut Vec<WatchGroup>) {
        let Some(value) = self.values.get("ndl.watch").copied() else { return };
        let remedy =
            "write [[ndl.watch]] and below it nodes = [\"leg.*\"], period_ms = 10 and missed_max = 3";
        let Some(tables) = value.get_ref().as_array() else {
            return self.reject("ndl.watch", value, check::WATCH_LEGAL, remedy);
        };
        for table in tables {
            match table.get_ref().as_table().and_then(watch_group) {
                Some(group) => groups.push(group),
                None => self.reject("ndl.watch", table, check::WATCH_LEGAL, remedy),
            }
        }
    }

    fn read_supervision(&mut self, config: &mut NodeConfig) {
        let supervision = &mut config.supervision;
        self.number(&check::LAYER_RESTARTS_MAX, &mut supervision.layer_restarts_max);
        self.time(&check::LAYER_WINDOW, &mut supervision.layer_window);
        self.number(&check::APP_RESTARTS_MAX, &mut supervision.app_restarts_max);
        self.time(&check::APP_WINDOW, &mut supervision.app_window);
    }

    fn read_security(&mut self, config: &mut NodeConfig) {
        let security = &mut config.security;
        self.text_or_off("security.keys", "\"/etc/sinew/keys\" or false", &mut security.keys);
        let example = "\"until-set\", \"strict\" or \"ignored\"";
        self.text("security.times", example, &mut security.times);
        self.text_or_off("security.access", "\"/etc/sinew/access.toml\" or false", &mut security.access);
    }

    fn read_record(&mut self, config: &mut NodeConfig) {
        let record = &mut config.record;
        self.text_or_off("record.folder", "\"/dev/shm\" or false", &mut record.folder);
        self.number(&check::KEEP_BYTES, &mut record.keep_bytes);
        self.time(&check::KEEP, &mut record.keep);
        self.time(&check::AFTER, &mut record.after);
        self.number(&check::FROZEN_MAX, &mut record.frozen_max);
        let example = "\"/var/lib/sinew\" or false";
        self.text_or_off("record.frozen_folder", example, &mut record.frozen_folder);
        let remedy = "set it as in [\"leg.*\"], or leave it out for all";
        self.read_list("record.apps", check::RECORDED_LEGAL, remedy, &mut record.apps);
        self.read_list("record.types", check::RECORDED_LEGAL, remedy, &mut record.types);
        self.text_or_off("record.file", "\"/var/log/{node}-{time}.mcap\" or false", &mut record.file);
        self.number_or_off(&check::SPLIT_BYTES, &mut record.split_bytes);
        let mut split_ms = record.split_time.map(|time| time.as_millis() as u64);
        self.number_or_off(&check::SPLIT_TIME, &mut split_ms);
        record.split_time = split_ms.map(Duration::from_millis);
        self.number_or_off(&check::MAX_BYTES, &mut record.max_bytes);
        let example = "\"zstd\", \"lz4\" or \"none\"";
        self.text("record.compression", example, &mut record.compression);
    }
}

/// Reads a group of nodes with its own detection times, if `table` has exactly its keys.
fn watch_group(table: &DeTable<'_>) -> Option<WatchGroup> {
    let number = |key: &str| {
        let number = table.get(key)?.get_ref().as_integer()?;
        u64::from_str_radix(number.as_str(), number.radix()).ok()
    };
    let nodes = table.get("nodes")?.get_ref().as_array()?;
    let nodes = nodes.iter().map(|name| name.get_ref().as_str().map(str::to_owned)).collect::<Option<_>>()?;
    let (period, missed_max) = (number("period_ms")?, u32::try_from(number("missed_max")?).ok()?);
    let is_all = table.len() == 3;
    is_all.then(|| WatchGroup { nodes, period: Duration::from_millis(period), missed_max })
}
