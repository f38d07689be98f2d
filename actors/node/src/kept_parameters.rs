//! Kept parameters: values that survive a restart of the node, in a file of its state directory.
//!
//! The values are read before the applications start. Later the thread `params` replaces the file after each change of
//! a kept parameter, so no control loop waits for a disk.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        mpsc::{Receiver, sync_channel},
    },
    thread,
};

use sinew_model::{context::NodeContext, thread_priority::lower_priority};
use sinew_runtime::{
    app::DynApp,
    log,
    name::shown,
    parameters::{self, Parameters, file},
    remedy::{Wanted, remedy},
};
use sinew_security::{files, state_files};

/// The file, and the parameters in it.
struct KeptParameters {
    path: PathBuf,
    apps: Vec<(String, Arc<dyn Parameters>)>,
    /// The values of applications that this program does not have. They stay in the file.
    others: file::ValuesOfApps,
}

/// Restores the kept values of these applications, and has later ones written, if the node has a state directory.
/// Applications in processes of their own have their parameters there, and are left out.
pub(super) fn keep(context: &NodeContext, apps: &[&DynApp]) {
    let Some(directory) = &context.config.state else { return };
    let hosted_here = apps.iter().filter(|app| !app.place().own_process);
    let with_parameters = hosted_here.filter_map(|app| Some((*app, app.parameters()?.clone())));
    let has_kept = |set: &Arc<dyn Parameters>| !parameters::kept_values(&**set).is_empty();
    let with_kept: Vec<_> = with_parameters.filter(|(_, set)| has_kept(set)).collect();
    if with_kept.is_empty() {
        return;
    }
    let path = state_files::path(directory, "parameters", &context.config.project, context.node);
    let named = with_kept.iter().map(|(app, set)| (app.name().to_owned(), set.clone()));
    let mut kept = KeptParameters { path, apps: named.collect(), others: file::ValuesOfApps::new() };
    kept.restore();
    let (notify, changed) = sync_channel(1);
    for (app, _) in &with_kept {
        let notify = notify.clone();
        // If the channel is full, a change is not written yet: that write has this one, too.
        app.on_kept_change(move || {
            let _ = notify.try_send(());
        });
    }
    let path = kept.path.clone();
    let started =
        thread::Builder::new().name("params".to_owned()).spawn(move || kept.write_changes(&changed));
    if let Err(error) = started {
        let remedy = remedy(Wanted::Thread, &error);
        log::warn!(?path, "kept parameters are not written, as there is no thread for it: {error}; {remedy}");
    }
}

impl KeptParameters {
    /// Gives the parameters their values in the file. A value that is not legal any more is left out.
    fn restore(&mut self) {
        let values = self.read().and_then(|text| file::parse(&text.unwrap_or_default()));
        let mut values = values.unwrap_or_else(|why| {
            self.set_aside(&why);
            file::ValuesOfApps::new()
        });
        for (application, set) in &self.apps {
            let Some(values) = values.remove(application) else { continue };
            for why in parameters::restore(&**set, &values) {
                let (path, why) = (&self.path, shown(&why.to_string()));
                log::warn!(application, ?path, "a kept value is left out, and begins at its default: {why}");
            }
        }
        self.others = values;
    }

    /// Renames a file that cannot be used: the next change would replace it, and the values of all applications.
    fn set_aside(&self, why: &str) {
        let mut aside = self.path.clone().into_os_string();
        aside.push(".unusable");
        let aside = PathBuf::from(aside);
        let (path, why) = (&self.path, shown(why));
        match std::fs::rename(path, &aside) {
            Ok(()) => log::warn!(
                ?path,
                "kept parameters begin at their defaults: {why}; the file is {} now: correct it, and rename it while the node is stopped",
                aside.display()
            ),
            Err(error) => log::warn!(
                ?path,
                "kept parameters begin at their defaults: {why}; correct the file, or delete it: it cannot be renamed ({error})"
            ),
        }
    }

    /// Returns the text of the file; `None` if there is none yet.
    fn read(&self) -> Result<Option<String>, String> {
        let bytes = files::own(&self.path, file::FILE_BYTES_MAX).map_err(|why| why.to_string())?;
        bytes.map(|bytes| String::from_utf8(bytes.to_vec())).transpose().map_err(|error| error.to_string())
    }

    /// Replaces the file after each change, until all applications are gone.
    fn write_changes(&self, changed: &Receiver<()>) {
        lower_priority();
        let mut has_failed = false;
        while changed.recv().is_ok() {
            let written = state_files::replace(&self.path, self.text().as_bytes());
            if let Err(why) = &written
                && !has_failed
            {
                log::warn!(path = ?self.path, "kept parameters are not written: {why}");
            }
            has_failed = written.is_err();
        }
    }

    /// Returns the content of the file.
    fn text(&self) -> String {
        let own = self.apps.iter().map(|(name, set)| (name.clone(), parameters::kept_values(&**set)));
        file::text(&self.others.clone().into_iter().chain(own).collect())
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::parameters::{NamedValue, Value};
    use sinew_security::testing::Directory;

    use super::*;

    sinew::params! {
        struct Gains {
            /// A gain.
            gain: f64 = 0.5, unit "1", range 0.0..=1.0, keep;
            /// A number of steps.
            steps: i64 = 4, unit "1", range 1..=16, keep;
        }
    }

    /// The knee's parameters, which are kept in this file.
    fn kept(path: PathBuf) -> (Arc<Gains>, KeptParameters) {
        let gains = Gains::new();
        let apps: Vec<(String, Arc<dyn Parameters>)> = vec![("knee".to_owned(), gains.clone())];
        (gains, KeptParameters { path, apps, others: file::ValuesOfApps::new() })
    }

    #[test]
    fn legal_values_are_restored_and_other_applications_keep_theirs() {
        let directory = Directory::new();
        let text = "[hip]\ngain = 0.25\n\n[knee]\ngain = 7.0\nsteps = 9\n";
        directory.put("parameters", 0o600, text);
        let (gains, mut kept) = kept(directory.path().join("parameters"));
        kept.restore();
        assert_eq!((gains.gain.get(), gains.steps.get()), (0.5, 9));
        let values = file::parse(&kept.text()).expect("it is its own text");
        let named = |name: &str, value| NamedValue { name: name.to_owned(), value };
        assert_eq!(values["hip"], [named("gain", Value::Number(0.25))]);
        assert_eq!(values["knee"], [named("gain", Value::Number(0.5)), named("steps", Value::Integer(9))]);
    }

    #[test]
    fn unusable_file_leaves_the_defaults() {
        let directory = Directory::new();
        for text in ["knee", "knee = 1", "[knee]\ngain = 'fast'\n", "\u{0}"] {
            directory.put("parameters", 0o600, text);
            let (gains, mut kept) = kept(directory.path().join("parameters"));
            kept.restore();
            assert_eq!((gains.gain.get(), gains.steps.get()), (0.5, 4), "{text:?}");
            // It is not lost by the next change.
            let aside = std::fs::read_to_string(directory.path().join("parameters.unusable"));
            assert_eq!(aside.expect("it was renamed"), text);
            assert!(!directory.path().join("parameters").exists());
        }
        let (gains, mut kept) = kept(directory.path().join("absent"));
        kept.restore();
        assert_eq!(gains.gain.get(), 0.5);
    }
}
