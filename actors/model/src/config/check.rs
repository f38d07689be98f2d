//! The legal range of every setting, checked at once for a configuration from code or from TOML.

#[cfg(test)]
mod reference;

use std::{
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddrV4, SocketAddrV6},
    path::Path,
    time::Duration,
};

use super::{
    ConfigError, ConfigFault, Interface, NodeConfig, Seed, WatchGroup, command::check_commands,
    faults::quoted,
};
use crate::limits::{FURTHER_MAX, NAME_BYTES_MAX, PATHS_MAX};

/// Maximum bytes of a unix socket's path: the limit of every system, with the terminating zero.
const SOCKET_BYTES_MAX: usize = 100;
/// Longest path of a directory in bytes: PATH_MAX of Linux.
const DIRECTORY_BYTES_MAX: usize = 4_096;
/// The legal values of an interface.
pub(super) const INTERFACE_LEGAL: &str = "each an address of this host, as in 192.168.1.7, fd00::7 or fe80::7%eth0, a name of 1 to 15 bytes, as in eth0, or all, the last two with /ipv4 \
     or /ipv6 behind them for one family alone";
/// Maximum number of seeds.
const SEEDS_MAX: usize = 256;
/// Maximum number of groups with their own detection times, and of names in one of them.
const WATCH_MAX: usize = 16;
const WATCHED_NAMES_MAX: usize = 64;

/// A setting that is a number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Range {
    /// Its name in a file: `section.key`.
    pub(super) key: &'static str,
    /// Smallest legal value.
    pub(super) low: u64,
    /// Largest legal value.
    pub(super) high: u64,
    unit: &'static str,
}

const fn range(key: &'static str, low: u64, high: u64, unit: &'static str) -> Range {
    Range { key, low, high, unit }
}

pub(super) const MAILBOX_CAPACITY: Range = range("node.mailbox_capacity", 1, 65_536, "messages");
pub(super) const MAILBOX_BYTES: Range = range("node.mailbox_bytes", 4 << 10, 1 << 30, "bytes");
pub(super) const PAYLOAD_MAX: Range = range("node.payload_max", 64, 64 << 20, "bytes");
pub(super) const CLIENTS_MAX: Range = range("lncl.clients_max", 1, 4_096, "connections");
pub(super) const CLIENTS_PER_PROCESS_MAX: Range =
    range("lncl.clients_per_process_max", 1, 4_096, "connections");
pub(super) const LNCL_STRANGERS_MAX: Range = range("lncl.strangers_max", 1, 1_024, "connections");
pub(super) const STRANGERS_PER_PROCESS_MAX: Range =
    range("lncl.strangers_per_process_max", 1, 1_024, "connections");
pub(super) const GUEST_FRAMES: Range = range("lncl.guest_frames_per_s", 100, 1_000_000, "frames in a second");
pub(super) const CLIENTS_BYTES: Range = range("lncl.clients_bytes", 64 << 10, 64 << 30, "bytes");
pub(super) const APPS_MAX: Range = range("lncl.apps_max", 1, 65_536, "applications");
pub(super) const RING_BYTES: Range = range("lncl.ring_bytes", 4 << 10, 16 << 20, "bytes");
pub(super) const GNCL_PORT: Range = range("gncl.port", 0, 65_535, "(0: any free port)");
pub(super) const QUEUE_CAPACITY: Range = range("gncl.queue_capacity", 1, 65_536, "messages");
pub(super) const QUEUE_BYTES: Range = range("gncl.queue_bytes", 4 << 10, 1 << 30, "bytes");
pub(super) const STRANGERS_MAX: Range = range("gncl.strangers_max", 1, 1_024, "connections");
pub(super) const HANDSHAKE: Range = range("gncl.handshake_ms", 10, 60_000, "ms");
pub(super) const REDIAL_MIN: Range = range("gncl.redial_min_ms", 1, 10_000, "ms");
pub(super) const REDIAL_MAX: Range = range("gncl.redial_max_ms", 1, 60_000, "ms");
pub(super) const GIVE_UP: Range = range("gncl.give_up_ms", 100, 600_000, "ms");
pub(super) const SPIN: Range = range("gncl.spin_ms", 0, 10, "ms");
pub(super) const NDL_PORT: Range = range("ndl.port", 0, 65_535, "(0: any free port)");
pub(super) const MDNS_PORT: Range = range("ndl.mdns_port", 1, 65_535, "or false");
pub(super) const PERIOD: Range = range("ndl.period_ms", 10, 60_000, "ms");
pub(super) const MISSED_MAX: Range = range("ndl.missed_max", 2, 100, "answers");
pub(super) const NODES_MAX: Range = range("ndl.nodes_max", 1, 65_536, "nodes");
pub(super) const LAYER_DEADLINE: Range = range("sync.layer_deadline_ms", 10, 600_000, "ms");
pub(super) const REQUIREMENT_DEADLINE: Range = range("sync.requirement_deadline_ms", 10, 86_400_000, "ms");
pub(super) const LAYER_RESTARTS_MAX: Range =
    range("supervision.layer_restarts_max", 0, 1_000_000, "restarts");
