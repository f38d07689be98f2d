//! The role of this process under `sinew play --check`: its applications run in virtual time, and no node starts.

use std::{
    fmt::Display,
    fs::{self, OpenOptions},
    io::{self, Write as _},
    iter,
    os::unix::fs::{MetadataExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, OnceLock},
    time::Duration,
};

use rustix::process::{Pid, geteuid, getppid};
use sinew_model::config::NodeConfig;
use sinew_replay::exchange::{self, CheckOrder, CheckOwner, CheckReport};
use sinew_runtime::{
    app::DynApp,
    lock,
    log::{self, LogObserver, tracing::Level},
    time::Time,
};

use crate::{StartError, SupervisorSpec};

/// Time limit at the end for writing this process's log.
const LOG_FLUSH_TIMEOUT: Duration = Duration::from_millis(500);
/// Maximum number of warnings that are kept, the first ones.
const WARNINGS_MAX: usize = 8;

/// Maximum number of processes between the command and this one, such as shells and `cargo run`.
const ANCESTORS_MAX: usize = 16;

/// Why this process is not checked, although the variable is set.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
enum OwnerError {
    /// The variable was left behind: the node starts.
    #[error("{0}")]
    LeftBehind(String),
    /// The check may run: its node must not start, because a check would become a robot that moves.
    #[error("{0}")]
    Unproved(String),
}

/// Returns the folder of the check, if `sinew play --check` has started this process. A variable that was left behind
/// has no effect: a warning in the log names it once.
///
/// # Errors
/// The check may run, and this process cannot be proved to belong to it.
fn folder() -> Result<Option<&'static Path>, String> {
    static FOLDER: OnceLock<Result<Option<PathBuf>, String>> = OnceLock::new();
    let found = FOLDER.get_or_init(|| {
        let path = std::env::var_os(exchange::VARIABLE).filter(|path| !path.is_empty());
        let Some(path) = path.map(PathBuf::from) else { return Ok(None) };
        let (name, shown) = (exchange::VARIABLE, path.display());
        match check_owner(&path, Time::now(), ancestors()) {
            Ok(()) => Ok(Some(path)),
            Err(OwnerError::LeftBehind(why)) => {
                log::warn!("the environment variable {name}={shown} is ignored: {why}; unset it");
                Ok(None)
            }
            Err(OwnerError::Unproved(why)) => Err(format!(
                "the environment variable {name}={shown} names a check, and {why}; let `sinew play --check` start this \
                 program, directly or by a script, as the same user, or unset the variable"
            )),
        }
    });
    found.as_ref().map(Option::as_deref).map_err(Clone::clone)
}

/// Checks that the folder is that of a command that runs now and has started this process.
fn check_owner(folder: &Path, now: Time, mut ancestors: impl Iterator<Item = u32>) -> Result<(), OwnerError> {
    let unproved = |why: &str| Err(OwnerError::Unproved(why.to_owned()));
    let found = match fs::symlink_metadata(folder) {
        Ok(found) => found,
        Err(why) if why.kind() == io::ErrorKind::NotFound => {
            return Err(OwnerError::LeftBehind(format!("it names no folder: {why}")));
        }
        Err(why) => return unproved(&format!("its folder cannot be looked at: {why}")),
    };
    if !found.is_dir() || found.uid() != geteuid().as_raw() || found.mode() & 0o777 != 0o700 {
        return unproved("this is no folder of this user with the mode 0700");
    }
    let owner = exchange::read::<CheckOwner>(&folder.join(exchange::OWNER), exchange::OWNER_BYTES_MAX);
    let CheckOwner { process, from_ns, until_ns } = match owner {
        Ok(owner) => owner,
        Err(why) => return unproved(&format!("its folder names no command: {why}")),
    };
    if !(from_ns..=until_ns).contains(&now.as_nanos()) {
        return Err(OwnerError::LeftBehind("the check of this folder is over".to_owned()));
    }
    if !ancestors.any(|ancestor| ancestor == process) {
        return unproved(&format!("its command, process {process}, has not started this process"));
    }
    Ok(())
}

/// Returns the parent of this process, its parent, and so on.
fn ancestors() -> impl Iterator<Item = u32> {
    let parent = u32::try_from(Pid::as_raw(getppid())).ok();
    iter::successors(parent, |process| parent_of(*process)).take(ANCESTORS_MAX)
}

/// Returns the parent of a process; `None` if it has none, or has ended.
fn parent_of(process: u32) -> Option<u32> {
    let stat = fs::read(format!("/proc/{process}/stat")).ok()?;
    let stat = String::from_utf8_lossy(&stat);
    // The name of the process, in parentheses, may have any characters.
    let (_, behind_name) = stat.rsplit_once(") ")?;
    behind_name.split(' ').nth(1)?.parse().ok()
}

/// Returns whether `sinew play --check` has started this process.
pub(crate) fn is_asked() -> bool {
    folder().is_ok_and(|folder| folder.is_some())
}

