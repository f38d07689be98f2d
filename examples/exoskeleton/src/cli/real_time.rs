//! A run in real time from the command line.

use std::{path::Path, time::Duration};

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
    print!("{}", report::table(&walk.report));
    print!("{}", words(&walk.real_time));
    println!("{}", links(arguments.keys.as_deref()));
    let json = json(&walk)?;
    std::fs::write(walk.folder.join("report.json"), &json)?;
    if let Some(path) = &arguments.report {
        std::fs::write(path, &json).map_err(|e| super::at(path, &e))?;
    }
    println!(
        "written: {}/ gait.svg, run.csv, report.json, and each process's trace and log",
        walk.folder.display()
    );
    Ok(if walk.report.passed { Verdict::LimitsHeld } else { Verdict::LimitBroken })
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
    if let Some(without) = figures.without_stalls {
        let each: Vec<String> = figures
            .stalls
            .iter()
            .map(|stall| format!("{:.0} ms at {:.1} s", 1000.0 * (stall.to_s - stall.from_s), stall.from_s))
            .collect();
        let ([hip, knee, ankle], phase) = (without.rms_deg, without.phase_rms_percent);
        text += &format!("the host stood still: {}\n", each.join(", "));
        text += &format!(
            "  without the strides around that: RMS {hip:.2} / {knee:.2} / {ankle:.2} deg, phase {phase:.2} %\n"
        );
    }
    if let Some(kill) = &figures.kill {
        for (what, times) in [("SAFE", &kill.safe_after_ms), ("NodeLost", &kill.node_lost_after_ms)] {
            let each: Vec<String> = times.iter().map(|(name, ms)| format!("{name} {}", after(*ms))).collect();
            text += &format!("from kill to {what}: {}\n", each.join(", "));
        }
    }
    text
}

fn after(ms: Option<f64>) -> String {
    ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms:.1} ms"))
}
