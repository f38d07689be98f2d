//! Nodes with a loss detection of their own.

use std::time::Duration;

use sinew_runtime::app::matches;

/// Nodes that need a faster, or may have a slower, loss detection than others. Each node decides for itself
/// how it watches others; those answer every query.
///
/// # Examples
///
/// ```
/// use sinew::{config::WatchGroup, prelude::*};
///
/// let mut config = NodeConfig::new("central");
/// // The loss of a leg is known within 40 ms, that of others in the default's 2 s.
/// let legs = WatchGroup { nodes: vec!["leg.*".into()], period: Duration::from_millis(10), missed_max: 3 };
/// config.ndl.watch.push(legs);
/// # config.validate().expect("it is legal");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WatchGroup {
    /// Names of nodes; `*` matches any text: `leg.*`. 1 to 64 names of 1 to 63 bytes.
    pub nodes: Vec<String>,
    /// Time between two queries to each of them. 10 ms to 60 s. A shorter time costs more datagrams: one each
    /// way per node and period.
    pub period: Duration,
    /// Consecutive missed answers after which one of them counts as lost. 2 to 100.
    pub missed_max: u32,
}

impl WatchGroup {
    /// Returns whether the node called `name` is in this group.
    ///
    /// # Examples
    ///
    /// ```
    /// # use sinew::config::WatchGroup;
    /// let legs = WatchGroup { nodes: vec!["leg.*".into(), "hip".into()], period: std::time::Duration::from_millis(10), missed_max: 3 };
    /// assert!(legs.covers("leg.left") && legs.covers("hip") && !legs.covers("hip.left"));
    /// ```
    #[must_use]
    pub fn covers(&self, name: &str) -> bool {
        self.nodes.iter().any(|pattern| matches(pattern, name))
    }
}
