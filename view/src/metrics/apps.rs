//! The metrics of a node's applications: readiness, waits, restarts, mailboxes.

use std::collections::BTreeSet;

use sinew::{
    Tid,
    inspect::{AppReport, AppsReport, GuardReport, Missing, TreeReport, WaitReport},
};

use super::{
    samples::Samples,
    system::{micros, truth},
    table::{
        APP_AGE, APP_MISSING, APP_READY, APPS, BARRIER_BLOCKED, BARRIER_WAIT, GUARD_CAUSE, GUARD_FAILED,
        GUARD_SAFE, MAILBOX_DEPTH, MAILBOX_DEPTH_MAX, MAILBOX_OLDEST, RESTARTS,
    },
};
use crate::{nodes::bounded, snapshot::Answers};

/// Maximum number of names of a node that are labels. Further ones, and applications without a name, are `other`.
const NAMES_MAX: usize = 512;
/// The label of all further applications.
pub(super) const OTHER: &str = "other";

/// The names of a node's applications that are labels.
#[derive(Default)]
pub(super) struct AppNames(BTreeSet<String>);

impl AppNames {
    /// Returns the label for a name. The text of an address, which stands for a missing name, is none.
    pub(super) fn label(&mut self, name: &str) -> String {
        let name = bounded(name);
        let is_name = !name.is_empty() && name.parse::<Tid>().is_err();
        if is_name && (self.0.contains(&name) || self.0.len() < NAMES_MAX) {
            self.0.insert(name.clone());
            return name;
        }
        OTHER.to_owned()
    }
}

/// Adds the applications of a node, except those of this program. Returns the names that are labels.
pub(super) fn add(samples: &mut Samples, answers: &Answers, node: &str, own: &BTreeSet<Tid>) -> AppNames {
    let mut names = AppNames::default();
    let apps = || answers.apps.apps.iter().filter(|app| !own.contains(&app.tid));
    samples.level(&APPS, [node], apps().count() as f64);
    for app in apps() {
        let label = names.label(app.name.as_deref().unwrap_or_default());
        add_app(samples, app, [node, &label]);
    }
    add_barriers(samples, &answers.apps, node, &mut names);
    add_tree(samples, &answers.tree, node, &mut names);
    add_guards(samples, answers, node, &mut names);
    names
}

fn add_app(samples: &mut Samples, app: &AppReport, labels: [&str; 2]) {
    // The states of several applications have no common value.
    if labels[1] != OTHER {
        samples.level(&APP_READY, labels, truth(app.ready));
        let missing = (app.missing.len() as u64).saturating_add(app.missing_left_out);
        samples.level(&APP_MISSING, labels, missing as f64);
    }
    if let Some(waits_us) = app.waits_us {
        samples.level(&BARRIER_WAIT, labels, micros(waits_us));
    }
}

fn add_barriers(samples: &mut Samples, report: &AppsReport, node: &str, names: &mut AppNames) {
    for WaitReport { name, waits_us } in report.barriers.iter().flat_map(|barrier| &barrier.waiting) {
        samples.level(&BARRIER_WAIT, [node, &names.label(name)], micros(*waits_us));
    }
    let of_barriers = report.barriers.iter().flat_map(|barrier| &barrier.missing);
    let of_apps = report.apps.iter().flat_map(|app| &app.missing);
    for Missing { name, since_us, .. } in of_barriers.chain(of_apps) {
        samples.level(&BARRIER_BLOCKED, [node, &names.label(name)], micros(since_us.unwrap_or(0)));
    }
}

fn add_tree(samples: &mut Samples, tree: &TreeReport, node: &str, names: &mut AppNames) {
    for line in &tree.lines {
        let label = names.label(&line.name);
        samples.count(&RESTARTS, [node, &label], line.restarts);
        for (metric, depth) in [(&MAILBOX_DEPTH, line.waiting), (&MAILBOX_DEPTH_MAX, line.waiting_most)] {
            if let Some(depth) = depth {
                samples.level(metric, [node, &label], depth as f64);
            }
        }
        if line.waiting.is_some() {
            samples.level(&MAILBOX_OLDEST, [node, &label], micros(line.oldest_us.unwrap_or(0)));
        }
    }
}

/// Adds the ages of handled messages, with the labels of the node's other metrics.
pub(super) fn add_ages(samples: &mut Samples, tree: &TreeReport, node: &str, names: &mut AppNames) {
    for (line, ages) in tree.lines.iter().filter_map(|line| Some((line, line.ages.as_ref()?))) {
        samples.ages(&APP_AGE, [node, &names.label(&line.name)], ages);
    }
}

fn add_guards(samples: &mut Samples, answers: &Answers, node: &str, names: &mut AppNames) {
    for GuardReport { receiver, safe, is_safe_failed, .. } in &answers.node.guards {
        let app = answers.apps.apps.iter().find(|app| app.tid == *receiver);
        let label = names.label(app.and_then(|app| app.name.as_deref()).unwrap_or_default());
        samples.level(&GUARD_SAFE, [node, &label], truth(safe.is_some()));
        samples.level(&GUARD_FAILED, [node, &label], truth(*is_safe_failed));
        if let Some(cause) = safe {
            samples.level(&GUARD_CAUSE, [node, &label, &bounded(cause)], 1.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_of_applications_are_names_and_few() {
        let mut names = AppNames::default();
        for unnamed in ["", "127.0.0.2/80000001"] {
            assert_eq!(names.label(unnamed), OTHER);
        }
        assert_eq!(names.label("knee.drive"), "knee.drive");
        for number in 0..2 * NAMES_MAX {
            names.label(&format!("app{number}"));
        }
        assert_eq!(names.0.len(), NAMES_MAX);
        assert_eq!(names.label(&format!("app{}", 2 * NAMES_MAX - 1)), OTHER);
        assert_eq!(names.label("knee.drive"), "knee.drive");
    }
}