pub(super) const LAYER_WINDOW: Range = range("supervision.layer_window_ms", 1, 3_600_000, "ms");
pub(super) const APP_RESTARTS_MAX: Range = range("supervision.app_restarts_max", 0, 1_000_000, "restarts");
pub(super) const APP_WINDOW: Range = range("supervision.app_window_ms", 1, 3_600_000, "ms");
pub(super) const KEEP_BYTES: Range = range("record.keep_bytes", 64 << 10, 4 << 30, "bytes");
pub(super) const SPLIT_BYTES: Range = range("record.split_bytes", 64 << 10, 1 << 50, "bytes, or false");
pub(super) const SPLIT_TIME: Range = range("record.split_ms", 1_000, 604_800_000, "ms, or false");
pub(super) const MAX_BYTES: Range = range("record.max_bytes", 64 << 10, 1 << 50, "bytes, or false");
pub(super) const KEEP: Range = range("record.keep_ms", 1_000, 600_000, "ms");
pub(super) const AFTER: Range = range("record.after_ms", 1_000, 60_000, "ms");
pub(super) const FROZEN_MAX: Range = range("record.frozen_max", 0, 64, "spans");
pub(super) const PROBE: Range = range("rt.probe_ms", 0, 60_000, "ms");
pub(super) const SLACK: Range = range("contracts.slack_ms", 0, 1_000, "ms");
pub(super) const COMMAND_START: Range = range("command.start_ms", 10, 600_000, "ms");
pub(super) const COMMAND_STOP: Range = range("command.stop_ms", 0, 60_000, "ms");
pub(super) const COMMAND_HANG: Range = range("command.hang_ms", 20, 600_000, "ms, or false");
pub(super) const COMMAND_BACKOFF_MIN: Range = range("command.backoff_min_ms", 1, 60_000, "ms");
pub(super) const COMMAND_BACKOFF_MAX: Range = range("command.backoff_max_ms", 1, 600_000, "ms");
/// Maximum number of names in `record.apps` and `record.types`, and maximum bytes of one.
const RECORDED_MAX: usize = 64;
const RECORDED_BYTES_MAX: usize = 255;
/// The legal values of these lists.
pub(super) const RECORDED_LEGAL: &str = "at most 64 names of 1 to 255 bytes, in which `*` matches any text";

impl Range {
    /// Returns the fault for the value `found` outside of this range.
    pub(super) fn fault(&self, found: String) -> ConfigFault {
        let Self { key, low, high, unit } = self;
        let remedy = format!("set {key} to a number from {low} to {high}");
        fault(key, found, format!("{low} to {high} {unit}"), remedy)
    }

    fn count(&self, faults: &mut Vec<ConfigFault>, found: usize) {
        if !(self.low..=self.high).contains(&(found as u64)) {
            faults.push(self.fault(found.to_string()));
        }
    }

    pub(super) fn time(&self, faults: &mut Vec<ConfigFault>, found: Duration) {
        if found < Duration::from_millis(self.low) || found > Duration::from_millis(self.high) {
            faults.push(self.fault(format!("{found:?}")));
        }
    }
}

/// Returns the fault of `key`, with the value that was found, the legal values, and the remedy.
pub fn fault(key: &str, found: String, legal: impl Into<String>, remedy: impl Into<String>) -> ConfigFault {
    ConfigFault {
        key: key.to_owned(),
        file: None,
        line: None,
        found,
        legal: legal.into(),
        remedy: remedy.into(),
    }
}

