//! The settings of the stop of the whole system.

/// The stop of the whole system: see `docs/book/src/how-to/stop.md`.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let mut config = NodeConfig::new("knee");
/// config.stop.on_lost = true;
/// config.validate()?;
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StopConfig {
    /// Whether this node presses the stop when it loses another node without its farewell. Then a node that is cut off
    /// stops by itself within [`period`](super::NdlConfig::period) times
    /// [`missed_max`](super::NdlConfig::missed_max) plus two periods, also where its commands come from
    /// its own applications. Default: `false`, the other outputs stay live when a node is lost.
    pub on_lost: bool,
}
