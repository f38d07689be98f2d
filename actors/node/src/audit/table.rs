//! Displays the audit as a table: within 120 columns with `{}`, with a column for each counter with `{:#}`.

use std::fmt::{Display, Formatter, Result};

use sinew_session::{counts::Account, place::cut};

use super::{
    reading::{Entry, NodeAudit},
    system::{At, Audit, Link, LinkState, Unexplained},
};

/// A heading, and the function that returns the number below it.
type Column = (&'static str, fn(&Account) -> u64);

/// The two columns that every table has.
const MAIN: [Column; 2] = [("taken", |account| account.taken), ("delivered", |account| account.delivered)];
/// The other counters. The short table lists those that are not 0 in one column; the wide one has a column for each.
const OTHERS: [Column; 9] = [
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
/// Columns of a terminal for the name of a place.
const PLACE: usize = 44;
/// Columns for each number of the short table.
const NUMBER: usize = 13;
/// Columns for the other counters of the short table: 120 in all.
const OTHERS_WIDTH: usize = 120 - PLACE - 2 * NUMBER - GAP;
/// Columns between the numbers and the other counters.
const GAP: usize = 2;

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
            f.write_str("\n\n")?;
            Display::fmt(node, f)?;
        }
        f.write_str("\n\n")?;
        row(f, "all nodes", &self.total())?;
        if !self.links.is_empty() {
            write!(f, "\n\n{:<PLACE$}{:>11}{:>14}{:>13}", "links", "sent", "known there", "taken there")?;
            write!(f, "\n  (the audit's own question and answer may lie between the readings)")?;
        }
        self.links.iter().try_for_each(|link| write!(f, "\n{link}"))
    }
}

/// Displays a heading, a line for each place, and the refusals.
impl Display for NodeAudit {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        place(f, &format!("{} {}", cut(&self.name), self.node))?;
        if f.alternate() {
            MAIN.iter().chain(&OTHERS).try_for_each(|(name, _)| write!(f, "{name:>11}"))?;
        } else {
            MAIN.iter().try_for_each(|(name, _)| write!(f, "{name:>NUMBER$}"))?;
            write!(f, "{:GAP$}others", "")?;
        }
        for Entry { place, account } in &self.entries {
            f.write_str("\n")?;
            row(f, &format!("  {place}"), account)?;
        }
        for (cause, count) in &self.refused {
            write!(f, "\n  refused, {}: {count}", cut(cause))?;
        }
        Ok(())
    }
}

/// Displays a place, padded to its column. A place that is too long gets a line of its own.
fn place(f: &mut Formatter<'_>, place: &str) -> Result {
    if place.chars().count() < PLACE {
        write!(f, "{place:<PLACE$}")
    } else {
        write!(f, "{place}\n{:PLACE$}", "")
    }
}

fn row(f: &mut Formatter<'_>, name: &str, account: &Account) -> Result {
    place(f, name)?;
    if f.alternate() {
        return MAIN.iter().chain(&OTHERS).try_for_each(|(_, value)| number(f, value(account), 11));
    }
    MAIN.iter().try_for_each(|(_, value)| number(f, value(account), NUMBER))?;
    let others = OTHERS.iter().map(|(name, value)| (value(account), name)).filter(|(count, _)| *count > 0);
    let mut free = OTHERS_WIDTH;
    for (at, (count, name)) in others.enumerate() {
        let text = format!("{count} {name}");
        let separator = match at {
            0 => format!("{:GAP$}", ""),
            // The comma of the line before takes a column, too.
            _ if text.len() + ", ".len() < free => ", ".to_owned(),
            _ => {
                free = OTHERS_WIDTH;
                format!(",\n{:1$}", "", PLACE + 2 * NUMBER + GAP)
            }
        };
        free = free.saturating_sub(text.len() + ", ".len());
        write!(f, "{separator}{text}")?;
    }
    Ok(())
}

fn number(f: &mut Formatter<'_>, count: u64, width: usize) -> Result {
    match count {
        0 => write!(f, "{:>width$}", "."),
        count => write!(f, "{count:>width$}"),
    }
}

impl Display for Link {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let class = self.class.map_or_else(String::new, |class| format!(", {class:?}"));
        let way = format!("  {} -> {}{class}", self.from, self.to);
        write!(f, "{way:<PLACE$}{:>11}{:>14}", self.sent, self.acknowledged)?;
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

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use sinew_runtime::{
        tid::{AppAddress, Incarnation, NodeAddress},
        wire::Class,
    };

    use super::*;
    use sinew_session::place::Place;

    /// Every counter of a robot that has sent 1,000 messages a second for 30 years.
    fn account() -> Account {
        let count = 1_000_000_000_000;
        Account {
            taken: count,
            own: count,
            delivered: count,
            handed_on: count,
            superseded: count,
            rejected: count,
            expired: count,
            failed: count,
            lost: count,
            unknown: count,
            waiting: count,
            unacknowledged: count,
            refused: count,
        }
    }

    fn audit(name: &str, account: Account) -> Audit {
        let node = NodeAddress::from([192, 168, 100, 200]);
        let (app, name) = (AppAddress::new(0x8000_0001), name.to_owned());
        let places = [
            Place::Mailbox { app, name: name.clone(), class: Class::Control },
            Place::Client { app, name: name.clone() },
            Place::FromNode { node, class: Some(Class::Control) },
            Place::FromFormerNodes,
        ];
        let entries = places.map(|place| Entry { place, account }).to_vec();
        let refused = BTreeMap::from([("not taken: NoSuchApplication".to_owned(), account.taken)]);
        let incarnation = Incarnation(1);
        let node_audit = NodeAudit { node, name, incarnation, entries, sessions: Vec::new(), refused };
        let link = |state| Link {
            from: node,
            to: node,
            class: Some(Class::Control),
            state,
            sent: account.taken,
            acknowledged: account.taken,
            taken: None,
        };
        let links = vec![link(LinkState::BegunAnew), link(LinkState::OneEndOnly)];
        let at = At::Place { node, place: Place::OtherMailboxes };
        let unexplained = vec![Unexplained { at, messages: 7 }];
        Audit { asked_by: node, nodes: vec![node_audit], silent: vec![node], links, unexplained }
    }

    #[test]
    fn table_is_at_most_120_columns_wide() {
        for name in ["knee", &"k".repeat(63), &"k".repeat(4_096), &"\u{202e}".repeat(60)] {
            let text = audit(name, account()).to_string();
            let widest = text.lines().map(|line| line.chars().count()).max();
            assert!(widest <= Some(120), "{widest:?}\n{text}");
        }
    }

    #[test]
    fn nonzero_counters_appear_in_last_or_own_columns() {
        let short = Account { taken: 120, delivered: 117, rejected: 2, waiting: 1, ..Account::default() };
        let audit = audit("knee", short);
        let has = |text: &str, words: &[&str]| {
            let in_one_space = |line: &str| line.split_whitespace().collect::<Vec<_>>().join(" ");
            text.lines().any(|line| in_one_space(line) == words.join(" "))
        };
        let text = audit.to_string();
        let place = "mailbox knee (80000001), Control";
        assert!(has(&text, &[place, "120 117", "2 rejected, 1 waiting"]), "{text}");
        let text = format!("{audit:#}");
        assert!(has(&text, &[place, "120 117 . 2 . . . . 1 . ."]), "{text}");
        assert!(text.contains("superseded") && text.contains("unacked"), "{text}");
    }
}
