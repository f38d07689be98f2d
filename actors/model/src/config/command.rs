//! The commands of a node's file: programs that the node starts and supervises.

use std::{path::PathBuf, time::Duration};

use sinew_runtime::{
    app::{AppSpec, CommandReadiness, DownPolicy, DynApp, Requirement},
    name::check_name,
    supervision::{Policy, Restart},
};

use super::{
    ConfigFault,
    check::{
        COMMAND_BACKOFF_MAX, COMMAND_BACKOFF_MIN, COMMAND_HANG, COMMAND_START, COMMAND_STOP, Range, fault,
        is_path,
    },
    faults::quoted,
};

/// Maximum number of commands of a file, and of the requirements of one.
pub(super) const COMMANDS_MAX: usize = 64;
pub(super) const COMMAND_REQUIRES_MAX: usize = 64;

/// A program that the node starts, restarts and stops: a table `[[command]]` of its file. It joins at
/// [`LnclConfig::socket`](super::LnclConfig::socket). In code:
/// [`AppSpec::command`](sinew_runtime::app::AppSpec::command).
///
/// # Examples
///
/// ```
/// use sinew::config::{CommandConfig, NodeConfig};
///
/// let mut config = NodeConfig::new("knee");
/// config.lncl.socket = Some("/run/sinew/knee.sock".into());
/// config.commands.push(CommandConfig::new("knee.drive", ["python3", "knee.py"]));
/// config.validate()?;
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CommandConfig {
    /// Name of the application, which the program registers.
    pub name: String,
    /// The program, by its path or its name in `PATH`, and its arguments: 1 to 64 texts.
    pub run: Vec<String>,
    /// Working directory of the program; 1 to 4,096 bytes. Default: none, that of the node.
    pub folder: Option<PathBuf>,
    /// Requirements that are met before the program is started; at most 64. Default: none.
    pub requires: Vec<String>,
    /// When the program is started again. Default [`Restart::Permanent`].
    pub restart: Restart,
    /// When the application is ready. Default [`CommandReadiness::Registered`].
    pub readiness: CommandReadiness,
    /// Policy for messages while no process is registered. Default [`DownPolicy::Hold`].
    pub while_down: DownPolicy,
    /// Time for the program to become ready. 10 ms to 10 min; default 10 s.
    pub start: Duration,
    /// Time from SIGTERM to SIGKILL at a stop. 0 to 60 s; default 2 s.
    pub stop: Duration,
    /// Time without a read or a frame of the program after which it counts as hung. 20 ms to 10 min; default: none.
    pub hang: Option<Duration>,
    /// First wait before a restart; it doubles with each consecutive failure. 1 ms to 60 s; default 1 ms.
    pub backoff_min: Duration,
    /// Longest wait before a restart. `backoff_min` to 10 min; default 2 s.
    pub backoff_max: Duration,
}

impl CommandConfig {
    /// Returns the defaults for this program.
    #[must_use]
    pub fn new<W: Into<String>>(name: impl Into<String>, run: impl IntoIterator<Item = W>) -> Self {
        let Policy { start_within, backoff_min, backoff_max, .. } = Policy::default();
        Self {
            name: name.into(),
            run: run.into_iter().map(Into::into).collect(),
            folder: None,
            requires: Vec::new(),
            restart: Restart::Permanent,
            readiness: CommandReadiness::default(),
            while_down: DownPolicy::default(),
            start: start_within,
            stop: Duration::from_secs(2),
            hang: None,
            backoff_min,
            backoff_max,
        }
    }

    pub(super) fn check(&self, faults: &mut Vec<ConfigFault>) {
        let name = quoted(&self.name);
        let key = |leaf: &str| format!("command.{}.{leaf}", name.trim_matches('"'));
        if let Err(why) = check_name(&self.name) {
            let legal = format!("a name of 1 to 63 bytes ({why})");
            faults.push(fault("command.name", name.clone(), legal, "name it as in \"knee.drive\""));
        }
        // A name that is wrong is a fault of its own.
        if let Some(why) = DynApp::from(self).fault() {
            faults.push(fault(&key("run"), quoted(&self.run.join(" ")), "a program and its arguments", why));
        }
        if let Some(folder) = self.folder.as_deref().filter(|folder| !is_path(folder)) {
            let (legal, remedy) = ("the path of a folder, 1 to 4096 bytes", "name a folder, as in /opt/knee");
            faults.push(fault(&key("folder"), quoted(&folder.to_string_lossy()), legal, remedy));
        }
        if self.requires.len() > COMMAND_REQUIRES_MAX {
            let found = format!("{} requirements", self.requires.len());
            let legal = format!("at most {COMMAND_REQUIRES_MAX} requirements");
            faults.push(fault(&key("requires"), found, legal, "write a pattern in place of several names"));
        }
        for text in self.requires.iter().take(COMMAND_REQUIRES_MAX) {
            if let Err(why) = text.parse::<Requirement>() {
                let remedy = "write it as in \"knee.imu\" or \"2 of *.drive\"";
                faults.push(fault(&key("requires"), quoted(text), format!("a requirement ({why})"), remedy));
            }
        }
        let mut check = |range: &Range, time: Duration| {
            let mut found = Vec::new();
            range.time(&mut found, time);
            let leaf = range.key.trim_start_matches("command.");
            faults.extend(found.into_iter().map(|found| ConfigFault { key: key(leaf), ..found }));
        };
        check(&COMMAND_START, self.start);
        check(&COMMAND_STOP, self.stop);
        self.hang.iter().for_each(|hang| check(&COMMAND_HANG, *hang));
        check(&COMMAND_BACKOFF_MIN, self.backoff_min);
        check(&COMMAND_BACKOFF_MAX, self.backoff_max);
        if self.backoff_min > self.backoff_max {
            let legal = format!("command.backoff_min_ms ({:?}) or more", self.backoff_min);
            let remedy = "raise backoff_max_ms or lower backoff_min_ms";
            faults.push(fault(&key("backoff_max_ms"), format!("{:?}", self.backoff_max), legal, remedy));
        }
    }
}

