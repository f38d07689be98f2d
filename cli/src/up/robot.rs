//! A robot file: the nodes of a robot, the program of each, its host, and the order of the start.

mod reader;
#[cfg(test)]
mod reference;
mod rows;
#[cfg(test)]
mod schema_tests;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::Read as _,
    path::{Path, PathBuf},
    time::Duration,
};

use sinew::nearest::nearest;
use sinew_model::config::{ConfigError, ConfigFault, fault, syntax_fault};
use toml::de::DeTable;

use reader::{Tables, Values};

/// Longest robot file in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// The name of this host.
pub(super) const HERE: &str = "here";
const READY_WITHIN: Duration = Duration::from_secs(30);
const STOP_WITHIN: Duration = Duration::from_secs(15);

/// A robot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Robot {
    pub(super) name: String,
    /// Directory of `sinew keys init`.
    pub(super) keys: Option<PathBuf>,
    /// Time limit of each wait for nodes.
    pub(super) ready_within: Duration,
    /// Time limit for a node to end after SIGTERM.
    pub(super) stop_within: Duration,
    /// The hosts, by their names; this one is among them if it has a table or a node.
    pub(super) hosts: BTreeMap<String, Host>,
    /// The nodes, by their names.
    pub(super) nodes: BTreeMap<String, NodeSpec>,
}

/// A host of the robot.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Host {
    /// Destination of `ssh`; `None` for this host.
    pub(super) ssh: Option<String>,
    pub(super) ssh_options: Vec<String>,
    /// The folder of all robots on it; `None`: below the home directory there.
    pub(super) folder: Option<String>,
    /// The command `sinew` for it; `None`: this program.
    pub(super) sinew: Option<PathBuf>,
    /// User in units of systemd.
    pub(super) user: Option<String>,
}

/// A node of the robot. Paths of local files are complete.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct NodeSpec {
    pub(super) host: String,
    pub(super) program: Program,
    pub(super) config: Option<PathBuf>,
    pub(super) arguments: Option<Vec<String>>,
    pub(super) files: Vec<PathBuf>,
    pub(super) environment: BTreeMap<String, String>,
    pub(super) socket: Option<String>,
    pub(super) after: Vec<String>,
    pub(super) ready: Vec<String>,
    pub(super) has_keys: bool,
    pub(super) limits: Limits,
}

/// The program of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Program {
    /// A file here, which is copied to the host.
    Copied(PathBuf),
    /// A file that is on the host already.
    Installed(String),
}

/// Limits of a node's process.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) struct Limits {
    /// Highest real-time priority; 0: none.
    pub(super) realtime_priority_max: u8,
    /// Whether any amount of memory may be locked.
    pub(super) lock_memory: bool,
    pub(super) nice: i8,
    /// CPUs of its threads; empty: all.
    pub(super) cpus: Vec<u16>,
}

impl Robot {
    /// Reads and checks a robot file.
    ///
    /// # Errors
    /// All faults, not only the first one.
    pub(super) fn from_file(path: &Path) -> Result<Self, ConfigError> {
        let text = read_bounded(path).map_err(|found| {
            let remedy = "name a robot file: sinew up PATH/robot.toml";
            let legal = "a text file of at most 1 MiB that this user may read";
            ConfigError::one(fault(&path.display().to_string(), found, legal, remedy))
        })?;
        let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let folder = absolute.parent().unwrap_or_else(|| Path::new("/"));
        Self::from_toml(&text, folder).map_err(|faults| faults.of_file(path))
    }

