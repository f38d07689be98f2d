//! The inputs and orders of a supervisor.

use super::{ChildId, Generation, Policy, Reason};
use crate::time::Time;

/// An input of a supervisor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// Start the children.
    Started,
    /// The requirements of this child are ready.
    Released(ChildId),
    /// This child is ready and takes messages.
    BecameReady(ChildId, Generation),
    /// This child hangs: the reason has its activity. It must be abandoned.
    Hung(ChildId, Generation, Reason),
    /// This child has ended.
    Ended(ChildId, Generation, Reason),
    /// The deadline of this incarnation to start or to stop is extended to this time, because it did not get
    /// its CPU time. Triggers no deadline check, so that several children can be extended before the next
    /// event.
    DeadlineExtended(ChildId, Generation, Time),
    /// A deadline may have passed.
    TimePassed,
    /// Stop the children, last first.
    StopOrdered,
    /// Add this child after the others, and start it in its turn.
    AddChild(ChildId, Policy),
    /// Stop this child and do not start it again. It is kept, unless it is temporary: then it is deleted.
    TerminateChild(ChildId),
    /// Start this child again. It was terminated or has ended by itself.
    RestartChild(ChildId),
    /// Delete this child. It was terminated or has ended by itself.
    DeleteChild(ChildId),
}

impl Input {
    /// Returns the command and its child, if this input is a command.
    #[must_use]
    pub const fn command(&self) -> Option<(Command, ChildId)> {
        match self {
            Self::AddChild(id, _) => Some((Command::Add, *id)),
            Self::TerminateChild(id) => Some((Command::Terminate, *id)),
            Self::RestartChild(id) => Some((Command::Restart, *id)),
            Self::DeleteChild(id) => Some((Command::Delete, *id)),
            Self::Started
            | Self::Released(_)
            | Self::BecameReady(..)
            | Self::Hung(..)
            | Self::Ended(..)
            | Self::DeadlineExtended(..)
            | Self::TimePassed
            | Self::StopOrdered => None,
        }
    }
}

/// A command on a child at run time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// [`Input::AddChild`].
    Add,
    /// [`Input::TerminateChild`].
    Terminate,
    /// [`Input::RestartChild`].
    Restart,
    /// [`Input::DeleteChild`].
    Delete,
}

/// The reason why a command is refused. Nothing has changed.
///
/// # Examples
///
/// ```
/// use sinew::supervision::ChildCommandError;
///
/// assert_eq!(ChildCommandError::Running.to_string(), "it runs; stop it first, with `stop_app`");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChildCommandError {
    /// The supervisor has no such child.
    #[error("there is no such child")]
    Unknown,
    /// The supervisor already has a child with this ID.
    #[error("this child is there already")]
    Present,
    /// The child is alive, or is about to be started.
    #[error("it runs; stop it first, with `stop_app`")]
    Running,
    /// The child failed and is about to be started again.
    #[error("it is being restarted; stop it first, with `stop_app`")]
    Restarting,
    /// The supervisor stops all its children.
    #[error("its supervisor ends")]
    Ending,
}

/// An order of a supervisor to its shell, or a fact for its listener.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Order {
    /// Create a new instance of this child.
    Spawn(ChildId, Generation),
    /// Order this child to stop.
    Stop(ChildId, Generation),
    /// Abandon this child without waiting for it.
    Abandon(ChildId, Generation),
    /// Fact: this child failed or was stopped, and will be started again in its turn.
    Failed(ChildId, Reason),
    /// Fact: this child is ready.
    Ready(ChildId),
    /// Fact: this child has ended. Only a command, or a restart of its group, starts it again.
    Gone(ChildId, Reason),
    /// Fact: this child was deleted.
    Deleted(ChildId),
    /// Fact: every wanted child is ready. Repeated after each restart.
    AllReady,
    /// Reply: the command was executed. A terminated child has ended. The start of an added or restarted
    /// child comes before this reply.
    Done(Command, ChildId),
    /// Reply: the command was refused.
    Refused(Command, ChildId, ChildCommandError),
    /// Fact: no child is alive any more, with the reason. The last order.
    Ended(Reason),
}
