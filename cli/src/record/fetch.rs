//! `sinew record fetch`: lists frozen spans, and writes a file for each node that has one.

mod convert;
mod dead;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{self, OpenOptions},
    io::Write,
    ops::RangeInclusive,
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    time::Duration,
};

use clap::Args;
use serde_json::json;
use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    inspect::{AskFrozen, FROZEN_BUSY, FrozenFacts, FrozenPart, FrozenReport, FrozenSpan},
};

use crate::{
    Report,
    system::{Answer, System, SystemError, in_words, present},
    table::{Table, clean, time},
};
use convert::{Converted, Source, convert, file_name};
use dead::DeadRing;

/// Maximum bytes of a frozen journal: the largest ring, and its table.
const RING_BYTES_MAX: u64 = (4 << 30) + (1 << 20);
/// Maximum bytes of the facts beside it.
const FACTS_BYTES_MAX: u64 = 4 << 20;

/// Maximum number of times that one ring is fetched.
const PULLS_MAX: usize = 3;

/// Time for which a node is asked again while it writes to the folder of its spans, and the pause before.
const BUSY_WITHIN: Duration = Duration::from_secs(5);
const BUSY_PAUSE: Duration = Duration::from_millis(20);

/// The arguments of `sinew record fetch`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// The ID of a span. Without it, and without --out: a list of all
    id: Option<String>,
    /// The folder for the files, by default the current one. Without an ID all spans are gathered
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace files of these names
    #[arg(long)]
    force: bool,
}

/// A frozen span of a node.
struct Frozen {
    node: NodeAddress,
    name: String,
    span: FrozenSpan,
}

/// All that was found.
#[derive(Default)]
struct Found {
    frozen: Vec<Frozen>,
    dead: Vec<DeadRing>,
    /// Nodes that have nothing to hand out, with the reason.
    refused: Vec<String>,
    /// Nodes that were there, and did not answer when their spans were fetched.
    silent: BTreeMap<NodeAddress, Silent>,
    /// Rings that are not gathered, with the remedy.
    skipped: BTreeSet<String>,
    /// Nodes that do not answer, and rings that cannot be read.
    faults: Vec<String>,
}

/// A node that does not answer any more.
struct Silent {
    name: String,
    /// The reason, of the first span.
    why: String,
    /// The IDs of the spans that it has not handed out.
    spans: Vec<String>,
}

/// Lists or gathers.
pub(super) fn show(system: &mut System, order: &Order) -> Result<Report, SystemError> {
    let mut found = find(system)?;
    if order.id.is_none() && order.out.is_none() {
        return Ok(listed(&found));
    }
    let ids: BTreeSet<String> = match &order.id {
        Some(id) => BTreeSet::from([id.clone()]),
        None => found.frozen.iter().map(|frozen| frozen.span.id.clone()).collect(),
    };
    let is_handed_out = found.frozen.iter().any(|frozen| ids.contains(&frozen.span.id));
    if !is_handed_out && !found.dead.iter().any(|ring| ids.contains(&ring.id)) {
        let id = order.id.as_deref().unwrap_or("at all");
        let why = format!("no node has a frozen span {id}; `sinew record fetch` lists them");
        return Err(SystemError::Unknown(clean(&why)));
    }
    let out = order.out.clone().unwrap_or_else(|| PathBuf::from("."));
    fs::create_dir_all(&out)
        .map_err(|why| SystemError::Bag(format!("the folder {} cannot be made: {why}", out.display())))?;
    let mut files = Vec::new();
    for id in ids {
        gather(system, &mut found, &id, (&out, order.force), &mut files);
    }
    found.report_silent();
    Ok(gathered(&found, &files))
}

impl Found {
    /// Adds one fault for each node that did not answer any more, with all spans that it has not handed out.
    fn report_silent(&mut self) {
        let line = |(node, Silent { name, why, spans }): (NodeAddress, Silent)| {
            format!(
                "{node} {name} has ended, or does not answer any more: {why}; not fetched: {}. Fetch again when it is \
                 there",
                spans.join(", ")
            )
        };
        self.faults.extend(std::mem::take(&mut self.silent).into_iter().map(line));
    }
}

/// Asks all nodes, and looks for rings of dead nodes on this host.
fn find(system: &mut System) -> Result<Found, SystemError> {
    let here = system.here()?;
    let mut found = Found::default();
    for answer in ask_spans(system, present(&here)) {
        let node = answer.node;
        match answer.result {
            Err(why) => found.faults.push(format!("{node} {}: {why}", answer.name)),
            Ok(FrozenReport { refused: Some(why), name, .. }) => {
                found.refused.push(format!("{node} {name}: {why}"));
            }
            Ok(report) => {
                if node == here.node {
                    let folders = [&report.folder, &report.frozen_folder].into_iter().flatten();
                    found.dead = dead::rings(folders.map(Path::new).collect(), &here.project);
                }
                let frozen = |span| Frozen { node, name: report.name.clone(), span };
                found.frozen.extend(report.spans.into_iter().map(frozen));
            }
        }
    }
    Ok(found)
}

