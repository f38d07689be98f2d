//! `sinew bag`: checks, sums up, merges and exports recordings. Asks no node.

use std::{
    fmt::Write as _,
    path::PathBuf,
    time::{Duration, UNIX_EPOCH},
};

use clap::{Subcommand, ValueEnum};
use serde_json::json;
use sinew_bag::{
    BagError,
    check::{self, EndReport, FileReport, Finding},
    export, info,
    merge::Merged,
};

use crate::{
    Report,
    system::SystemError,
    table::{Table, clean, or_dash, paragraph},
};

/// An operation on recordings.
#[derive(Debug, Subcommand)]
pub(crate) enum Order {
    /// Proves that recordings are complete: seen = written + dropped for each channel, and both ends compared
    ///
    /// Give the files of all nodes, and all parts of each: both ends of a channel are compared where the files of both
    /// nodes are given. A missing message is named, or the second in which it is missing. Exit code 1 if there is a
    /// finding.
    ///
    /// Check the files before they are merged: a merged file is sorted by time, so its tallies prove nothing.
    #[command(after_help = r#"Examples:
  sinew bag check walk.mcap
  sinew bag check hip.mcap knee.mcap ankle.mcap
  sinew bag check *.mcap --json | jq '.findings[].text'"#)]
    Check {
        /// The files
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,
    },
    /// Sums up recordings: node, time span, and the messages of each channel
    Info {
        /// The files, also of other recorders of MCAP
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,
    },
    /// Merges recordings of several nodes into one file, on the clock of the first file's node
    ///
    /// The clock readings in the files convert the times of each node. The output and the file itself state how wrong
    /// they may be. Topics get the name of their node in front.
    #[command(after_help = r#"Examples:
  sinew bag merge hip.mcap knee.mcap --out leg.mcap"#)]
    Merge {
        /// The files; the first one has the clock
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,
        /// The file that is made
        #[arg(long, short, value_name = "FILE")]
        out: PathBuf,
    },
    /// Writes a file for each channel, with a column for each value
    #[command(after_help = r#"Examples:
  sinew bag export walk.mcap --out walk
  sinew bag export walk.mcap --out walk --format parquet"#)]
    Export {
        /// The recording
        file: PathBuf,
        /// The directory for the files
        #[arg(long, short, value_name = "DIR")]
        out: PathBuf,
        /// The format
        #[arg(long, value_enum, default_value_t = Format::Csv)]
        format: Format,
    },
}

/// The format of exported files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// Text with commas
    Csv,
    /// Apache Parquet
    Parquet,
}

impl From<BagError> for SystemError {
    fn from(error: BagError) -> Self {
        // Some errors quote a file.
        Self::Bag(clean(&error.to_string()))
    }
}

/// Carries out `order`.
pub(crate) fn show(order: &Order, is_wide: bool) -> Result<Report, SystemError> {
    match order {
        Order::Check { files } => Ok(checked(&sinew_bag::check(files)?, is_wide)),
        Order::Info { files } => {
            let all = files.iter().map(info).collect::<Result<Vec<_>, _>>()?;
            Ok(summed_up(&all, is_wide))
        }
        Order::Merge { files, out } => {
            let merged = sinew_bag::merge(files, out)?;
            Ok(merged_report(&merged, out, is_wide))
        }
        Order::Export { file, out, format } => {
            let format = match format {
                Format::Csv => export::Format::Csv,
                Format::Parquet => export::Format::Parquet,
            };
            Ok(exported(&export(file, out, format)?, is_wide))
        }
    }
}

/// Returns a time of a file as text.
fn moment(at_ns: u64) -> String {
    let at = UNIX_EPOCH.checked_add(Duration::from_nanos(at_ns));
    at.map_or_else(|| at_ns.to_string(), |at| humantime::format_rfc3339_millis(at).to_string())
}

fn span(first_ns: u64, last_ns: u64) -> String {
    let seconds = Duration::from_nanos(last_ns.saturating_sub(first_ns)).as_secs_f64();
    format!("{} to {}, {seconds:.3} s", moment(first_ns), moment(last_ns))
}

fn checked(report: &check::Report, is_wide: bool) -> Report {
    let mut text = String::new();
    let mut table = Table::new(["FILE", "NODE", "PART", "CHANNEL", "SEEN", "WRITTEN", "DROPPED", "IN FILE"])
        .wide(is_wide);
    for file in &report.files {
        let FileReport { file, node, part, channels, .. } = file;
        for counts in channels {
            let numbers = [counts.seen, counts.written, counts.dropped, counts.in_file]
                .map(|number| number.to_string());
            let [seen, written, dropped, in_file] = numbers;
            table.row([
                file.clone(),
                node.clone(),
                part.to_string(),
                counts.topic.clone(),
                seen,
                written,
                dropped,
                in_file,
            ]);
        }
    }
    text += &table.text();
    if !report.ends.is_empty() {
        text += "\n";
        text += &ends(&report.ends, is_wide);
    }
    for FileReport { file, .. } in report.files.iter().filter(|file| !file.is_finished) {
        let line = format!(
            "{}: unfinished: its recorder was killed or could not write; checked up to its last chunk",
            clean(file)
        );
        text += &paragraph(0, &line, is_wide);
    }
    for FileReport { file, events_lost, .. } in report.files.iter().filter(|file| file.events_lost > 0) {
        let line = format!("{}: events and clock readings that are in no file: {events_lost}", clean(file));
        text += &paragraph(0, &line, is_wide);
    }
    text += "\n";
    for Finding { file, topic, text: found, from_ns, to_ns, .. } in &report.findings {
        let when = match (from_ns, to_ns) {
            (0, 0) => String::new(),
            (from, to) if from == to => format!(", at {}", moment(*from)),
            (from, to) => format!(", between {} and {}", moment(*from), moment(*to)),
        };
        let place = [file, topic]
            .map(|part| clean(part))
            .into_iter()
            .filter(|part| !part.is_empty())
            .collect::<Vec<_>>();
        text += &paragraph(0, &format!("{}: {}{when}", place.join(" "), clean(found)), is_wide);
    }
    let is_finished = report.files.iter().all(|file| file.is_finished);
    let _ = match report.findings.len() {
        0 if is_finished => writeln!(text, "complete: every message is written, or counted as dropped"),
        0 => writeln!(text, "nothing is missing up to the last chunk of each file"),
        count => writeln!(text, "findings: {count}"),
    };
    Report { text, json: json!(report), is_fine: report.is_fine() }
}

