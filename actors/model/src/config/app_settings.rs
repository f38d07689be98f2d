//! The settings of applications: the tables `[app.NAME]` of a node's file.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    path::PathBuf,
    sync::{Arc, Mutex},
};

use serde::de::DeserializeOwned;
use sinew_runtime::lock;
use toml::{
    Spanned, Table, Value,
    de::{DeTable, DeValue},
};

use super::{ConfigError, ConfigFault, NodeConfig, check::fault, faults::quoted, file::line_of};
use crate::nearest::nearest;

/// The key of all these tables.
const APP: &str = "app";

/// The tables of a file, and which of them were read. Clones of a configuration share the latter.
///
/// # Examples
///
/// ```
/// use sinew::config::NodeConfig;
///
/// #[derive(serde::Deserialize)]
/// struct DriveSettings { kp: f64 }
///
/// let config = NodeConfig::from_toml("[node]\nname = 'knee'\n[app.drive]\nkp = 12.5\n")?;
/// let drive: DriveSettings = config.app("drive")?; // out of `config.app_settings`
/// assert_eq!(drive.kp, 12.5);
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Default)]
pub struct AppSettings {
    tables: Table,
    /// The file, and the lines of its tables and keys by their full keys.
    file: Option<PathBuf>,
    lines: BTreeMap<String, usize>,
    claimed: Arc<Mutex<BTreeSet<String>>>,
}

impl fmt::Debug for AppSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Settings may be secrets.
        f.debug_list().entries(self.tables.keys()).finish()
    }
}

impl PartialEq for AppSettings {
    fn eq(&self, other: &Self) -> bool {
        self.tables == other.tables
    }
}

impl AppSettings {
    /// Returns the tables below `table`, which is that of `[app]`.
    pub(super) fn read(text: &str, table: &DeTable<'_>) -> Self {
        let tables: Option<Table> = toml::from_str(text).ok();
        let tables = tables.and_then(|mut all| match all.remove(APP) {
            Some(Value::Table(tables)) => Some(tables),
            Some(_) | None => None,
        });
        let mut lines = BTreeMap::new();
        note_lines(text, APP, table, &mut lines);
        Self { tables: tables.unwrap_or_default(), lines, ..Self::default() }
    }

    pub(super) fn name_file(&mut self, file: PathBuf) {
        self.file = Some(file);
    }

    /// Returns the table of `name`, written `[app."knee.drive"]` or `[app.knee.drive]`.
    fn table(&self, name: &str) -> Option<(&Value, String)> {
        if let Some(found) = self.tables.get(name) {
            return Some((found, format!("{APP}.{name}")));
        }
        let mut parts = name.split('.');
        let mut found = self.tables.get(parts.next()?)?;
        for part in parts {
            found = found.get(part)?;
        }
        Some((found, format!("{APP}.{name}")))
    }

    fn fault(&self, key: &str, found: &str, legal: String, remedy: String) -> ConfigFault {
        let line = self.lines.get(key).copied();
        let file = self.file.clone();
        ConfigFault { line, file, ..fault(quoted(key).trim_matches('"'), found.to_owned(), legal, remedy) }
    }

    fn missing(&self, name: &str) -> ConfigFault {
        let place = self
            .file
            .as_ref()
            .map_or_else(|| "the node's file".to_owned(), |file| file.display().to_string());
        let similar = nearest_name(name, self.tables.keys().map(String::as_str));
        let similar =
            similar.map_or_else(String::new, |other| format!("; [{APP}.{other}] is there, is it misspelt?"));
        let key = format!("{APP}.{name}");
        let legal = format!("a table with the settings of '{name}'");
        self.fault(&key, "no such table", legal, format!("add [{key}] to {place}{similar}"))
    }