/// Writes the files of one span.
fn gather(
    system: &mut System,
    found: &mut Found,
    id: &str,
    (out, is_forced): (&Path, bool),
    files: &mut Vec<Converted>,
) {
    let own = system.endpoint.tid().node;
    let first = files.len();
    let mut faults = Vec::new();
    let mut times = None;
    for Frozen { node, name, span } in found.frozen.iter().filter(|frozen| frozen.span.id == id) {
        if *node == own && !span.has_died {
            times = Some(span.begin_ns..=span.end_ns);
        }
        match fetch(system, *node, span, (out, is_forced), files) {
            Ok(file) => files.push(file),
            Err(SystemError::NoAnswer(_, why)) => {
                let silent = || Silent { name: name.clone(), why, spans: Vec::new() };
                found.silent.entry(*node).or_insert_with(silent).spans.push(id.to_owned());
            }
            Err(why) => faults.push(format!("{node} {name}: {why}")),
        }
    }
    let is_handed_out = found.frozen.iter().any(|frozen| frozen.span.id == id);
    for ring in &found.dead {
        if has_ring(&files[first..], ring) {
            continue;
        }
        let part = match part_of(id, &ring.id, is_handed_out) {
            Part::None => continue,
            Part::Whole => Some(0..=u64::MAX),
            Part::Span => times.clone().filter(|_| ring.is_of_this_boot),
        };
        let Some(times) = part else {
            found.skipped.insert(ring.remedy());
            continue;
        };
        match of_dead(ring, id, &times, (out, is_forced), files) {
            Ok(file) => files.extend(file),
            Err(why) => faults.push(format!("{}: {why}", ring.path.display())),
        }
    }
    found.faults.extend(faults);
}

/// Fetches the span of a node. It starts over if the node replaces the span meanwhile: a late trigger does.
fn fetch(
    system: &mut System,
    node: NodeAddress,
    span: &FrozenSpan,
    (out, is_forced): (&Path, bool),
    files: &[Converted],
) -> Result<Converted, SystemError> {
    let part = out.join(format!(".{}", file_name(&node.to_string(), &span.id, "part")));
    let converted = pull_unchanged(system, node, &span.id, &part).and_then(|facts| {
        // It may have other times than the list had.
        let span = facts.span.clone().unwrap_or_else(|| span.clone());
        let source = Source { ring: &part, facts, times: span.begin_ns..=span.end_ns, address: node };
        let times = (!span.has_died).then_some((span.at_ns, span.bound_ns));
        let (file, is_new) = path_of(files, out, (&source.facts.report.name, node), &span.id);
        convert(&source, times, file, is_forced && is_new)
    });
    // It is not needed any more.
    let _ = fs::remove_file(&part);
    let converted = converted?;
    // One that was replaced since then has to be fetched again.
    let after = pull_facts(system, node, &span.id);
    if after
        .is_ok_and(|facts| facts.span.is_some_and(|after| converted.times == (after.begin_ns..=after.end_ns)))
    {
        // Else its place is not given to another one.
        let done = AskFrozen { id: Some(span.id.clone()), is_fetched: true, ..AskFrozen::default() };
        let _ = ask(system, node, &done);
    }
    Ok(converted)
}

/// Fetches the ring and the facts of a span, until both are of one and the same span.
fn pull_unchanged(
    system: &mut System,
    node: NodeAddress,
    id: &str,
    part: &Path,
) -> Result<FrozenFacts, SystemError> {
    let mut before = pull_facts(system, node, id)?;
    for _ in 0..PULLS_MAX {
        let pulled = pull_ring(system, node, id, part);
        let after = pull_facts(system, node, id)?;
        match pulled {
            Ok(()) if is_same(&before, &after) => return Ok(after),
            // A ring that is replaced while it is read may have an end before the offset.
            Err(why) if is_same(&before, &after) => return Err(why),
            _ => before = after,
        }
    }
    Err(SystemError::Bag(format!(
        "the span {} has changed {PULLS_MAX} times while it was fetched; fetch it again when no trigger follows",
        clean(id)
    )))
}