/// Handles the builder of a node in a process that is checked. Returns whether the builder must not start the node.
/// Does not return if the recording has one of its applications.
///
/// # Errors
/// A check may run, and this process cannot be proved to belong to it.
pub(crate) fn takes_over(config: &NodeConfig, tree: &mut SupervisorSpec) -> Result<bool, StartError> {
    let Some(folder) = folder().map_err(StartError::Check)? else { return Ok(false) };
    let name = &config.name;
    note(format_args!("`sinew play --check` has started this program: the node {name} does not start"));
    let order = exchange::read::<CheckOrder>(&folder.join(exchange::ORDER), exchange::ORDER_BYTES_MAX);
    let order = match order {
        Ok(order) => order,
        Err(why) => end(folder, &CheckReport::Failed(format!("the program cannot read its order: {why}"))),
    };
    if tree.apps().iter().any(|app| order.tests(app.name())) {
        let tree = std::mem::replace(tree, SupervisorSpec::new(""));
        check(folder, &order, tree.into_apps());
    }
    declare(folder, config, &tree.apps());
    Ok(true)
}

/// Prints a line to standard error. If that has no reader, the exit code remains.
fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "sinew: {text}");
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

/// Writes the report, and ends the process: with code 0 only if all messages were those of the recording.
fn end(folder: &Path, report: &CheckReport) -> ! {
    let written = exchange::write(&folder.join(exchange::REPORT), report);
    if let Err(why) = &written {
        note(format_args!("the report of the check cannot be written: {why}; free space on its device"));
    }
    log::flush(LOG_FLUSH_TIMEOUT);
    let is_fine = written.is_ok() && matches!(report, CheckReport::Identical { .. });
    std::process::exit(i32::from(!is_fine))
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
    use std::os::unix::fs::{DirBuilderExt as _, PermissionsExt as _};

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

    /// A folder of one test, which is removed at its end.
    struct TestFolder(PathBuf);

    impl TestFolder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("sinew-check-{name}-{}", std::process::id()));
            let _ = fs::remove_dir_all(&path);
            fs::DirBuilder::new().mode(0o700).create(&path).unwrap();
            Self(path)
        }
    }

    impl Drop for TestFolder {
        fn drop(&mut self) {
            // The system clears the folder of temporary files, too.
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    fn check(folder: &Path, at_s: u64, ancestors: &[u32]) -> Result<(), OwnerError> {
        check_owner(folder, Time::ZERO + Duration::from_secs(at_s), ancestors.iter().copied())
    }

    /// Returns whether the node must not start, for a reason with these words.
    fn refuses(folder: &Path, at_s: u64, ancestors: &[u32], words: &str) -> bool {
        matches!(check(folder, at_s, ancestors), Err(OwnerError::Unproved(why)) if why.contains(words))
    }

    /// Returns whether the variable has no effect, for a reason with these words.
    fn ignores(folder: &Path, at_s: u64, ancestors: &[u32], words: &str) -> bool {
        matches!(check(folder, at_s, ancestors), Err(OwnerError::LeftBehind(why)) if why.contains(words))
    }

    #[test]
    fn only_children_of_a_running_command_are_checked() {
        let folder = TestFolder::new("owner");
        assert!(refuses(&folder.0, 15, &[7], "names no command"));
        let owner = CheckOwner { process: 7, from_ns: 10_000_000_000, until_ns: 20_000_000_000 };
        exchange::write(&folder.0.join(exchange::OWNER), &owner).unwrap();
        assert_eq!(check(&folder.0, 15, &[7]), Ok(()));
        assert_eq!(check(&folder.0, 15, &[9, 7, 1]), Ok(()), "a script has started it");
        assert!(refuses(&folder.0, 15, &[9, 1], "process 7"), "a robot would start during the check");
        for at_s in [9, 21] {
            assert!(ignores(&folder.0, at_s, &[7], "is over") && ignores(&folder.0, at_s, &[1], "is over"));
        }
        fs::set_permissions(&folder.0, fs::Permissions::from_mode(0o755)).unwrap();
        assert!(refuses(&folder.0, 15, &[7], "0700"));
        assert!(refuses(Path::new("/dev/null"), 15, &[7], "0700"));
        assert!(ignores(&folder.0.join("absent"), 15, &[7], "no folder"));
    }

    #[test]
    fn parents_are_found_up_to_the_first_process() {
        let found: Vec<_> = ancestors().collect();
        assert!(!found.is_empty() && found.len() <= ANCESTORS_MAX, "{found:?}");
        assert_eq!(parent_of(std::process::id()), found.first().copied());
    }

    #[test]
    fn ordinary_process_starts_its_node() {
        assert!(!is_asked(), "the tests run without the variable");
        let takes_over = takes_over(&NodeConfig::new("knee"), &mut SupervisorSpec::new("applications"));
        assert!(matches!(takes_over, Ok(false)));
    }
}
