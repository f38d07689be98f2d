//! What is wrong with a configuration: all of it at once, each with its remedy.

use std::{
    fmt,
    path::{Path, PathBuf},
};

/// All that is wrong with a configuration. The user is at fault; nothing was started.
///
/// It is written with one fault a line.
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
pub struct ConfigFaults(Vec<ConfigFault>);

/// One thing that is wrong with a configuration.
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
    /// Which setting: `ndl.period_ms`.
    pub key: String,
    /// The file; `None` where the setting comes from code or from a text.
    pub file: Option<PathBuf>,
    /// Line of the file, from 1; `None` where the setting comes from code or is missing.
    pub line: Option<usize>,
    /// What is there.
    pub found: String,
    /// What may be there: the range with its unit.
    pub legal: String,
    /// What to do about it.
    pub remedy: String,
}

impl ConfigFaults {
    /// All of them, at least one: those of a file by line, those of code in the order of the settings.
    #[must_use]
    pub fn faults(&self) -> &[ConfigFault] {
        &self.0
    }

    /// Good if there are no `faults`.
    pub(crate) fn check(faults: Vec<ConfigFault>) -> Result<(), Self> {
        if faults.is_empty() { Ok(()) } else { Err(Self(faults)) }
    }

    /// A single fault.
    pub(crate) fn one(fault: ConfigFault) -> Self {
        Self(vec![fault])
    }

    /// The same of the file at `path`.
    pub(crate) fn of_file(mut self, path: &Path) -> Self {
        self.0.iter_mut().for_each(|fault| fault.file = Some(path.to_owned()));
        self
    }

    pub(crate) fn into_vec(self) -> Vec<ConfigFault> {
        self.0
    }
}

impl std::error::Error for ConfigFaults {}

impl fmt::Display for ConfigFaults {
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

/// `text` in quotes, without control characters and not longer than a line.
pub(crate) fn quoted(text: &str) -> String {
    const SHOWN_MAX: usize = 80;
    let shown: String = text.chars().take(SHOWN_MAX).collect();
    let more = if shown.len() < text.len() { "..." } else { "" };
    format!("{shown:?}{more}")
}
