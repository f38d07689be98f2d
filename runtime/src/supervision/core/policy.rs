//! Supervision policies: strategy, restart type, times, restart intensity.

use std::time::Duration;

/// Selects the children that are restarted when one child fails.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// // Encoder, controller and drive of a joint make sense together only.
/// let joint = SupervisorSpec::new("knee").strategy(Strategy::OneForAll);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Strategy {
    /// Restarts the failed child alone.
    #[default]
    OneForOne,
    /// Restarts the failed child and the children started after it.
    RestForOne,
    /// Restarts all children.
    OneForAll,
}

impl Strategy {
    /// Returns whether children are started in order, each one when those before it are ready.
    pub(super) const fn is_ordered(self) -> bool {
        match self {
            Self::OneForOne => false,
            Self::RestForOne | Self::OneForAll => true,
        }
    }
}

/// Selects when a child that ended is started again.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Homing;
/// # impl Actor for Homing { type Context = AppContext<Self>; }
///
/// // Started again only where it failed: once the joint is homed, it ends for good.
/// let homing = AppSpec::new("homing", || Homing).restart(Restart::Transient);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restart {
    /// Restarts after every end.
    Permanent,
    /// Restarts only after a failure.
    Transient,
    /// Never restarts the child, not even with its group. Its supervisor removes it when it ends.
    Temporary,
}

/// Selects whether a supervisor shuts down when its [significant](Policy::significant) children have
/// finished. A transient child finishes when it ends without a failure, a temporary one when it ends in any
/// way.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Trial;
/// # impl Actor for Trial { type Context = AppContext<Self>; }
///
/// // The node stops in order when the trial is over.
/// let trial = AppSpec::new("trial", || Trial).restart(Restart::Transient).significant();
/// let node = Node::builder("bench").app(trial).auto_shutdown(AutoShutdown::AnySignificant);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AutoShutdown {
    /// Does not shut down.
    #[default]
    Never,
    /// Shuts down when the first significant child has finished.
    AnySignificant,
    /// Shuts down when the last significant child has finished.
    AllSignificant,
}

/// The supervision policy of a child.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Policy {
    /// When the child is started again. Default [`Restart::Permanent`].
    pub restart: Restart,
    /// Whether the end of the child may end its supervisor; see [`AutoShutdown`]. Has no effect on a
    /// permanent child, which is always restarted. Default no.
    pub significant: bool,
    /// Time for the child to become ready. Default 10 s.
    pub start_within: Duration,
    /// Time for the child to stop before it is abandoned. Default 500 ms.
    pub stop_within: Duration,
    /// First wait before a restart. It doubles with each consecutive failure, and is then shortened by a
    /// random part of up to a quarter. Default 1 ms.
    pub backoff_min: Duration,
    /// Longest wait before a restart. Default 2 s.
    pub backoff_max: Duration,
    /// Maximum duration of one turn (a handler, a timer, `started`) before the actor counts as hung. Default
    /// 1 s; `None`: no limit.
    pub progress_within: Option<Duration>,
    /// Whether the child waits for its release before its first start and after each failure. Default no.
    pub held: bool,
    /// The retry policy for a start that [failed by an explicit call](super::Reason::StartFailed).
    pub start_retry: StartRetry,
}

/// The retry policy for a start that failed by an explicit call. Such failures do not count towards restart intensity.
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, supervision::StartRetry};
///
/// // A sensor that is plugged in by hand: look for it twice a second.
/// let retry = StartRetry { wait_max: Duration::from_millis(500), ..StartRetry::default() };
/// assert_eq!(retry.wait_min, Duration::from_millis(100));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StartRetry {
    /// First wait. It doubles with each consecutive failure of this kind, and is then shortened by a random
    /// part of up to a quarter. Default 100 ms.
    pub wait_min: Duration,
    /// Longest wait. Default 5 s.
    pub wait_max: Duration,
    /// Time after the first of consecutive failures of this kind from which they count as restarts. Default
    /// `None`: never.
    pub give_up_after: Option<Duration>,
}

impl Default for StartRetry {
    fn default() -> Self {
        let (wait_min, wait_max) = (Duration::from_millis(100), Duration::from_secs(5));
        Self { wait_min, wait_max, give_up_after: None }
    }
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            restart: Restart::Permanent,
            significant: false,
            start_within: Duration::from_secs(10),
            stop_within: Duration::from_millis(500),
            backoff_min: Duration::from_millis(1),
            backoff_max: Duration::from_secs(2),
            progress_within: Some(Duration::from_secs(1)),
            held: false,
            start_retry: StartRetry::default(),
        }
    }
}

/// The limit of restarts: restart intensity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Intensity {
    /// Maximum number of restarts in one window; one more and the supervisor gives up. Default 5.
    pub restarts_max: usize,
    /// Maximum number of restarts in one window because a child lost its thread. Another actor on the same
    /// thread caused these, so they are counted separately. Default 50.
    pub losses_max: usize,
    /// The length of the window. Default 10 s.
    pub window: Duration,
}

impl Default for Intensity {
    fn default() -> Self {
        Self { restarts_max: 5, losses_max: 50, window: Duration::from_secs(10) }
    }
}

/// The policy of a supervisor for its children as a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flags {
    /// The children that are restarted when one fails. Default [`Strategy::OneForOne`].
    pub strategy: Strategy,
    /// The limit of restarts.
    pub intensity: Intensity,
    /// Whether the supervisor shuts down with its significant children. Default [`AutoShutdown::Never`].
    pub auto_shutdown: AutoShutdown,
    /// Maximum number of abandoned incarnations that have not released their threads; one more and the
    /// supervisor gives up. Each keeps a thread. The count is kept per supervisor, also when the supervisor
    /// itself is restarted. Default 3.
    pub abandoned_max: usize,
}

impl Default for Flags {
    fn default() -> Self {
        Self {
            strategy: Strategy::default(),
            intensity: Intensity::default(),
            auto_shutdown: AutoShutdown::default(),
            abandoned_max: 3,
        }
    }
}

impl From<Strategy> for Flags {
    fn from(strategy: Strategy) -> Self {
        Self { strategy, ..Self::default() }
    }
}
