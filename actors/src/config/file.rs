//! Reads a configuration from TOML: knows the keys and their types. What is legal, the check decides.

use std::{
    collections::BTreeMap,
    fs::File,
    io::Read,
    net::{SocketAddrV4, SocketAddrV6},
    ops::Range as Span,
    path::Path,
    str::FromStr,
    time::Duration,
};

use sinew_runtime::tid::NodeAddress;
use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

use super::{
    AppSettings, ConfigFault, ConfigFaults, Interface, Interfaces, LogLevel, NodeConfig, WatchGroup,
    check::{self, Range, fault},
    faults::quoted,
};
use crate::nearest::nearest;

/// Longest configuration file in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

const SECTIONS: [&str; 9] = ["node", "lncl", "gncl", "ndl", "sync", "supervision", "security", "log", "app"];

/// Every key of every section.
pub(super) const KEYS: [&str; 49] = [
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
];

impl NodeConfig {
    /// Reads and checks the configuration in the TOML `text`; what it does not set has its default.
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
    /// # Ok::<(), sinew::config::ConfigFaults>(())
    /// ```
    pub fn from_toml(text: &str) -> Result<Self, ConfigFaults> {
        let (config, faults) = Self::read(text)?;
        ConfigFaults::check(faults)?;
        Ok(config)
    }

    /// Reads the settings that are valid, and lists all faults of the others. The caller adds the faults of its own checks.
    fn read(text: &str) -> Result<(Self, Vec<ConfigFault>), ConfigFaults> {
        let table = DeTable::parse(text).map_err(|error| ConfigFaults::one(syntax_fault(text, &error)))?;
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
        config.app_settings = reader.app_settings.take().unwrap_or_default();
        let faults = reader.finish(&config).err().map(ConfigFaults::into_vec).unwrap_or_default();
        Ok((config, faults))
    }

