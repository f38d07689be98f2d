//! `sinew record`: writes the messages of the node into a file.

mod fetch;
mod freeze;
mod sizes;
mod stop;

use std::{
    io::{self, IsTerminal as _},
    path::{Path, PathBuf},
    time::{Duration, UNIX_EPOCH},
};

use clap::{Args, Subcommand, ValueEnum};
use serde_json::json;
use sinew::{
    AppAddress, Tid, Time,
    inspect::{AskRecord, RecordReport, Selection},
};
use sinew_bag::{BagWriter, Options, Origin, Totals};
use sinew_recorder::{JournalReader, Names, ReadJournalError, Recorder, Setup, Start};

use crate::{
    Report, output,
    system::{System, SystemError, in_words},
    table::clean,
};
use sizes::Split;
use stop::StopRequest;

/// Pause after the journal was read to its end. Its 64 MiB, unless configured otherwise, last for far longer.
const PAUSE: Duration = Duration::from_millis(5);
/// Interval at which the recording is renewed at the node: its lease is 5 s.
const RENEWAL: Duration = Duration::from_secs(1);
/// Time limit of a renewal: meanwhile the journal is not read.
const RENEWED_WITHIN: Duration = Duration::from_millis(300);
/// Time at the end for messages that are on their way into the journal.
const ARRIVAL: Duration = Duration::from_millis(200);
/// Time limit for the rest of the journal at the end.
const DRAINED_WITHIN: Duration = Duration::from_secs(10);
/// Maximum number of faults that are reported.
const FAULTS_MAX: usize = 16;

/// The arguments of `sinew record`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct Order {
    #[command(subcommand)]
    spans: Option<Spans>,
    /// The file. Without it: NODE-DATE-TIME.mcap in the current folder, in UTC
    file: Option<PathBuf>,
    /// Only messages of this application of the node, by its name; `*` matches any text. May be given several times
    #[arg(long = "app", value_name = "NAME")]
    apps: Vec<String>,
    /// Only this type of payload, by its name; `*` matches any text. May be given several times
    #[arg(long = "type", value_name = "NAME")]
    types: Vec<String>,
    /// Messages to this group, too, by its name. May be given several times
    #[arg(long = "group", value_name = "NAME")]
    groups: Vec<String>,
    /// End after so long, as in 30s or 5m
    #[arg(long = "for", value_name = "TIME", value_parser = sizes::time)]
    lasts: Option<Duration>,
    /// End at this size of all files, as in 500M or 2G
    #[arg(long, value_name = "BYTES", value_parser = sizes::bytes)]
    max_size: Option<u64>,
    /// Begin a new file after so many bytes or so long, as in 500M or 5m: walk.mcap, walk.1.mcap
    #[arg(long, value_name = "BYTES|TIME", value_parser = sizes::split)]
    split: Option<Split>,
    /// The compression
    #[arg(long, value_enum, default_value_t = Compression::Zstd)]
    compression: Compression,
    /// Leave out the views for plots: payloads and headers alone
    #[arg(long)]
    raw_only: bool,
    /// Replace a file of this name
    #[arg(long)]
    force: bool,
}

/// The spans that nodes keep around faults.
#[derive(Debug, Subcommand)]
pub(crate) enum Spans {
    /// Has all nodes freeze the messages around this moment: those that record from their start
    ///
    /// They freeze the same span, some seconds before and after (`record.keep_ms`, `record.after_ms`). The command
    /// prints the ID of the span, and waits until the nodes have it.
    #[command(after_help = r#"Examples:
  sinew record freeze --reason 'the knee jerked'"#)]
    Freeze(freeze::Order),
    /// Lists the frozen spans of all nodes, or writes those of one ID: a file for each node
    ///
    /// The ring of a node that has died is written, too, if it lies on this host. A span that was fetched may be
    /// replaced by a later one.
    #[command(after_help = r#"Examples:
  sinew record fetch                          a list
  sinew record fetch 10.0.0.2-6431f2a9c0b1d-1 --out fault
  sinew record fetch --out faults             all of them"#)]
    Fetch(fetch::Order),
}

