//! The names of applications, nodes and payload types.

use std::collections::BTreeMap;

use sinew_runtime::{
    tid::{NodeAddress, Tid},
    wire::Kind,
};

/// Maximum names of each sort. Further ones are not stored: then the address is shown.
const NAMES_MAX: usize = 65_536;

/// The names of applications, nodes and payload types, as far as they are known.
///
/// # Examples
///
/// ```
/// use sinew_recorder::Names;
/// use sinew_runtime::{tid::Tid, wire::Kind};
///
/// let knee: Tid = "10.0.0.2/80000001".parse()?;
/// let mut names = Names::default();
/// names.add_app(knee, "knee.drive");
/// names.add_type(Kind::named("demo.angle"), "demo.angle");
/// assert_eq!(names.app(knee), Some("knee.drive"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Names {
    apps: BTreeMap<Tid, String>,
    nodes: BTreeMap<NodeAddress, String>,
    types: BTreeMap<Kind, String>,
    changes: u64,
}

impl Names {
    /// Adds the name of an application or of a group, in place of a former one.
    pub fn add_app(&mut self, app: Tid, name: &str) {
        self.changes += u64::from(add(&mut self.apps, app, name));
    }

    /// Adds the name of a node.
    pub fn add_node(&mut self, node: NodeAddress, name: &str) {
        self.changes += u64::from(add(&mut self.nodes, node, name));
    }

    /// Adds the name of a payload type.
    pub fn add_type(&mut self, kind: Kind, name: &str) {
        self.changes += u64::from(add(&mut self.types, kind, name));
    }

    /// Returns the name of an application or of a group.
    #[must_use]
    pub fn app(&self, app: Tid) -> Option<&str> {
        self.apps.get(&app).map(String::as_str)
    }

    /// Returns the name of a node.
    #[must_use]
    pub fn node(&self, node: NodeAddress) -> Option<&str> {
        self.nodes.get(&node).map(String::as_str)
    }

    /// Returns the name of a payload type.
    #[must_use]
    pub fn type_name(&self, kind: Kind) -> Option<&str> {
        self.types.get(&kind).map(String::as_str)
    }

    /// Returns how often a name was added or has changed.
    pub(crate) const fn changes(&self) -> u64 {
        self.changes
    }
}

/// Returns whether it is a change.
fn add<K: Ord>(all: &mut BTreeMap<K, String>, key: K, name: &str) -> bool {
    let known = all.get(&key);
    if known.is_some_and(|known| known == name) || (known.is_none() && all.len() >= NAMES_MAX) {
        return false;
    }
    all.insert(key, name.to_owned());
    true
}