impl NodeConfig {
    /// Checks every setting and their combinations. A node is built only from a checked configuration.
    ///
    /// # Errors
    /// All faults, not just the first one.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::config::NodeConfig;
    /// let mut config = NodeConfig::new("knee");
    /// config.ndl.missed_max = 0;
    /// let faults = config.validate().unwrap_err().to_string();
    /// assert!(faults.starts_with("ndl.missed_max: found 0; legal is 2 to 100 answers"));
    /// ```
    pub fn validate(&self) -> Result<(), ConfigError> {
        let mut faults = Vec::new();
        self.check_node(&mut faults);
        self.check_lncl(&mut faults);
        self.check_gncl(&mut faults);
        self.check_ndl(&mut faults);
        LAYER_DEADLINE.time(&mut faults, self.sync.layer_deadline);
        REQUIREMENT_DEADLINE.time(&mut faults, self.sync.requirement_deadline);
        LAYER_RESTARTS_MAX.count(&mut faults, self.supervision.layer_restarts_max);
        LAYER_WINDOW.time(&mut faults, self.supervision.layer_window);
        APP_RESTARTS_MAX.count(&mut faults, self.supervision.app_restarts_max);
        APP_WINDOW.time(&mut faults, self.supervision.app_window);
        self.check_security(&mut faults);
        self.check_record(&mut faults);
        PROBE.time(&mut faults, self.rt.probe);
        SLACK.time(&mut faults, self.contracts.slack);
        check_commands(&mut faults, &self.commands, self.lncl.socket.is_some());
        ConfigError::check(faults)
    }

    fn check_node(&self, faults: &mut Vec<ConfigFault>) {
        check_node_name(faults, "node.name", &self.name);
        check_node_name(faults, "node.project", &self.project);
        if let Some(address) = self.address.filter(|address| !address.is_single()) {
            let legal = "an address of one node, as in 10.0.0.7";
            let remedy =
                "choose one that no other node of the project has, or leave it out for the interface's";
            faults.push(fault("node.address", quoted(&address.to_string()), legal, remedy));
        }
        let is_nameless =
            self.ndl.interface.first_address().is_none() && self.ndl.interface.iter().next().is_some();
        if self.address.is_none() && is_nameless {
            let legal =
                "an address of one node, as in 10.0.0.7, where ndl.interface names no IPv4 address first";
            let remedy = "give the node an address of its own: an IPv6 address is too long for one, and an interface that is chosen by its name may have none, or another one tomorrow";
            faults.push(fault("node.address", "nothing".to_owned(), legal, remedy));
        }
        if let Some(state) = self.state.as_deref().filter(|state| !is_path(state)) {
            let legal = format!("the path of a directory, 1 to {DIRECTORY_BYTES_MAX} bytes, or false");
            let remedy = "name a directory of the node's user, as in /var/lib/sinew";
            faults.push(fault("node.state", quoted(&state.to_string_lossy()), legal, remedy));
        }
        MAILBOX_CAPACITY.count(faults, self.mailbox_capacity);
        MAILBOX_BYTES.count(faults, self.mailbox_bytes);
        PAYLOAD_MAX.count(faults, self.payload_max);
    }

    fn check_lncl(&self, faults: &mut Vec<ConfigFault>) {
        if let Some(socket) = self.lncl.socket.as_deref().filter(|socket| !is_socket_path(socket)) {
            let legal = format!("a path of 1 to {SOCKET_BYTES_MAX} bytes, or false");
            let remedy = "choose a shorter path, as in /run/sinew/knee.sock";
            faults.push(fault("lncl.socket", quoted(&socket.to_string_lossy()), legal, remedy));
        }
        CLIENTS_MAX.count(faults, self.lncl.clients_max);
        CLIENTS_PER_PROCESS_MAX.count(faults, self.lncl.clients_per_process_max);
        LNCL_STRANGERS_MAX.count(faults, self.lncl.strangers_max);
        STRANGERS_PER_PROCESS_MAX.count(faults, self.lncl.strangers_per_process_max);
        GUEST_FRAMES.count(faults, self.lncl.guest_frames_per_s);
        CLIENTS_BYTES.count(faults, self.lncl.clients_bytes);
        APPS_MAX.count(faults, self.lncl.apps_max);
        RING_BYTES.count(faults, self.lncl.ring_bytes);
    }

