//! Which users of this host may register what, beside the node's own user and root.

use std::{fmt, ops::RangeInclusive};

use sinew_runtime::{app::matches, tid::AppAddress};

use super::rule::List;

/// Rules for users of one list at most.
pub(super) const CLIENTS_MAX: usize = 64;

/// What some processes of this host may register.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ClientRule {
    /// Where it begins in its file, from 1.
    pub(super) line: usize,
    /// Processes of this user, if it says so; of this group, if it says so; of both.
    pub(super) uid: Option<u32>,
    pub(super) gid: Option<u32>,
    /// Patterns of the names that they may have; none: they may have no name.
    pub(super) names: Vec<String>,
    /// The fixed addresses that they may have; none: only those that the node chooses.
    pub(super) addresses: Vec<RangeInclusive<u32>>,
    /// The groups that they may join, if it says so; else nothing is allowed by it, and the robot's own are not narrowed.
    pub(super) groups: Option<Vec<Joinable>>,
}

/// A group that somebody may join. What is asked for is a number made of its name, so that no pattern can be compared with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Joinable {
    Any,
    One(AppAddress),
}

/// A process that comes in, as the kernel says (SO_PEERCRED).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Applicant {
    /// Its effective user.
    pub(crate) uid: u32,
    /// Its effective group; its further ones the kernel does not tell.
    pub(crate) gid: u32,
}

impl fmt::Display for Applicant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "user {} of group {}", self.uid, self.gid)
    }
}

/// Why a process may not register so. It is at fault, or the list is.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ClientRefusal {
    #[error(
        "user {0} may not use this node: it runs as user {1}, and no [[client]] in its access list is about user {0}; run the application as user {1}, or add one"
    )]
    NotAdmitted(u32, u32),
    #[error(
        "{who} may not be called '{name}': [[client]] at {lines} of the access list does not have that name; choose another one, or add it to `names`"
    )]
    Name { who: Applicant, name: String, lines: Lines },
    #[error(
        "{who} may not have the address {address}: [[client]] at {lines} of the access list does not have it; choose another one, or add it to `addresses`"
    )]
    Address { who: Applicant, address: AppAddress, lines: Lines },
    #[error(
        "{who} may not join the group {group}: [[client]] at {lines} of the access list does not have it; join another one, or add its name to `groups`"
    )]
    Group { who: Applicant, group: AppAddress, lines: Lines },
}

/// Where the rules are that are about somebody.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Lines(Vec<usize>);

impl fmt::Display for Lines {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines: Vec<_> = self.0.iter().map(ToString::to_string).collect();
        write!(f, "line {}", lines.join(", "))
    }
}

impl ClientRule {
    fn is_about(&self, who: Applicant) -> bool {
        self.uid.is_none_or(|uid| uid == who.uid) && self.gid.is_none_or(|gid| gid == who.gid)
    }
}

impl List {
    fn about(&self, who: Applicant) -> impl Iterator<Item = &ClientRule> {
        self.clients.iter().filter(move |rule| rule.is_about(who))
    }

    /// Whether a rule is about `who`.
    pub(crate) fn is_about(&self, who: Applicant) -> bool {
        self.about(who).next().is_some()
    }

    /// Where the rules are that let users beside `own` and root in and name no groups, if there are any.
    pub(super) fn without_groups(&self, own: u32) -> Option<Lines> {
        let is_of_others = |rule: &&ClientRule| rule.uid.is_none_or(|uid| uid != own && uid != 0);
        let without = self.clients.iter().filter(is_of_others).filter(|rule| rule.groups.is_none());
        let lines: Vec<_> = without.map(|rule| rule.line).collect();
        (!lines.is_empty()).then_some(Lines(lines))
    }

    /// Whether `who` may come in on a node that runs as the user `own`: that user and root may, and whoever a rule is about.
    ///
    /// # Errors
    /// Why not.
    pub(crate) fn admit(&self, own: u32, who: Applicant) -> Result<(), ClientRefusal> {
        let is_known = who.uid == own || who.uid == 0 || self.about(who).next().is_some();
        if is_known { Ok(()) } else { Err(ClientRefusal::NotAdmitted(who.uid, own)) }
    }

    /// Whether `who` may have this name and this fixed address. The node's own user and root may have any, unless a rule is about them.
    ///
    /// # Errors
    /// Why not.
    pub(crate) fn may_register(
        &self,
        own: u32,
        who: Applicant,
        name: Option<&str>,
        address: Option<AppAddress>,
    ) -> Result<(), ClientRefusal> {
        self.admit(own, who)?;
        let mut rules = self.about(who).peekable();
        if rules.peek().is_none() {
            return Ok(());
        }
        let has_name = |rule: &ClientRule| {
            name.is_none_or(|name| rule.names.iter().any(|pattern| matches(pattern, name)))
        };
        let has_address = |rule: &ClientRule| {
            address.is_none_or(|app| rule.addresses.iter().any(|range| range.contains(&app.bits())))
        };
        let lines = || Lines(self.about(who).map(|rule| rule.line).collect());
        match (name, address) {
            (Some(name), _) if !self.about(who).any(has_name) => {
                Err(ClientRefusal::Name { who, name: name.to_owned(), lines: lines() })
            }
            // One rule must have both: a name of one and an address of another were never meant to go together.
            (_, Some(address)) if !self.about(who).any(|rule| has_name(rule) && has_address(rule)) => {
                Err(ClientRefusal::Address { who, address, lines: lines() })
            }
            (_, _) => Ok(()),
        }
    }

    /// Whether `who` may become a member of `group`. The node's own user and root may, unless a rule about them says which groups; others
    /// only where a rule says so.
    ///
    /// # Errors
    /// Why not.
    pub(crate) fn may_join(&self, own: u32, who: Applicant, group: AppAddress) -> Result<(), ClientRefusal> {
        self.admit(own, who)?;
        let is_own = who.uid == own || who.uid == 0;
        let mut said = self.about(who).filter_map(|rule| rule.groups.as_deref()).peekable();
        if is_own && said.peek().is_none() {
            return Ok(());
        }
        let covers = |joinable: &Joinable| match joinable {
            Joinable::Any => true,
            Joinable::One(one) => *one == group,
        };
        if said.flatten().any(covers) {
            return Ok(());
        }
        let lines = Lines(self.about(who).map(|rule| rule.line).collect());
        Err(ClientRefusal::Group { who, group, lines })
    }
}
