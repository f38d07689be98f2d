//! Children added, stopped, started again and removed while the node runs.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        atomic::Ordering,
        mpsc::{RecvTimeoutError, SyncSender},
    },
    time::Duration,
};

use sinew_runtime::{
    app::DynApp,
    supervision::{ChildId, Command, Input, Refusal, SupervisorFact},
};

use super::{
    NodeHandle, StartError, Told,
    layers::{self, LAYERS},
    root::{Phase, Root, RootEvent},
};

/// Time for an answer. A child's stop may take as long as it was given; its supervisor goes on with it when nobody waits.
const WITHIN: Duration = Duration::from_secs(10);

/// Why a change of the supervision tree was not made, or is not known to be.
///
/// # Examples
///
/// ```
/// use sinew::{NodeHandle, node::CommandError};
///
/// fn stop_camera(handle: &NodeHandle) -> Result<(), CommandError> {
///     match handle.stop_app("camera") {
///         Err(CommandError::Unknown(_)) => Ok(()), // this robot has none
///         other => other,
///     }
/// }
/// ```
#[derive(Debug, thiserror::Error)]
pub enum CommandError {
    /// Nobody has this name. Nothing has changed.
    #[error("no application and no supervisor of this node is called '{0}'; `NodeHandle::tree` lists them")]
    Unknown(String),
    /// New children go under supervisors only. Nothing has changed.
    #[error("'{0}' is an application; children are added under a supervisor")]
    NotASupervisor(String),
    /// A layer is not at the user's command. Nothing has changed.
    #[error(
        "'{0}' is a layer of the node: it lives as long as the node does, which restarts it when it fails; to end both, \
         `NodeHandle::stop`"
    )]
    Layer(String),
    /// A supervisor that the node has by itself is not at the user's command. Nothing has changed.
    #[error(
        "'{0}' is a supervisor of the node's own, and lives as long as the node does; name one of its applications, or \
         end all with `NodeHandle::stop`"
    )]
    OwnSupervisor(String),
    /// The node's root has more orders than it can keep. Nothing has changed.
    #[error("the node's root has more orders waiting than it can keep; try again, and not so often")]
    Busy,
    /// The supervisor refuses. Nothing has changed.
    #[error("'{name}': {why}")]
    Refused {
        /// Whom it was about.
        name: String,
        /// Why.
        why: Refusal,
    },
    /// The application cannot be registered: its name is taken, for instance. Nothing has changed.
    #[error(transparent)]
    Start(#[from] StartError),
    /// A process of its own needs an application that the program declares before its node starts. Nothing has changed.
    #[error("'{0}' has a process of its own; such applications are declared before the node starts")]
    OwnProcess(String),
    /// The node does not run. Nothing has changed.
    #[error("the node does not run")]
    NotRunning,
    /// No answer in time. What was ordered may still happen.
    #[error("no answer within {WITHIN:?}; what was ordered for '{0}' may still happen")]
    NoAnswer(String),
}

/// An order by the node's owner, and where its answer goes.
pub(crate) struct Ordered {
    what: What,
    answer: SyncSender<Result<(), CommandError>>,
}

enum What {
    Add(Box<DynApp>, Option<String>),
    Tell(Command, String),
}

impl std::fmt::Debug for Ordered {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.what {
            What::Add(app, under) => write!(f, "Add({} under {under:?})", app.name()),
            What::Tell(command, name) => write!(f, "{command:?}({name})"),
        }
    }
}

/// Who waits for the answers to commands.
#[derive(Default)]
pub(super) struct Answers(BTreeMap<ChildId, VecDeque<Waits>>);

struct Waits {
    command: Command,
    name: String,
    answer: SyncSender<Result<(), CommandError>>,
}

