//! The tables of `sinew top`, from two snapshots of the system. Pure.

use std::collections::BTreeMap;

use serde_json::{Map, Value, json};
use sinew::{
    AppAddress, Class, NodeAddress,
    audit::{Account, NodeAudit, Place},
    inspect::{AppReport, GuardReport, LinkReport, LostReport, NodeReport, PeerReport},
    stop::StopState,
};
use sinew_view::{Answers, NodeAnswers, Snapshot};

use crate::{
    stop,
    table::{clean, time},
};

/// A column: its heading, and its key in JSON. The unit of a number is in the key.
type Column = (&'static str, &'static str);

const NODES: &[Column] = &[
    ("NODE", "name"),
    ("ADDRESS", "address"),
    ("STATE", "state"),
    ("STOP", "stop"),
    ("UP", "up_us"),
    ("PRIORITY", "priority"),
    ("LATE P99", "late_p99_us"),
    ("LATE MAX", "late_max_us"),
    ("STALLS", "stalls"),
    ("LONGEST", "stall_longest_us"),
    ("RETAINED", "retained_values"),
    ("NOT RETAINED", "retained_dropped"),
];
const APPS: &[Column] = &[
    ("APPLICATION", "name"),
    ("NODE", "node"),
    ("STATE", "state"),
    ("IN/S", "in_per_s"),
    ("DIRECT OUT/S", "direct_out_per_s"),
    ("WAITING", "waiting"),
    ("MOST", "waiting_most"),
    ("OLDEST", "oldest_us"),
    ("RESTARTS", "restarts"),
    ("GUARD", "guard"),
];
const LINKS: &[Column] = &[
    ("FROM", "from"),
    ("TO", "to"),
    ("CLASS", "class"),
    ("STATE", "state"),
    ("ROUND TRIP", "round_trip_us"),
    ("OUT/S", "out_per_s"),
    ("IN/S", "in_per_s"),
    ("WAITING", "waiting"),
    ("UNCONFIRMED", "unconfirmed"),
];
const LOSSES: &[Column] = &[
    ("CLASS", "class"),
    ("LOST/S", "lost_per_s"),
    ("LOST", "lost"),
    ("EXPIRED", "expired"),
    ("REJECTED", "rejected"),
    ("FAILED", "failed"),
    ("UNKNOWN", "unknown"),
    ("REFUSED", "refused"),
];
const LOST_NODES: &[Column] =
    &[("LOSS", "class"), ("NODE", "name"), ("ADDRESS", "address"), ("AGO", "lost_us"), ("REASON", "why")];

/// A cell of a table.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Cell {
    Text(String),
    Count(u64),
    /// In events a second.
    Rate(f64),
    /// In microseconds.
    Time(u64),
    Unknown,
}

impl Cell {
    fn text(&self) -> String {
        match self {
            Self::Text(text) => clean(text),
            Self::Count(count) => count.to_string(),
            Self::Rate(rate) if *rate >= 100.0 => format!("{rate:.0}"),
            Self::Rate(rate) => format!("{rate:.1}"),
            Self::Time(micros) => time(*micros),
            Self::Unknown => "-".to_owned(),
        }
    }

    fn json(&self) -> Value {
        match self {
            Self::Text(text) => json!(text),
            Self::Count(number) | Self::Time(number) => json!(number),
            Self::Rate(rate) => json!(rate),
            Self::Unknown => Value::Null,
        }
    }

    fn count(known: Option<u64>) -> Self {
        known.map_or(Self::Unknown, Self::Count)
    }

    fn time(known_us: Option<u64>) -> Self {
        known_us.map_or(Self::Unknown, Self::Time)
    }
}

/// A row of a table.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Row {
    pub(super) cells: Vec<Cell>,
    pub(super) is_fine: bool,
}

impl Row {
    /// Returns the cells as text.
    pub(super) fn texts(&self) -> Vec<String> {
        self.cells.iter().map(Cell::text).collect()
    }
}

/// A table with its title.
#[derive(Clone, Debug)]
pub(super) struct Section {
    pub(super) title: &'static str,
    key: &'static str,
    columns: &'static [Column],
    pub(super) rows: Vec<Row>,
}

impl Section {
    pub(super) fn heading(&self) -> Vec<&'static str> {
        self.columns.iter().map(|(heading, _)| *heading).collect()
    }

    #[cfg(test)]
    pub(super) const fn for_test(
        title: &'static str,
        columns: &'static [(&'static str, &'static str)],
        rows: Vec<Row>,
    ) -> Self {
        Self { title, key: "test", columns, rows }
    }

    fn json(&self) -> Value {
        let row = |row: &Row| {
            let cells = self.columns.iter().zip(&row.cells);
            Value::Object(cells.map(|((_, key), cell)| ((*key).to_owned(), cell.json())).collect())
        };
        self.rows.iter().map(row).collect()
    }
}

