//! A list put together with the directory's names, so that a message costs two looks at a table and no search through texts.
//!
//! For every application that has a name here it is known beforehand which rules are about it as a source, and which as a target. The
//! first rule that is in both, and is about the class, decides. One without a name is compared with the addresses in the rules, which
//! are numbers.

use std::{collections::BTreeMap, sync::Arc};

use sinew_runtime::{
    tid::{NodeAddress, Tid},
    wire::Class,
};

use super::rule::{List, Question, RULES_MAX, Rule, Verdict};

/// Some of a list's rules.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Rules([u64; RULES_MAX / 64]);

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
struct Known {
    name: Arc<str>,
    /// The rules that it is a source of.
    from: Rules,
    /// The rules that it is a target of.
    to: Rules,
}

/// A list and the names that are known.
#[derive(Clone, Debug)]
pub(super) struct Index {
    pub(super) list: Arc<List>,
    here: NodeAddress,
    /// For each class in the order of their numbers.
    classes: [Rules; 3],
    known: BTreeMap<Tid, Known>,
}

impl Index {
    /// `list` on the node at `here`, which knows these names.
    pub(super) fn new(list: Arc<List>, here: NodeAddress, names: &BTreeMap<Tid, Arc<str>>) -> Self {
        let classes = [Class::Control, Class::Stream, Class::Bulk]
            .map(|class| Rules::of(&list.rules, |rule| rule.classes.has(class)));
        let mut index = Self { list, here, classes, known: BTreeMap::new() };
        for (tid, name) in names {
            let known = index.look(*tid, name.clone());
            index.known.insert(*tid, known);
        }
        index
    }

    /// The same list, and other names. Only those that are new are compared with the rules.
    pub(super) fn with_names(&self, names: &BTreeMap<Tid, Arc<str>>) -> Self {
        let known = names.iter().map(|(tid, name)| {
            let same = self.known.get(tid).filter(|known| known.name == *name);
            (*tid, same.cloned().unwrap_or_else(|| self.look(*tid, name.clone())))
        });
        Self { known: known.collect(), list: self.list.clone(), ..*self }
    }

    fn look(&self, tid: Tid, name: Arc<str>) -> Known {
        let from = Rules::of(&self.list.rules, |rule| rule.is_from(self.here, tid, Some(&name)));
        let to = Rules::of(&self.list.rules, |rule| rule.is_to(self.here, tid, Some(&name)));
        Known { name, from, to }
    }

    /// What the directory calls the application at `tid`.
    pub(super) fn name_of(&self, tid: Tid) -> Option<&str> {
        self.known.get(&tid).map(|known| &*known.name)
    }

    /// What becomes of a message.
    pub(super) fn decide(&self, asked: Question) -> Verdict {
        let Question { source, target, group, class } = asked;
        let rules = &self.list.rules;
        let from = match self.known.get(&source) {
            Some(known) => known.from,
            None => Rules::of(rules, |rule| rule.is_from(self.here, source, None)),
        };
        let mut to = match self.known.get(&target) {
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