impl NodeHandle {
    /// Adds an application while the node runs, as the last child of the supervisor called `under`; of the one that the
    /// builder's applications have, if `None`. Returns when it is taken in; it starts when what it requires is ready, and
    /// [`wait_until_running`](Self::wait_until_running) waits for it too. Supervisors, and applications in processes of their
    /// own, are declared when the node is built; under a supervisor that was, applications come and go.
    ///
    /// # Errors
    /// Why it was not added. All variants but [`CommandError::NoAnswer`] say that nothing has changed.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{node::CommandError, prelude::*};
    ///
    /// struct Recorder;
    /// # impl Actor for Recorder { type Context = AppContext<Self>; }
    ///
    /// /// Begins to record while the robot walks.
    /// fn record(handle: &sinew::NodeHandle) -> Result<(), CommandError> {
    ///     handle.add_app(AppSpec::new("recorder", || Recorder), None)
    /// }
    /// ```
    pub fn add_app(&self, app: impl Into<DynApp>, under: Option<&str>) -> Result<(), CommandError> {
        let app = app.into();
        let name = app.name().to_owned();
        self.order(What::Add(Box::new(app), under.map(str::to_owned)), name)
    }

    /// Stops an application, or a supervisor with all its children, and does not start it again. It keeps its place and an
    /// application its TID, until [`restart_app`](Self::restart_app) or [`remove_app`](Self::remove_app); one that is
    /// temporary is removed at once. Messages to it are refused meanwhile. As in OTP, a restart of its whole group starts it
    /// again. Returns when it has stopped.
    ///
    /// # Errors
    /// Why it was not stopped.
    pub fn stop_app(&self, name: &str) -> Result<(), CommandError> {
        self.order(What::Tell(Command::Terminate, name.to_owned()), name.to_owned())
    }

    /// Starts a child again that was stopped or has ended by itself. Returns when that is ordered.
    ///
    /// # Errors
    /// Why not: it runs, for instance.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{NodeHandle, node::CommandError};
    ///
    /// /// Has the camera read its calibration again.
    /// fn restart_camera(handle: &NodeHandle) -> Result<(), CommandError> {
    ///     handle.stop_app("camera")?;
    ///     handle.restart_app("camera")
    /// }
    /// ```
    pub fn restart_app(&self, name: &str) -> Result<(), CommandError> {
        self.order(What::Tell(Command::Restart, name.to_owned()), name.to_owned())
    }

    /// Removes a child that was stopped or has ended by itself: its name and its TID are free again.
    ///
    /// # Errors
    /// Why not: it runs, for instance.
    pub fn remove_app(&self, name: &str) -> Result<(), CommandError> {
        self.order(What::Tell(Command::Delete, name.to_owned()), name.to_owned())
    }

    fn order(&self, what: What, name: String) -> Result<(), CommandError> {
        if self.is_bystander || self.stores.stopping.load(Ordering::Relaxed) {
            return Err(CommandError::NotRunning);
        }
        let (answer, answered) = std::sync::mpsc::sync_channel(1);
        match self.tell(RootEvent::Ordered(Ordered { what, answer })) {
            Told::Taken => {}
            Told::TooMany => return Err(CommandError::Busy),
            Told::HasEnded => return Err(CommandError::NotRunning),
        }
        match answered.recv_timeout(WITHIN) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Timeout) => Err(CommandError::NoAnswer(name)),
            Err(RecvTimeoutError::Disconnected) => Err(CommandError::NotRunning),
        }
    }
}

impl Root {
    pub(super) fn ordered(&mut self, ordered: Ordered) {
        let Ordered { what, answer } = ordered;
        let given = match what {
            What::Add(app, under) => {
                let name = app.name().to_owned();
                let added = self.add(&app, under.as_deref());
                // Not here: what it captured is the user's, and if it was not added, nobody else holds it.
                self.burials.bury(name.clone(), app);
                added.map(|id| (id, Command::Add, name))
            }
            What::Tell(command, name) => self.command(command, &name).map(|id| (id, command, name)),
        };
        match given {
            Ok((id, command, name)) => {
                self.answers.0.entry(id).or_default().push_back(Waits { command, name, answer });
            }
            // Who asked may have stopped waiting.
            Err(error) => _ = answer.try_send(Err(error)),
        }
    }

