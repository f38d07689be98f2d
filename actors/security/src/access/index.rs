//! The access list, indexed by the names in the directory. A decision costs two table look-ups and no text search.
//!
//! For each named application, the index stores the rules that match it as a source, and those that match it as a
//! target. The first rule that is in both sets and covers the class decides. An application without a name is compared
//! with the addresses in the rules, which are numbers.

use std::{collections::BTreeMap, sync::Arc};

use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::Class,
};

use super::rule::{List, Question, RULES_MAX, Rule, Verdict};

/// A subset of a list's rules.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Rules([u64; RULES_MAX / 64]);

impl Rules {
    fn of(rules: &[Rule], is_one: impl Fn(&Rule) -> bool) -> Self {
        let mut some = Self::default();
        for (at, _) in rules.iter().enumerate().take(RULES_MAX).filter(|(_, rule)| is_one(rule)) {
            some.0[at / 64] |= 1 << (at % 64);
        }
        some
    }

    fn and(self, other: Self) -> Self {
        Self(std::array::from_fn(|at| self.0[at] & other.0[at]))
    }

    fn or(self, other: Self) -> Self {
        Self(std::array::from_fn(|at| self.0[at] | other.0[at]))
    }

    /// Returns the index of the first rule of the subset.
    fn first(self) -> Option<usize> {
        let (at, word) = self.0.iter().enumerate().find(|(_, word)| **word != 0)?;
        Some(at * 64 + word.trailing_zeros() as usize)
    }
}

/// An application with a name, and the rules that match it.
#[derive(Clone, Debug)]
pub(super) struct Known {
    name: Arc<str>,
    /// The rules that match the application as a source.
    from: Rules,
    /// The rules that match the application as a target.
    to: Rules,
}

/// The named applications of one incarnation of a node.
pub(super) type Named = Arc<BTreeMap<AppAddress, Known>>;

/// The known names on one node.
#[derive(Clone, Debug, Default)]
pub(super) struct Names {
    /// The node's incarnation that these names belong to, if known.
    pub(super) incarnation: Option<Incarnation>,
    /// Whether this incarnation has reported its names.
    pub(super) is_reported: bool,
    pub(super) apps: Named,
    /// The previous incarnation and its names. Its last wills are judged by these names.
    pub(super) former: Option<(Incarnation, Named)>,
}

/// A list and the known names.
#[derive(Clone, Debug)]
pub(super) struct Index {
    pub(super) list: Arc<List>,
    here: NodeAddress,
    /// The rules of each class, in the order of the class numbers.
    classes: [Rules; 3],
    /// The names of each node. A new name on one node copies the names of that node only.
    pub(super) nodes: BTreeMap<NodeAddress, Arc<Names>>,
}

impl Index {
    /// Creates an index of `list` on the node at `here`, without any names.
    pub(super) fn new(list: Arc<List>, here: NodeAddress) -> Self {
        let classes = [Class::Control, Class::Stream, Class::Bulk]
            .map(|class| Rules::of(&list.rules, |rule| rule.classes.has(class)));
        Self { list, here, classes, nodes: BTreeMap::new() }
    }

    /// Returns an index of another list with the same names.
    pub(super) fn with_list(&self, list: Arc<List>) -> Self {
        let mut index = Self::new(list, self.here);
        for (node, names) in &self.nodes {
            let match_rules = |apps: &Named| {
                let all = apps.iter().map(|(app, known)| (*app, &*known.name));
                index.match_all(*node, all, &Named::default())
            };
            let former = names.former.as_ref().map(|(incarnation, apps)| (*incarnation, match_rules(apps)));
            let names = Names { apps: match_rules(&names.apps), former, ..**names };
            index.nodes.insert(*node, Arc::new(names));
        }
        index
    }

    /// Returns an index of the same list with these names on `node`.
    pub(super) fn with_names(&self, node: NodeAddress, names: Names) -> Self {
        let mut index = self.clone();
        index.nodes.insert(node, Arc::new(names));
        index
    }

    /// Returns the known names on `node`.
    pub(super) fn names_on(&self, node: NodeAddress) -> Names {
        self.nodes.get(&node).map(|names| Names::clone(names)).unwrap_or_default()
    }

    /// Looks up the rules for these applications on `node`. An application with the same name as in `before` keeps its
    /// entry and is not matched again.
    pub(super) fn match_all<'a>(
        &self,
        node: NodeAddress,
        apps: impl Iterator<Item = (AppAddress, &'a str)>,
        before: &Named,
    ) -> Named {
        let known = apps.map(|(app, name)| {
            let same = before.get(&app).filter(|known| &*known.name == name);
            (app, same.cloned().unwrap_or_else(|| self.match_rules(Tid::new(node, app), name)))
        });
        Arc::new(known.collect())
    }

    /// Looks up the rules that match an application.
    pub(super) fn match_rules(&self, tid: Tid, name: &str) -> Known {
        let from = Rules::of(&self.list.rules, |rule| rule.is_from(self.here, tid, Some(name)));
        let to = Rules::of(&self.list.rules, |rule| rule.is_to(self.here, tid, Some(name)));
        Known { name: name.into(), from, to }
    }

    fn known(&self, tid: Tid) -> Option<&Known> {
        self.nodes.get(&tid.node)?.apps.get(&tid.app)
    }

    /// Returns the name of the application at `tid` in the directory.
    pub(super) fn name_of(&self, tid: Tid) -> Option<&str> {
        self.known(tid).map(|known| &*known.name)
    }

    /// Returns whether `node` is another node that has not reported its names yet.
    fn is_unreported(&self, node: NodeAddress) -> bool {
        node != self.here && self.nodes.get(&node).is_none_or(|names| !names.is_reported)
    }

    /// Decides whether a message is allowed.
    pub(super) fn decide(&self, asked: Question) -> Verdict {
        let Question { source, target, group, class } = asked;
        let rules = &self.list.rules;
        let from = match self.known(source) {
            Some(known) => known.from,
            // The name is unknown. A refusal of any name applies until the node has reported its names.
            None if self.is_unreported(source.node) => Rules::of(rules, |rule| {
                rule.is_from(self.here, source, None) || rule.may_refuse(self.here, source.node)
            }),
            None => Rules::of(rules, |rule| rule.is_from(self.here, source, None)),
        };
        let mut to = match self.known(target) {
            Some(known) => known.to,
            None => Rules::of(rules, |rule| rule.is_to(self.here, target, None)),
        };
        if let Some(group) = group {
            to = to.or(Rules::of(rules, |rule| rule.groups.contains(&group)));
        }
        let of_class = match class {
            Class::Control => self.classes[0],
            Class::Stream => self.classes[1],
            Class::Bulk => self.classes[2],
        };
        self.list.verdict(from.and(to).and(of_class).first())
    }
}
