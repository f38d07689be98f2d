//! The report as a table for people.

use std::fmt::Write;

use super::{PercentilesUs, Report, RunMode, Verdict};

/// The result table of a run, lines of at most 78 characters.
#[must_use]
pub fn table(report: &Report) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write_table(&mut text, report);
    text
}

fn write_table(out: &mut String, report: &Report) -> std::fmt::Result {
    let source = report.trial.as_deref().unwrap_or("built-in curves");
    let mode = match report.mode {
        RunMode::LockStep => "lock-step, virtual time",
        RunMode::RealTime => "real time",
    };
    writeln!(out, "{} strides, {source}, seed {} ({mode})", report.strides, report.seed)?;
    writeln!(out, "{:-<72}", "")?;
    writeln!(out, "{:32} {:>16} {:>14}  held", "limit", "expected", "seen")?;
    for limit in &report.limits {
        let seen = limit.seen.map_or_else(|| "never".to_owned(), |seen| format!("{seen:.3}"));
        let held = match (limit.held, limit.disturbed) {
            (true, _) => "yes",
            (false, false) => "NO",
            (false, true) => "not judged",
        };
        writeln!(out, "{:32} {:>16} {seen:>14}  {held}", limit.name, limit.expected)?;
    }
    writeln!(out, "{:-<72}", "")?;
    writeln!(out, "{:32} {:>10} {:>10} {:>10}", "", "hip", "knee", "ankle")?;
    for (name, value) in [
        ("RMS to reference, deg", report.rms_deg),
        ("RMS to intention, deg", report.rms_intended_deg),
        ("work into the leg, J/stride", report.work_positive_j_per_stride),
        ("work out of the leg, J/stride", report.work_negative_j_per_stride),
        ("greatest torque, Nm", report.torque_peak_nm),
    ] {
        writeln!(out, "{name:32} {:10.2} {:10.2} {:10.2}", value.hip, value.knee, value.ankle)?;
    }
    if let Some(stride) = report.assisted_from_stride {
        writeln!(out, "assistance allowed after {stride:.2} strides")?;
    }
    write_fault(out, report)?;
    write_timing(out, report)?;
    write_verdict(out, report)
}

fn write_verdict(out: &mut String, report: &Report) -> std::fmt::Result {
    let longest_ms =
        report.stalls.iter().map(|stall| 1000.0 * (stall.to_s - stall.from_s)).fold(0.0, f64::max);
    let stalled = format!("the host stalled {} times (up to {longest_ms:.0} ms)", report.stalls.len());
    let apart = report.strides_counted - report.strides_judged;
    match report.verdict {
        Verdict::Failed => writeln!(out, "FAILED: see `NO` above"),
        Verdict::Passed if apart > 0.01 => {
            writeln!(out, "PASSED: all limits held; {stalled}, so {apart:.1} strides were not judged")
        }
        Verdict::Passed => writeln!(out, "PASSED: all limits held"),
        Verdict::Inconclusive => writeln!(
            out,
            "INCONCLUSIVE: {stalled}; see `not judged` above.\nStop other load on this host, ask for more \
             strides, or use --lock-step, which needs no real time."
        ),
    }
}

fn write_fault(out: &mut String, report: &Report) -> std::fmt::Result {
    let Some(fault) = &report.fault else { return Ok(()) };
    let deviation = fault.deviation_max_deg;
    writeln!(
        out,
        "{} killed at {:.2} s; deviation until assistance came back {:.1} / {:.1} / {:.1} deg",
        fault.node, fault.at_s, deviation.hip, deviation.knee, deviation.ankle
    )
}

fn write_timing(out: &mut String, report: &Report) -> std::fmt::Result {
    let (Some(period), Some(age)) = (report.period_us, report.age_us) else {
        return writeln!(out, "period, age, deadline misses: not measured (virtual time)");
    };
    let row = |p: PercentilesUs| format!("{:10.0} {:10.0} {:10.0} {:10.0}", p.p50, p.p99, p.p999, p.max);
    writeln!(out, "{:24} {:>10} {:>10} {:>10} {:>10}", "us", "p50", "p99", "p99.9", "max")?;
    writeln!(out, "{:24} {}", "period", row(period))?;
    writeln!(out, "{:24} {}", "age at use", row(age))?;
    let of =
        |misses: Option<u64>, all: Option<u64>| format!("{} of {}", misses.unwrap_or(0), all.unwrap_or(0));
    writeln!(
        out,
        "deadline misses (more than 2 ms late): drives {} ticks, witness {} wakes",
        of(report.deadline_misses, report.ticks),
        of(report.witness_misses, report.witness_wakes)
    )
}
