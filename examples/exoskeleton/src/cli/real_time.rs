//! A run in real time from the command line.

use std::{path::Path, time::Duration};

use exoskeleton::output;
use exoskeleton::report;
use exoskeleton::robot::launch::{self, LaunchOptions, RealTimeFigures, Walk};
use exoskeleton::robot::topology::{Control, ControlThread, ReleaseBy};

use super::{Arguments, RunError, Verdict};

/// Where the control loops run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum ThreadArgument {
    /// On the thread that reads the node's sockets.
    Io,
    /// On a thread of their own.
    Own,
}

/// Starts the five processes, walks, prints the table, writes the folder.
pub(super) fn run(arguments: &Arguments) -> Result<Verdict, RunError> {
    let walk = launch::run(&options(arguments)?)?;
    output::print(&report::table(&walk.report));
    output::print(&words(&walk.real_time));
    output::print(&format!("{}\n", links(arguments.keys.as_deref())));
    let json = json(&walk)?;
    let mut unwritten = walk.unwritten.clone();
    let in_folder = walk.folder.join("report.json");
    // One that cannot be written takes no other away.
    for path in [Some(&in_folder), arguments.report.as_ref()].into_iter().flatten() {
        if let Err(error) = std::fs::write(path, &json) {
            unwritten.get_or_insert_with(|| super::at(path, &error).to_string());
        }
    }
    if let Some(why) = unwritten {
        return Err(RunError::Record(why));
    }
    output::print(&format!(
        "written: {}/ gait.svg, run.csv, report.json, and each process's trace and log\n",
        walk.folder.display()
    ));
    Ok(Verdict::Walked(walk.report.verdict))
}

fn options(arguments: &Arguments) -> Result<LaunchOptions, RunError> {
    let device_watchdog = match arguments.device_watchdog {
        Some(ms) if !(1..=10_000).contains(&ms) => return Err(RunError::Watchdog(ms)),
        limit => limit.map(Duration::from_millis),
    };
    let thread = match arguments.control_thread {
        // The network must not run at a real-time priority.
        ThreadArgument::Io if arguments.realtime_priority.is_none() => ControlThread::Io,
        ThreadArgument::Io | ThreadArgument::Own => ControlThread::Own,
    };
    Ok(LaunchOptions {
        strides: arguments.strides,
        seed: arguments.seed,
        trial: arguments.trial.clone(),
        kill: arguments.kill,
        device_watchdog,
        control: Control {
            thread,
            realtime_priority: arguments.realtime_priority,
            release: ReleaseBy::Itself,
        },
        keys: arguments.keys.clone(),
        runs: arguments.runs.clone(),
    })
}

/// Who could speak to whom.
fn links(keys: Option<&Path>) -> String {
    keys.map_or_else(
        || "links between nodes: open to every program of this host; `--keys DIR` closes them".to_owned(),
        |keys| {
            format!(
                "links between nodes: TLS 1.3, each node proven by its key in {}; those to the plant's devices are open",
                keys.join("nodes").display()
            )
        },
    )
}

/// The report, with what only a real-time run can say.
fn json(walk: &Walk) -> std::io::Result<String> {
    let mut value = serde_json::to_value(&walk.report).map_err(std::io::Error::other)?;
    value["real_time"] = serde_json::to_value(&walk.real_time).map_err(std::io::Error::other)?;
    Ok(serde_json::to_string_pretty(&value).map_err(std::io::Error::other)? + "\n")
}

fn words(figures: &RealTimeFigures) -> String {
    let row = |name: &str, p: report::PercentilesUs| {
        format!("{name:24} {:10.0} {:10.0} {:10.0} {:10.0}\n", p.p50, p.p99, p.p999, p.max)
    };
    let mut text = row("joint sample age", figures.drives.sample_age_us)
        + &row("gait state age", figures.drives.gait_age_us)
        + &row("drive lateness", figures.drives.lateness_us)
        + &row("central lateness", figures.central_late_us)
        + &row("plant lateness", figures.plant_late_us);
    let each: Vec<String> =
        figures.cpu_percent.iter().map(|(name, share)| format!("{name} {share:.0}")).collect();
    text += &format!("CPU: {:.0} % of one ({})\n", figures.cpu_percent_total, each.join(", "));
    text += &host_words(figures);
    if let Some(kill) = &figures.kill {
        for (what, times) in [("SAFE", &kill.safe_after_ms), ("NodeLost", &kill.node_lost_after_ms)] {
            let each: Vec<String> = times.iter().map(|(name, ms)| format!("{name} {}", after(*ms))).collect();
            text += &format!("from kill to {what}: {}\n", each.join(", "));
        }
    }
    text
}

/// What the witness saw, and what became of it.
fn host_words(figures: &RealTimeFigures) -> String {
    /// Stalls that are listed one by one.
    const LISTED_MAX: usize = 8;
    let host = &figures.host;
    let percent = |share: Option<f64>| share.map_or_else(|| "?".to_owned(), |share| format!("{share:.0} %"));
    let mut text = format!(
        "host: other programs {} of all CPUs, taken by a hypervisor {}\n",
        percent(host.others_cpu_percent),
        percent(host.stolen_cpu_percent)
    );
    for (whose, stalls) in [("the host's", &host.stalls), ("the robot's own", &host.own_stalls)] {
        if stalls.is_empty() {
            continue;
        }
        let each: Vec<String> = stalls
            .iter()
            .take(LISTED_MAX)
            .map(|stall| format!("{:.0} ms at {:.1} s", 1000.0 * (stall.to_s - stall.from_s), stall.from_s))
            .collect();
        let more = if stalls.len() > LISTED_MAX { ", ..." } else { "" };
        text += &format!("stalls, {whose}: {} ({}{more})\n", stalls.len(), each.join(", "));
    }
    if let Some(without) = figures.without_stalls.filter(|_| !host.strides_disturbed.is_empty()) {
        let strides: Vec<String> = host.strides_disturbed.iter().map(u32::to_string).collect();
        let ([hip, knee, ankle], phase) = (without.rms_deg, without.phase_rms_percent);
        text += &format!("  strides disturbed by the host: {}\n", strides.join(" "));
        if !phase.is_nan() {
            text += &format!("  the others: RMS {hip:.2} / {knee:.2} / {ankle:.2} deg, phase {phase:.2} %\n");
        }
    }
    text
}

fn after(ms: Option<f64>) -> String {
    ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms:.1} ms"))
}
