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
    supervision::{ChildCommandError, ChildId, Command, Input, SupervisorFact},
};

use super::{
    NodeHandle, OrderStatus, StartError,
    layers::{self, LAYERS},
    root::{Phase, Root, RootEvent},
};

/// Time limit for an answer. The stop of a child may take as long as its own limit; its supervisor completes
/// it even if the caller stops waiting.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Why a change of the supervision tree failed, or is not known to have succeeded.
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
    /// No child has this name. Nothing has changed.
    #[error("no application and no supervisor of this node is called '{0}'; `NodeHandle::tree` lists them")]
    Unknown(String),
    /// Children can only be added under supervisors. Nothing has changed.
    #[error("'{0}' is an application; children are added under a supervisor")]
    NotASupervisor(String),
    /// Commands cannot change a layer. Nothing has changed.
    #[error(
        "'{0}' is a layer of the node: it runs as long as the node does, which restarts it when it fails; to end both, \
         `NodeHandle::stop`"
    )]
    Layer(String),
    /// Commands cannot change a supervisor of the node itself. Nothing has changed.
    #[error(
        "'{0}' is a supervisor of the node's own, and runs as long as the node does; name one of its applications, or \
         end all with `NodeHandle::stop`"
    )]
    OwnSupervisor(String),
    /// The root's order queue is full. Nothing has changed.
    #[error("the node's root has more orders waiting than it can keep; try again, and not so often")]
    Busy,
    /// The supervisor refuses. Nothing has changed.
    #[error("'{name}': {why}")]
    Refused {
        /// The child.
        name: String,
        /// The cause.
        why: ChildCommandError,
    },
    /// The application cannot be registered, for example because its name is taken. Nothing has changed.
    #[error(transparent)]
    Start(#[from] StartError),
    /// Only applications declared before the node starts can have a process of their own. Nothing has changed.
    #[error("'{0}' has a process of its own; such applications are declared before the node starts")]
    OwnProcess(String),
    /// The node does not run. Nothing has changed.
    #[error("the node does not run")]
    NotRunning,
    /// No answer in time. The order may still be executed.
    #[error("no answer within {ANSWER_TIMEOUT:?}; what was ordered for '{0}' may still happen")]
    NoAnswer(String),
}

/// An order of the node's owner, and the channel for its answer.
pub(crate) struct Ordered {
    kind: OrderKind,
    answer: SyncSender<Result<(), CommandError>>,
}

enum OrderKind {
    Add(Box<DynApp>, Option<String>),
    Command(Command, String),
}

impl std::fmt::Debug for Ordered {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.kind {
            OrderKind::Add(app, under) => write!(f, "Add({} under {under:?})", app.name()),
            OrderKind::Command(command, name) => write!(f, "{command:?}({name})"),
        }
    }
}

/// Callers that wait for the answers to commands.
#[derive(Default)]
pub(super) struct Answers(BTreeMap<ChildId, VecDeque<PendingAnswer>>);

struct PendingAnswer {
    command: Command,
    name: String,
    answer: SyncSender<Result<(), CommandError>>,
}

impl NodeHandle {
    /// Adds an application while the node runs, as the last child of the supervisor called `under`; of the
    /// supervisor of the builder's applications, if `None`. Returns when it is added. It starts when its
    /// requirements are ready, and [`wait_until_running`](Self::wait_until_running) waits for it too.
    /// Supervisors, and applications in processes of their own, are declared when the node is built;
    /// applications can be added to and removed from these supervisors.
    ///
    /// # Errors
    /// The reason why it was not added. After all variants but [`CommandError::NoAnswer`] nothing has changed.
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
        self.order(OrderKind::Add(Box::new(app), under.map(str::to_owned)), name)
    }

    /// Stops an application, or a supervisor with all its children, and does not start it again. It keeps its
    /// place, and an application its TID, until [`restart_app`](Self::restart_app) or
    /// [`remove_app`](Self::remove_app); a temporary one is removed at once. Messages to it are refused
    /// meanwhile. As in OTP, a restart of its whole group starts it again. Returns when it has stopped.
    ///
    /// # Errors
    /// The reason why it was not stopped.
    pub fn stop_app(&self, name: &str) -> Result<(), CommandError> {
        self.order(OrderKind::Command(Command::Terminate, name.to_owned()), name.to_owned())
    }

    /// Starts a child again that was stopped or has ended. Returns when the start is ordered.
    ///
    /// # Errors
    /// The reason why it was not started, for example because it runs.
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
        self.order(OrderKind::Command(Command::Restart, name.to_owned()), name.to_owned())
    }

    /// Removes a child that was stopped or has ended: its name and its TID are free again.
    ///
    /// # Errors
    /// The reason why it was not removed, for example because it runs.
    pub fn remove_app(&self, name: &str) -> Result<(), CommandError> {
        self.order(OrderKind::Command(Command::Delete, name.to_owned()), name.to_owned())
    }

    fn order(&self, what: OrderKind, name: String) -> Result<(), CommandError> {
        if self.hosts_other_node || self.state.ctx.stopping.load(Ordering::Relaxed) {
            return Err(CommandError::NotRunning);
        }
        let (answer, answered) = std::sync::mpsc::sync_channel(1);
        match self.send_to_root(RootEvent::Ordered(Ordered { kind: what, answer })) {
            OrderStatus::Queued => {}
            OrderStatus::QueueFull => return Err(CommandError::Busy),
            OrderStatus::NodeEnded => return Err(CommandError::NotRunning),
        }
        match answered.recv_timeout(ANSWER_TIMEOUT) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Timeout) => Err(CommandError::NoAnswer(name)),
            Err(RecvTimeoutError::Disconnected) => Err(CommandError::NotRunning),
        }
    }
}

