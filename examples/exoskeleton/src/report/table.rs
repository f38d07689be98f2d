//! The report as a table for people.

use std::fmt::Write;

use super::{
    HostFigures, PercentilesUs, RealTimeFigures, Report, RunMode, Timing, UnstalledFigures, Verdict,
};

/// The result table of a run, with the figures that only a run in real time has. Lines have at most 78
/// characters.
#[must_use]
pub fn table(report: &Report) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write_table(&mut text, report);
    text
}

fn write_table(out: &mut String, report: &Report) -> std::fmt::Result {
    let run = &report.run;
    let source = run.trial.as_deref().unwrap_or("built-in curves");
    let mode = match run.mode {
        RunMode::LockStep => "lock-step, virtual time",
        RunMode::RealTime => "real time",
    };
    writeln!(out, "{} strides, {source}, seed {} ({mode})", run.strides, run.seed)?;
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
    let figures = &report.figures;
    for (name, [hip, knee, ankle]) in [
        ("RMS to reference, deg", figures.rms_deg),
        ("RMS to intention, deg", figures.rms_intended_deg),
        ("work into the leg, J/stride", figures.work_positive_j_per_stride),
        ("work out of the leg, J/stride", figures.work_negative_j_per_stride),
        ("greatest torque, Nm", figures.torque_peak_nm),
    ] {
        writeln!(out, "{name:32} {hip:10.2} {knee:10.2} {ankle:10.2}")?;
    }
    if let Some(stride) = figures.assisted_from_stride {
        writeln!(out, "assistance allowed after {stride:.2} strides")?;
    }
    if let Some(fault) = &figures.fault {
        let ([hip, knee, ankle], outage) = (fault.deviation_max_deg, &fault.outage);
        writeln!(
            out,
            "{} killed at {:.2} s; deviation until assistance came back {hip:.1} / {knee:.1} / {ankle:.1} deg",
            outage.part, outage.from_s
        )?;
    }
    write_timing(out, &report.timing)?;
    write_verdict(out, report)?;
    report.real_time.iter().try_for_each(|figures| write_real_time(out, figures))
}

fn write_verdict(out: &mut String, report: &Report) -> std::fmt::Result {
    let longest_ms =
        report.stalls.iter().map(|stall| 1000.0 * (stall.to_s - stall.from_s)).fold(0.0, f64::max);
    let stalled = format!("the host stalled {} times (up to {longest_ms:.0} ms)", report.stalls.len());
    let apart = report.figures.strides_counted - report.strides_judged;
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

fn write_timing(out: &mut String, timing: &Timing) -> std::fmt::Result {
    let (Some(period), Some(age)) = (timing.period_us, timing.age_us) else {
        return writeln!(out, "period, age, deadline misses: not measured (virtual time)");
    };
    writeln!(out, "{:24} {:>10} {:>10} {:>10} {:>10}", "us", "p50", "p99", "p99.9", "max")?;
    write_percentiles(out, "period", period)?;
    write_percentiles(out, "age at use", age)?;
    let of =
        |misses: Option<u64>, all: Option<u64>| format!("{} of {}", misses.unwrap_or(0), all.unwrap_or(0));
    writeln!(
        out,
        "deadline misses (more than 2 ms late): drives {} ticks, witness {} wakes",
        of(timing.deadline_misses, timing.ticks),
        of(timing.witness_misses, timing.witness_wakes)
    )
}

fn write_percentiles(out: &mut String, name: &str, p: PercentilesUs) -> std::fmt::Result {
    writeln!(out, "{name:24} {:10.0} {:10.0} {:10.0} {:10.0}", p.p50, p.p99, p.p999, p.max)
}

fn write_real_time(out: &mut String, figures: &RealTimeFigures) -> std::fmt::Result {
    write_percentiles(out, "joint sample age", figures.drives.sample_age_us)?;
    write_percentiles(out, "gait state age", figures.drives.gait_age_us)?;
    write_percentiles(out, "drive lateness", figures.drives.lateness_us)?;
    write_percentiles(out, "central lateness", figures.central_late_us)?;
    write_percentiles(out, "plant lateness", figures.plant_late_us)?;
    let each: Vec<String> =
        figures.cpu_percent.iter().map(|(name, share)| format!("{name} {share:.0}")).collect();
    writeln!(out, "CPU: {:.0} % of one ({})", figures.cpu_percent_total, each.join(", "))?;
    write_host(out, &figures.host, figures.without_stalls)?;
    let Some(kill) = &figures.kill else { return Ok(()) };
    let after = |ms: &Option<f64>| ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms:.1} ms"));
    for (what, times) in [("SAFE", &kill.safe_after_ms), ("NodeLost", &kill.node_lost_after_ms)] {
        let each: Vec<String> = times.iter().map(|(name, ms)| format!("{name} {}", after(ms))).collect();
        writeln!(out, "from kill to {what}: {}", each.join(", "))?;
    }
    Ok(())
}

/// The witness's observations, and their effect on the verdict.
fn write_host(
    out: &mut String,
    host: &HostFigures,
    without_stalls: Option<UnstalledFigures>,
) -> std::fmt::Result {
    /// Stalls that are listed one by one.
    const LISTED_MAX: usize = 8;
    let percent = |share: Option<f64>| share.map_or_else(|| "?".to_owned(), |share| format!("{share:.0} %"));
    let (others, stolen) = (percent(host.others_cpu_percent), percent(host.stolen_cpu_percent));
    writeln!(out, "host: other programs {others} of all CPUs, taken by a hypervisor {stolen}")?;
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
        writeln!(out, "stalls, {whose}: {} ({}{more})", stalls.len(), each.join(", "))?;
    }
    let Some(without) = without_stalls.filter(|_| !host.strides_disturbed.is_empty()) else { return Ok(()) };
    let strides: Vec<String> = host.strides_disturbed.iter().map(u32::to_string).collect();
    writeln!(out, "  strides disturbed by the host: {}", strides.join(" "))?;
    let ([hip, knee, ankle], phase) = (without.rms_deg, without.phase_rms_percent);
    if phase.is_nan() {
        return Ok(());
    }
    writeln!(out, "  the others: RMS {hip:.2} / {knee:.2} / {ankle:.2} deg, phase {phase:.2} %")
}