    fn check_security(&self, faults: &mut Vec<ConfigFault>) {
        if let Some(keys) = self.security.keys.as_deref().filter(|keys| !is_path(keys)) {
            let legal = format!("the path of a directory, 1 to {DIRECTORY_BYTES_MAX} bytes, or false");
            let remedy = "name the directory that `sinew keys` made for this node, as in /etc/sinew/keys";
            faults.push(fault("security.keys", quoted(&keys.to_string_lossy()), legal, remedy));
        }
        if let Some(access) = self.security.access.as_deref().filter(|access| !is_path(access)) {
            let legal = format!("the path of a file, 1 to {DIRECTORY_BYTES_MAX} bytes, or false");
            let remedy = "name the file that has the access list, as in /etc/sinew/access.toml";
            faults.push(fault("security.access", quoted(&access.to_string_lossy()), legal, remedy));
        }
    }

    fn check_record(&self, faults: &mut Vec<ConfigFault>) {
        let record = &self.record;
        for (key, folder, remedy) in [
            ("record.folder", &record.folder, "name a folder in memory, as in /dev/shm"),
            (
                "record.frozen_folder",
                &record.frozen_folder,
                "name a folder of this user, as in /var/lib/sinew",
            ),
        ] {
            if let Some(folder) = folder.as_deref().filter(|folder| !is_path(folder)) {
                let legal = format!("the path of a folder, 1 to {DIRECTORY_BYTES_MAX} bytes, or false");
                faults.push(fault(key, quoted(&folder.to_string_lossy()), legal, remedy));
            }
        }
        KEEP_BYTES.count(faults, record.keep_bytes);
        if let Some(file) = record.file.as_deref().filter(|file| !is_path(file)) {
            let legal = format!("the path of a file, 1 to {DIRECTORY_BYTES_MAX} bytes, or false");
            let remedy = "name a file, as in /var/log/{node}-{time}.mcap";
            faults.push(fault("record.file", quoted(&file.to_string_lossy()), legal, remedy));
        }
        for (range, bytes) in [(&SPLIT_BYTES, record.split_bytes), (&MAX_BYTES, record.max_bytes)] {
            if let Some(bytes) = bytes.filter(|bytes| !(range.low..=range.high).contains(bytes)) {
                faults.push(range.fault(bytes.to_string()));
            }
        }
        if let Some(time) = record.split_time {
            SPLIT_TIME.time(faults, time);
        }
        FROZEN_MAX.count(faults, record.frozen_max);
        AFTER.time(faults, record.after);
        let before = faults.len();
        KEEP.time(faults, record.keep);
        // A value outside its own range is one fault, not two.
        if faults.len() == before
            && record.keep < record.after
            && record.after.as_millis() <= u128::from(AFTER.high)
        {
            let legal = format!("record.after_ms ({:?}) to {} ms", record.after, KEEP.high);
            let remedy = "raise record.keep_ms or lower record.after_ms";
            faults.push(fault(KEEP.key, format!("{:?}", record.keep), legal, remedy));
        }
        for (key, names) in [("record.apps", &record.apps), ("record.types", &record.types)] {
            if names.len() > RECORDED_MAX {
                let remedy = "write a `*` in place of several";
                faults.push(fault(key, format!("{} names", names.len()), RECORDED_LEGAL, remedy));
            }
            let is_name = |name: &&String| {
                (1..=RECORDED_BYTES_MAX).contains(&name.len()) && !name.contains(char::is_control)
            };
            for name in names.iter().take(RECORDED_MAX).filter(|name| !is_name(name)) {
                faults.push(fault(
                    key,
                    quoted(name),
                    RECORDED_LEGAL,
                    "write a name, or a part of it and `*`",
                ));
            }
        }
    }

    fn check_further(&self, faults: &mut Vec<ConfigFault>) {
        let further = &self.gncl.further;
        let interfaces: Vec<_> = self.ndl.interface.addresses().collect();
        let legal = format!(
            "at most {FURTHER_MAX} addresses of this host, with those of ndl.interface but the first, each another one than there"
        );
        if !further.is_empty() && !self.ndl.interface.are_ipv4_addresses() {
            let remedy = "leave it out: where ndl.interface chooses by name, or an IPv6 address, GNCL listens at all that it chooses";
            faults.push(fault("gncl.further", format!("{} addresses", further.len()), legal.clone(), remedy));
        }
        if !further.is_empty() && self.gncl_further().len() > FURTHER_MAX {
            let remedy = "list one address for each further interface";
            faults.push(fault("gncl.further", format!("{} addresses", further.len()), legal.clone(), remedy));
        }
        let is_unfit = |(at, ip): &(usize, &Ipv4Addr)| {
            !is_host_address(**ip) || interfaces.contains(ip) || further[..*at].contains(ip)
        };
        for (_, ip) in further.iter().enumerate().take(FURTHER_MAX).filter(is_unfit) {
            let remedy = "write another interface's address, or leave it out";
            faults.push(fault("gncl.further", quoted(&ip.to_string()), legal.clone(), remedy));
        }
    }

