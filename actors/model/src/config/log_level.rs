//! The amount of logging, and its words in a configuration.

use std::str::FromStr;

/// The amount of logging.
///
/// # Examples
///
/// ```
/// use sinew::config::{LogLevel, NodeConfig};
///
/// let config = NodeConfig::from_toml("[node]\nname = 'knee'\n[log]\nlevel = 'warn'\n")?;
/// assert_eq!(config.log.level, LogLevel::Warn);
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogLevel {
    /// Nothing, except panics of actors.
    Off,
    /// Failures.
    Error,
    /// Also conditions that need attention.
    Warn,
    /// Also starts, stops, and changes of members.
    #[default]
    Info,
    /// Also details for debugging.
    Debug,
    /// Everything.
    Trace,
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
