//! The charts.

use crate::{
    bars::{Bar, BarChart, Group, Owner},
    instructions::Instructions,
    merged::{Case, Merged, Summary},
    numbers::{grouped, micros},
    paths::{BACK_TO_BACK, BETWEEN_NODES, EVERY_MILLISECOND, FLOOD_CPUS, FLOODS, ONE_HOST, PathGroup},
};

const ROUND_TRIP: &str = "round trip of 1,000 bytes, median, us: shorter is better";

/// Draws all charts. Returns their names and texts.
///
/// # Errors
/// The results have nothing for one of them.
pub(crate) fn all(merged: &Merged, counted: &Instructions) -> Result<Vec<(&'static str, String)>, String> {
    let caption = merged.caption();
    let charts = [
        ("one-host-1khz", one_host("Every millisecond", merged, EVERY_MILLISECOND)),
        ("one-host-back-to-back", one_host("Back to back", merged, BACK_TO_BACK)),
        ("between-nodes", between_nodes(merged)),
        ("floods", floods(merged)),
    ];
    let drawn = charts.into_iter().map(|(name, chart)| {
        let chart = BarChart { caption: caption.clone(), ..chart };
        Ok((name, chart.draw()?))
    });
    drawn.chain([instructions(counted).draw().map(|text| ("instructions", text))]).collect()
}

fn one_host(pace_label: &str, merged: &Merged, pace: &str) -> BarChart {
    let title = format!("{pace_label}: {}", ONE_HOST.title);
    let groups = vec![Group { title: "", bars: times(merged, &ONE_HOST, pace) }];
    BarChart { title, axis: ROUND_TRIP, groups, caption: Vec::new() }
}

fn between_nodes(merged: &Merged) -> BarChart {
    let group = |title, pace| Group { title, bars: times(merged, &BETWEEN_NODES, pace) };
    let groups = vec![group("Every millisecond", EVERY_MILLISECOND), group("Back to back", BACK_TO_BACK)];
    let title = format!("Round trip: {}", BETWEEN_NODES.title);
    BarChart { title, axis: ROUND_TRIP, groups, caption: Vec::new() }
}

/// Returns the bars of a group's medians, the shortest first.
fn times(merged: &Merged, group: &PathGroup, pace: &str) -> Vec<Bar> {
    let bar = |(name, label): &(&str, &str)| {
        let p50 = merged.p50(Case { name, pace, cpus: group.cpus })?;
        Some(bar(label, p50, p50.median as f64 / 1_000.0, micros))
    };
    let mut bars: Vec<_> = group.paths.iter().filter_map(bar).collect();
    bars.sort_by(|one, other| one.value.total_cmp(&other.value));
    bars
}

fn floods(merged: &Merged) -> BarChart {
    let bar = |(name, label): &(&str, &str)| {
        let rate = merged.rate(name, FLOOD_CPUS)?;
        Some(bar(label, rate, rate.median as f64, grouped))
    };
    let mut bars: Vec<_> = FLOODS.iter().filter_map(bar).collect();
    bars.sort_by(|one, other| other.value.total_cmp(&one.value));
    BarChart {
        title: "Flood: two processes by the loopback interface, a CPU each".to_owned(),
        axis: "messages of 1,000 bytes a second: longer is better",
        groups: vec![Group { title: "", bars }],
        caption: Vec::new(),
    }
}

fn bar(label: &str, summary: Summary, value: f64, shown: impl Fn(u64) -> String) -> Bar {
    let mut text = shown(summary.median);
    if summary.runs > 1 {
        text = format!("{text} ({})", shown(summary.least));
    }
    Bar { label: label.to_owned(), value, text, owner: Owner::of(label) }
}

fn instructions(counted: &Instructions) -> BarChart {
    let bar = |(label, count): &(String, u64)| Bar {
        label: label.clone(),
        value: *count as f64,
        text: grouped(*count),
        owner: Owner::Sinew,
    };
    let bars = counted.counts.iter().map(bar).collect();
    BarChart {
        title: "Instructions of a round trip, by path".to_owned(),
        axis: "instructions outside the kernel, all processes together: fewer are better",
        groups: vec![Group { title: "", bars }],
        caption: counted.caption(),
    }
}

#[cfg(test)]
mod tests {
    use sinew_figures::results::CaseResult;

    use super::*;
    use crate::merged::{BYTES, tests::run};

    fn took(case: &str, p50_ns: u64) -> CaseResult {
        let [case, pace, cpus] = [case, "1khz", "one_cpu"].map(str::to_owned);
        CaseResult { case, pace, cpus, bytes: BYTES, p50_ns: Some(p50_ns), ..CaseResult::default() }
    }

    #[test]
    fn bars_are_sorted_and_show_the_minimum_run() {
        let mut first = run("M", took("tcp", 30_000));
        first.results.push(took("sinew_nodes_io_thread", 21_000));
        let merged = Merged::new(vec![first, run("M", took("tcp", 20_000))]).unwrap();
        let bars = times(&merged, &BETWEEN_NODES, EVERY_MILLISECOND);
        let shown: Vec<_> =
            bars.iter().map(|bar| (bar.label.as_str(), bar.text.as_str(), bar.owner)).collect();
        assert_eq!(
            shown,
            [("Sinew, on the I/O thread", "21.0", Owner::Sinew), ("TCP", "25.0 (20.0)", Owner::Other),]
        );
    }
}
