//! Reads the local files of a robot: programs, configurations, keys. Nothing is changed before all of them are there.

use std::{
    collections::BTreeMap,
    net::{IpAddr, SocketAddr},
    path::{Path, PathBuf},
};

use sinew::{
    NodeAddress, NodeConfig,
    security::files::{AUTHORITY, DENIED, NODE_CERTIFICATE, NODE_KEY},
};

use super::{
    order::{Hash, KEYS_PREFIX, NodeOrder, PlacedFile, Port, ProgramOrder},
    plan::Wanted,
    protocol::CONTENT_BYTES_MAX,
    robot::{NodeSpec, Program, Robot},
};

/// The folder of a node's keys, in its own folder and in the configurations.
const KEYS: &str = "keys";
/// Maximum number of files of one node's keys.
const KEY_FILES_MAX: usize = 32;

/// The wanted nodes, and the local files with their contents.
#[derive(Debug, Default)]
pub(super) struct Gathered {
    pub(super) wanted: BTreeMap<String, Wanted>,
    pub(super) contents: BTreeMap<Hash, PathBuf>,
    /// All that is missing or does not fit.
    pub(super) faults: Vec<String>,
}

/// Reads all local files of a robot, and checks the configurations.
pub(super) fn gather(robot: &Robot) -> Gathered {
    let mut gathered = Gathered::default();
    let mut configs = BTreeMap::new();
    for (name, node) in &robot.nodes {
        let config = node.config.as_deref().and_then(|path| gathered.config(name, path));
        if let Some(order) = gathered.order(robot, (name, node), config.as_ref()) {
            let wanted = Wanted { host: node.host.clone(), order, after: node.after.clone() };
            gathered.wanted.insert(name.clone(), wanted);
        }
        configs.extend(config.map(|config| (name, config)));
    }
    gathered.check_together(&configs);
    gathered
}

impl Gathered {
    fn fault(&mut self, node: &str, why: impl std::fmt::Display) {
        self.faults.push(format!("{node}: {why}"));
    }

    fn config(&mut self, name: &str, path: &Path) -> Option<NodeConfig> {
        let config = match NodeConfig::from_file(path) {
            Ok(config) => config,
            Err(faults) => {
                self.fault(name, format_args!("its configuration has faults:\n{faults}"));
                return None;
            }
        };
        if config.name != name {
            let (path, other) = (path.display(), &config.name);
            self.fault(
                name,
                format_args!(
                    "{path} is of a node called '{other}'; correct node.name there, or its table here"
                ),
            );
        }
        Some(config)
    }

    /// Hashes a file, and remembers its path.
    fn content(&mut self, node: &str, path: &Path) -> Option<Hash> {
        match hashed(path) {
            Ok(hash) => {
                self.contents.insert(hash.clone(), path.to_owned());
                Some(hash)
            }
            Err(why) => {
                self.fault(node, format_args!("{}: {why}; build it, or correct the path", path.display()));
                None
            }
        }
    }

    fn order(
        &mut self,
        robot: &Robot,
        (name, node): (&str, &NodeSpec),
        config: Option<&NodeConfig>,
    ) -> Option<NodeOrder> {
        let before = self.faults.len();
        let program = match &node.program {
            Program::Installed(path) => Some(ProgramOrder::Installed(path.clone())),
            Program::Copied(path) => self.content(name, path).map(|hash| {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                ProgramOrder::Copied { name, hash }
            }),
        };
        let mut files = Vec::new();
        for path in node.config.iter().chain(&node.files) {
            let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            files.extend(self.content(name, path).map(|hash| PlacedFile { path: file, hash }));
        }
        if let Some(keys) = robot.keys.as_deref().filter(|_| node.has_keys) {
            self.keys(name, &keys.join("nodes").join(name), &mut files);
        }
        self.check_keys(name, config, robot.keys.is_some() && node.has_keys);
        let of_config = || {
            let file = node.config.as_deref().and_then(Path::file_name);
            file.map(|file| file.to_string_lossy().into_owned()).into_iter().collect()
        };
        let socket = config.and_then(|config| config.lncl.socket.as_deref()).map(Path::to_string_lossy);
        let order = NodeOrder {
            name: name.to_owned(),
            program: program?,
            arguments: node.arguments.clone().unwrap_or_else(of_config),
            environment: node.environment.clone(),
            files,
            socket: node.socket.clone().or_else(|| socket.map(std::borrow::Cow::into_owned)),
            ports: config.map(ports).unwrap_or_default(),
            limits: node.limits.clone(),
        };
        (self.faults.len() == before).then_some(order)
    }

