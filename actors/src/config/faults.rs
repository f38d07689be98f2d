//! What is wrong with a configuration: all of it at once, each with its remedy.

use std::{
    fmt,
    path::{Path, PathBuf},
};

/// All that is wrong with a configuration. The user is at fault; nothing was started.
///
/// It is written with one fault a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigFaults {
    faults: Vec<ConfigFault>,
    /// The file that was read, if one was.
    file: Option<PathBuf>,
}

/// One thing that is wrong with a configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigFault {
    /// Which setting: `ndl.period_ms`.
    pub key: String,
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
        &self.faults
    }

    /// The file that they are in; `None` of those of code.
    #[must_use]
    pub fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }

    /// The same, of the file at `path`: each line of the text names it.
    #[must_use]
    pub(crate) fn in_file(self, path: &Path) -> Self {
        Self { file: Some(path.to_owned()), ..self }
    }

    /// Good if there are no `faults`.
    pub(crate) fn check(faults: Vec<ConfigFault>) -> Result<(), Self> {
        if faults.is_empty() { Ok(()) } else { Err(Self { faults, file: None }) }
    }

    /// A single fault.
    pub(crate) fn one(fault: ConfigFault) -> Self {
        Self { faults: vec![fault], file: None }
    }

    pub(super) fn into_vec(self) -> Vec<ConfigFault> {
        self.faults
    }
}

impl std::error::Error for ConfigFaults {}

impl fmt::Display for ConfigFaults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (place, fault) in self.faults.iter().enumerate() {
            let end = if place == 0 { "" } else { "\n" };
            match &self.file {
                Some(file) => write!(f, "{end}{}: {fault}", file.display())?,
                None => write!(f, "{end}{fault}")?,
            }
        }
        Ok(())
    }
}

impl fmt::Display for ConfigFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, line, found, legal, remedy } = self;
        write!(f, "{key}")?;
        if let Some(line) = line {
            write!(f, " (line {line})")?;
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
