//! The role of this process under `sinew play --check`: its applications run in virtual time, and no node starts.

use std::{
    fs::OpenOptions,
    io::{self, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
    time::Duration,
};

use sinew_model::config::NodeConfig;
use sinew_replay::exchange::{self, CheckOrder, CheckReport};
use sinew_runtime::{
    app::DynApp,
    lock,
    log::{self, LogObserver, tracing::Level},
};

use crate::SupervisorSpec;

/// Time limit at the end for writing this process's log.
const LOG_FLUSH_TIMEOUT: Duration = Duration::from_millis(500);
/// Maximum number of warnings that are kept, the first ones.
const WARNINGS_MAX: usize = 8;

/// Returns the folder of the check, if `sinew play --check` has started this process.
fn folder() -> Option<PathBuf> {
    std::env::var_os(exchange::VARIABLE).filter(|path| !path.is_empty()).map(PathBuf::from)
}

/// Returns whether `sinew play --check` has started this process.
pub(crate) fn is_asked() -> bool {
    folder().is_some()
}

/// Handles the builder of a node in a process that is checked. Returns whether the builder must not start the node.
/// Does not return if the recording has one of its applications.
pub(crate) fn takes_over(config: &NodeConfig, tree: &mut SupervisorSpec) -> bool {
    let Some(folder) = folder() else { return false };
    let order = exchange::read::<CheckOrder>(&folder.join(exchange::ORDER), exchange::ORDER_BYTES_MAX);
    let order = match order {
        Ok(order) => order,
        Err(why) => end(&folder, &CheckReport::Failed(format!("the program cannot read its order: {why}"))),
    };
    if tree.apps().iter().any(|app| order.tests(app.name())) {
        let tree = std::mem::replace(tree, SupervisorSpec::new(""));
        check(&folder, &order, tree.into_apps());
    }
    declare(&folder, config, &tree.apps());
    true
}

/// Runs the check, then ends this process.
fn check(folder: &Path, order: &CheckOrder, apps: Vec<DynApp>) -> ! {
    let warnings = Arc::new(Warnings::default());
    let observer: Arc<dyn LogObserver> = warnings.clone();
    // A process has fewer observers than there is room for.
    log::observe(&observer);
    let mut report = order.run(apps);
    log::flush(LOG_FLUSH_TIMEOUT);
    if let CheckReport::Differs(difference) = &mut report
        && let Some(misfit) = &mut difference.misfit
        && let Some(refused) = warnings.first_refused()
    {
        *misfit = format!("{misfit}: {refused}");
    }
    end(folder, &report)
}

fn end(folder: &Path, report: &CheckReport) -> ! {
    let written = exchange::write(&folder.join(exchange::REPORT), report);
    if let Err(why) = &written {
        // If standard error has no reader, only the exit code remains.
        let _ = writeln!(io::stderr(), "the report of the check cannot be written: {why}");
    }
    log::flush(LOG_FLUSH_TIMEOUT);
    std::process::exit(i32::from(written.is_err()))
}

/// Reports the applications of a builder that the recording does not have.
fn declare(folder: &Path, config: &NodeConfig, apps: &[&DynApp]) {
    let names: Vec<_> = apps.iter().map(|app| app.name()).collect();
    let path = folder.join(exchange::DECLARED);
    let file = OpenOptions::new().append(true).create(true).mode(0o600).open(path);
    // Without it the command reports that the program has not answered.
    let _ = file.and_then(|mut file| writeln!(file, "node {}: {}", config.name, names.join(", ")));
}

/// The first warnings of this process's log.
#[derive(Debug, Default)]
struct Warnings(Mutex<Vec<String>>);

impl Warnings {
    /// Returns the first warning about a message that an application could not decode.
    fn first_refused(&self) -> Option<String> {
        let warnings = lock(&self.0);
        let refused = warnings.iter().find(|text| text.contains("this is not a "));
        refused.cloned()
    }
}

impl LogObserver for Warnings {
    fn wrote(&self, level: Level, _: &str, text: &str) {
        if level > Level::WARN {
            return;
        }
        let mut warnings = lock(&self.0);
        if warnings.len() < WARNINGS_MAX {
            warnings.push(text.to_owned());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_warnings_are_kept_and_searched() {
        let warnings = Warnings::default();
        warnings.wrote(Level::INFO, "sinew", "this is not a warning");
        for number in 0..2 * WARNINGS_MAX {
            warnings.wrote(Level::WARN, "sinew", &format!("{number}: this is not a demo.angle"));
        }
        assert_eq!(warnings.first_refused().as_deref(), Some("0: this is not a demo.angle"));
        assert_eq!(lock(&warnings.0).len(), WARNINGS_MAX);
    }

    #[test]
    fn ordinary_process_starts_its_node() {
        assert!(!is_asked(), "the tests run without the variable");
        assert!(!takes_over(&NodeConfig::new("knee"), &mut SupervisorSpec::new("applications")));
    }
}
