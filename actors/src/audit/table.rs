//! The audit as a table to read.

use std::fmt::{Display, Formatter, Result};

use super::{
    account::Account,
    reading::{Entry, NodeAudit},
    system::{At, Audit, Link, LinkState, Unexplained},
};

/// A heading, and the number below it.
type Column = (&'static str, fn(&Account) -> u64);

/// What the table has of each account.
const COLUMNS: [Column; 11] = [
    ("taken", |account| account.taken),
    ("delivered", |account| account.delivered),
    ("superseded", |account| account.superseded),
    ("rejected", |account| account.rejected),
    ("expired", |account| account.expired),
    ("failed", |account| account.failed),
    ("lost", |account| account.lost),
    ("unknown", |account| account.unknown),
    ("waiting", |account| account.waiting),
    ("unacked", |account| account.unacknowledged),
    ("refused", |account| account.refused),
];

impl Display for Audit {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        match self.missing() {
            0 => write!(f, "audit of {} nodes: every message is explained", self.nodes.len())?,
            missing => {
                write!(f, "audit of {} nodes: {missing} messages are NOT EXPLAINED", self.nodes.len())?
            }
        }
        for found in &self.unexplained {
            write!(f, "\n  {found}")?;
        }
        for silent in &self.silent {
            write!(f, "\n  {silent} did not answer")?;
        }
        for node in &self.nodes {
            write!(f, "\n\n{node}")?;
        }
        write!(f, "\n\n{:<44}", "all nodes")?;
        row(f, &self.total())?;
        if !self.links.is_empty() {
            write!(f, "\n\n{:<44}{:>11}{:>14}{:>13}", "links", "sent", "known there", "taken there")?;
            write!(f, "\n  (the audit's own question and answer may lie between the readings)")?;
        }
        self.links.iter().try_for_each(|link| write!(f, "\n{link}"))
    }
}

/// A heading, a line for each place, and what was refused.
impl Display for NodeAudit {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let heading = format!("{} {}", self.name.escape_debug(), self.node);
        write!(f, "{heading:<44}")?;
        COLUMNS.iter().try_for_each(|(name, _)| write!(f, "{name:>11}"))?;
        for Entry { place, account } in &self.entries {
            let place = format!("  {place}");
            write!(f, "\n{place:<44}")?;
            row(f, account)?;
        }
        for (cause, count) in &self.refused {
            write!(f, "\n  refused, {}: {count}", cause.escape_debug())?;
        }
        Ok(())
    }
}

fn row(f: &mut Formatter<'_>, account: &Account) -> Result {
    COLUMNS.iter().try_for_each(|(_, value)| match value(account) {
        0 => write!(f, "{:>11}", "."),
        count => write!(f, "{count:>11}"),
    })
}

impl Display for Link {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let class = self.class.map_or_else(String::new, |class| format!(", {class:?}"));
        let way = format!("  {} -> {}{class}", self.from, self.to);
        write!(f, "{way:<44}{:>11}{:>14}", self.sent, self.acknowledged)?;
        match (self.taken, self.state) {
            (Some(taken), _) => write!(f, "{taken:>13}"),
            (None, LinkState::BegunAnew) => write!(f, "   (the other end has begun anew)"),
            (None, LinkState::OneSession | LinkState::OneEndOnly) => write!(f, "{:>13}", "?"),
        }
    }
}

impl Display for Unexplained {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        match &self.at {
            At::Place { node, place } => write!(f, "node {node}, {place}")?,
            At::Link { from, to, class: Some(class) } => write!(f, "{from} -> {to}, {class:?}")?,
            At::Link { from, to, class: None } => write!(f, "{from} -> {to}")?,
        }
        let count = self.messages.unsigned_abs();
        if self.messages > 0 { write!(f, ": {count} missing") } else { write!(f, ": {count} too many") }
    }
}
