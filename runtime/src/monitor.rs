//! Monitors: who is told when a life of another application ends, and why. In OTP's sense.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{
    supervision::Reason,
    tid::Tid,
    wire::{Class, Payload},
};

/// Names one monitor; never used twice in a node's life.
///
/// # Examples
///
/// ```
/// use sinew::{events::{MonitorError, MonitorId}, prelude::*};
///
/// struct Arm { gripper: Option<MonitorId> }
/// # impl Actor for Arm { type Context = AppContext<Self>; }
///
/// fn take_hold(arm: &mut Arm, gripper: Tid, ctx: &mut AppContext<Arm>) -> Result<(), MonitorError> {
///     arm.gripper = Some(ctx.monitor(gripper)?);
///     Ok(())
/// }
///
/// fn let_go(arm: &mut Arm, ctx: &mut AppContext<Arm>) {
///     arm.gripper.take().map(|monitor| ctx.demonitor(monitor));
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct MonitorId(pub u64);

/// Which kind of end it was.
///
/// # Examples
///
/// ```
/// use sinew::events::DownClass;
///
/// /// Whether the end of a drive is a reason to stop the leg.
/// fn is_failure(class: DownClass) -> bool {
///     !matches!(class, DownClass::Normal | DownClass::Shutdown)
/// }
/// assert!(is_failure(DownClass::Panic) && is_failure(DownClass::NodeLost));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum DownClass {
    /// It ended by itself, in order.
    Normal,
    /// It was told to stop, or stopped because it lost what it requires.
    Shutdown,
    /// It panicked.
    Panic,
    /// It did not come back in its progress budget.
    Hung,
    /// Its life was taken: it missed a deadline, or lost what it ran on.
    Killed,
    /// Its process ended.
    ProcessEnded,
    /// Its node was lost, left, or is not known. Whether the application lives is not known.
    NodeLost,
    /// Nobody has this TID.
    NoSuchAddress,
}

impl DownClass {
    /// The class of a life's end.
    #[must_use]
    pub const fn of(reason: &Reason) -> Self {
        match reason {
            Reason::Normal => Self::Normal,
            Reason::Shutdown | Reason::RequirementLost(_) | Reason::GaveUp(_) => Self::Shutdown,
            Reason::Panic(_) => Self::Panic,
            Reason::Hung(_) => Self::Hung,
            Reason::Killed | Reason::StartTimeout | Reason::StartFailed(_) | Reason::ThreadEnded => {
                Self::Killed
            }
            Reason::ProcessEnded(_) => Self::ProcessEnded,
        }
    }
}

/// What a monitor says, once: the life that was watched has ended. The watcher handles it with `handles::<Down>()`; it
/// goes ahead of every message that waits. A restart behind the same TID is an end, too; who wants to watch the next
/// life monitors again. That there is nobody ([`DownClass::NoSuchAddress`], [`DownClass::NodeLost`]) is told at once, 256 times;
/// who goes on to ask is told once every 10 ms.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Hip;
/// # impl Actor for Hip { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<Down>> for Hip {
///     type Result = ();
///     fn handle(&mut self, down: Delivery<Down>, ctx: &mut Self::Context) {
///         println!("{} ended: {}", down.tid, down.why);
///         // The next life has the same TID, and needs a monitor of its own.
///         let _ = ctx.monitor(down.tid);
///     }
/// }
///
/// let hip = AppSpec::new("hip", || Hip).handles::<Down>();
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Down {
    /// Which monitor.
    pub monitor: MonitorId,
    /// Who was watched.
    pub tid: Tid,
    /// Which kind of end it was.
    pub class: DownClass,
    /// The reason in words, at most 256 bytes.
    pub why: String,
}

impl Payload for Down {
    const NAME: &'static str = "sinew.down";
    const CLASS: Class = Class::Control;
}

impl fmt::Display for Down {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.tid, self.why)
    }
}

/// Why a monitor was not set. Nothing changed.
///
/// # Examples
///
/// ```
/// use sinew::{Tid, events::MonitorError};
///
/// let error = MonitorError::NotOne(Tid::group("drives"));
/// assert!(error.to_string().ends_with("is not the TID of one application"));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MonitorError {
    /// This is not the TID of one application: a layer, a group, everybody.
    #[error("{0} is not the TID of one application")]
    NotOne(Tid),
    /// This application has as many monitors as it may have.
    #[error("this application has {0} monitors, which is the limit; demonitor some")]
    TooMany(usize),
    /// The node has as many monitors as it may have.
    #[error("the node has {0} monitors, which is the limit")]
    NodeFull(usize),
    /// As many applications of that node are watched from here as may be.
    #[error("{0} applications of that node are watched from here, which is the limit")]
    PeerFull(usize),
    /// This life of the application was taken.
    #[error("this life of the application is over; a later one speaks for it")]
    LifeOver,
    /// Not from here: an application in a process of its own cannot monitor others.
    #[error("an application in a process of its own cannot monitor others")]
    Unsupported,
}