    fn settings<T: DeserializeOwned>(&self, name: &str) -> Result<T, Vec<ConfigFault>> {
        lock(&self.claimed).insert(name.to_owned());
        let Some((value, key)) = self.table(name) else { return Err(vec![self.missing(name)]) };
        let (mut unknown, mut track) = (Vec::new(), serde_path_to_error::Track::new());
        let mut note = |path: serde_ignored::Path<'_>| unknown.push(path.to_string());
        let tracked = serde_path_to_error::Deserializer::new(value.clone(), &mut track);
        let read = T::deserialize(serde_ignored::Deserializer::new(tracked, &mut note));
        let mut faults: Vec<_> = unknown
            .iter()
            .map(|path| {
                let legal = format!("a key of the settings of '{name}'");
                let remedy = "correct its spelling, or remove it".to_owned();
                self.fault(&format!("{key}.{path}"), "a key that does not exist", legal, remedy)
            })
            .collect();
        match read {
            Ok(settings) if faults.is_empty() => return Ok(settings),
            Ok(_) => {}
            Err(error) => {
                let path = track.path().to_string();
                let at = if path == "." { key } else { format!("{key}.{path}") };
                let remedy = format!("correct it in the table of '{name}'");
                let what = error.to_string();
                let what = what.lines().next().unwrap_or("a value that cannot be used");
                faults.push(self.fault(
                    &at,
                    what,
                    format!("what the settings of '{name}' have there"),
                    remedy,
                ));
            }
        }
        Err(faults)
    }

    /// Returns a fault for each table that was not read.
    fn unclaimed(&self) -> Vec<ConfigFault> {
        let claimed = lock(&self.claimed);
        let mut unread = Vec::new();
        note_unread(&self.tables, "", &claimed, &mut unread);
        let fault = |name: String| {
            let remedy = nearest_name(&name, claimed.iter().map(String::as_str)).map_or_else(
                || "remove it".to_owned(),
                |nearest| format!("write [{APP}.{nearest}], the nearest, or remove it"),
            );
            let legal = "a table that an application of this program reads".to_owned();
            self.fault(&format!("{APP}.{name}"), "settings that no application reads", legal, remedy)
        };
        unread.into_iter().map(fault).collect()
    }
}

fn note_unread(table: &Table, above: &str, claimed: &BTreeSet<String>, unread: &mut Vec<String>) {
    for (key, value) in table {
        let name = if above.is_empty() { key.clone() } else { format!("{above}.{key}") };
        if claimed.contains(&name) {
            continue;
        }
        let is_above_one = claimed.iter().any(|other| other.starts_with(&format!("{name}.")));
        match value.as_table().filter(|_| is_above_one) {
            Some(below) => note_unread(below, &name, claimed, unread),
            None => unread.push(name),
        }
    }
}

fn note_lines(text: &str, above: &str, table: &DeTable<'_>, lines: &mut BTreeMap<String, usize>) {
    for (name, value) in table {
        let key = format!("{above}.{}", name.get_ref());
        lines.insert(key.clone(), line_of(text, &Spanned::span(name)));
        if let DeValue::Table(below) = value.get_ref() {
            note_lines(text, &key, below, lines);
        }
    }
}

/// Returns the most similar of these names, if one is similar.
fn nearest_name<'a>(name: &str, others: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    nearest(name, others, |other| other).into_iter().next()
}

impl NodeConfig {
    /// Returns the settings of the application `name`: its table `[app.NAME]` in the node's file, read by serde.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::config::NodeConfig;
    ///
    /// #[derive(serde::Deserialize)]
    /// struct DriveSettings { kp: f64, limit_nm: f64 }
    ///
    /// let file = "[node]\nname = 'knee'\n[app.knee.drive]\nkp = 12.5\nlimit_nm = 40\n";
    /// let settings: DriveSettings = NodeConfig::from_toml(file)?.app("knee.drive")?;
    /// assert_eq!(settings.kp, 12.5);
    /// # Ok::<(), sinew::config::ConfigError>(())
    /// ```
    ///
    /// # Errors
    /// There is no such table, or it has keys that `T` does not have, or a value of another type.
    pub fn app<T: DeserializeOwned>(&self, name: &str) -> Result<T, ConfigError> {
        self.app_settings.settings(name).map_err(|faults| match ConfigError::check(faults) {
            Err(faults) => faults,
            Ok(()) => ConfigError::one(self.app_settings.missing(name)),
        })
    }

    /// Returns a fault for each table `[app.NAME]` that no application of this program reads.
    pub fn unclaimed_settings(&self) -> Vec<ConfigFault> {
        self.app_settings.unclaimed()
    }

    /// Records that another program reads the table `[app.NAME]` of the same file, so that it is no fault if
    /// this one does not.
    pub fn app_is_elsewhere(&self, name: &str) {
        lock(&self.app_settings.claimed).insert(name.to_owned());
    }
}