/// Returns whether both are of the same frozen span.
fn is_same(before: &FrozenFacts, after: &FrozenFacts) -> bool {
    let mark = |facts: &FrozenFacts| {
        facts.span.as_ref().map(|span| (span.begin_ns, span.end_ns, span.at_ns, span.bound_ns))
    };
    mark(before) == mark(after) && before.report == after.report
}

fn pull_facts(system: &mut System, node: NodeAddress, id: &str) -> Result<FrozenFacts, SystemError> {
    let mut bytes = Vec::new();
    pull(system, node, (id, FrozenPart::Facts), FACTS_BYTES_MAX, &mut bytes)?;
    rmp_serde::from_slice(&bytes).map_err(|why| SystemError::Bag(format!("its names cannot be read: {why}")))
}

/// The part of a dead node's ring that is gathered.
#[derive(Debug, PartialEq, Eq)]
enum Part {
    None,
    /// The times of the span.
    Span,
    Whole,
}

/// Returns the part of a dead node's ring, with its own ID, that belongs to the span of this ID.
fn part_of(id: &str, ring: &str, is_handed_out: bool) -> Part {
    if !id.starts_with("died-") {
        return Part::Span;
    }
    // A node that has started again hands out the whole ring by such an ID.
    if id == ring && !is_handed_out { Part::Whole } else { Part::None }
}

/// Returns whether one of the files of a span has the records of this ring: its node has started again, and has handed
/// out its former spans.
fn has_ring(files: &[Converted], ring: &DeadRing) -> bool {
    files.iter().any(|file| file.origin == (ring.address, Some(ring.incarnation)))
}

/// Writes the part of a dead node's ring that is within the span. `None` if it has no record of it.
fn of_dead(
    ring: &DeadRing,
    id: &str,
    times: &RangeInclusive<u64>,
    (out, is_forced): (&Path, bool),
    files: &[Converted],
) -> Result<Option<Converted>, SystemError> {
    let span =
        sinew_recorder::Span::scan(&ring.path, times).map_err(|why| SystemError::Bag(why.to_string()))?;
    if span.records == 0 {
        return Ok(None);
    }
    let facts = ring.facts.clone();
    let source = Source { ring: &ring.path, facts, times: times.clone(), address: ring.address };
    // The node may have started again, and have the same span.
    let id = if id == ring.id { id.to_owned() } else { format!("{id}-{}", ring.id) };
    let (file, is_new) = path_of(files, out, (&ring.name, ring.address), &id);
    let written = convert(&source, None, file, is_forced && is_new)?;
    if !ring.is_there() {
        // Its records may be those of the next incarnation.
        let _ = fs::remove_file(&written.file);
        return Err(SystemError::Bag(
            "its node has started again meanwhile; fetch the span again".to_owned(),
        ));
    }
    Ok(Some(Converted { has_died: true, ..written }))
}

/// Returns the path of a file, and whether this run has not written it yet: then it may replace a former file. A second
/// node of one name has its address in the file's name.
fn path_of(
    files: &[Converted],
    out: &Path,
    (name, address): (&str, NodeAddress),
    id: &str,
) -> (PathBuf, bool) {
    let is_new = |path: &PathBuf| files.iter().all(|file| file.file != *path);
    let short = out.join(file_name(name, id, "mcap"));
    if is_new(&short) {
        return (short, true);
    }
    let long = out.join(file_name(&format!("{name}-{address}"), id, "mcap"));
    let is_new = is_new(&long);
    (long, is_new)
}

fn pull_ring(system: &mut System, node: NodeAddress, id: &str, to: &Path) -> Result<(), SystemError> {
    let failed = |why| SystemError::Bag(format!("the file {} cannot be written: {why}", to.display()));
    // One of a killed command may be there.
    let _ = fs::remove_file(to);
    let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(to);
    pull(system, node, (id, FrozenPart::Ring), RING_BYTES_MAX, &mut file.map_err(failed)?)
}

/// Fetches a file in parts.
fn pull(
    system: &mut System,
    node: NodeAddress,
    (id, part): (&str, FrozenPart),
    bytes_max: u64,
    into: &mut impl Write,
) -> Result<(), SystemError> {
    let mut offset = 0;
    let mut length = None;
    loop {
        let question = AskFrozen { id: Some(id.to_owned()), part, offset, is_fetched: false };
        let report = ask(system, node, &question)?;
        if report.length > bytes_max {
            return Err(SystemError::Bag(format!("it names a file of {} bytes", report.length)));
        }
        if *length.get_or_insert(report.length) != report.length {
            return Err(SystemError::Bag(
                "its file was replaced while it was read; fetch it again".to_owned(),
            ));
        }
        if report.bytes.is_empty() {
            return Ok(());
        }
        into.write_all(&report.bytes)
            .map_err(|why| SystemError::Bag(format!("the file cannot be written: {why}")))?;
        offset += report.bytes.len() as u64;
        if offset >= report.length {
            return Ok(());
        }
    }
}