    /// Reads and checks the text of a robot file. Relative paths in it are those of `folder`.
    fn from_toml(text: &str, folder: &Path) -> Result<Self, ConfigError> {
        let table = DeTable::parse(text).map_err(|error| {
            let remedy = "correct this line; docs/book/src/reference/robot.md has a complete file".to_owned();
            ConfigError::one(ConfigFault { remedy, ..syntax_fault(text, &error) })
        })?;
        let mut tables = Tables::read(text, table.get_ref());
        let hosts = tables.hosts.iter().map(|(name, values)| (name.clone(), Host::of(values, folder)));
        let nodes = tables.nodes.iter().map(|(name, values)| (name.clone(), NodeSpec::of(values, folder)));
        let within = |key: &str, default| tables.robot.number(key).map_or(default, millis);
        let mut robot = Self {
            name: tables.robot.text("name").unwrap_or_default(),
            keys: tables.robot.text("keys").map(|keys| folder.join(keys)),
            ready_within: within("ready_within_ms", READY_WITHIN),
            stop_within: within("stop_within_ms", STOP_WITHIN),
            hosts: hosts.collect(),
            nodes: nodes.collect(),
        };
        robot.check(&mut tables);
        if robot.nodes.values().any(|node| node.host == HERE) {
            robot.hosts.entry(HERE.to_owned()).or_default();
        }
        tables.faults.sort_by_key(|fault| fault.line);
        ConfigError::check(tables.faults)?;
        Ok(robot)
    }

    /// Adds the faults of values that do not fit each other.
    fn check(&self, tables: &mut Tables) {
        if tables.robot.line == 0 {
            let legal = "a table [robot] with a name";
            let remedy = "write [robot] and name = \"my-leg\" below it";
            tables.add(1, fault("robot", "nothing".to_owned(), legal, remedy));
        }
        if self.nodes.is_empty() && tables.nodes.is_empty() {
            let remedy = "write [node.knee] and its program below it";
            tables.add(1, fault("node", "nothing".to_owned(), "at least one table of a node", remedy));
        }
        let mut faults = Vec::new();
        for (name, node) in &self.nodes {
            let line = |key: &str| tables.nodes.get(name).map_or(1, |values| values.line_of(key));
            self.check_node(name, node, &mut |key, fault| faults.push((line(key), fault)));
        }
        for (name, values) in &tables.hosts {
            let host = &self.hosts[name];
            for (key, path) in [("folder", &host.folder)] {
                if path.as_ref().is_some_and(|path| !path.starts_with('/')) {
                    let found = format!("{:?}", path.as_deref().unwrap_or_default());
                    let remedy = "write a path that begins with /";
                    let fault = fault(&format!("host.{name}.{key}"), found, "an absolute path", remedy);
                    faults.push((values.line_of(key), fault));
                }
            }
            if name == HERE && host.ssh.is_some() {
                let remedy = "give the other host another name: here is this host";
                let fault = fault("host.here.ssh", "a destination".to_owned(), "no destination", remedy);
                faults.push((values.line_of("ssh"), fault));
            }
        }
        if let Some(circle) = self.circle() {
            let line = tables.nodes.get(&circle[0]).map_or(1, |values| values.line_of("after"));
            let found = format!("a circle: {}", circle.join(" after "));
            let remedy = "remove one of them: requirements of applications need no order of nodes";
            let key = format!("node.{}.after", circle[0]);
            faults.push((line, fault(&key, found, "an order without circles", remedy)));
        }
        faults.into_iter().for_each(|(line, fault)| tables.add(line, fault));
    }

    fn check_node(&self, name: &str, node: &NodeSpec, add: &mut dyn FnMut(&str, ConfigFault)) {
        let key = |leaf: &str| format!("node.{name}.{leaf}");
        if node.host != HERE && !self.hosts.contains_key(&node.host) {
            let remedy = nearest_of(&node.host, self.hosts.keys().map(String::as_str).chain([HERE]));
            add(
                "host",
                fault(&key("host"), format!("{:?}", node.host), "the name of a [host], or here", remedy),
            );
        }
        for other in node.after.iter().filter(|other| !self.nodes.contains_key(*other)) {
            let remedy = nearest_of(other, self.nodes.keys().map(String::as_str));
            add("after", fault(&key("after"), format!("{other:?}"), "names of nodes of this file", remedy));
        }
        match &node.program {
            Program::Installed(path) if path.is_empty() => {
                let remedy = "set program to a file here, or installed to one on the host";
                let legal = "one of program and installed";
                add("program", fault(&key("program"), "none of them, or both".to_owned(), legal, remedy));
            }
            Program::Installed(path) if !path.starts_with('/') => {
                let remedy = "write a path that begins with /, or set program";
                add("installed", fault(&key("installed"), format!("{path:?}"), "an absolute path", remedy));
            }
            Program::Installed(_) | Program::Copied(_) => {}
        }
        let mut names = BTreeSet::new();
        for file in node.config.iter().chain(&node.files) {
            let name = file.file_name().unwrap_or_default();
            let is_own = OWN_FILES.iter().any(|own| name == *own);
            if is_own || !names.insert(name) {
                let found = format!("{:?}", file.display().to_string());
                let legal = format!("file names that differ, none of {}", OWN_FILES.join(", "));
                add(
                    "files",
                    fault(&key("files"), found, legal, "rename the file: all are in one folder there"),
                );
            }
        }
    }

