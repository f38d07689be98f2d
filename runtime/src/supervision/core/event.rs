//! What a supervisor is told, and what it orders.

use super::{ChildId, Generation, Policy, Reason};
use crate::time::Time;

/// What a supervisor is told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// Start the children.
    Started,
    /// What this child requires is ready.
    Released(ChildId),
    /// This child takes messages.
    BecameReady(ChildId, Generation),
    /// This child does not come back: the reason says what it is in. Its life is taken.
    Hung(ChildId, Generation, Reason),
    /// This child is gone.
    Ended(ChildId, Generation, Reason),
    /// This life was not given all of its time to start or to stop: it has until then. Judges no deadline, so that several may
    /// be reprieved before the next event does.
    Reprieved(ChildId, Generation, Time),
    /// A deadline may have passed.
    TimePassed,
    /// Stop the children, last first.
    StopOrdered,
    /// Take this child in, after the others, and start it in its turn.
    AddChild(ChildId, Policy),
    /// Stop this child and do not start it again. It is kept, unless it is temporary: then it is forgotten.
    TerminateChild(ChildId),
    /// Start this child again, which was terminated or has ended by itself.
    RestartChild(ChildId),
    /// Forget this child, which was terminated or has ended by itself.
    DeleteChild(ChildId),
}

impl Input {
    /// Which command it is, and for whom, if it is one.
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
            | Self::Reprieved(..)
            | Self::TimePassed
            | Self::StopOrdered => None,
        }
    }
}

/// What a supervisor was asked to do with a child at run time.
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

/// Why a command is not carried out. Nothing has changed.
///
/// # Examples
///
/// ```
/// use sinew::supervision::Refusal;
///
/// assert_eq!(Refusal::Running.to_string(), "it runs; stop it first, with `stop_app`");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// The supervisor has no such child.
    #[error("there is no such child")]
    Unknown,
    /// The supervisor has a child of this id already.
    #[error("this child is there already")]
    Present,
    /// The child lives, or is about to be started.
    #[error("it runs; stop it first, with `stop_app`")]
    Running,
    /// The child failed and is about to be started again.
    #[error("it is being restarted; stop it first, with `stop_app`")]
    Restarting,
    /// The supervisor stops all its children.
    #[error("its supervisor ends")]
    Ending,
}

/// What a supervisor orders its shell to do, and what it says to others.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Order {
    /// Make a new instance of this child.
    Spawn(ChildId, Generation),
    /// Tell this child to stop.
    Stop(ChildId, Generation),
    /// Take this child's life without waiting for it.
    Abandon(ChildId, Generation),
    /// For others: this child failed or was stopped, and is started again if its turn comes.
    Failed(ChildId, Reason),
    /// For others: this child is ready.
    Ready(ChildId),
    /// For others: this child is gone. It is not started again unless by a command, or together with its group.
    Gone(ChildId, Reason),
    /// For others: this child is forgotten.
    Deleted(ChildId),
    /// For others: every child that is wanted is ready. Said again after each restart.
    AllReady,
    /// For who asked: the command is carried out. A terminated child has ended; a child that was added or restarted has its
    /// start before it.
    Done(Command, ChildId),
    /// For who asked: the command is not carried out.
    Refused(Command, ChildId, Refusal),
    /// For others: no child lives any more, and why. The last order.
    Ended(Reason),
}
