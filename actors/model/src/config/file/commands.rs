//! Reads the commands of a file: its tables `[[command]]`.

use std::{str::FromStr, time::Duration};

use sinew_runtime::{
    app::{CommandReadiness, DownPolicy},
    supervision::Restart,
};
use toml::de::DeTable;

use super::reader::Reader;
use crate::config::{CommandConfig, check};

/// Every key of a command.
pub(in crate::config) const COMMAND_KEYS: [&str; 12] = [
    "command.name",
    "command.run",
    "command.folder",
    "command.requires",
    "command.restart",
    "command.ready",
    "command.while_down",
    "command.start_ms",
    "command.stop_ms",
    "command.hang_ms",
    "command.backoff_min_ms",
    "command.backoff_max_ms",
];

/// A text that stands for a value of another package.
struct Word<T>(T);

impl FromStr for Word<Restart> {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        match text {
            "permanent" => Ok(Self(Restart::Permanent)),
            "transient" => Ok(Self(Restart::Transient)),
            "temporary" => Ok(Self(Restart::Temporary)),
            _ => Err(()),
        }
    }
}

impl FromStr for Word<CommandReadiness> {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        match text {
            "registered" => Ok(Self(CommandReadiness::Registered)),
            "called" => Ok(Self(CommandReadiness::Called)),
            _ => Err(()),
        }
    }
}

impl FromStr for Word<DownPolicy> {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        match text {
            "hold" => Ok(Self(DownPolicy::Hold)),
            "drop" => Ok(Self(DownPolicy::Drop)),
            _ => Err(()),
        }
    }
}

impl<'t> Reader<'t> {
    /// Reads the commands that have no fault.
    pub(super) fn read_commands(&mut self) -> Vec<CommandConfig> {
        let Some(value) = self.commands else { return Vec::new() };
        let (legal, remedy) =
            ("tables [[command]]", "write [[command]] on a line of its own and its keys below");
        let Some(tables) = value.get_ref().as_array() else {
            self.reject("command", value, legal, remedy);
            return Vec::new();
        };
        let mut commands = Vec::new();
        for table in tables {
            match table.get_ref().as_table() {
                Some(keys) => commands.extend(self.read_command(keys)),
                None => self.reject("command", table, legal, remedy),
            }
        }
        commands
    }

    fn read_command(&mut self, table: &'t DeTable<'t>) -> Option<CommandConfig> {
        let mut reader = self.beside();
        reader.add_keys("command", table, &COMMAND_KEYS);
        let mut command = CommandConfig::new("", [""; 0]);
        reader.text("command.name", "\"knee.drive\"", &mut command.name);
        let remedy = "set it as in [\"python3\", \"knee.py\"]";
        reader.read_list(
            "command.run",
            "a list of texts: the program and its arguments",
            remedy,
            &mut command.run,
        );
        reader.text_or_off("command.folder", "\"/opt/knee\" or false", &mut command.folder);
        let remedy = "set it as in [\"knee.imu\", \"camera ?2s\"]";
        reader.read_list("command.requires", "a list of requirements", remedy, &mut command.requires);
        let mut restart = Word(command.restart);
        reader.text("command.restart", "\"permanent\", \"transient\" or \"temporary\"", &mut restart);
        let mut readiness = Word(command.readiness);
        reader.text("command.ready", "\"registered\" or \"called\"", &mut readiness);
        let mut while_down = Word(command.while_down);
        reader.text("command.while_down", "\"hold\" or \"drop\"", &mut while_down);
        (command.restart, command.readiness, command.while_down) = (restart.0, readiness.0, while_down.0);
        reader.time(&check::COMMAND_START, &mut command.start);
        reader.time(&check::COMMAND_STOP, &mut command.stop);
        let mut hang = command.hang.map(|hang| hang.as_millis() as u64);
        reader.number_or_off(&check::COMMAND_HANG, &mut hang);
        command.hang = hang.map(Duration::from_millis);
        reader.time(&check::COMMAND_BACKOFF_MIN, &mut command.backoff_min);
        reader.time(&check::COMMAND_BACKOFF_MAX, &mut command.backoff_max);
        self.take_faults(reader).then_some(command)
    }
}