    /// Returns nodes that wait for each other in a circle, the first one repeated at the end.
    fn circle(&self) -> Option<Vec<String>> {
        let mut done: BTreeSet<&str> = BTreeSet::new();
        self.nodes.keys().find_map(|name| self.circle_from(name, &mut Vec::new(), &mut done))
    }

    fn circle_from<'r>(
        &'r self,
        name: &'r str,
        path: &mut Vec<&'r str>,
        done: &mut BTreeSet<&'r str>,
    ) -> Option<Vec<String>> {
        if let Some(at) = path.iter().position(|on| *on == name) {
            return Some(path[at..].iter().chain([&name]).map(|name| (*name).to_owned()).collect());
        }
        if done.contains(name) {
            return None;
        }
        path.push(name);
        let after = self.nodes.get(name).into_iter().flat_map(|node| &node.after);
        for other in after {
            if let Some(circle) = self.circle_from(other, path, done) {
                return Some(circle);
            }
        }
        path.pop();
        done.insert(name);
        None
    }
}

/// Files in a node's folder that this program makes itself.
const OWN_FILES: [&str; 5] = ["bin", "keys", "log", "log.1", "up.json"];

impl Host {
    fn of(values: &Values, folder: &Path) -> Self {
        Self {
            ssh: values.text("ssh"),
            ssh_options: values.texts("ssh_options").unwrap_or_default(),
            folder: values.text("folder"),
            sinew: values.text("sinew").map(|path| folder.join(path)),
            user: values.text("user"),
        }
    }
}

impl NodeSpec {
    fn of(values: &Values, folder: &Path) -> Self {
        let program = match (values.text("program"), values.text("installed")) {
            (Some(program), None) => Program::Copied(folder.join(program)),
            (None, Some(path)) => Program::Installed(path),
            // Refused by the check.
            (None, None) | (Some(_), Some(_)) => Program::Installed(String::new()),
        };
        let files = values.texts("files").unwrap_or_default();
        let byte = |key: &str| values.number(key).unwrap_or_default();
        let cpus = values.numbers("cpus").unwrap_or_default();
        Self {
            host: values.text("host").unwrap_or_else(|| HERE.to_owned()),
            program,
            config: values.text("config").map(|path| folder.join(path)),
            arguments: values.texts("arguments"),
            files: files.iter().map(|file| folder.join(file)).collect(),
            environment: values.variables("environment").unwrap_or_default(),
            socket: values.text("socket"),
            after: values.texts("after").unwrap_or_default(),
            ready: values.texts("ready").unwrap_or_default(),
            has_keys: values.truth("keys").unwrap_or(true),
            limits: Limits {
                realtime_priority_max: u8::try_from(byte("realtime_priority_max")).unwrap_or_default(),
                lock_memory: values.truth("lock_memory").unwrap_or_default(),
                nice: i8::try_from(byte("nice")).unwrap_or_default(),
                cpus: cpus.into_iter().filter_map(|cpu| u16::try_from(cpu).ok()).collect(),
            },
        }
    }
}

fn nearest_of<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> String {
    let near = nearest(name, known, |known| known).first().copied();
    near.map_or_else(
        || "correct its spelling, or add its table".to_owned(),
        |near| format!("write {near:?}, the nearest one, or add its table"),
    )
}

/// A number of milliseconds that the reader has checked.
fn millis(number: i64) -> Duration {
    Duration::from_millis(u64::try_from(number).unwrap_or_default())
}

fn read_bounded(path: &Path) -> Result<String, String> {
    let file = File::open(path).map_err(|error| error.to_string())?;
    let mut text = String::new();
    file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text).map_err(|error| error.to_string())?;
    if text.len() as u64 > FILE_BYTES_MAX { Err("a longer file".to_owned()) } else { Ok(text) }
}