/// All tables.
#[derive(Clone, Debug)]
pub(super) struct Model {
    pub(super) sections: Vec<Section>,
    /// Why the entry node does not answer.
    pub(super) fault: Option<String>,
    /// Number of nodes that were not asked.
    pub(super) left_out: u64,
}

impl Model {
    /// Returns the tables of a snapshot, with the rates since the former one.
    pub(super) fn of(former: Option<&Snapshot>, now: &Snapshot) -> Self {
        let names = names(now);
        let pairs: Vec<_> = now.nodes.iter().filter_map(|node| Pair::of(former, node)).collect();
        let lost = now.entry.as_ref().map_or(&[][..], |entry| entry.lost.as_slice());
        let section =
            |(title, key): (&'static str, &'static str), columns, rows| Section { title, key, columns, rows };
        let sections = vec![
            section(("Nodes", "nodes"), NODES, now.nodes.iter().map(node_row).collect()),
            section(("Applications", "apps"), APPS, app_rows(&pairs, now)),
            section(("Links", "links"), LINKS, link_rows(&pairs, &names)),
            section(("Losses of messages", "losses"), LOSSES, loss_rows(&pairs)),
            section(("Lost nodes", "lost_nodes"), LOST_NODES, lost.iter().map(lost_row).collect()),
        ];
        Self { sections, fault: now.entry.as_ref().err().cloned(), left_out: now.left_out }
    }

    pub(super) fn json(&self) -> Value {
        let sections = self.sections.iter().map(|section| (section.key.to_owned(), section.json()));
        let mut all: Map<String, Value> = sections.collect();
        all.insert("left_out".to_owned(), json!(self.left_out));
        Value::Object(all)
    }

    /// Returns whether each node answers and is not stopped, and no link is down.
    pub(super) fn is_fine(&self) -> bool {
        let is_shown = |section: &&Section| ["nodes", "links"].contains(&section.key);
        let mut rows = self.sections.iter().filter(is_shown).flat_map(|section| &section.rows);
        rows.all(|row| row.is_fine) && self.fault.is_none() && self.left_out == 0
    }
}

/// The names of the nodes that answer.
fn names(snapshot: &Snapshot) -> BTreeMap<NodeAddress, String> {
    let named = snapshot.nodes.iter().filter(|node| !node.name.is_empty());
    named.map(|node| (node.node, node.name.clone())).collect()
}

/// The answers of a node, and those of the former snapshot with the seconds since then.
struct Pair<'s> {
    now: &'s Answers,
    former: Option<(&'s NodeAudit, f64)>,
}

impl<'s> Pair<'s> {
    fn of(former: Option<&'s Snapshot>, node: &'s NodeAnswers) -> Option<Self> {
        let now: &Answers = node.result.as_ref().ok()?;
        let of_node = |one: &&NodeAnswers| one.node == node.node;
        let former = former.and_then(|former| former.nodes.iter().find(of_node)?.result.as_ref().ok());
        // Counters of another incarnation began anew.
        let former = former.filter(|former| former.node.incarnation == now.node.incarnation);
        let former = former.map(|former| {
            let micros = now.node.up_us.saturating_sub(former.node.up_us);
            (&former.audit, micros as f64 / 1e6)
        });
        Some(Self { now, former: former.filter(|(_, seconds)| *seconds > 0.0) })
    }

    /// Returns how fast a count grows.
    fn rate(&self, count: impl Fn(&NodeAudit) -> u64) -> Cell {
        let Some((former, seconds)) = self.former else { return Cell::Unknown };
        // Places that have ended are not in the later report.
        Cell::Rate(count(&self.now.audit).saturating_sub(count(former)) as f64 / seconds)
    }
}