    fn add(&mut self, app: &DynApp, under: Option<&str>) -> Result<ChildId, CommandError> {
        let (Phase::Running, Some(roster)) = (self.phase, self.app_supervisor.clone()) else {
            return Err(CommandError::NotRunning);
        };
        if app.place().own_process {
            return Err(CommandError::OwnProcess(app.name().to_owned()));
        }
        let under = match under {
            None => roster.top(),
            Some(name) => self.named(name)?,
        };
        if self.apps.contains(under) {
            return Err(CommandError::NotASupervisor(
                roster.who(under).map_or_else(String::new, |who| who.name),
            ));
        }
        if self.apps.named(app.name()).is_some() {
            return Err(StartError::SameName(app.name().to_owned()).into());
        }
        self.apps.check_place(app)?;
        let spec = self.register(app)?;
        let id = spec.id;
        if let Err(spec) = roster.bring(under, spec) {
            self.burials.bury(spec.name.clone(), spec);
            self.apps.remove(&self.stores, id);
            self.absences.forget(id);
            return Err(CommandError::Busy);
        }
        Ok(id)
    }

    fn named(&self, name: &str) -> Result<ChildId, CommandError> {
        let unknown = || match name {
            layers::SUPERVISOR => CommandError::OwnSupervisor(name.to_owned()),
            layer if LAYERS.contains(&layer) => CommandError::Layer(name.to_owned()),
            _ => CommandError::Unknown(name.to_owned()),
        };
        self.apps.named(name).ok_or_else(unknown)
    }

    fn command(&self, command: Command, name: &str) -> Result<ChildId, CommandError> {
        let (Phase::Running, Some(roster)) = (self.phase, &self.app_supervisor) else {
            return Err(CommandError::NotRunning);
        };
        let id = self.named(name)?;
        if id == roster.top() {
            return Err(CommandError::OwnSupervisor(name.to_owned()));
        }
        let input = match command {
            Command::Terminate => Input::TerminateChild(id),
            Command::Restart => Input::RestartChild(id),
            Command::Delete => Input::DeleteChild(id),
            Command::Add => return Err(CommandError::Unknown(name.to_owned())),
        };
        roster.tell(input).map_err(|_| CommandError::Busy)?;
        Ok(id)
    }

    /// The answer of a supervisor to a command.
    pub(super) fn answered(&mut self, fact: &SupervisorFact) {
        let (command, id, refused) = match fact {
            SupervisorFact::Done(command, id) => (*command, *id, None),
            SupervisorFact::Refused(command, id, why) => (*command, *id, Some(*why)),
            SupervisorFact::Starting(..)
            | SupervisorFact::Ready(_)
            | SupervisorFact::Failed(..)
            | SupervisorFact::Gone(..)
            | SupervisorFact::Deleted(_)
            | SupervisorFact::AllReady
            | SupervisorFact::Ended(_) => return,
        };
        if command == Command::Add && refused.is_some() {
            self.apps.remove(&self.stores, id);
        }
        let Some(waiting) = self.answers.0.get_mut(&id) else { return };
        if let Some(index) = waiting.iter().position(|waits| waits.command == command) {
            let waits = waiting.remove(index).expect("its place was found just now");
            let answer = refused.map_or(Ok(()), |why| Err(CommandError::Refused { name: waits.name, why }));
            // Who asked may have stopped waiting.
            let _ = waits.answer.try_send(answer);
        }
        if self.answers.0.get(&id).is_some_and(VecDeque::is_empty) {
            self.answers.0.remove(&id);
        }
    }

    /// Nobody is left who could answer.
    pub(super) fn answer_all_that_wait(&mut self) {
        for waits in std::mem::take(&mut self.answers.0).into_values().flatten() {
            // Who asked may have stopped waiting.
            let _ = waits.answer.try_send(Err(CommandError::NotRunning));
        }
    }
}
