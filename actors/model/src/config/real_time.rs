//! The settings of the measurement that a node makes of its own real-time behaviour.

use std::time::Duration;

/// The measurement of the node's rights and of its lateness after its start: see
/// [`real_time`](sinew_runtime::real_time). `sinew nodes` shows the result.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// config.rt.probe = Duration::from_secs(10);
/// config.validate()?;
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RtConfig {
    /// How long a thread measures its lateness at 1 kHz after the start, with the priority of the thread that makes
    /// outputs safe. It costs 2 to 4 % of a CPU for this time on a virtual machine. 0 to 60 s; default 2 s. With 0
    /// nothing is measured, and the node reports no rights.
    pub probe: Duration,
}

impl Default for RtConfig {
    fn default() -> Self {
        Self { probe: Duration::from_secs(2) }
    }
}
