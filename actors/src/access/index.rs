//! A list put together with the directory's names, so that a message costs two looks at a table and no search through texts.
//!
//! For every application that has a name here it is known beforehand which rules are about it as a source, and which as a target. The
//! first rule that is in both, and is about the class, decides. One without a name is compared with the addresses in the rules, which
//! are numbers.

use std::{collections::BTreeMap, sync::Arc};

use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::Class,
};

use super::rule::{List, Question, RULES_MAX, Rule, Verdict};

/// Some of a list's rules.
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

    /// The first of them.
    fn first(self) -> Option<usize> {
        let (at, word) = self.0.iter().enumerate().find(|(_, word)| **word != 0)?;
        Some(at * 64 + word.trailing_zeros() as usize)
    }
}

/// An application that has a name.
#[derive(Clone, Debug)]
pub(super) struct Known {
    name: Arc<str>,
    /// The rules that it is a source of.
    from: Rules,
    /// The rules that it is a target of.
    to: Rules,
}

/// Those of one life of a node that have a name.
pub(super) type Named = Arc<BTreeMap<AppAddress, Known>>;

/// What is known of the names on one node.
#[derive(Clone, Debug, Default)]
pub(super) struct Names {
    /// Which life of the node these are of, as far as that is known.
    pub(super) life: Option<Incarnation>,
    /// Whether this life has said who is called how.
    pub(super) is_told: bool,
    pub(super) apps: Named,
    /// The life before, and its names: its last wills are judged by them.
    pub(super) former: Option<(Incarnation, Named)>,
}

/// A list and the names that are known.
#[derive(Clone, Debug)]
pub(super) struct Index {
    pub(super) list: Arc<List>,
    here: NodeAddress,
    /// For each class in the order of their numbers.
    classes: [Rules; 3],
    /// Node by node, so that a name more on one copies those of that one alone.
    pub(super) nodes: BTreeMap<NodeAddress, Arc<Names>>,
}

impl Index {
    /// `list` on the node at `here`, which knows no names.
    pub(super) fn new(list: Arc<List>, here: NodeAddress) -> Self {
        let classes = [Class::Control, Class::Stream, Class::Bulk]
            .map(|class| Rules::of(&list.rules, |rule| rule.classes.has(class)));
        Self { list, here, classes, nodes: BTreeMap::new() }
    }

    /// Another list, and the same names.
    pub(super) fn with_list(&self, list: Arc<List>) -> Self {
        let mut index = Self::new(list, self.here);
        for (node, names) in &self.nodes {
            let look = |apps: &Named| {
                let all = apps.iter().map(|(app, known)| (*app, &*known.name));
                index.look_all(*node, all, &Named::default())
            };
            let former = names.former.as_ref().map(|(life, apps)| (*life, look(apps)));
            let names = Names { apps: look(&names.apps), former, ..**names };
            index.nodes.insert(*node, Arc::new(names));
        }
        index
    }

    /// The same list, and these names on `node`.
    pub(super) fn with_names(&self, node: NodeAddress, names: Names) -> Self {
        let mut index = self.clone();
        index.nodes.insert(node, Arc::new(names));
        index
    }

    /// What is known of the names on `node`.
    pub(super) fn names_on(&self, node: NodeAddress) -> Names {
        self.nodes.get(&node).map(|names| Names::clone(names)).unwrap_or_default()
    }

    /// These applications on `node`. Only those that are called otherwise than `before` are compared with the rules.
    pub(super) fn look_all<'a>(
        &self,
        node: NodeAddress,
        apps: impl Iterator<Item = (AppAddress, &'a str)>,
        before: &Named,
    ) -> Named {
        let known = apps.map(|(app, name)| {
            let same = before.get(&app).filter(|known| &*known.name == name);
            (app, same.cloned().unwrap_or_else(|| self.look(Tid::new(node, app), name)))
        });
        Arc::new(known.collect())
    }

    /// An application and the rules about it.
    pub(super) fn look(&self, tid: Tid, name: &str) -> Known {
        let from = Rules::of(&self.list.rules, |rule| rule.is_from(self.here, tid, Some(name)));
        let to = Rules::of(&self.list.rules, |rule| rule.is_to(self.here, tid, Some(name)));
        Known { name: name.into(), from, to }
    }

    fn known(&self, tid: Tid) -> Option<&Known> {
        self.nodes.get(&tid.node)?.apps.get(&tid.app)
    }

    /// What the directory calls the application at `tid`.
    pub(super) fn name_of(&self, tid: Tid) -> Option<&str> {
        self.known(tid).map(|known| &*known.name)
    }

    /// Whether this node does not know yet who is called how on `node`.
    fn is_untold(&self, node: NodeAddress) -> bool {
        node != self.here && self.nodes.get(&node).is_none_or(|names| !names.is_told)
    }

    /// What becomes of a message.
    pub(super) fn decide(&self, asked: Question) -> Verdict {
        let Question { source, target, group, class } = asked;
        let rules = &self.list.rules;
        let from = match self.known(source) {
            Some(known) => known.from,
            // It may be called anything: what is refused to some name is refused to it, until its node has said who it is.
            None if self.is_untold(source.node) => Rules::of(rules, |rule| {
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