fn ends(ends: &[EndReport], is_wide: bool) -> String {
    let heading =
        ["FROM", "TO", "TYPE", "CLASS", "SENT", "RECEIVED", "LOST", "SUPERSEDED OR LOST", "NOT RECORDED"];
    let mut table = Table::new(heading).wide(is_wide);
    for end in ends {
        let numbers = [end.sent, end.received, end.lost, end.superseded_or_lost, end.not_recorded];
        let [sent, received, lost, superseded, not_recorded] = numbers.map(|number| number.to_string());
        let [source, destination, type_name, class] =
            [&end.source, &end.destination, &end.type_name, &end.class].map(|text| text.clone());
        table.row([source, destination, type_name, class, sent, received, lost, superseded, not_recorded]);
    }
    table.text()
}

fn summed_up(all: &[info::Info], is_wide: bool) -> Report {
    let mut text = String::new();
    for (at, info) in all.iter().enumerate() {
        if at > 0 {
            text += "\n";
        }
        let value = |key: &str| info.origin.get(key).map_or("", String::as_str);
        let state = if info.is_finished {
            "finished"
        } else {
            "unfinished: its recorder was killed or could not write"
        };
        let _ = writeln!(text, "{}: {} bytes, {state}", clean(&info.file), info.bytes);
        let (node, address, part) = (value("node"), value("address"), value("part"));
        if !address.is_empty() {
            let incarnation = value("incarnation");
            let _ = writeln!(
                text,
                "node {} at {}, incarnation {incarnation}, part {part}",
                clean(node),
                clean(address)
            );
        }
        let _ = writeln!(text, "{}", span(info.first_ns, info.last_ns));
        let mut table =
            Table::new(["CHANNEL", "TYPE", "CLASS", "DIRECTION", "MESSAGES", "HZ", "BYTES"]).wide(is_wide);
        for channel in &info.channels {
            let seconds =
                Duration::from_nanos(channel.last_ns.saturating_sub(channel.first_ns)).as_secs_f64();
            let rate = if seconds > 0.0 {
                format!("{:.1}", (channel.messages - 1) as f64 / seconds)
            } else {
                String::new()
            };
            let [messages, bytes] = [channel.messages, channel.bytes].map(|number| number.to_string());
            let dash = |text: String| or_dash(Some(text).filter(|text| !text.is_empty()));
            let [class, direction, rate] = [channel.class.clone(), channel.direction.clone(), rate].map(dash);
            table.row([
                channel.topic.clone(),
                channel.type_name.clone(),
                class,
                direction,
                messages,
                rate,
                bytes,
            ]);
        }
        text += &table.text();
        for damage in &info.damage {
            text += &paragraph(0, &clean(damage), is_wide);
        }
    }
    let is_fine = all.iter().all(|info| info.damage.is_empty());
    Report { text, json: json!({ "files": all }), is_fine }
}

fn merged_report(merged: &Merged, out: &std::path::Path, is_wide: bool) -> Report {
    let mut table = Table::new(["NODE", "ADDRESS", "MESSAGES", "ERROR"]).wide(is_wide);
    for node in &merged.nodes {
        let error =
            if node.address == merged.reference { "this clock".to_owned() } else { micros(node.bound_ns) };
        table.row([node.node.clone(), node.address.clone(), node.messages.to_string(), error]);
    }
    let mut text = table.text();
    for damage in merged.damage.iter().chain(&merged.unfinished) {
        text += &paragraph(0, &clean(damage), is_wide);
    }
    let _ = writeln!(text, "written to {}", clean(&out.display().to_string()));
    let json = json!({
        "out": out, "reference": merged.reference, "nodes": merged.nodes, "damage": merged.damage,
        "unfinished": merged.unfinished,
    });
    Report { text, json, is_fine: merged.damage.is_empty() }
}

fn micros(bound_ns: u64) -> String {
    format!("at most {:.1} us", bound_ns as f64 / 1e3)
}

fn exported(all: &export::Exports, is_wide: bool) -> Report {
    let mut table = Table::new(["FILE", "ROWS", "COLUMNS"]).wide(is_wide).whole(&["FILE"]);
    for one in &all.files {
        table.row([one.file.display().to_string(), one.rows.to_string(), one.columns.to_string()]);
    }
    let mut text = table.text();
    for one in all.files.iter().filter(|one| one.left_out > 0) {
        let line = format!(
            "{}: {} values are in no column, because there are too many columns",
            clean(&one.topic),
            one.left_out
        );
        text += &paragraph(0, &line, is_wide);
    }
    for damage in all.damage.iter().chain(&all.unfinished) {
        text += &paragraph(0, &clean(damage), is_wide);
    }
    Report { text, json: json!(all), is_fine: all.damage.is_empty() }
}
