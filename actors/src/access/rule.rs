//! A rule, and which of several counts: the first one in the list that covers source, target and class.

use std::fmt;

use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::Class,
};

use super::{client::ClientRule, who::Who};

/// Rules of one list at most.
pub(super) const RULES_MAX: usize = 256;
/// Texts in `from` and `to` of all rules of one list at most: so much each new name is compared with.
pub(super) const PATTERNS_MAX: usize = 2_048;
/// Texts in one `from`, `to`, `groups`, `names` or `addresses` at most, in a rule or in a `[[client]]`.
pub(super) const TEXTS_MAX: usize = 64;

/// Everything that a file says.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct List {
    /// Who may send what to whom, in the order of the file.
    pub(super) rules: Vec<Rule>,
    /// Which users of this host may register what.
    pub(super) clients: Vec<ClientRule>,
}

/// Who may, or may not, send what to whom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Rule {
    /// What people call it.
    pub(super) name: Option<String>,
    /// Where it begins in its file, from 1.
    pub(super) line: usize,
    /// What becomes of a message that it covers.
    pub(super) action: Action,
    pub(super) from: Vec<Who>,
    pub(super) to: Vec<Who>,
    /// Groups whose members get what is sent to the group, whoever they are.
    pub(super) groups: Vec<AppAddress>,
    pub(super) classes: Classes,
}

/// What a rule says of the messages that it covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Action {
    Allow,
    Refuse,
}

/// Some of the three classes, at least one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Classes(u8);

impl Classes {
    pub(super) const ALL: Self = Self(0b111);

    pub(super) fn of(classes: impl IntoIterator<Item = Class>) -> Self {
        Self(classes.into_iter().fold(0, |all, class| all | 1 << class as u8))
    }

    pub(super) const fn has(self, class: Class) -> bool {
        self.0 & (1 << class as u8) != 0
    }
}

/// A message, as far as rules look at it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Question {
    /// Who sends it; the node has seen to that this is so.
    pub(crate) source: Tid,
    /// The application that it may reach or not.
    pub(crate) target: Tid,
    /// The group that it was sent to, if it was.
    pub(crate) group: Option<AppAddress>,
    pub(crate) class: Class,
}

/// The names of source and target, as far as the directory has them.
#[cfg(any(test, feature = "fuzzing"))]
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Names<'a> {
    pub(super) source: Option<&'a str>,
    pub(super) target: Option<&'a str>,
}

/// What a list says of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// By the n-th rule, from 0.
    Allowed(usize),
    /// By the n-th rule, from 0, or because there is none for it.
    Refused(Option<usize>),
}

impl List {
    /// What becomes of a message on the node at `here`. What no rule covers is refused.
    #[cfg(any(test, feature = "fuzzing"))]
    pub(super) fn decide(&self, here: NodeAddress, asked: Question, names: Names<'_>) -> Verdict {
        self.verdict(self.rules.iter().position(|rule| rule.covers(here, asked, names)))
    }

    /// What the rule that counts says.
    pub(super) fn verdict(&self, rule: Option<usize>) -> Verdict {
        match rule.and_then(|at| Some((at, self.rules.get(at)?.action))) {
            Some((at, Action::Allow)) => Verdict::Allowed(at),
            Some((at, Action::Refuse)) => Verdict::Refused(Some(at)),
            None => Verdict::Refused(None),
        }
    }

    /// What people call the rule at `rule`, or that there is none.
    pub(super) fn in_words(&self, rule: Option<usize>) -> String {
        let found = rule.and_then(|at| Some((at + 1, self.rules.get(at)?)));
        found.map_or_else(|| "no rule allows it".to_owned(), |(number, rule)| format!("rule {number}{rule}"))
    }
}

impl Rule {
    #[cfg(any(test, feature = "fuzzing"))]
    fn covers(&self, here: NodeAddress, asked: Question, names: Names<'_>) -> bool {
        self.classes.has(asked.class)
            && self.is_from(here, asked.source, names.source)
            && (self.is_to(here, asked.target, names.target)
                || asked.group.is_some_and(|group| self.groups.contains(&group)))
    }

    pub(super) fn is_from(&self, here: NodeAddress, source: Tid, name: Option<&str>) -> bool {
        self.from.iter().any(|who| who.covers(here, source, name))
    }

    /// Whether it refuses something to applications on `node` that have some name.
    pub(super) fn may_refuse(&self, here: NodeAddress, node: NodeAddress) -> bool {
        self.action == Action::Refuse && self.from.iter().any(|who| who.names_some(here, node))
    }

    pub(super) fn is_to(&self, here: NodeAddress, target: Tid, name: Option<&str>) -> bool {
        self.to.iter().any(|who| who.covers(here, target, name))
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(name) = &self.name {
            write!(f, " '{name}'")?;
        }
        write!(f, " (line {})", self.line)
    }
}