impl Root {
    pub(super) fn execute(&mut self, ordered: Ordered) {
        let Ordered { kind: what, answer } = ordered;
        let given = match what {
            OrderKind::Add(app, under) => {
                let name = app.name().to_owned();
                let added = self.add(&app, under.as_deref());
                // Not dropped here: its captured values belong to the user, and if it was not added, there is
                // no other owner.
                self.drop_queue.push(name.clone(), app);
                added.map(|id| (id, Command::Add, name))
            }
            OrderKind::Command(command, name) => self.command(command, &name).map(|id| (id, command, name)),
        };
        match given {
            Ok((id, command, name)) => {
                self.answers.0.entry(id).or_default().push_back(PendingAnswer { command, name, answer });
            }
            // The caller may have stopped waiting.
            Err(error) => _ = answer.try_send(Err(error)),
        }
    }

    fn add(&mut self, app: &DynApp, under: Option<&str>) -> Result<ChildId, CommandError> {
        let (Phase::Running, Some(supervisor)) = (self.phase, self.app_supervisor.clone()) else {
            return Err(CommandError::NotRunning);
        };
        if app.place().own_process {
            return Err(CommandError::OwnProcess(app.name().to_owned()));
        }
        let under = match under {
            None => supervisor.top(),
            Some(name) => self.named(name)?,
        };
        if self.apps.contains(under) {
            return Err(CommandError::NotASupervisor(
                supervisor.child_info(under).map_or_else(String::new, |info| info.name),
            ));
        }
        if self.apps.named(app.name()).is_some() {
            return Err(StartError::SameName(app.name().to_owned()).into());
        }
        self.apps.check_place(app)?;
        let spec = self.register(app)?;
        let id = spec.id;
        if let Err(spec) = supervisor.add_child(under, spec) {
            self.drop_queue.push(spec.name.clone(), spec);
            self.apps.remove(&self.state, id);
            self.down_policies.remove(id);
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
        let (Phase::Running, Some(supervisor)) = (self.phase, &self.app_supervisor) else {
            return Err(CommandError::NotRunning);
        };
        let id = self.named(name)?;
        if id == supervisor.top() {
            return Err(CommandError::OwnSupervisor(name.to_owned()));
        }
        let input = match command {
            Command::Terminate => Input::TerminateChild(id),
            Command::Restart => Input::RestartChild(id),
            Command::Delete => Input::DeleteChild(id),
            Command::Add => return Err(CommandError::Unknown(name.to_owned())),
        };
        supervisor.send(input).map_err(|_| CommandError::Busy)?;
        Ok(id)
    }

    /// Handles the answer of a supervisor to a command.
    pub(super) fn answer(&mut self, fact: &SupervisorFact) {
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
            self.apps.remove(&self.state, id);
        }
        let Some(waiting) = self.answers.0.get_mut(&id) else { return };
        if let Some(index) = waiting.iter().position(|waits| waits.command == command) {
            let waits = waiting.remove(index).expect("its place was found just now");
            let answer = refused.map_or(Ok(()), |why| Err(CommandError::Refused { name: waits.name, why }));
            // The caller may have stopped waiting.
            let _ = waits.answer.try_send(answer);
        }
        if self.answers.0.get(&id).is_some_and(VecDeque::is_empty) {
            self.answers.0.remove(&id);
        }
    }

    /// Answers all waiting callers: no supervisor is left that could answer.
    pub(super) fn answer_all(&mut self) {
        for waits in std::mem::take(&mut self.answers.0).into_values().flatten() {
            // The caller may have stopped waiting.
            let _ = waits.answer.try_send(Err(CommandError::NotRunning));
        }
    }
}
