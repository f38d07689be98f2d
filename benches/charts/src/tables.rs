//! The tables of the page, as Markdown.

use std::fmt::Write;

use crate::{
    instructions::Instructions,
    merged::{Case, Merged, Summary},
    numbers::{grouped, micros, ratio},
    paths::{BACK_TO_BACK, BETWEEN_NODES, EVERY_MILLISECOND, ONE_HOST, POLLED, PathGroup},
};

const END: &str = "<!-- end of table -->";
/// A cell without a result.
const NONE: &str = "-";

/// Returns the page with this table in place of its former version.
///
/// # Errors
/// The page has no place for it.
pub(crate) fn replaced(page: &str, name: &str, table: &str) -> Result<String, String> {
    let start = format!("<!-- table: {name} -->\n");
    let none = || format!("there is no {} with {END} after it", start.trim_end());
    let (before, rest) = page.split_once(&start).ok_or_else(none)?;
    let (_, after) = rest.split_once(END).ok_or_else(none)?;
    Ok(format!("{before}{start}{table}{END}{after}"))
}

/// The round trips of all paths, with their ratios to the bare path and to the other middleware.
pub(crate) fn peers(merged: &Merged) -> String {
    let mut table = "\
| path | back to back, us | to bare | to peer | at 1 kHz, us | to bare | to peer | p99.9 at 1 kHz, us |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
"
    .to_owned();
    for group in [ONE_HOST, POLLED, BETWEEN_NODES] {
        // Writing to a String cannot fail.
        let _ = writeln!(table, "| **{}** | | | | | | | |", group.title);
        for (name, label) in group.paths {
            let cells = [BACK_TO_BACK, EVERY_MILLISECOND].map(|pace| times(merged, &group, name, pace));
            let paced = Case { name, pace: EVERY_MILLISECOND, cpus: group.cpus };
            let p999 = merged.p999(paced).map_or_else(|| NONE.to_owned(), |p999| micros(p999.median));
            if cells.iter().any(|cells| cells[0] != NONE) {
                let _ = writeln!(table, "| {label} | {} | {p999} |", cells.concat().join(" | "));
            }
        }
    }
    table
}

/// Returns the median of a path at a pace, and its ratios to the bare path and to the other middleware.
fn times(merged: &Merged, group: &PathGroup, name: &str, pace: &str) -> [String; 3] {
    let p50 = |name: &str| merged.p50(Case { name, pace, cpus: group.cpus });
    let Some(Summary { median, .. }) = p50(name) else { return [NONE; 3].map(str::to_owned) };
    let to = |other: &str| p50(other).map_or_else(|| NONE.to_owned(), |other| ratio(median, other.median));
    [micros(median), to(group.bare), to(group.peer)]
}

/// The instructions of each path.
pub(crate) fn instructions(counted: &Instructions) -> String {
    let mut table = "| path | instructions | to the shortest |\n| --- | ---: | ---: |\n".to_owned();
    for (label, count) in &counted.counts {
        // Writing to a String cannot fail.
        let _ = writeln!(table, "| {label} | {} | {} |", grouped(*count), ratio(*count, counted.counts[0].1));
    }
    table
}

#[cfg(test)]
mod tests {
    use sinew_figures::results::CaseResult;

    use super::*;
    use crate::merged::{BYTES, tests::run};

    fn took(case: &str, p50_ns: u64) -> CaseResult {
        let [case, pace, cpus] = [case, BACK_TO_BACK, "one_cpu"].map(str::to_owned);
        CaseResult { case, pace, cpus, bytes: BYTES, p50_ns: Some(p50_ns), ..CaseResult::default() }
    }

    #[test]
    fn ratios_are_to_bare_path_and_to_peer() {
        let mut run = run("M", took("tcp", 10_000));
        run.results.extend([took("zenoh", 40_000), took("sinew_nodes_io_thread", 20_000)]);
        let table = peers(&Merged::new(vec![run]).unwrap());
        assert!(table.contains("| TCP | 10.0 | 1.00 | 0.25 | - | - | - | - |\n"), "{table}");
        assert!(
            table.contains("| Sinew, on the I/O thread | 20.0 | 2.00 | 0.50 | - | - | - | - |\n"),
            "{table}"
        );
        assert!(!table.contains("threads of their own"), "{table}");
    }

    #[test]
    fn table_replaces_its_former_version_alone() {
        let page = "a\n<!-- table: one -->\n| old |\n<!-- end of table -->\nb\n";
        let new = replaced(page, "one", "| new |\n").unwrap();
        assert_eq!(new, "a\n<!-- table: one -->\n| new |\n<!-- end of table -->\nb\n");
        assert_eq!(replaced(&new, "one", "| new |\n").unwrap(), new);
        assert!(replaced(page, "two", "").unwrap_err().contains("table: two"));
    }
}
