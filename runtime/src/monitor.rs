//! Monitors, in OTP's sense: notifications of the end of another application's incarnation, and its reason.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{
    supervision::Reason,
    tid::Tid,
    wire::{Class, Payload},
};

/// The ID of one monitor, unique in the lifetime of a node.
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

/// The kind of end.
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
    /// The application ended itself, in order.
    Normal,
    /// The application was ordered to stop, or stopped because it lost a requirement.
    Shutdown,
    /// The application panicked.
    Panic,
    /// The application exceeded its progress budget.
    Hung,
    /// The application was abandoned: it missed a deadline, or lost its thread.
    Killed,
    /// The application's process ended.
    ProcessEnded,
    /// The application's node was lost, left, or is unknown. Whether the application is alive is unknown.
    NodeLost,
    /// No application has this TID.
    NoSuchAddress,
}

impl DownClass {
    /// Returns the class of an end reason.
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

/// The one report of a monitor: the watched incarnation has ended. The watcher handles it with
/// `handles::<Down>()`; it precedes all queued messages. A restart behind the same TID is an end too; to
/// watch the next incarnation, set a new monitor. An absent target ([`DownClass::NoSuchAddress`],
/// [`DownClass::NodeLost`]) is reported at once for the first 256 requests, and after that once every 10 ms.
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
///         // The next incarnation has the same TID, and needs a monitor of its own.
///         let _ = ctx.monitor(down.tid);
///     }
/// }
///
/// let hip = AppSpec::new("hip", || Hip).handles::<Down>();
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Down {
    /// The ID of the monitor.
    pub monitor: MonitorId,
    /// The TID of the watched application.
    pub tid: Tid,
    /// The kind of end.
    pub class: DownClass,
    /// The reason as a text, at most 256 bytes.
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

/// The reason why a monitor was not set. Nothing changed.
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
    /// The TID is not that of one application, but of a layer, a group, or all applications.
    #[error("{0} is not the TID of one application")]
    NotOne(Tid),
    /// The application has its maximum number of monitors.
    #[error("this application has {0} monitors, which is the limit; demonitor some")]
    TooMany(usize),
    /// The node has its maximum number of monitors.
    #[error("the node has {0} monitors, which is the limit")]
    NodeFull(usize),
    /// The maximum number of applications of that node is watched from here.
    #[error("{0} applications of that node are watched from here, which is the limit")]
    PeerFull(usize),
    /// This incarnation of the application was abandoned.
    #[error("this incarnation of the application has ended; a later one has replaced it")]
    LifeOver,
    /// Not supported here: an application in a process of its own cannot monitor others.
    #[error("an application in a process of its own cannot monitor others")]
    Unsupported,
}
