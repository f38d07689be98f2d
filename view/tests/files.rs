//! The files beside this package name metrics that exist: the dashboard, the alert rules and the book's table.

use std::{
    collections::BTreeSet,
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

use serde_json::Value;
use sinew_testkit::reference::GeneratedFile;
use sinew_view::{METRICS, Shape};

const COMMAND: &str = "UPDATE=1 cargo test -p sinew-view --test files";

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

fn read(name: &str) -> String {
    fs::read_to_string(path(name)).unwrap_or_else(|why| panic!("{name}: {why}"))
}

/// Returns the names of metrics in a text.
fn named(text: &str) -> BTreeSet<String> {
    let words = text.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
    words.filter(|word| word.starts_with("sinew_")).map(str::to_owned).collect()
}

/// Returns the names of all metrics, and of the samples of histograms.
fn all() -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for metric in METRICS {
        let name = metric.full_name();
        if metric.shape == Shape::Histogram {
            names.extend(["_bucket", "_count", "_sum"].map(|suffix| format!("{name}{suffix}")));
        }
        names.insert(name);
    }
    names
}

/// Returns the expressions of a dashboard, wherever they are in it.
fn expressions<'a>(value: &'a Value, found: &mut Vec<&'a str>) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                match (key.as_str(), value) {
                    ("expr" | "query" | "definition", Value::String(text)) => found.push(text),
                    _ => expressions(value, found),
                }
            }
        }
        Value::Array(list) => list.iter().for_each(|value| expressions(value, found)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

#[test]
fn dashboard_shows_metrics_that_exist() {
    let dashboard: Value = serde_json::from_str(&read("grafana.json")).expect("it is JSON");
    let mut found = Vec::new();
    expressions(&dashboard, &mut found);
    let panels = dashboard["panels"].as_array().expect("a list");
    assert!(found.len() > panels.len() && panels.len() > 10, "{} of {}", found.len(), panels.len());
    for panel in panels {
        let targets = panel["targets"].as_array().expect("a list");
        assert!(!targets.is_empty(), "{} shows nothing", panel["title"]);
        for target in targets {
            let names = named(target["expr"].as_str().expect("a text"));
            assert!(!names.is_empty() && names.is_subset(&all()), "{}: {names:?}", panel["title"]);
        }
    }
    let names = named(&found.join(" "));
    assert!(names.is_subset(&all()), "unknown: {:?}", names.difference(&all()));
}

#[test]
fn alerts_watch_metrics_that_exist() {
    let rules = read("alerts.yml");
    let expressions: Vec<_> =
        rules.lines().filter_map(|line| line.trim_start().strip_prefix("expr: ")).collect();
    let alerts = rules.matches("- alert: ").count();
    assert_eq!((expressions.len(), rules.matches("summary: ").count()), (alerts, alerts));
    for expression in expressions {
        let names = named(expression);
        assert!(!names.is_empty() && names.is_subset(&all()), "{expression}: {names:?}");
    }
}

/// Returns the table of all metrics.
fn table() -> String {
    let mut table = "\n| metric | kind | labels | meaning |\n| --- | --- | --- | --- |\n".to_owned();
    for metric in METRICS {
        let kind = match metric.shape {
            Shape::Counter => "counter",
            Shape::Gauge => "gauge",
            Shape::Histogram => "histogram",
        };
        let labels: Vec<_> = metric.labels.iter().map(|label| format!("`{label}`")).collect();
        let labels = if labels.is_empty() { "-".to_owned() } else { labels.join(", ") };
        let _ = writeln!(table, "| `{}` | {kind} | {labels} | {} |", metric.full_name(), metric.help);
    }
    table + "\n"
}

#[test]
fn page_has_the_table_of_all_metrics() {
    let page = GeneratedFile::new(path("../docs/book/src/reference/metrics.md"), COMMAND);
    let table = table();
    page.check_part(&table);
    let outside = named(&page.read().replace(&table, ""));
    assert!(outside.is_subset(&all()), "the page names {:?}", outside.difference(&all()));
}

#[test]
fn names_are_found_in_expressions() {
    let expression = "sum by (node) (rate(sinew_a_total{x=\"y\"}[1m])) > sinew_b / other_c";
    assert_eq!(named(expression), BTreeSet::from(["sinew_a_total".to_owned(), "sinew_b".to_owned()]));
}
