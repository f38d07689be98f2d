//! The settings of the contracts of applications.

use std::time::Duration;

/// The contracts of applications: see `docs/book/src/how-to/contracts.md`.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// config.contracts.dry_run = true;
/// config.contracts.slack = Duration::from_millis(2);
/// config.validate()?;
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ContractsConfig {
    /// Whether each output is measured by a dry run when it is made: the node injects a silence before the output is
    /// armed. Its safe function is called once more by that. Default: `false`.
    pub dry_run: bool,
    /// Time that the checks of contracts add for a late thread and for the safe function itself. 0 to 1 s; default 5
    /// ms. A dry run that takes longer is a finding.
    pub slack: Duration,
}

impl Default for ContractsConfig {
    fn default() -> Self {
        Self { dry_run: false, slack: Duration::from_millis(5) }
    }
}