fn ask(system: &mut System, node: NodeAddress, question: &AskFrozen) -> Result<FrozenReport, SystemError> {
    let (to, within) = (Tid::new(node, AppAddress::INSPECT), system.within);
    let until = Time::now() + BUSY_WITHIN;
    loop {
        let answer: Result<FrozenReport, _> = system.endpoint.message(to, question).ask(within);
        let report = answer.map_err(|error| SystemError::NoAnswer(node.to_string(), in_words(&error)))?;
        match report.refused {
            Some(why) if why == FROZEN_BUSY && Time::now() < until => std::thread::sleep(BUSY_PAUSE),
            Some(why) => return Err(SystemError::Bag(clean(&why))),
            None => return Ok(report),
        }
    }
}

/// Asks nodes for their spans. One that is busy is asked again.
pub(super) fn ask_spans(system: &mut System, nodes: Vec<(NodeAddress, String)>) -> Vec<Answer<FrozenReport>> {
    let mut answers = system.ask_these::<AskFrozen, FrozenReport>(nodes);
    for answer in &mut answers {
        if answer.result.as_ref().is_ok_and(|report| report.refused.as_deref() == Some(FROZEN_BUSY)) {
            answer.result = ask(system, answer.node, &AskFrozen::default()).map_err(|error| {
                // The line of a node begins with its address.
                if let SystemError::NoAnswer(_, why) = error { why } else { error.to_string() }
            });
        }
    }
    answers
}

fn listed(found: &Found) -> Report {
    let mut table = Table::new(["ID", "NODE", "NAME", "SPAN", "BYTES", "FETCHED", "CAUSE"]).whole(&["ID"]);
    let mut spans = Vec::new();
    for Frozen { node, name, span } in &found.frozen {
        let lasts = if span.has_died {
            "the whole ring".to_owned()
        } else {
            time(span.end_ns.saturating_sub(span.begin_ns) / 1_000)
        };
        let fetched = if span.is_fetched { "yes" } else { "no" };
        let cells = [
            span.id.clone(),
            node.to_string(),
            name.clone(),
            lasts,
            span.bytes.to_string(),
            fetched.to_owned(),
            span.cause.clone(),
        ];
        table.row(cells);
        spans.push(json!({
            "id": span.id, "node": node.to_string(), "name": name, "cause": span.cause, "at_ns": span.at_ns,
            "bound_ns": span.bound_ns, "begin_ns": span.begin_ns, "end_ns": span.end_ns, "bytes": span.bytes,
            "has_died": span.has_died, "is_fetched": span.is_fetched,
        }));
    }
    let mut text = if spans.is_empty() { "No node has a frozen span.\n".to_owned() } else { table.text() };
    for ring in &found.dead {
        text += &format!(
            "{} at {} has died: {}; it is gathered with the spans of its time, and as a whole by the ID {}.\n",
            clean(&ring.name),
            ring.address,
            ring.path.display(),
            ring.id
        );
    }
    text += &notes(found);
    let dead: Vec<_> =
        found.dead.iter().map(|ring| json!({ "name": ring.name, "path": ring.path })).collect();
    let json = json!({ "spans": spans, "dead": dead, "refused": found.refused, "faults": found.faults });
    Report { text, json, is_fine: found.faults.is_empty() }
}

fn gathered(found: &Found, files: &[Converted]) -> Report {
    let mut text = String::new();
    let mut json_files = Vec::new();
    for file in files {
        let died = if file.has_died { "; the node has died" } else { "" };
        let name = clean(&file.file.display().to_string());
        text += &format!(
            "{name}: {} messages, {} dropped; covers {} of {}; {}{died}\n",
            file.written,
            file.dropped,
            time(file.covered_ns() / 1_000),
            file.span_ns().map_or_else(|| "the whole ring".to_owned(), |span_ns| time(span_ns / 1_000)),
            clean(&file.node)
        );
        json_files.push(file.json());
    }
    text += &notes(found);
    let json = json!({
        "files": json_files, "refused": found.refused, "skipped": found.skipped, "faults": found.faults,
    });
    Report { text, json, is_fine: found.faults.is_empty() && !files.is_empty() }
}

/// Returns a line for each node that has given nothing, and for each ring that was skipped.
fn notes(found: &Found) -> String {
    found.refused.iter().chain(&found.skipped).chain(&found.faults).map(|line| clean(line) + "\n").collect()
}