    /// Reads and checks the configuration in the TOML file at `path`; at most 1 MiB.
    ///
    /// # Errors
    /// All faults, as in [`from_toml`](Self::from_toml). A file that cannot be read is one fault.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, ConfigFaults> {
        let (config, faults) = Self::read_file(path.as_ref());
        ConfigFaults::check(faults)?;
        Ok(config)
    }

    /// As much of the file as can be used, with all that is wrong.
    pub(crate) fn read_file(path: &Path) -> (Self, Vec<ConfigFault>) {
        let read =
            Self::text_of(path).and_then(|text| Self::read(&text).map_err(|faults| faults.of_file(path)));
        match read {
            Ok((mut config, faults)) => {
                config.app_settings.name_file(path.to_owned());
                (
                    config,
                    ConfigFaults::check(faults)
                        .err()
                        .map_or_else(Vec::new, |all| all.of_file(path).into_vec()),
                )
            }
            Err(faults) => (Self::new(""), faults.into_vec()),
        }
    }

    fn text_of(path: &Path) -> Result<String, ConfigFaults> {
        read_bounded(path).map_err(|found| {
            let legal = "a text file of at most 1 MiB that this user may read";
            let remedy = "check its path and its permissions";
            ConfigFaults::one(fault(&path.display().to_string(), found, legal, remedy))
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

pub(crate) fn syntax_fault(text: &str, error: &toml::de::Error) -> ConfigFault {
    let line = error.span().map(|span| line_of(text, &span));
    let remedy = "correct this line; docs/CONFIGURATION.md has a complete file";
    ConfigFault { line, ..fault("syntax", error.message().to_owned(), "TOML (https://toml.io)", remedy) }
}

/// The line of `text` on which `span` begins, from 1.
pub(crate) fn line_of(text: &str, span: &Span<usize>) -> usize {
    let before = text.as_bytes().get(..span.start).unwrap_or_default();
    1 + before.iter().filter(|byte| **byte == b'\n').count()
}

/// What stands at `span`, on one line and not longer than that.
pub(crate) fn shown(text: &str, span: Span<usize>) -> String {
    const SHOWN_MAX: usize = 80;
    let raw = text.get(span).unwrap_or_default();
    let line: String = raw.chars().map(|c| if c.is_control() { ' ' } else { c }).take(SHOWN_MAX).collect();
    if line.len() < raw.len() { line + "..." } else { line }
}

/// The values of a file by their full keys, and what is wrong with them so far.
struct Reader<'t> {
    text: &'t str,
    values: BTreeMap<&'static str, &'t Spanned<DeValue<'t>>>,
    app_settings: Option<AppSettings>,
    faults: Vec<ConfigFault>,
}

/// Sorting the file's keys.
impl<'t> Reader<'t> {
    fn new(text: &'t str, table: &'t DeTable<'t>) -> Self {
        let mut reader = Self { text, values: BTreeMap::new(), app_settings: None, faults: Vec::new() };
        for (name, value) in table {
            let section = SECTIONS.into_iter().find(|section| *section == name.get_ref());
            match (section, value.get_ref()) {
                (Some("app"), DeValue::Table(table)) => {
                    reader.app_settings = Some(AppSettings::read(text, table));
                }
                (Some(section), DeValue::Table(table)) => reader.add_section(section, table),
                (Some(section), _) => {
                    let legal = format!("a section [{section}]");
                    let remedy = format!("write [{section}] on a line of its own and its keys below");
                    reader.reject(section, value, legal, remedy);
                }
                (None, DeValue::Table(_)) => reader.unknown(name, name.get_ref(), &SECTIONS),
                (None, _) => reader.unknown(name, name.get_ref(), &KEYS),
            }
        }
        reader
    }

    fn add_section(&mut self, section: &'static str, table: &'t DeTable<'t>) {
        for (name, value) in table {
            let full = format!("{section}.{}", name.get_ref());
            match KEYS.into_iter().find(|key| **key == *full) {
                Some(key) => {
                    self.values.insert(key, value);
                }
                None => self.unknown(name, &full, &KEYS),
            }
        }
    }

    fn unknown<S>(&mut self, place: &Spanned<S>, name: &str, known: &[&'static str]) {
        let (kind, remedy) = match (known == SECTIONS, nearest_key(name, known)) {
            (true, Some(nearest)) => {
                ("section", format!("write [{nearest}], the nearest section, or remove it"))
            }
            (false, Some(nearest)) => ("key", format!("write {nearest}, the nearest key, or remove it")),
            (true, None) => ("section", "remove it".to_owned()),
            (false, None) => ("key", "remove it".to_owned()),
        };
        let line = Some(line_of(self.text, &place.span()));
        let key = quoted(name).trim_matches('"').to_owned();
        let found = format!("a {kind} that does not exist");
        let legal = format!("a {kind} of docs/CONFIGURATION.md");
        self.faults.push(ConfigFault { line, ..fault(&key, found, legal, remedy) });
    }

    fn reject<S>(
        &mut self,
        key: &str,
        value: &Spanned<S>,
        legal: impl Into<String>,
        remedy: impl Into<String>,
    ) {
        let found = shown(self.text, value.span());
        let line = Some(line_of(self.text, &value.span()));
        self.faults.push(ConfigFault { line, ..fault(key, found, legal, remedy) });
    }

    fn reject_number(&mut self, range: &Range, value: &Spanned<DeValue<'_>>) {
        let found = shown(self.text, value.span());
        let line = Some(line_of(self.text, &value.span()));
        self.faults.push(ConfigFault { line, ..range.fault(found) });
    }

    /// Adds what the check finds, and says where it stands.
    fn finish(mut self, config: &NodeConfig) -> Result<(), ConfigFaults> {
        let checked = config.validate().err().map(ConfigFaults::into_vec).unwrap_or_default();
        for mut found in checked {
            // What could not be read has its default, or nothing, and its fault already.
            if self.faults.iter().all(|fault| fault.key != found.key) {
                let value = self.values.get(found.key.as_str());
                found.line = value.map(|value| line_of(self.text, &value.span()));
                self.faults.push(found);
            }
        }
        self.faults.sort_by_key(|fault| fault.line);
        ConfigFaults::check(self.faults)
    }
}

/// Reading values by their types.
impl<'t> Reader<'t> {
    fn integer(&mut self, range: &Range) -> Option<u64> {
        let value = *self.values.get(range.key)?;
        let number = value.get_ref().as_integer();
        let read = number.and_then(|number| u64::from_str_radix(number.as_str(), number.radix()).ok());
        if read.is_none() {
            self.reject_number(range, value);
        }
        read
    }

    /// A number into a type that may be too small for it.
    fn number<T: TryFrom<u64>>(&mut self, range: &Range, target: &mut T) {
        let Some(integer) = self.integer(range) else { return };
        match T::try_from(integer) {
            Ok(number) => *target = number,
            Err(_) => self.reject_number(range, self.values[range.key]),
        }
    }

    fn time(&mut self, range: &Range, target: &mut Duration) {
        if let Some(millis) = self.integer(range) {
            *target = Duration::from_millis(millis);
        }
    }

    /// A text that is a `T`; the example shows how one looks.
    fn text<T: FromStr>(&mut self, key: &str, example: &str, target: &mut T) {
        let Some(value) = self.values.get(key).copied() else { return };
        match value.get_ref().as_str().map(str::parse) {
            Some(Ok(read)) => *target = read,
            Some(Err(_)) | None => {
                self.reject(
                    key,
                    value,
                    format!("a text like {example}"),
                    format!("set {key} as in {example}"),
                );
            }
        }
    }

    fn truth(&mut self, key: &str, target: &mut bool) {
        let Some(value) = self.values.get(key).copied() else { return };
        match value.get_ref().as_bool() {
            Some(read) => *target = read,
            None => self.reject(key, value, "true or false", format!("set {key} to one of them")),
        }
    }

    /// Whether the value of `key` is `false`: switched off.
    fn is_off(&self, key: &str) -> bool {
        self.values.get(key).is_some_and(|value| value.get_ref().as_bool() == Some(false))
    }

    /// A text that is a `T`, or `false` for none.
    fn text_or_off<T: FromStr>(&mut self, key: &str, example: &str, target: &mut Option<T>) {
        if self.is_off(key) {
            *target = None;
        } else {
            let mut read = Found(None);
            self.text(key, example, &mut read);
            if let Found(Some(found)) = read {
                *target = Some(found);
            }
        }
    }
}

impl FromStr for LogLevel {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        Ok(match text {
            "off" => Self::Off,
            "error" => Self::Error,
            "warn" => Self::Warn,
            "info" => Self::Info,
            "debug" => Self::Debug,
            "trace" => Self::Trace,
            _ => return Err(()),
        })
    }
}

/// An optional value that is read like the value itself.
struct Found<T>(Option<T>);

impl<T: FromStr> FromStr for Found<T> {
    type Err = T::Err;

    fn from_str(text: &str) -> Result<Self, T::Err> {
        text.parse().map(|found| Self(Some(found)))
    }
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

    /// One interface, or a list of them.
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

    fn read_list<T: FromStr>(
        &mut self,
        key: &'static str,
        legal: &'static str,
        remedy: &'static str,
        list: &mut Vec<T>,
    ) {
        let Some(value) = self.values.get(key).copied() else { return };
        let Some(texts) = value.get_ref().as_array() else {
            return self.reject(key, value, legal, remedy);
        };
        for text in texts {
            match text.get_ref().as_str().map(str::parse) {
                Some(Ok(item)) => list.push(item),
                Some(Err(_)) | None => self.reject(key, text, legal, remedy),
            }
        }
    }
}

/// A group of nodes with a pace of their own, if `table` has what one has and nothing else.
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

/// The known name that is most similar to `name`. A name without a section is compared with keys without theirs.
fn nearest_key(name: &str, known: &[&'static str]) -> Option<&'static str> {
    let compared = |key: &&'static str| match key.split_once('.') {
        Some((_, leaf)) if !name.contains('.') => leaf,
        Some(_) | None => *key,
    };
    let known = known.iter().map(|key| (compared(key), *key));
    nearest(name, known, |(compared, _)| compared).first().map(|(_, key)| *key)
}
