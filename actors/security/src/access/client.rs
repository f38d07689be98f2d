//! Rules for the names, addresses and groups that users of this host may use, besides the node's own user and root.

use std::{fmt, ops::RangeInclusive};

use sinew_runtime::{app::matches, tid::AppAddress};

use super::rule::List;

/// Maximum number of rules for users in one list.
pub(super) const CLIENTS_MAX: usize = 64;

/// Permissions of some processes of this host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ClientRule {
    /// Line in the file at which the rule begins, from 1.
    pub(super) line: usize,
    /// The user (`uid`) and the group (`gid`) of the processes. If both are set, both must match.
    pub(super) uid: Option<u32>,
    pub(super) gid: Option<u32>,
    /// Patterns of the allowed names. If empty, the processes may have no name.
    pub(super) names: Vec<String>,
    /// The allowed fixed addresses. If empty, only addresses chosen by the node are allowed.
    pub(super) addresses: Vec<RangeInclusive<u32>>,
    /// The groups that the processes may join. If `None`, the rule allows no group and does not restrict the robot's
    /// own processes.
    pub(super) groups: Option<Vec<Joinable>>,
}

/// A group that a rule allows to join. A request contains a number made from the group's name, so patterns cannot be
/// compared with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Joinable {
    Any,
    One(AppAddress),
}

/// A connecting process, as reported by the kernel (SO_PEERCRED).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Applicant {
    /// Effective user of the process.
    pub uid: u32,
    /// Effective group of the process. The kernel does not report supplementary groups.
    pub gid: u32,
}

impl fmt::Display for Applicant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "user {} of group {}", self.uid, self.gid)
    }
}

/// The reason why a registration is refused. The process or the list is at fault.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ClientAccessError {
    #[error(
        "user {0} may not use this node: it runs as user {1}, and no [[client]] in its access list is about user {0}; run the application as user {1}, or add one"
    )]
    NotAdmitted(u32, u32),
    #[error(
        "{applicant} may not be called '{name}': [[client]] at {lines} of the access list does not have that name; choose another one, or add it to `names`"
    )]
    Name { applicant: Applicant, name: String, lines: Lines },
    #[error(
        "{applicant} may not have the address {address}: [[client]] at {lines} of the access list does not have it; choose another one, or add it to `addresses`"
    )]
    Address { applicant: Applicant, address: AppAddress, lines: Lines },
    #[error(
        "{applicant} may not join the group {group}: [[client]] at {lines} of the access list does not have it; join another one, or add its name to `groups`"
    )]
    Group { applicant: Applicant, group: AppAddress, lines: Lines },
}

/// The lines of the rules that match an applicant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lines(Vec<usize>);

impl fmt::Display for Lines {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines: Vec<_> = self.0.iter().map(ToString::to_string).collect();
        write!(f, "line {}", lines.join(", "))
    }
}

impl ClientRule {
    fn is_about(&self, applicant: Applicant) -> bool {
        self.uid.is_none_or(|uid| uid == applicant.uid) && self.gid.is_none_or(|gid| gid == applicant.gid)
    }
}

impl List {
    fn about(&self, applicant: Applicant) -> impl Iterator<Item = &ClientRule> {
        self.clients.iter().filter(move |rule| rule.is_about(applicant))
    }

    /// Returns whether any `[[client]]` rule matches the applicant.
    pub fn is_about(&self, applicant: Applicant) -> bool {
        self.about(applicant).next().is_some()
    }

    /// Returns the lines of the rules that admit users other than `own` and root and name no groups, if there are any.
    pub(super) fn without_groups(&self, own: u32) -> Option<Lines> {
        let is_of_others = |rule: &&ClientRule| rule.uid.is_none_or(|uid| uid != own && uid != 0);
        let without = self.clients.iter().filter(is_of_others).filter(|rule| rule.groups.is_none());
        let lines: Vec<_> = without.map(|rule| rule.line).collect();
        (!lines.is_empty()).then_some(Lines(lines))
    }

    /// Authorizes a connection to a node that runs as the user `own`. It admits that user, root, and each applicant
    /// that a rule matches.
    ///
    /// # Errors
    /// Returns the reason for the refusal.
    pub fn admit(&self, own: u32, applicant: Applicant) -> Result<(), ClientAccessError> {
        let is_known = applicant.uid == own || applicant.uid == 0 || self.about(applicant).next().is_some();
        if is_known { Ok(()) } else { Err(ClientAccessError::NotAdmitted(applicant.uid, own)) }
    }

    /// Authorizes a registration with this name and this fixed address. The node's own user and root may use any,
    /// unless a rule matches them.
    ///
    /// # Errors
    /// Returns the reason for the refusal.
    pub fn may_register(
        &self,
        own: u32,
        applicant: Applicant,
        name: Option<&str>,
        address: Option<AppAddress>,
    ) -> Result<(), ClientAccessError> {
        self.admit(own, applicant)?;
        let mut rules = self.about(applicant).peekable();
        if rules.peek().is_none() {
            return Ok(());
        }
        let has_name = |rule: &ClientRule| {
            name.is_none_or(|name| rule.names.iter().any(|pattern| matches(pattern, name)))
        };
        let has_address = |rule: &ClientRule| {
            address.is_none_or(|app| rule.addresses.iter().any(|range| range.contains(&app.bits())))
        };
        let lines = || Lines(self.about(applicant).map(|rule| rule.line).collect());
        match (name, address) {
            (Some(name), _) if !self.about(applicant).any(has_name) => {
                Err(ClientAccessError::Name { applicant, name: name.to_owned(), lines: lines() })
            }
            // One rule must allow both. A name from one rule and an address from another are not combined.
            (_, Some(address)) if !self.about(applicant).any(|rule| has_name(rule) && has_address(rule)) => {
                Err(ClientAccessError::Address { applicant, address, lines: lines() })
            }
            (_, _) => Ok(()),
        }
    }

    /// Authorizes a membership of `group`. The node's own user and root may join any group, unless a rule that matches
    /// them lists groups. Another user needs a rule that lists the group.
    ///
    /// # Errors
    /// Returns the reason for the refusal.
    pub fn may_join(
        &self,
        own: u32,
        applicant: Applicant,
        group: AppAddress,
    ) -> Result<(), ClientAccessError> {
        self.admit(own, applicant)?;
        let is_own = applicant.uid == own || applicant.uid == 0;
        let mut listed = self.about(applicant).filter_map(|rule| rule.groups.as_deref()).peekable();
        if is_own && listed.peek().is_none() {
            return Ok(());
        }
        let covers = |joinable: &Joinable| match joinable {
            Joinable::Any => true,
            Joinable::One(one) => *one == group,
        };
        if listed.flatten().any(covers) {
            return Ok(());
        }
        let lines = Lines(self.about(applicant).map(|rule| rule.line).collect());
        Err(ClientAccessError::Group { applicant, group, lines })
    }
}
