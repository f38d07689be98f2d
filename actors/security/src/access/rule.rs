//! Access rules. The first rule in the list that covers source, target and class decides.

use std::fmt;

use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::Class,
};

use super::{client::ClientRule, selector::Selector};

/// Maximum number of rules in one list.
pub(super) const RULES_MAX: usize = 256;
/// Maximum number of texts in `from` and `to` of all rules of one list. Each new name is compared with all of them.
pub(super) const PATTERNS_MAX: usize = 2_048;
/// Maximum number of texts in one `from`, `to`, `groups`, `names` or `addresses` of a rule or a `[[client]]`.
pub(super) const TEXTS_MAX: usize = 64;

/// The content of an access list file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct List {
    /// The rules for messages, in the order of the file.
    pub(super) rules: Vec<Rule>,
    /// The rules for users of this host.
    pub(super) clients: Vec<ClientRule>,
    /// The roles.
    pub(super) roles: Roles,
}

/// The applications that have a role. Its rights are in addition to those by rules.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Roles {
    /// May set and read parameters.
    pub(super) operators: Vec<Selector>,
    /// May read parameters.
    pub(super) observers: Vec<Selector>,
}

/// Allows or refuses the messages of a set of sources to a set of targets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Rule {
    /// Display name of the rule.
    pub(super) name: Option<String>,
    /// Line in the file at which the rule begins, from 1.
    pub(super) line: usize,
    /// Action for the messages that the rule covers.
    pub(super) action: Action,
    pub(super) from: Vec<Selector>,
    pub(super) to: Vec<Selector>,
    /// Groups. The rule covers messages to these groups, for all members.
    pub(super) groups: Vec<AppAddress>,
    pub(super) classes: Classes,
}

/// Action of a rule for the messages that it covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Action {
    Allow,
    Refuse,
}

/// A non-empty subset of the three classes.
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

/// The properties of a message that rules match.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Question {
    /// The sender of the message, already verified by the node.
    pub source: Tid,
    /// The application that may receive the message.
    pub target: Tid,
    /// The destination group, if the message was sent to a group.
    pub group: Option<AppAddress>,
    /// The class of the message.
    pub class: Class,
}

/// The names of source and target in the directory, if known.
#[cfg(any(test, feature = "fuzzing"))]
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Names<'a> {
    pub(super) source: Option<&'a str>,
    pub(super) target: Option<&'a str>,
}

/// The decision of a list for a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Allowed by the rule with this index, from 0.
    Allowed(usize),
    /// Refused by the rule with this index, from 0. `None`: no rule covers the message.
    Refused(Option<usize>),
}

impl List {
    /// Decides on a message on the node at `here`. A message that no rule covers is refused.
    #[cfg(any(test, feature = "fuzzing"))]
    pub(super) fn decide(&self, here: NodeAddress, asked: Question, names: Names<'_>) -> Verdict {
        self.verdict(self.rules.iter().position(|rule| rule.covers(here, asked, names)))
    }

    /// Returns the verdict of the rule that decides.
    pub(super) fn verdict(&self, rule: Option<usize>) -> Verdict {
        match rule.and_then(|at| Some((at, self.rules.get(at)?.action))) {
            Some((at, Action::Allow)) => Verdict::Allowed(at),
            Some((at, Action::Refuse)) => Verdict::Refused(Some(at)),
            None => Verdict::Refused(None),
        }
    }

    /// Describes the rule at index `rule`, or states that there is none.
    pub(super) fn describe(&self, rule: Option<usize>) -> String {
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
        self.from.iter().any(|selector| selector.covers(here, source, name))
    }

    /// Returns whether the rule refuses messages of named applications on `node`.
    pub(super) fn may_refuse(&self, here: NodeAddress, node: NodeAddress) -> bool {
        self.action == Action::Refuse && self.from.iter().any(|selector| selector.names_some(here, node))
    }

    pub(super) fn is_to(&self, here: NodeAddress, target: Tid, name: Option<&str>) -> bool {
        self.to.iter().any(|selector| selector.covers(here, target, name))
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
