//! What a supervisor may do with its children: strategy, restart type, times, intensity.

use std::time::Duration;

/// Who is restarted when one child fails.
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
    /// That child alone.
    #[default]
    OneForOne,
    /// That child and those started after it.
    RestForOne,
    /// All children.
    OneForAll,
}

impl Strategy {
    /// Whether children are started in order, each when those before it are ready.
    pub(super) const fn is_ordered(self) -> bool {
        match self {
            Self::OneForOne => false,
            Self::RestForOne | Self::OneForAll => true,
        }
    }
}

/// When a child that ended is started again.
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
    /// Always.
    Permanent,
    /// Only if it failed.
    Transient,
    /// Never, not even with its group; its supervisor forgets it when it ends.
    Temporary,
}

/// Whether a supervisor ends by itself when its [significant](Policy::significant) children have done their work: when one
/// that is transient ends without a failure, or one that is temporary ends in whatever way.
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
    /// It does not.
    #[default]
    Never,
    /// When the first of them has.
    AnySignificant,
    /// When the last of them has.
    AllSignificant,
}

/// What a supervisor may do with a child.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Policy {
    /// When it is started again. Default [`Restart::Permanent`].
    pub restart: Restart,
    /// Whether its end may be the end of its supervisor; see [`AutoShutdown`]. Of no effect on a permanent child, whose
    /// end is never its last word. Default no.
    pub significant: bool,
    /// Time to become ready. Default 10 s.
    pub start_within: Duration,
    /// Time to stop before it is abandoned. Default 500 ms.
    pub stop_within: Duration,
    /// First wait before a restart; doubles with each failure in a row, and is then shortened by chance by up to a quarter.
    /// Default 1 ms.
    pub backoff_min: Duration,
    /// Longest wait before a restart. Default 2 s.
    pub backoff_max: Duration,
    /// Longest time that one turn (a handler, a timer, `started`) may take before the actor counts as hung. Default 1 s;
    /// `None`: it may take as long as it likes.
    pub progress_within: Option<Duration>,
    /// Whether it waits for its release before its first start and after each failure. Default no.
    pub held: bool,
    /// How a start that [failed by an explicit call](super::Reason::StartFailed) is tried again.
    pub start_retry: StartRetry,
}

/// How a start that failed by an explicit call is tried again. Such failures do not count towards restart intensity.
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
    /// First wait; doubles with each such failure in a row, and is then shortened by chance by up to a quarter. Default 100 ms.
    pub wait_min: Duration,
    /// Longest wait. Default 5 s.
    pub wait_max: Duration,
    /// Time after the first such failure in a row from which they count as restarts do. Default `None`: never.
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

/// How many restarts are too many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Intensity {
    /// Restarts allowed in one window; one more and the supervisor gives up. Default 5.
    pub restarts_max: usize,
    /// Restarts allowed in one window because a child lost its thread: the fault of who was on the thread with it, so they
    /// are counted apart. Default 50.
    pub losses_max: usize,
    /// The window. Default 10 s.
    pub window: Duration,
}

impl Default for Intensity {
    fn default() -> Self {
        Self { restarts_max: 5, losses_max: 50, window: Duration::from_secs(10) }
    }
}

/// How a supervisor treats its children as a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flags {
    /// Who is restarted when one fails. Default [`Strategy::OneForOne`].
    pub strategy: Strategy,
    /// How many restarts are too many.
    pub intensity: Intensity,
    /// Whether it ends with its significant children. Default [`AutoShutdown::Never`].
    pub auto_shutdown: AutoShutdown,
    /// Lives that were taken and have not let go of their threads, at most; one more and the supervisor gives up. Each keeps
    /// a thread. Counted for each supervisor, and not forgotten when the supervisor itself is restarted. Default 3.
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
