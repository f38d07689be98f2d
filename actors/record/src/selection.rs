//! The messages to record: by the names of applications, payload types and groups.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{is_pattern, matches},
    tid::{AppAddress, Tid},
    wire::Kind,
};
use thiserror::Error;

/// Maximum number of names in each list.
pub const NAMES_MAX: usize = 64;
/// Maximum bytes of a name.
pub const NAME_BYTES_MAX: usize = 255;

/// The messages to record. In each name `*` matches any text. Without any application and group, messages of all are
/// chosen; without any type, those of all types.
///
/// A message is chosen if its type is, and if one of its ends is a chosen application, or it is sent to a chosen group.
///
/// # Examples
///
/// ```
/// use sinew_record::Selection;
///
/// let selection = Selection { apps: vec!["leg.*".into()], ..Selection::default() };
/// assert!(selection.has_app("leg.knee") && !selection.has_app("arm"));
/// assert!(selection.has_type("any.type") && !selection.is_all());
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Selection {
    /// Names of applications.
    #[serde(default)]
    pub apps: Vec<String>,
    /// Names of payload types.
    #[serde(default)]
    pub types: Vec<String>,
    /// Names of groups, each without `*`: a group is known by the hash of its name.
    #[serde(default)]
    pub groups: Vec<String>,
}

/// A fault of a selection.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SelectionError {
    /// A list is too long.
    #[error("a selection has at most {NAMES_MAX} {0}, and this one has {1}; write a `*` in place of several")]
    Many(&'static str, usize),
    /// A name is none.
    #[error("`{0}` cannot be a name: 1 to {NAME_BYTES_MAX} bytes without control characters")]
    Name(String),
    /// A group has a `*`.
    #[error("the group `{0}` has to be written without `*`: a node knows groups by their numbers")]
    Group(String),
}

impl Selection {
    /// Checks the lists and the names.
    ///
    /// # Errors
    /// The first fault.
    pub fn check(&self) -> Result<(), SelectionError> {
        for (title, names) in [("applications", &self.apps), ("types", &self.types), ("groups", &self.groups)]
        {
            if names.len() > NAMES_MAX {
                return Err(SelectionError::Many(title, names.len()));
            }
            let is_name = |name: &&String| {
                (1..=NAME_BYTES_MAX).contains(&name.len()) && !name.contains(char::is_control)
            };
            if let Some(name) = names.iter().find(|name| !is_name(name)) {
                let shown = name.chars().filter(|c| !c.is_control()).take(NAME_BYTES_MAX).collect();
                return Err(SelectionError::Name(shown));
            }
        }
        match self.groups.iter().find(|group| is_pattern(group)) {
            Some(group) => Err(SelectionError::Group(group.clone())),
            None => Ok(()),
        }
    }

    /// Returns whether every message is chosen.
    #[must_use]
    pub const fn is_all(&self) -> bool {
        self.apps.is_empty() && self.types.is_empty() && self.groups.is_empty()
    }

    /// Returns whether messages of the application with this name are chosen.
    #[must_use]
    pub fn has_app(&self, name: &str) -> bool {
        self.has_all_apps() || has(&self.apps, name)
    }

    /// Returns whether messages with a payload type of this name are chosen.
    #[must_use]
    pub fn has_type(&self, name: &str) -> bool {
        self.types.is_empty() || has(&self.types, name)
    }

    /// Returns whether messages of all applications are chosen.
    #[must_use]
    pub const fn has_all_apps(&self) -> bool {
        self.apps.is_empty() && self.groups.is_empty()
    }

    /// Adds the names of another selection: then the messages of both are chosen, and of an application of one with a
    /// type of the other, too.
    pub fn add(&mut self, other: &Self) {
        let join = |own: &mut Vec<String>, other: &[String], is_all: bool| {
            if is_all {
                own.clear();
            } else {
                own.extend_from_slice(other);
                own.sort();
                own.dedup();
            }
        };
        let all_apps = self.has_all_apps() || other.has_all_apps();
        join(&mut self.apps, &other.apps, all_apps);
        join(&mut self.groups, &other.groups, all_apps);
        let all_types = self.types.is_empty() || other.types.is_empty();
        join(&mut self.types, &other.types, all_types);
    }

    /// Returns the addresses and numbers of this selection, for these applications and types. Types without `*` are
    /// chosen even if nothing has used them yet.
    #[must_use]
    pub fn chosen<'a>(
        &self,
        apps: impl IntoIterator<Item = (&'a str, Tid)>,
        kinds: impl IntoIterator<Item = (&'a str, Kind)>,
    ) -> Chosen {
        let tids = apps.into_iter().filter(|(name, _)| has(&self.apps, name)).map(|(_, tid)| tid);
        let tids = (!self.has_all_apps()).then(|| tids.collect::<BTreeSet<_>>().into_iter().collect());
        let exact = self.types.iter().filter(|name| !is_pattern(name)).map(|name| Kind::named(name));
        let known = kinds.into_iter().filter(|(name, _)| has(&self.types, name)).map(|(_, kind)| kind);
        let kinds = exact.chain(known).collect::<BTreeSet<_>>().into_iter().collect();
        let groups = self.groups.iter().map(|name| AppAddress::group(name)).collect::<BTreeSet<_>>();
        Chosen {
            tids,
            kinds: (!self.types.is_empty()).then_some(kinds),
            groups: groups.into_iter().collect(),
        }
    }
}

fn has(patterns: &[String], name: &str) -> bool {
    patterns.iter().any(|pattern| matches(pattern, name))
}

/// A selection in addresses and numbers, for the senders' threads: it allocates nothing and searches sorted lists.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chosen {
    /// `None`: all.
    tids: Option<Box<[Tid]>>,
    /// `None`: all.
    kinds: Option<Box<[Kind]>>,
    groups: Box<[AppAddress]>,
}