    fn check_gncl(&self, faults: &mut Vec<ConfigFault>) {
        let gncl = &self.gncl;
        if let Some(outer) = gncl.announce.filter(|outer| !is_host_address(*outer.ip()) || outer.port() == 0)
        {
            let legal = "the address of one host and a port, as in 192.168.1.7:6912, or false";
            let remedy = "write where the others' connections are forwarded from, or leave it out";
            faults.push(fault("gncl.announce", quoted(&outer.to_string()), legal, remedy));
        }
        self.check_further(faults);
        QUEUE_CAPACITY.count(faults, gncl.queue_capacity);
        QUEUE_BYTES.count(faults, gncl.queue_bytes);
        STRANGERS_MAX.count(faults, gncl.strangers_max);
        HANDSHAKE.time(faults, gncl.handshake);
        GIVE_UP.time(faults, gncl.give_up);
        REDIAL_MIN.time(faults, gncl.redial_min);
        let before = faults.len();
        REDIAL_MAX.time(faults, gncl.redial_max);
        // A value outside its own range is one fault, not two.
        if faults.len() == before && gncl.redial_max < gncl.redial_min {
            let legal = format!("gncl.redial_min_ms ({:?}) to {} ms", gncl.redial_min, REDIAL_MAX.high);
            let remedy = "raise gncl.redial_max_ms or lower gncl.redial_min_ms";
            faults.push(fault(REDIAL_MAX.key, format!("{:?}", gncl.redial_max), legal, remedy));
        }
        SPIN.time(faults, gncl.spin);
    }

    fn check_interfaces(&self, faults: &mut Vec<ConfigFault>) {
        let chosen: Vec<_> = self.ndl.interface.iter().collect();
        let legal = format!("1 to {PATHS_MAX} interfaces, {INTERFACE_LEGAL}, each once");
        let remedy = "name the interfaces over which the other nodes are reached (see `ip address`)";
        if !(1..=PATHS_MAX).contains(&chosen.len()) {
            faults.push(fault(
                "ndl.interface",
                format!("{} interfaces", chosen.len()),
                legal.clone(),
                remedy,
            ));
        }
        let is_read_again = |interface: &Interface| interface.to_string().parse().as_ref() == Ok(interface);
        for (at, interface) in chosen.iter().enumerate() {
            let is_fit = match interface {
                Interface::Address(address) => is_host_address(*address),
                Interface::Address6 { address, .. } => is_host_address6(*address) && is_read_again(interface),
                Interface::Name(..) | Interface::All(_) => is_read_again(interface),
            };
            if !is_fit || chosen[..at].contains(interface) {
                faults.push(fault("ndl.interface", quoted(&interface.to_string()), legal.clone(), remedy));
            }
        }
    }

    fn check_ndl(&self, faults: &mut Vec<ConfigFault>) {
        let ndl = &self.ndl;
        self.check_interfaces(faults);
        if let Some(group) = ndl.multicast.filter(|group| !is_multicast(group)) {
            let legal = "a multicast address and a port, as in 239.255.83.119:6910, or false";
            let remedy = "choose an address from 239.0.0.0 to 239.255.255.255, the same on every node";
            faults.push(fault("ndl.multicast", quoted(&group.to_string()), legal, remedy));
        }
        if let Some(group) = ndl.multicast6.filter(|group| !is_multicast6(group)) {
            let legal = "a multicast address that stays on its link, and a port, as in [ff12::8000:5377]:6910, or false";
            let remedy = "choose an address from ff12::8000:0 to ff12::ffff:ffff, the same on every node";
            faults.push(fault("ndl.multicast6", quoted(&group.to_string()), legal, remedy));
        }
        if ndl.mdns_port == Some(0) {
            faults.push(MDNS_PORT.fault("0".to_owned()));
        }
        check_seeds(faults, &ndl.seeds);
        check_watch(faults, &ndl.watch);
        PERIOD.time(faults, ndl.period);
        MISSED_MAX.count(faults, ndl.missed_max as usize);
        NODES_MAX.count(faults, ndl.nodes_max);
    }
}