/// The compression of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Compression {
    /// The smallest files
    Zstd,
    /// Less work
    Lz4,
    /// The least work, the largest files
    None,
}

/// Why a recording has ended.
#[derive(Debug, PartialEq, Eq)]
enum End {
    /// The user has asked for it.
    Asked,
    /// The requested time is over.
    Time,
    /// The file has its maximum size.
    Full,
    /// The node has stopped, or has ended the recording.
    Closed,
    /// The node was killed.
    NodeDied,
    /// The journal cannot be read any more.
    Unreadable(String),
}

/// Records until the requested end, or until the user or the node ends it.
pub(crate) fn show(system: &mut System, order: &Order) -> Result<Report, SystemError> {
    match &order.spans {
        Some(Spans::Freeze(order)) => return freeze::show(system, order),
        Some(Spans::Fetch(order)) => return fetch::show(system, order),
        None => {}
    }
    let question = order.question()?;
    let stop = StopRequest::listen()
        .map_err(|why| SystemError::Bag(format!("Ctrl-C cannot be handled: {why}; free descriptors")))?;
    let within = system.within;
    let first = ask(system, &question, within)?;
    let begun = begin(system, order, &question, &first);
    let recorded = begun.map(|(mut recorder, file)| {
        let mut session = Session { question: &question, order, stop: &stop, faults: Vec::new() };
        let end = session.run(system, &mut recorder);
        let totals = session.finish(recorder);
        session.report(&file, &first, &end, &totals)
    });
    // Without it the recording would end 5 s later. A node that has died does not answer.
    let _ = ask(system, &AskRecord { ends: true, ..AskRecord::default() }, RENEWED_WITHIN.min(within));
    recorded
}

impl Order {
    fn question(&self) -> Result<AskRecord, SystemError> {
        let Self { apps, types, groups, .. } = self;
        let selection = Selection { apps: apps.clone(), types: types.clone(), groups: groups.clone() };
        selection.check().map_err(|why| SystemError::Usage(clean(&why.to_string())))?;
        Ok(AskRecord { selection, ends: false })
    }

    fn options(&self) -> Options {
        let (split_bytes, split_time) = match self.split {
            Some(Split::Bytes(bytes)) => (Some(bytes), None),
            Some(Split::Time(time)) => (None, Some(time)),
            None => (None, None),
        };
        let compression = match self.compression {
            Compression::Zstd => sinew_bag::Compression::Zstd,
            Compression::Lz4 => sinew_bag::Compression::Lz4,
            Compression::None => sinew_bag::Compression::None,
        };
        Options {
            compression,
            size_max: self.max_size,
            split_bytes,
            split_time,
            raw_only: self.raw_only,
            replace: self.force,
            ..Options::default()
        }
    }
}

/// Starts or renews the recording at the node, or ends it.
fn ask(system: &mut System, question: &AskRecord, within: Duration) -> Result<RecordReport, SystemError> {
    let to = Tid::new(system.endpoint.tid().node, AppAddress::INSPECT);
    let answer: Result<RecordReport, _> = system.endpoint.message(to, question).ask(within);
    let report = answer.map_err(|error| SystemError::NoAnswer(system.path.clone(), in_words(&error)))?;
    match &report.refused {
        Some(why) => Err(SystemError::Bag(format!("the node at {}: {}", system.path, clean(why)))),
        None => Ok(report),
    }
}