impl Chosen {
    /// Returns whether messages of this application are chosen, whatever their destination.
    #[must_use]
    pub fn has_app(&self, app: Tid) -> bool {
        self.tids.as_ref().is_none_or(|tids| tids.binary_search(&app).is_ok())
    }

    /// Returns whether a message of this type between these ends is chosen.
    #[must_use]
    pub fn has(&self, source: Tid, destination: Tid, kind: Kind) -> bool {
        let is_kind = self.kinds.as_ref().is_none_or(|kinds| kinds.binary_search(&kind).is_ok());
        is_kind && self.has_ends(source, destination)
    }

    /// Returns whether messages of some type between these ends are chosen.
    #[must_use]
    pub fn has_ends(&self, source: Tid, destination: Tid) -> bool {
        self.has_app(source) || self.has_app(destination) || self.has_group(destination)
    }

    /// Returns whether the groups of this selection have an influence: then messages of applications that are not
    /// chosen are looked at, too.
    #[must_use]
    pub fn has_groups(&self) -> bool {
        !self.groups.is_empty()
    }

    fn has_group(&self, destination: Tid) -> bool {
        self.groups.binary_search(&destination.app).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    fn tid(app: u32) -> Tid {
        Tid::from_bits(u64::from(app) | 0x7f00_0001 << 32)
    }

    #[test]
    fn message_is_chosen_by_either_end_and_its_type() {
        let selection = Selection {
            apps: names(&["leg.*"]),
            types: names(&["exact", "torque.*"]),
            groups: names(&["all legs"]),
        };
        let apps = [("leg.knee", tid(1)), ("arm", tid(2))];
        let kinds = [("torque.left", Kind::named("torque.left")), ("angle", Kind::named("angle"))];
        let chosen = selection.chosen(apps, kinds);
        let has = |source, destination, kind| chosen.has(source, destination, Kind::named(kind));
        assert!(has(tid(1), tid(2), "torque.left") && has(tid(2), tid(1), "exact"));
        assert!(!has(tid(1), tid(2), "angle") && !has(tid(2), tid(3), "exact"));
        let group = Tid::group("all legs");
        assert!(has(tid(2), group, "exact") && !has(tid(2), Tid::group("others"), "exact"));
        assert!(chosen.has_app(tid(1)) && !chosen.has_app(tid(2)) && chosen.has_groups());
    }

    #[test]
    fn empty_selection_has_everything() {
        let chosen = Selection::default().chosen([], []);
        assert!(Selection::default().is_all());
        assert!(chosen.has(tid(1), tid(2), Kind::named("any")) && chosen.has_app(tid(9)));
        assert!(!chosen.has_groups());
    }

    #[test]
    fn sum_of_two_selections_has_the_messages_of_both() {
        let legs = Selection { apps: names(&["leg.*"]), types: names(&["torque"]), ..Selection::default() };
        let arms =
            Selection { apps: names(&["arm", "leg.*"]), types: names(&["angle"]), ..Selection::default() };
        let mut sum = legs.clone();
        sum.add(&arms);
        assert_eq!(
            (sum.apps.clone(), sum.types.clone()),
            (names(&["arm", "leg.*"]), names(&["angle", "torque"]))
        );
        sum.add(&Selection { types: names(&["x"]), ..Selection::default() });
        assert!(sum.has_all_apps() && !sum.has_type("y") && sum.has_type("torque"));
        sum.add(&Selection::default());
        assert!(sum.is_all());
    }

    #[test]
    fn faults_are_named() {
        let check = |selection: Selection| selection.check();
        assert_eq!(check(Selection { apps: names(&["leg.*"]), ..Selection::default() }), Ok(()));
        let many = vec!["a".to_owned(); NAMES_MAX + 1];
        assert!(matches!(
            check(Selection { types: many, ..Selection::default() }),
            Err(SelectionError::Many("types", 65))
        ));
        for name in [String::new(), "a\nb".to_owned(), "x".repeat(256)] {
            let found = check(Selection { apps: vec![name], ..Selection::default() });
            assert!(matches!(found, Err(SelectionError::Name(_))));
        }
        assert!(matches!(
            check(Selection { groups: names(&["leg*"]), ..Selection::default() }),
            Err(SelectionError::Group(_))
        ));
    }
}
