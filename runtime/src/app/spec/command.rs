//! An application that is a command: any program, which its node starts, supervises and stops.

use std::{path::PathBuf, sync::Arc, time::Duration};

use actix::Actor;

use super::AppSpec;
use crate::{
    app::{AppContext, RequirementPolicy},
    supervision::Place,
};

/// Maximum number of words of a command: the program and its arguments.
pub const COMMAND_WORDS_MAX: usize = 64;
/// Time for an orderly stop of a command, from SIGTERM to SIGKILL.
const STOP_WITHIN: Duration = Duration::from_secs(2);

/// The actor type of an application that is a [command](AppSpec::command). It has no values: the messages go to the
/// program.
///
/// # Examples
///
/// ```
/// use sinew::{app::Program, prelude::*};
///
/// fn python(name: &str, file: &str) -> AppSpec<Program> {
///     AppSpec::command(name, ["python3", "-u", file]).while_down(DownPolicy::Drop)
/// }
/// ```
#[derive(Debug)]
pub enum Program {}

impl Actor for Program {
    type Context = AppContext<Self>;
}

/// The program of an application that is a [command](AppSpec::command).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CommandLine {
    /// The program, by its path or its name in `PATH`, and its arguments.
    pub words: Vec<String>,
    /// The working directory of the program; `None`: that of the node.
    pub folder: Option<PathBuf>,
    /// The condition for its readiness.
    pub readiness: CommandReadiness,
}

/// When a command is ready.
///
/// # Examples
///
/// ```
/// use sinew::{app::CommandReadiness, prelude::*};
///
/// // Its driver opens the device after it has registered.
/// let knee = AppSpec::command("knee.drive", ["python3", "knee.py"]).readiness(CommandReadiness::Called);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CommandReadiness {
    /// When its program has registered the application's name.
    #[default]
    Registered,
    /// When its program has registered the name, and has called `ready`.
    Called,
}

impl AppSpec<Program> {
    /// Declares an application that is a command: the node starts this program, restarts it and stops it, by the same
    /// rules as an application with [`own_process`](Self::own_process). `words` are the program and its arguments.
    ///
    /// The program joins at the socket of the node (`lncl.socket`): it registers the application's name with a
    /// client, in any language. The name belongs to it: the node refuses the name to processes that it did not start
    /// for this application. The environment has the path of the socket (`SINEW_SOCKET`) and the name (`SINEW_NAME`).
    ///
    /// - It is ready when it has registered, or as [`readiness`](Self::readiness) says. Without that it is killed
    ///   after [`start_within`](Self::start_within), and started again.
    /// - A stop sends SIGTERM to its process group, and SIGKILL after [`stop_within`](Self::stop_within), here 2 s.
    /// - With [`progress_within`](Self::progress_within) a program that neither reads nor sends for so long counts as
    ///   hung. Here the default is no limit.
    /// - Exit code 0 is an end in order. Each other exit code, and each signal, is a failure.
    /// - Lines of its standard output and standard error go to the node's log.
    ///
    /// The node starts its own program again, which becomes this command. So the code before the start of the node runs
    /// in that process, too, as for `own_process`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// let knee = AppSpec::command("knee.drive", ["python3", "knee.py"])
    ///     .requires(["knee.imu"])
    ///     .progress_within(Duration::from_millis(200));
    /// let node = Node::builder("knee")
    ///     .configure(|config| config.lncl.socket = Some("/run/sinew/knee.sock".into()))
    ///     .app(knee);
    /// ```
    pub fn command<W: Into<String>>(name: impl Into<String>, words: impl IntoIterator<Item = W>) -> Self {
        let no_actor = || Err("it is a command, which only a node can start".to_owned());
        let mut spec = Self::made_by(name.into(), Arc::new(no_actor)).place(Place::process());
        spec.common.policy.progress_within = None;
        spec.common.policy.stop_within = STOP_WITHIN;
        let words = words.into_iter().map(Into::into).collect();
        spec.common.command =
            Some(CommandLine { words, folder: None, readiness: CommandReadiness::default() });
        spec
    }

    /// Sets the working directory of the program. Default: that of the node.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// let knee = AppSpec::command("knee.drive", ["./knee"]).folder("/opt/knee");
    /// ```
    #[must_use]
    pub fn folder(mut self, folder: impl Into<PathBuf>) -> Self {
        if let Some(line) = &mut self.common.command {
            line.folder = Some(folder.into());
        }
        self
    }

    /// Sets when the application is ready. Default: when its program has registered.
    #[must_use]
    pub const fn readiness(mut self, readiness: CommandReadiness) -> Self {
        if let Some(line) = &mut self.common.command {
            line.readiness = readiness;
        }
        self
    }
}

impl CommandLine {
    /// Returns the error in this declaration, as a text, if it has one.
    pub(super) fn fault(&self, place: &Place, on_lost: RequirementPolicy) -> Option<String> {
        let Self { words, folder, .. } = self;
        if words.first().is_none_or(String::is_empty) {
            return Some("its command names no program; write it as the first word".to_owned());
        }
        if words.len() > COMMAND_WORDS_MAX {
            let found = words.len();
            return Some(format!(
                "its command has {found} words, and may have {COMMAND_WORDS_MAX}; write a script"
            ));
        }
        let folder = folder.iter().map(|folder| folder.as_os_str().as_encoded_bytes());
        if words.iter().map(String::as_bytes).chain(folder).any(|bytes| bytes.contains(&0)) {
            return Some("its command has a zero byte, which no argument can have; remove it".to_owned());
        }
        if on_lost != RequirementPolicy::CarryOn {
            let why = "it is a command: its program handles the loss of a requirement itself; remove that policy, and let it get `RequirementEvent`";
            return Some(why.to_owned());
        }
        let is_placed = !place.own_process || place.realtime_priority.is_some() || place.cpu.is_some();
        is_placed.then(|| {
            "it is a command: its program sets its threads itself (`chrt`, `taskset`); remove its place"
                .to_owned()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::DynApp;

    fn fault(spec: AppSpec<Program>) -> Option<String> {
        DynApp::from(spec).fault()
    }

    #[test]
    fn command_needs_a_program_and_no_thread() {
        let knee = || AppSpec::command("knee", ["python3", "knee.py"]);
        assert_eq!(fault(knee()), None);
        assert_eq!(fault(knee().folder("/opt/knee").readiness(CommandReadiness::Called)), None);
        let wrong = [
            (AppSpec::command("knee", [""; 0]), "names no program"),
            (AppSpec::command("knee", ["", "knee.py"]), "names no program"),
            (AppSpec::command("knee", ["x"; COMMAND_WORDS_MAX + 1]), "65 words"),
            (AppSpec::command("knee", ["python3", "a\0b"]), "zero byte"),
            (knee().folder("a\0b"), "zero byte"),
            (knee().on_requirement_lost(RequirementPolicy::Restart), "RequirementEvent"),
            (knee().own_thread(), "remove its place"),
            (knee().place(Place::process().on_cpu(1)), "remove its place"),
        ];
        for (spec, words) in wrong {
            let why = fault(spec).expect("it cannot be started");
            assert!(why.contains(words), "{why}");
        }
    }
}