fn check_node_name(faults: &mut Vec<ConfigFault>, key: &str, name: &str) {
    if let Err(why) = sinew_runtime::name::check_node_name(name) {
        let found = if name.is_empty() { "nothing".to_owned() } else { quoted(name) };
        let legal = format!("a name of 1 to {NAME_BYTES_MAX} bytes ({why})");
        faults.push(fault(key, found, legal, format!("set {key} to a short name, as in \"knee\"")));
    }
}

pub(super) fn is_path(path: &Path) -> bool {
    let bytes = path.as_os_str().as_encoded_bytes();
    (1..=DIRECTORY_BYTES_MAX).contains(&bytes.len()) && !bytes.contains(&0)
}

fn is_socket_path(path: &Path) -> bool {
    let bytes = path.as_os_str().as_encoded_bytes();
    (1..=SOCKET_BYTES_MAX).contains(&bytes.len()) && !bytes.contains(&0)
}

fn is_host_address(address: Ipv4Addr) -> bool {
    !address.is_unspecified() && !address.is_multicast() && !address.is_broadcast()
}

fn is_multicast(group: &SocketAddrV4) -> bool {
    group.ip().is_multicast() && group.port() != 0
}

/// Returns whether it is an address of a host. IPv4-mapped addresses are excluded: an IPv6-only socket cannot use them.
const fn is_host_address6(address: Ipv6Addr) -> bool {
    !address.is_unspecified() && !address.is_multicast() && address.to_ipv4_mapped().is_none()
}

/// Returns whether it is a multicast address of link-local scope, with any flags: seeds reach nodes on other links.
const fn is_multicast6(group: &SocketAddrV6) -> bool {
    let is_of_link = group.ip().segments()[0] & 0xff0f == 0xff02;
    is_of_link && group.port() != 0 && group.scope_id() == 0
}

fn check_seeds(faults: &mut Vec<ConfigFault>, seeds: &[Seed]) {
    let legal = format!(
        "at most {SEEDS_MAX} addresses with their ports, as in 192.168.1.7:6911, [fd00::7]:6911 or [fe80::7%eth0]:6911"
    );
    if seeds.len() > SEEDS_MAX {
        let remedy = "list a few nodes only: they tell of the others";
        faults.push(fault("ndl.seeds", format!("{} addresses", seeds.len()), legal.clone(), remedy));
    }
    let nowhere = |seed: &&Seed| {
        let is_of_a_host = match seed.address.ip() {
            IpAddr::V4(ip) => !ip.is_unspecified() && seed.zone.is_none(),
            IpAddr::V6(ip) => is_host_address6(ip) && seed.to_string().parse().as_ref() == Ok(*seed),
        };
        seed.address.port() == 0 || !is_of_a_host
    };
    for seed in seeds.iter().take(SEEDS_MAX).filter(nowhere) {
        let remedy = "write the address of a node and its ndl.port";
        faults.push(fault("ndl.seeds", quoted(&seed.to_string()), legal.clone(), remedy));
    }
}

/// The legal values of a group in `ndl.watch`.
pub(super) const WATCH_LEGAL: &str = "at most 16 groups, each with `nodes` (1 to 64 names, `*` for any text), `period_ms` (10 to 60000) and \
     `missed_max` (2 to 100)";

fn check_watch(faults: &mut Vec<ConfigFault>, groups: &[WatchGroup]) {
    let mut fault_in =
        |found: String, remedy: &str| faults.push(fault("ndl.watch", found, WATCH_LEGAL, remedy));
    if groups.len() > WATCH_MAX {
        fault_in(format!("{} groups", groups.len()), "put nodes of one pace into one group");
    }
    for group in groups.iter().take(WATCH_MAX) {
        if group.nodes.is_empty() || group.nodes.len() > WATCHED_NAMES_MAX {
            fault_in(format!("a group of {} names", group.nodes.len()), "name its nodes, or write a `*`");
        }
        for name in group.nodes.iter().take(WATCHED_NAMES_MAX) {
            if let Err(why) = sinew_runtime::name::check_name_pattern(name) {
                let remedy =
                    format!("write a node's name, as in \"knee\" or \"leg.*\": no node is called so ({why})");
                fault_in(quoted(name), &remedy);
            }
        }
        let mut of_numbers = Vec::new();
        PERIOD.time(&mut of_numbers, group.period);
        MISSED_MAX.count(&mut of_numbers, group.missed_max as usize);
        for fault in of_numbers {
            fault_in(fault.found, "set `period_ms` and `missed_max` of this group within their ranges");
        }
    }
}
