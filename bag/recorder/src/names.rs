//! The names of applications, nodes and payload types, and the structures of these types.

use std::{collections::BTreeMap, sync::Arc};

use sinew_record::RecordReport;
use sinew_runtime::{
    tid::{NodeAddress, Tid},
    wire::Kind,
};
use sinew_schema::Schema;

/// Maximum names of each sort. Further ones are not stored: then the address is shown.
const NAMES_MAX: usize = 65_536;
/// Maximum types with a known structure, or with a note that there is none. Further ones have views as JSON.
const SCHEMAS_MAX: usize = 4_096;

/// The names of applications, nodes and payload types, and the structures of these types, as far as they are known.
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
/// assert!(names.has_app("knee.drive") && !names.has_app("hip.drive"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Names {
    apps: BTreeMap<Tid, String>,
    nodes: BTreeMap<NodeAddress, String>,
    types: BTreeMap<Kind, String>,
    /// `None` for a type without a known structure.
    schemas: BTreeMap<Kind, Option<Arc<Schema>>>,
    changes: u64,
}

impl Names {
    /// Adds the name of an application or of a group, in place of a former one.
    pub fn add_app(&mut self, app: Tid, name: &str) {
        self.changes += u64::from(add(&mut self.apps, app, name));
    }

    /// Adds the names that a node has reported, and the structures of those types for which it was asked.
    pub fn learn(&mut self, report: &RecordReport, asked: &[Kind]) {
        report.apps.iter().for_each(|app| self.add_app(app.tid, &app.name));
        for one in &report.types {
            self.add_type(one.kind, &one.name);
            if asked.contains(&one.kind) {
                self.add_schema(one.kind, one.schema.as_deref());
            }
        }
        // The structures stand first in the answer. The first one is in it, or is not known to the node.
        let answered = if report.types_left_out == 0 { asked.len() } else { 1 };
        asked.iter().take(answered).for_each(|kind| self.add_schema(*kind, None));
        if let Some(node) = report.node {
            self.add_node(node, &report.name);
        }
    }

    /// Adds the name of a node.
    pub fn add_node(&mut self, node: NodeAddress, name: &str) {
        self.changes += u64::from(add(&mut self.nodes, node, name));
    }

    /// Adds the name of a payload type.
    pub fn add_type(&mut self, kind: Kind, name: &str) {
        self.changes += u64::from(add(&mut self.types, kind, name));
    }

    /// Adds the structure of a payload type, in its canonical bytes; `None` if its node does not know it. Bytes that
    /// are no schema leave the type without a known structure. A structure that is known stays.
    pub fn add_schema(&mut self, kind: Kind, schema: Option<&[u8]>) {
        let schema = schema.and_then(|bytes| Schema::parse(bytes).ok()).map(Arc::new);
        let has_room = self.schemas.len() < SCHEMAS_MAX;
        match self.schemas.get_mut(&kind) {
            Some(known) => *known = known.take().or(schema),
            None if has_room => drop(self.schemas.insert(kind, schema)),
            None => {}
        }
    }

    /// Returns the structure of a payload type.
    #[must_use]
    pub fn schema(&self, kind: Kind) -> Option<&Arc<Schema>> {
        self.schemas.get(&kind)?.as_ref()
    }

    /// Returns whether the node need not be asked for the structure of a payload type any more.
    pub(crate) fn is_settled(&self, kind: Kind) -> bool {
        self.schemas.contains_key(&kind) || self.schemas.len() >= SCHEMAS_MAX
    }

    /// Returns the name of an application or of a group.
    #[must_use]
    pub fn app(&self, app: Tid) -> Option<&str> {
        self.apps.get(&app).map(String::as_str)
    }

    /// Returns whether an application or a group has this name. It looks at all of them.
    #[must_use]
    pub fn has_app(&self, name: &str) -> bool {
        self.apps.values().any(|known| known == name)
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

#[cfg(test)]
mod tests {
    use sinew_schema::Shape;

    use super::*;

    #[test]
    fn known_structure_stays() {
        let kind = Kind::named("test.angle");
        let mut names = Names::default();
        assert!(!names.is_settled(kind));
        // These bytes are no schema.
        names.add_schema(kind, Some(&[0xff; 9]));
        assert!(names.schema(kind).is_none() && names.is_settled(kind));
        let schema = Schema { root: Shape::F32, types: BTreeMap::new() };
        names.add_schema(kind, Some(&schema.encode()));
        names.add_schema(kind, None);
        assert_eq!(names.schema(kind).map(|known| &**known), Some(&schema));
    }

    #[test]
    fn structures_are_bounded() {
        let mut names = Names::default();
        for kind in 0..=SCHEMAS_MAX as u32 {
            names.add_schema(Kind::from_bits(kind), None);
        }
        assert_eq!(names.schemas.len(), SCHEMAS_MAX);
        assert!(names.is_settled(Kind::from_bits(u32::MAX)), "none is asked for any more");
    }
}