/// Opens the journal, and creates the file.
fn begin(
    system: &System,
    order: &Order,
    question: &AskRecord,
    first: &RecordReport,
) -> Result<(Recorder, PathBuf), SystemError> {
    let fault = |why: ReadJournalError| SystemError::Bag(why.to_string());
    let Some(path) = &first.path else {
        let why = "it names no journal; update it".to_owned();
        return Err(SystemError::NoAnswer(system.path.clone(), why));
    };
    let reader = JournalReader::open(Path::new(path), Start::Newest).map_err(fault)?;
    let own = system.endpoint.tid().node;
    let node = first.node.unwrap_or(own);
    let now = Time::now().as_nanos();
    let origin = Origin {
        node: first.name.clone(),
        address: node.to_string(),
        incarnation: first.incarnation.map_or(0, |incarnation| incarnation.0),
        version: concat!("sinew record ", env!("CARGO_PKG_VERSION")).to_owned(),
        wall_offset_ns: first.wall_offset_ns,
        began_ns: now,
    };
    let file = order.file.clone();
    let file = file.unwrap_or_else(|| PathBuf::from(file_name(&first.name, origin.wall_ns(now))));
    let bag = BagWriter::create(file.clone(), order.options(), origin)?;
    let selection = question.selection.clone();
    let mut names = Names::default();
    for group in &selection.groups {
        names.add_app(Tid::group(group), group);
    }
    learn(&mut names, first);
    let setup = Setup { node, selection, names, left_out: system.own.iter().copied().collect() };
    let mut recorder = Recorder::begin(reader, bag, setup).map_err(fault)?;
    recorder.clocks(now, &first.clocks);
    Ok((recorder, file))
}

/// Adds the names that the node has reported.
fn learn(names: &mut Names, report: &RecordReport) {
    report.apps.iter().for_each(|app| names.add_app(app.tid, &app.name));
    report.types.iter().for_each(|one| names.add_type(one.kind, &one.name));
    if let Some(node) = report.node {
        names.add_node(node, &report.name);
    }
}

/// Returns the name of a file without a chosen one: `knee-2026-01-31-093000.mcap`.
fn file_name(node: &str, wall_ns: u64) -> String {
    let letter = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let node: String = node.trim_start_matches('.').chars().map(letter).collect();
    let at = UNIX_EPOCH.checked_add(Duration::from_nanos(wall_ns)).unwrap_or(UNIX_EPOCH);
    let time = humantime::format_rfc3339_seconds(at).to_string().replace(':', "").replace('T', "-");
    format!("{node}-{}.mcap", time.trim_end_matches('Z'))
}

/// A running recording.
struct Session<'s> {
    question: &'s AskRecord,
    order: &'s Order,
    stop: &'s StopRequest,
    faults: Vec<String>,
}