fn node_row(node: &NodeAnswers) -> Row {
    let (name, address) = (Cell::Text(node.name.clone()), Cell::Text(node.node.to_string()));
    let text = |text: &str| Cell::Text(text.to_owned());
    let report: &NodeReport = match &node.result {
        Ok(answers) => &answers.node,
        Err(_) => {
            let mut cells = vec![name, address, text("no answer")];
            cells.resize(NODES.len(), Cell::Unknown);
            return Row { cells, is_fine: false };
        }
    };
    let (state, is_fine) = if report.stopping {
        ("stops", false)
    } else if report.troubled > 0 {
        ("troubled", false)
    } else {
        ("up", true)
    };
    let (measured, retained) = (report.real_time.as_ref(), report.retained);
    let cells = vec![
        name,
        address,
        text(state),
        report.stop.map_or(Cell::Unknown, |state| text(stop::state(Some(state)))),
        Cell::Time(report.up_us),
        Cell::count(measured.map(|found| found.granted.into())),
        Cell::time(measured.map(|found| found.p99_ns / 1_000)),
        Cell::time(measured.map(|found| found.max_ns / 1_000)),
        Cell::count(report.own_stalls.map(|stalls| stalls.count)),
        Cell::time(report.own_stalls.filter(|stalls| stalls.count > 0).map(|stalls| stalls.longest_us)),
        Cell::count(retained.map(|of| of.values)),
        Cell::count(retained.map(|of| of.not_kept.saturating_add(of.not_handed_over))),
    ];
    // A node of an older version does not know the stop.
    let is_released = report.stop.is_none_or(|state| state == StopState::Released);
    Row { cells, is_fine: is_fine && is_released }
}