/// Checks the commands, and that they have a socket at which they can join.
pub(super) fn check_commands(faults: &mut Vec<ConfigFault>, commands: &[CommandConfig], has_socket: bool) {
    if commands.len() > COMMANDS_MAX {
        let remedy = "start several programs by one, or at several nodes";
        let found = format!("{} commands", commands.len());
        faults.push(fault("command", found, format!("at most {COMMANDS_MAX} commands"), remedy));
    }
    for (at, command) in commands.iter().enumerate().take(COMMANDS_MAX) {
        command.check(faults);
        if commands[..at].iter().any(|other| other.name == command.name) {
            let remedy = "give each command a name of its own";
            faults.push(fault(
                "command.name",
                quoted(&command.name),
                "a name that no other command has",
                remedy,
            ));
        }
    }
    if !commands.is_empty() && !has_socket {
        let legal = "a path, where there is a [[command]]: its program joins there";
        let remedy = "set lncl.socket, as in \"/run/sinew/knee.sock\"";
        faults.push(fault("lncl.socket", "nothing".to_owned(), legal, remedy));
    }
}

impl From<&CommandConfig> for DynApp {
    fn from(config: &CommandConfig) -> Self {
        let CommandConfig { name, run, folder, requires, restart, .. } = config;
        let spec = AppSpec::command(name, run)
            .requires(requires)
            .restart(*restart)
            .readiness(config.readiness)
            .while_down(config.while_down)
            .start_within(config.start)
            .stop_within(config.stop)
            .backoff(config.backoff_min, config.backoff_max);
        let spec = match config.hang {
            Some(hang) => spec.progress_within(hang),
            None => spec,
        };
        match folder {
            Some(folder) => spec.folder(folder).into(),
            None => spec.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::config::NodeConfig;

    use super::*;

    fn read(commands: &str) -> Result<NodeConfig, String> {
        let text = format!("[node]\nname = 'knee'\n[lncl]\nsocket = '/run/knee.sock'\n{commands}");
        NodeConfig::from_toml(&text).map_err(|faults| faults.to_string())
    }

    #[test]
    fn commands_are_read_in_order_with_their_defaults() {
        let config = read(
            "[[command]]\nname = 'knee.drive'\nrun = ['python3', 'knee.py']\n\
             [[command]]\nname = 'camera'\nrun = ['camera']\nrestart = 'transient'\nready = 'called'\nhang_ms = 200\n\
             while_down = 'drop'\nfolder = '/opt/camera'\nrequires = ['knee.drive']\nstop_ms = 0\n",
        );
        let camera = CommandConfig {
            folder: Some("/opt/camera".into()),
            requires: vec!["knee.drive".to_owned()],
            restart: Restart::Transient,
            readiness: CommandReadiness::Called,
            while_down: DownPolicy::Drop,
            stop: Duration::ZERO,
            hang: Some(Duration::from_millis(200)),
            ..CommandConfig::new("camera", ["camera"])
        };
        let expected = [CommandConfig::new("knee.drive", ["python3", "knee.py"]), camera];
        assert_eq!(config.expect("it is legal").commands, expected);
    }

    #[test]
    fn faults_of_commands_name_place_and_remedy() {
        let one = |more: &str| format!("[[command]]\nname = 'knee'\nrun = ['knee']\n{more}");
        let cases = [
            ("command = 7\n".to_owned(), "write [[command]]"),
            ("[[command]]\nname = 'knee'\n".to_owned(), "command.knee.run"),
            ("[[command]]\nrun = ['knee']\n".to_owned(), "command.name"),
            (one("restrat = 'permanent'\n"), "write command.restart"),
            (one("restart = 'always'\n"), "\"permanent\", \"transient\" or \"temporary\""),
            (one("hang_ms = 19\n"), "command.knee.hang_ms"),
            (one("run2 = ['x']\n"), "a key that does not exist"),
            (one("requires = ['']\n"), "command.knee.requires"),
            (one("backoff_min_ms = 10\nbackoff_max_ms = 9\n"), "command.knee.backoff_max_ms"),
            (one(&one("")), "a name that no other command has"),
        ];
        for (text, words) in cases {
            // The key without a section has to be before all tables.
            let read = if text.starts_with("command") {
                NodeConfig::from_toml(&format!("{text}[node]\nname = 'knee'\n"))
                    .map_err(|faults| faults.to_string())
            } else {
                read(&text)
            };
            let faults = read.expect_err(&text);
            assert!(faults.contains(words), "{text}: {faults}");
        }
    }

    #[test]
    fn command_needs_the_socket_of_the_node() {
        let mut config = NodeConfig::new("knee");
        config.commands.push(CommandConfig::new("knee.drive", ["python3", "knee.py"]));
        let faults = config.validate().expect_err("it could not join").to_string();
        assert!(faults.starts_with("lncl.socket: found nothing"), "{faults}");
        config.lncl.socket = Some("/run/knee.sock".into());
        assert!(config.validate().is_ok());
    }
}