    /// Adds the keys of a node.
    fn keys(&mut self, name: &str, folder: &Path, files: &mut Vec<PlacedFile>) {
        let shown = folder.display();
        let remedy =
            "make it with `sinew keys init`, or with `sinew keys issue` if the project has keys already";
        let entries = match std::fs::read_dir(folder) {
            Ok(entries) => entries.flatten().take(KEY_FILES_MAX + 1),
            Err(error) => return self.fault(name, format_args!("its keys {shown}: {error}; {remedy}")),
        };
        let mut paths: Vec<_> = entries.map(|entry| entry.path()).filter(|path| path.is_file()).collect();
        paths.sort();
        if paths.len() > KEY_FILES_MAX {
            return self.fault(
                name,
                format_args!("its keys {shown} are more than {KEY_FILES_MAX} files; move others away"),
            );
        }
        for file in [NODE_KEY, NODE_CERTIFICATE, AUTHORITY, DENIED] {
            if !paths.contains(&folder.join(file)) {
                self.fault(name, format_args!("its keys {shown} lack {file}; {remedy}"));
            }
        }
        for path in paths {
            let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let placed = |hash| PlacedFile { path: format!("{KEYS_PREFIX}{file}"), hash };
            files.extend(self.content(name, &path).map(placed));
        }
    }

    /// Without keys in its configuration, a node would be open in spite of them.
    fn check_keys(&mut self, name: &str, config: Option<&NodeConfig>, has_keys: bool) {
        let Some(config) = config else { return };
        let named = config.security.keys.as_deref();
        match (has_keys, named) {
            (true, None) => {
                let why = "robot.keys is set, and its configuration uses no keys; write [security] and keys = \"keys\" there, or keys = false here";
                self.fault(name, why);
            }
            (false, Some(path)) if path == Path::new(KEYS) => {
                let why = "its configuration uses the keys `keys`, and the robot file has none; set robot.keys to the directory of `sinew keys init`";
                self.fault(name, why);
            }
            (true | false, Some(_)) | (false, None) => {}
        }
    }

    /// Checks that the nodes are of one project, and differ in their addresses.
    fn check_together(&mut self, configs: &BTreeMap<&String, NodeConfig>) {
        let mut addresses: BTreeMap<NodeAddress, &str> = BTreeMap::new();
        let Some((first, config)) = configs.first_key_value() else { return };
        for (name, other) in configs {
            if other.project != config.project {
                let why = format!(
                    "its project is '{}', and that of {first} is '{}'; set the same node.project",
                    other.project, config.project
                );
                self.fault(name, why);
            }
            if let Some(before) = addresses.insert(other.node_address(), name) {
                let address = other.node_address();
                self.fault(
                    name,
                    format_args!("its address {address} is that of {before}, too; set node.address"),
                );
            }
        }
    }
}

/// Returns the hash of a file that a host accepts.
fn hashed(path: &Path) -> Result<Hash, String> {
    let found = std::fs::metadata(path).map_err(|error| error.to_string())?;
    // A device or a pipe may have no end.
    if !found.is_file() {
        return Err("it is no file".to_owned());
    }
    if found.len() > CONTENT_BYTES_MAX {
        return Err(format!("it has {} bytes, and a file has at most 4 GiB", found.len()));
    }
    Hash::of_file(path).map(|(hash, _)| hash).map_err(|error| error.to_string())
}

/// Returns the ports that a configuration fixes.
fn ports(config: &NodeConfig) -> Vec<Port> {
    let Some(address) = config.ndl.interface.first_address() else { return Vec::new() };
    let port = |key: &str, is_udp, port| {
        let address = SocketAddr::new(IpAddr::V4(address), port);
        (port > 0).then(|| Port { key: key.to_owned(), is_udp, address })
    };
    [port("gncl.port", false, config.gncl.port), port("ndl.port", true, config.ndl.port)]
        .into_iter()
        .flatten()
        .collect()
}