fn app_rows(pairs: &[Pair<'_>], snapshot: &Snapshot) -> Vec<Row> {
    let mut rows = Vec::new();
    for pair in pairs {
        let others = pair.now.apps.apps.iter().filter(|app| !snapshot.own.contains(&app.tid));
        rows.extend(others.map(|app| app_row(pair, app)));
    }
    rows
}

fn app_row(pair: &Pair<'_>, app: &AppReport) -> Row {
    let address = app.tid.app;
    let line = pair.now.tree.lines.iter().find(|line| line.tid == Some(app.tid));
    let has_direct = pair.now.audit.entries.iter().any(|entry| is_direct_from(&entry.place, address));
    let direct_out = |audit: &NodeAudit| sum(audit, |place| is_direct_from(place, address)).taken;
    // An application in a process of its own has its queue at the node.
    let waiting = line.and_then(|line| line.waiting).unwrap_or_else(|| {
        sum(&pair.now.audit, |place| matches!(place, Place::Client { app, .. } if *app == address)).waiting
    });
    let (guard, is_guarded_live) = guard(&pair.now.node.guards, app);
    let state = if app.ready { "ready" } else { "not ready" };
    let cells = vec![
        Cell::Text(app.name.clone().unwrap_or_else(|| app.tid.to_string())),
        Cell::Text(pair.now.node.name.clone()),
        Cell::Text(state.to_owned()),
        pair.rate(|audit| received(audit, address)),
        if has_direct { pair.rate(direct_out) } else { Cell::Unknown },
        Cell::Count(waiting),
        Cell::count(line.and_then(|line| line.waiting_most)),
        Cell::time(line.and_then(|line| line.oldest_us)),
        Cell::count(line.map(|line| line.restarts)),
        guard,
    ];
    Row { cells, is_fine: app.ready && is_guarded_live }
}

/// Returns the number of messages that an application got so far, on all ways.
fn received(audit: &NodeAudit, address: AppAddress) -> u64 {
    let account = sum(audit, |place| match place {
        Place::Mailbox { app, .. } | Place::Client { app, .. } => *app == address,
        Place::DirectLink { to, .. } => *to == address,
        Place::ToNode { .. }
        | Place::FromNode { .. }
        | Place::OtherMailboxes
        | Place::OtherClients
        | Place::OtherDirectLinks
        | Place::ToFormerNodes
        | Place::FromFormerNodes => false,
    });
    account.taken.saturating_sub(account.own)
}

fn is_direct_from(place: &Place, address: AppAddress) -> bool {
    matches!(place, Place::DirectLink { from, .. } if *from == address)
}

fn sum(audit: &NodeAudit, is_wanted: impl Fn(&Place) -> bool) -> Account {
    audit.entries.iter().filter(|entry| is_wanted(&entry.place)).map(|entry| entry.account).sum()
}

/// Returns the state of the outputs of an application, the worst first, and whether all are live.
fn guard(guards: &[GuardReport], app: &AppReport) -> (Cell, bool) {
    let own = || guards.iter().filter(|guard| guard.receiver == app.tid);
    if own().any(|guard| guard.is_safe_failed) {
        return (Cell::Text("FAILED".to_owned()), false);
    }
    match own().find_map(|guard| guard.safe.as_ref()) {
        Some(cause) => (Cell::Text(format!("safe: {cause}")), false),
        None if own().next().is_some() => (Cell::Text("live".to_owned()), true),
        None => (Cell::Unknown, true),
    }
}

fn link_rows(pairs: &[Pair<'_>], names: &BTreeMap<NodeAddress, String>) -> Vec<Row> {
    let mut rows = Vec::new();
    for pair in pairs {
        for peer in &pair.now.node.peers {
            rows.extend(peer.links.iter().map(|link| link_row(pair, peer, link, names)));
        }
    }
    rows
}

fn link_row(
    pair: &Pair<'_>,
    peer: &PeerReport,
    link: &LinkReport,
    names: &BTreeMap<NodeAddress, String>,
) -> Row {
    let (node, class) = (peer.node, class(&link.class));
    let sent = |audit: &NodeAudit| {
        let account = audit.account(&Place::ToNode { node, class });
        account.taken.saturating_sub(account.own)
    };
    let taken = |audit: &NodeAudit| audit.account(&Place::FromNode { node, class }).taken;
    let name = peer.name.as_ref().or_else(|| names.get(&node)).filter(|name| !name.is_empty());
    let cells = vec![
        Cell::Text(pair.now.node.name.clone()),
        Cell::Text(name.cloned().unwrap_or_else(|| node.to_string())),
        Cell::Text(link.class.to_lowercase()),
        Cell::Text(if link.is_up { "up" } else { "DOWN" }.to_owned()),
        Cell::time(peer.round_trip_ns.map(|nanos| nanos / 1_000)),
        pair.rate(sent),
        pair.rate(taken),
        Cell::Count(link.waiting),
        Cell::Count(link.unconfirmed),
    ];
    Row { cells, is_fine: link.is_up }
}

/// Returns the class of a link; `None` for one that carries all classes.
fn class(word: &str) -> Option<Class> {
    [Class::Control, Class::Stream, Class::Bulk]
        .into_iter()
        .find(|class| word.eq_ignore_ascii_case(class_word(*class)))
}

const fn class_word(class: Class) -> &'static str {
    match class {
        Class::Control => "control",
        Class::Stream => "stream",
        Class::Bulk => "bulk",
    }
}

/// Returns the messages that did not arrive, by class. Places without a class are one more row.
fn loss_rows(pairs: &[Pair<'_>]) -> Vec<Row> {
    let classes = [Some(Class::Control), Some(Class::Stream), Some(Class::Bulk), None];
    classes.map(|class| loss_row(pairs, class)).to_vec()
}

fn loss_row(pairs: &[Pair<'_>], wanted: Option<Class>) -> Row {
    let of = |audit: &NodeAudit| sum(audit, |place| class_of(place) == wanted);
    let account: Account = pairs.iter().map(|pair| of(&pair.now.audit)).sum();
    let rates = pairs.iter().filter_map(|pair| match pair.rate(|audit| lost(&of(audit))) {
        Cell::Rate(rate) => Some(rate),
        Cell::Text(_) | Cell::Count(_) | Cell::Time(_) | Cell::Unknown => None,
    });
    let rates: Vec<_> = rates.collect();
    let rate: f64 = rates.iter().sum();
    let Account { lost: gone, expired, rejected, failed, unknown, refused, .. } = account;
    let mut cells = vec![
        Cell::Text(wanted.map_or("other", class_word).to_owned()),
        if rates.is_empty() { Cell::Unknown } else { Cell::Rate(rate) },
    ];
    cells.extend([gone, expired, rejected, failed, unknown, refused].map(Cell::Count));
    Row { cells, is_fine: rate == 0.0 }
}

const fn class_of(place: &Place) -> Option<Class> {
    match place {
        Place::Mailbox { class, .. } => Some(*class),
        Place::ToNode { class, .. } | Place::FromNode { class, .. } => *class,
        Place::Client { .. }
        | Place::DirectLink { .. }
        | Place::OtherMailboxes
        | Place::OtherClients
        | Place::OtherDirectLinks
        | Place::ToFormerNodes
        | Place::FromFormerNodes => None,
    }
}

/// Returns the number of messages that ended without being delivered. A superseded value is no loss.
fn lost(account: &Account) -> u64 {
    let Account { lost, expired, rejected, failed, unknown, refused, .. } = *account;
    [lost, expired, rejected, failed, unknown, refused].into_iter().fold(0, u64::saturating_add)
}

fn lost_row(lost: &LostReport) -> Row {
    let class = lost.why.split(':').next().unwrap_or_default();
    let cells = vec![
        Cell::Text(class.to_owned()),
        Cell::Text(lost.name.clone()),
        Cell::Text(lost.node.to_string()),
        Cell::Time(lost.lost_us),
        Cell::Text(lost.why.clone()),
    ];
    Row { cells, is_fine: lost.why == "left" }
}

#[cfg(test)]
mod tests;