impl Session<'_> {
    /// Moves records from the journal to the file until the end.
    fn run(&mut self, system: &mut System, recorder: &mut Recorder) -> End {
        let began = Time::now();
        let mut renewal = began + RENEWAL;
        loop {
            let now = Time::now();
            let is_empty = match self.pump(recorder, now) {
                Ok(is_empty) => is_empty,
                Err(why) => return End::Unreadable(why),
            };
            if let Some(end) = self.end(recorder, began, now) {
                return end;
            }
            if now >= renewal {
                renewal = now + RENEWAL;
                self.renew(system, recorder);
                show_progress(&recorder.totals(), now.since(began));
            }
            if is_empty {
                std::thread::sleep(PAUSE);
            }
        }
    }

    /// Returns whether the journal was read to its end, or why it cannot be read any more.
    fn pump(&mut self, recorder: &mut Recorder, now: Time) -> Result<bool, String> {
        let pumped = recorder.pump(now.as_nanos());
        if let Some(fault) = recorder.take_fault() {
            self.note(fault.to_string());
        }
        match pumped {
            Ok(is_empty) => Ok(is_empty),
            Err(fault @ ReadJournalError::Damaged { .. }) => {
                self.note(fault.to_string());
                Ok(true)
            }
            Err(fault) => Err(fault.to_string()),
        }
    }

    fn end(&self, recorder: &Recorder, began: Time, now: Time) -> Option<End> {
        if self.stop.is_there() {
            return Some(End::Asked);
        }
        if self.order.lasts.is_some_and(|lasts| now.since(began) >= lasts) {
            return Some(End::Time);
        }
        if recorder.is_full() {
            return Some(End::Full);
        }
        if recorder.is_writer_alive() {
            return None;
        }
        Some(if recorder.is_closed().unwrap_or(false) { End::Closed } else { End::NodeDied })
    }

    /// Renews the recording at the node. If the node does not answer for 5 s it ends the recording, which the journal
    /// shows.
    fn renew(&self, system: &mut System, recorder: &mut Recorder) {
        let within = RENEWED_WITHIN.min(system.within);
        if let Ok(report) = ask(system, self.question, within) {
            learn(recorder.names_mut(), &report);
        }
    }

    fn note(&mut self, fault: String) {
        if self.faults.len() < FAULTS_MAX {
            output::note(format_args!("sinew: {}", clean(&fault)));
            self.faults.push(fault);
        }
    }

    /// Reads the rest of the journal, and finishes the file.
    fn finish(&mut self, mut recorder: Recorder) -> Totals {
        let began = Time::now();
        let mut is_over = recorder.stop().is_err();
        while !is_over {
            let now = Time::now();
            let pumped = self.pump(&mut recorder, now);
            let has_waited = now.since(began) >= ARRIVAL && pumped == Ok(true);
            is_over =
                pumped.is_err() || recorder.is_drained() || has_waited || now.since(began) >= DRAINED_WITHIN;
            if !is_over && pumped == Ok(true) {
                std::thread::sleep(PAUSE);
            }
        }
        let totals = recorder.totals();
        recorder.finish(Time::now().as_nanos()).unwrap_or_else(|fault| {
            self.note(fault.to_string());
            totals
        })
    }

    fn report(&self, file: &Path, first: &RecordReport, end: &End, totals: &Totals) -> Report {
        let Totals { seen, written, dropped, misfits, events_lost, bytes, parts } = *totals;
        let name = clean(&file.display().to_string());
        let files = if parts > 1 { format!("{parts} files") } else { "1 file".to_owned() };
        let mut text = format!("{name}: {written} messages, {dropped} dropped; {bytes} bytes in {files}\n");
        if let Some(line) = end.line() {
            text += &format!("{}\n", clean(&line));
        }
        let json = json!({
            "file": file, "node": first.name, "end": end.word(), "seen": seen, "written": written,
            "dropped": dropped, "misfits": misfits, "events_lost": events_lost, "bytes": bytes,
            "parts": parts, "faults": self.faults,
        });
        Report { text, json, is_fine: self.faults.is_empty() && !matches!(end, End::Unreadable(_)) }
    }
}

impl End {
    /// Returns the word for programs.
    const fn word(&self) -> &'static str {
        match self {
            Self::Asked => "asked",
            Self::Time => "time",
            Self::Full => "full",
            Self::Closed => "closed",
            Self::NodeDied => "node_died",
            Self::Unreadable(_) => "unreadable",
        }
    }

    /// Returns a line for users, unless they have asked for this end.
    fn line(&self) -> Option<String> {
        let rest = "the file has all messages up to then that the journal still had";
        match self {
            Self::Asked | Self::Time => None,
            Self::Full => Some("the recording has its maximum size: --max-size sets another one".to_owned()),
            Self::Closed => Some(format!("the node has stopped, or has ended this recording; {rest}")),
            Self::NodeDied => Some(format!("the node has died; {rest}")),
            Self::Unreadable(why) => Some(format!("{why}; the file has the messages before")),
        }
    }
}

/// Shows one line on a terminal.
fn show_progress(totals: &Totals, lasts: Duration) {
    if io::stderr().is_terminal() {
        let Totals { written, dropped, bytes, .. } = totals;
        let seconds = lasts.as_secs();
        output::note(format_args!("{seconds} s: {written} messages, {dropped} dropped, {bytes} bytes"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_is_named_by_node_and_time() {
        let at_ns = 1_769_852_640_000_000_000;
        assert_eq!(file_name("leg/knee", at_ns), "leg_knee-2026-01-31-094400.mcap");
    }
}
