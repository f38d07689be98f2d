//! The faults of a configuration: all at once, each with its remedy.

use std::{
    fmt,
    path::{Path, PathBuf},
};

/// All faults of a configuration. The user is at fault; nothing was started.
///
/// Displayed with one fault per line.
///
/// # Examples
///
/// ```
/// use sinew::config::NodeConfig;
///
/// let faults = NodeConfig::from_toml("[node]\nname = 'knee'\n[ndl]\nperiod_ms = 5\nmissed_max = 0\n").unwrap_err();
/// assert_eq!(faults.faults().len(), 2);
/// println!("{faults}"); // one a line
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigError(Vec<ConfigFault>);

/// One fault of a configuration.
///
/// # Examples
///
/// ```
/// use sinew::config::NodeConfig;
///
/// let faults = NodeConfig::from_toml("[node]\nname = 'knee'\n[ndl]\nmissed_max = 0\n").unwrap_err();
/// let fault = &faults.faults()[0];
/// assert_eq!((fault.key.as_str(), fault.line), ("ndl.missed_max", Some(4)));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigFault {
    /// The setting: `ndl.period_ms`.
    pub key: String,
    /// The file; `None` if the setting comes from code or from a text.
    pub file: Option<PathBuf>,
    /// Line of the file, from 1; `None` if the setting comes from code or is missing.
    pub line: Option<usize>,
    /// The value found.
    pub found: String,
    /// The legal values: the range with its unit.
    pub legal: String,
    /// The remedy.
    pub remedy: String,
}

impl ConfigError {
    /// Returns all of them, at least one: those of a file by line, those of code in the order of the settings.
    #[must_use]
    pub fn faults(&self) -> &[ConfigFault] {
        &self.0
    }

    /// Returns an error unless `faults` is empty.
    pub fn check(faults: Vec<ConfigFault>) -> Result<(), Self> {
        if faults.is_empty() { Ok(()) } else { Err(Self(faults)) }
    }

    /// Returns a single fault.
    pub fn one(fault: ConfigFault) -> Self {
        Self(vec![fault])
    }

    /// Adds the file at `path` to the faults.
    pub fn of_file(mut self, path: &Path) -> Self {
        self.0.iter_mut().for_each(|fault| fault.file = Some(path.to_owned()));
        self
    }

    /// Returns the faults, in the order in which they were found.
    pub fn into_vec(self) -> Vec<ConfigFault> {
        self.0
    }
}

impl std::error::Error for ConfigError {}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (place, fault) in self.0.iter().enumerate() {
            let end = if place == 0 { "" } else { "\n" };
            write!(f, "{end}{fault}")?;
        }
        Ok(())
    }
}

impl fmt::Display for ConfigFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, file, line, found, legal, remedy } = self;
        write!(f, "{key}")?;
        match (file, line) {
            (Some(file), Some(line)) => write!(f, " ({}, line {line})", file.display())?,
            (Some(file), None) => write!(f, " ({})", file.display())?,
            (None, Some(line)) => write!(f, " (line {line})")?,
            (None, None) => {}
        }
        write!(f, ": found {found}; legal is {legal}; {remedy}")
    }
}

/// Returns `text` in quotes, without control characters and at most one line long.
pub fn quoted(text: &str) -> String {
    const SHOWN_MAX: usize = 80;
    let shown: String = text.chars().take(SHOWN_MAX).collect();
    let more = if shown.len() < text.len() { "..." } else { "" };
    format!("{shown:?}{more}")
}
