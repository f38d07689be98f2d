//! `sinew record`: writes the messages of the node into a file.

mod fetch;
mod freeze;
pub(crate) mod sizes;
pub(crate) mod stop;

use std::{
    io::{self, IsTerminal as _},
    path::PathBuf,
    time::Duration,
};

use clap::{Args, Subcommand, ValueEnum};
use serde_json::json;
use sinew::{
    AppAddress, NodeAddress, Tid,
    inspect::{AskRecord, RecordReport, Selection},
};
use sinew_recorder::{
    Connection, End, FileOptions, RecordingError, RecordingOptions, Session, Summary, Totals,
};

use crate::{
    Report, output,
    system::{System, SystemError, in_words},
    table::clean,
};
use sizes::Split;
use stop::StopRequest;

/// Interval at which the progress is shown.
const SHOWN: Duration = Duration::from_secs(1);

/// The arguments of `sinew record`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct Order {
    #[command(subcommand)]
    spans: Option<Spans>,
    /// The file; {node} and {time} in it are replaced. Without it: {node}-{time}.mcap in the current folder, in UTC
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

/// Records until the requested end, or until the user or the node ends it.
pub(crate) fn show(system: &mut System, order: &Order) -> Result<Report, SystemError> {
    match &order.spans {
        Some(Spans::Freeze(order)) => return freeze::show(system, order),
        Some(Spans::Fetch(order)) => return fetch::show(system, order),
        None => {}
    }
    let stop = StopRequest::listen()
        .map_err(|why| SystemError::Bag(format!("Ctrl-C cannot be handled: {why}; free descriptors")))?;
    let path = system.path.clone();
    let session = Session::begin(Asked(system), order.options()).map_err(|why| in_place(&path, &why))?;
    let summary = run(session, &stop);
    Ok(report(&summary))
}

impl Order {
    fn options(&self) -> RecordingOptions {
        let Self { apps, types, groups, .. } = self;
        let (split_bytes, split_time) = match self.split {
            Some(Split::Bytes(bytes)) => (Some(bytes), None),
            Some(Split::Time(time)) => (None, Some(time)),
            None => (None, None),
        };
        let compression = match self.compression {
            Compression::Zstd => sinew_recorder::Compression::Zstd,
            Compression::Lz4 => sinew_recorder::Compression::Lz4,
            Compression::None => sinew_recorder::Compression::None,
        };
        let file = FileOptions {
            compression,
            size_max: self.max_size,
            split_bytes,
            split_time,
            raw_only: self.raw_only,
            replace: self.force,
            ..FileOptions::default()
        };
        RecordingOptions {
            path: self.file.clone(),
            selection: Selection { apps: apps.clone(), types: types.clone(), groups: groups.clone() },
            lasts: self.lasts,
            file,
            goes_on_when_full: false,
            program: concat!("sinew record ", env!("CARGO_PKG_VERSION")).to_owned(),
        }
    }
}

/// The connection of this command to its node.
struct Asked<'s>(&'s mut System);

impl Connection for Asked<'_> {
    fn ask(&mut self, question: &AskRecord, within: Duration) -> Result<RecordReport, String> {
        let to = Tid::new(self.node(), AppAddress::INSPECT);
        self.0.endpoint.message(to, question).ask(within).map_err(|error| in_words(&error))
    }

    fn node(&self) -> NodeAddress {
        self.0.endpoint.tid().node
    }

    fn own(&self) -> Vec<Tid> {
        self.0.own.iter().copied().collect()
    }

    fn patience(&self) -> Duration {
        self.0.within
    }
}

/// Returns the error with the place of the node at fault.
fn in_place(path: &str, why: &RecordingError) -> SystemError {
    match why {
        RecordingError::NoAnswer(why) => SystemError::NoAnswer(path.to_owned(), why.clone()),
        RecordingError::Selection(why) => SystemError::Usage(clean(&why.to_string())),
        RecordingError::Refused(why) => SystemError::Bag(format!("the node at {path}: {}", clean(why))),
        RecordingError::Journal(_)
        | RecordingError::File(_)
        | RecordingError::Thread(_)
        | RecordingError::NotEnded(_)
        | RecordingError::Panicked => SystemError::Bag(why.to_string()),
    }
}

fn run(mut session: Session<Asked<'_>>, stop: &StopRequest) -> Summary {
    let (mut shown, mut due) = (0, SHOWN);
    let end = loop {
        if stop.is_there() {
            break End::Asked;
        }
        if let Some(end) = session.step() {
            break end;
        }
        for fault in &session.faults()[shown..] {
            output::note(format_args!("sinew: {}", clean(fault)));
        }
        shown = session.faults().len();
        if session.lasts() >= due {
            due = session.lasts() + SHOWN;
            show_progress(&session.totals(), session.lasts());
        }
    };
    let summary = session.finish(end);
    for fault in &summary.faults[shown..] {
        output::note(format_args!("sinew: {}", clean(fault)));
    }
    summary
}

fn report(summary: &Summary) -> Report {
    let Summary { file, node, end, totals, faults } = summary;
    let Totals { seen, written, dropped, misfits, events_lost, bytes, parts } = *totals;
    let name = clean(&file.display().to_string());
    let files = if parts > 1 { format!("{parts} files") } else { "1 file".to_owned() };
    let mut text = format!("{name}: {written} messages, {dropped} dropped; {bytes} bytes in {files}\n");
    match end {
        End::Asked | End::Time => {}
        End::Full => text += &format!("{end}: --max-size sets another one\n"),
        End::Closed | End::NodeDied | End::Unreadable(_) => text += &format!("{}\n", clean(&end.to_string())),
    }
    let json = json!({
        "file": file, "node": node, "end": end.word(), "seen": seen, "written": written,
        "dropped": dropped, "misfits": misfits, "events_lost": events_lost, "bytes": bytes,
        "parts": parts, "faults": faults,
    });
    Report { text, json, is_fine: faults.is_empty() && !matches!(end, End::Unreadable(_)) }
}

/// Shows one line on a terminal.
fn show_progress(totals: &Totals, lasts: Duration) {
    if io::stderr().is_terminal() {
        let Totals { written, dropped, bytes, .. } = totals;
        let seconds = lasts.as_secs();
        output::note(format_args!("{seconds} s: {written} messages, {dropped} dropped, {bytes} bytes"));
    }
}
