//! The supervision tree as data: the supervised children, their states, since when, and how their previous
//! incarnations ended.

use std::{fmt, sync::atomic::Ordering, time::Duration};

use sinew_model::directory::Absence;
use sinew_runtime::{
    lock,
    mailbox::MessageAges,
    supervision::{BranchView, ChildId, ChildState, ChildView, Flags, Reason, Strategy, SupervisorHandle},
    tid::Tid,
    time::Time,
};

use super::{
    CommandError, NodeHandle, OrderStatus,
    root::{Root, RootEvent},
};

/// Time limit for the root's answer. The root waits for no other thread, so this expires only if the root itself hangs.
const WITHIN: Duration = Duration::from_secs(10);
/// The same for the text of an error, because the caller has already waited its full time.
const WITHIN_OF_ERRORS: Duration = Duration::from_secs(1);

/// The supervised children of a node, as of the query. `{}` displays it as a tree.
///
/// # Examples
///
/// ```
/// use sinew::{NodeHandle, node::CommandError};
///
/// fn restarts_of_the_drive(handle: &NodeHandle) -> Result<Option<u64>, CommandError> {
///     let tree = handle.tree()?;
///     println!("{tree}");
///     Ok(tree.find("knee.drive").map(|drive| drive.restarts))
/// }
/// ```
#[derive(Clone, Debug)]
pub struct SupervisionTree {
    /// The node's name.
    pub node: String,
    /// Its own supervisors: `layers`, and `applications` once the layers are ready.
    pub supervisors: Vec<Supervised>,
}

/// One actor or supervisor.
///
/// # Examples
///
/// ```
/// use sinew::node::{LifeState, Supervised};
///
/// fn describe(app: &Supervised) -> String {
///     match (&app.state, &app.last_reason) {
///         (LifeState::Ready, _) => format!("{} is up for {:?}", app.name, app.since),
///         (state, Some(reason)) => format!("{} is {state}, after {reason:?}", app.name),
///         (state, None) => format!("{} is {state}", app.name),
///     }
/// }
/// ```
#[derive(Clone, Debug)]
pub struct Supervised {
    /// Its name.
    pub name: String,
    /// Its address; layers and supervisors have none here.
    pub tid: Option<Tid>,
    /// The state of the child.
    pub state: LifeState,
    /// How long it has been in this state: for one that is ready, its uptime.
    pub since: Duration,
    /// Its incarnation number, from 1; 0 before its first.
    pub generation: u64,
    /// Number of restarts.
    pub restarts: u64,
    /// How its previous incarnation ended.
    pub last_reason: Option<Reason>,
    /// Where it runs: the name of its thread, or a process of its own. `None` for a supervisor, which runs on
    /// the root's thread.
    pub place: Option<String>,
    /// The state of its mailbox; `None` if there is no mailbox.
    pub mailbox: Option<MailboxState>,
    /// Its missing requirements, since when, and why each is not ready: before its start those it waits for,
    /// later those it lost.
    pub missing: Vec<Absence>,
    /// Number of its former incarnations that hung or did not stop, were abandoned, and still keep their threads.
    pub abandoned: usize,
    /// The children, if it is a supervisor.
    pub supervises: Option<Supervises>,
}

/// The state of an actor or a supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LifeState {
    /// Its requirements are not ready.
    WaitsForRequirements,
    /// Children before it are not ready, or have not stopped.
    WaitsForItsTurn,
    /// It failed; the back-off before its restart is not over.
    BacksOff,
    /// It was started and is not ready yet.
    Starts,
    /// It is ready.
    Ready,
    /// It is ready, has lost a requirement, and was declared to pause in this case.
    Paused,
    /// It was ordered to stop.
    Stops,
    /// It was stopped or has ended, and is not restarted automatically.
    Down,
}

/// The messages in a mailbox, and the ages of those that were handled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MailboxState {
    /// Number of messages that wait now.
    pub depth: usize,
    /// Maximum number that ever waited at once.
    pub high_water: usize,
    /// Age of the oldest one; `None`: none waits, or its age is unknown.
    pub oldest: Option<Duration>,
    /// Ages of the delivered ones when their handlers were called; none of an actor in a process of its own.
    pub ages: MessageAges,
}

/// The settings and the children of a supervisor.
#[derive(Clone, Debug)]
pub struct Supervises {
    /// Its strategy and limits.
    pub flags: Flags,
    /// Number of restarts in the window that ends now; `flags.intensity` is the maximum.
    pub restarts_in_window: usize,
    /// Number of abandoned incarnations that still keep their threads.
    pub abandoned: usize,
    /// Its children, in the order of their start.
    pub children: Vec<Supervised>,
}

impl NodeHandle {
    /// Returns the current supervision tree: layers, applications and the supervisors between. Asks only the
    /// root: a child that hangs or is flooded is shown like all others, and no message is delayed.
    ///
    /// # Errors
    /// The node does not run, or its root's order queue is full.
    pub fn tree(&self) -> Result<SupervisionTree, CommandError> {
        self.tree_within(WITHIN)
    }

    /// The same, with a time limit for the root's answer.
    pub(crate) fn tree_within(&self, within: Duration) -> Result<SupervisionTree, CommandError> {
        if self.hosts_other_node || self.state.ctx.stopping.load(Ordering::Relaxed) {
            return Err(CommandError::NotRunning);
        }
        let (answer, answered) = std::sync::mpsc::sync_channel(1);
        if self.send_to_root(RootEvent::QueryTree(answer)) == OrderStatus::QueueFull {
            return Err(CommandError::Busy);
        }
        answered.recv_timeout(within).map_err(|_| CommandError::NotRunning)
    }
}

impl NodeHandle {
    /// Returns the applications of this process that have their requirements and are not ready; none if the
    /// root does not answer.
    pub(super) fn starting(&self) -> Vec<Supervised> {
        let tree = self.tree_within(WITHIN_OF_ERRORS);
        tree.map_or_else(
            |_| Vec::new(),
            |tree| tree.supervisors.iter().flat_map(Supervised::starting).collect(),
        )
    }
}

impl SupervisionTree {
    /// Returns the child called `name`, at any depth.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<&Supervised> {
        self.supervisors.iter().find_map(|supervised| supervised.find(name))
    }
}

impl Supervised {
    fn starting(&self) -> Vec<Self> {
        match (&self.supervises, self.state) {
            (Some(below), _) => below.children.iter().flat_map(Self::starting).collect(),
            (None, LifeState::WaitsForItsTurn | LifeState::BacksOff | LifeState::Starts) => {
                vec![self.clone()]
            }
            (
                None,
                LifeState::WaitsForRequirements
                | LifeState::Ready
                | LifeState::Paused
                | LifeState::Stops
                | LifeState::Down,
            ) => Vec::new(),
        }
    }

    fn find(&self, name: &str) -> Option<&Self> {
        if self.name == name {
            return Some(self);
        }
        self.supervises.iter().flat_map(|below| &below.children).find_map(|child| child.find(name))
    }
}

impl Root {
    pub(super) fn tree(&self) -> SupervisionTree {
        let now = Time::now();
        let supervisors = [&self.layer_supervisor, &self.app_supervisor].into_iter().flatten();
        SupervisionTree {
            node: self.state.ctx.config.name.clone(),
            supervisors: supervisors.map(|supervisor| self.top(supervisor, now)).collect(),
        }
    }

    fn top(&self, supervisor: &SupervisorHandle, now: Time) -> Supervised {
        let view = supervisor.view(now);
        let state = if view.is_ending { LifeState::Stops } else { LifeState::Ready };
        Supervised {
            name: supervisor.child_info(view.id).map_or_else(|| view.id.to_string(), |info| info.name),
            tid: None,
            state,
            since: now.since(self.began),
            generation: 1,
            restarts: 0,
            last_reason: None,
            place: None,
            mailbox: None,
            missing: Vec::new(),
            abandoned: 0,
            supervises: Some(self.supervises(supervisor, now, view)),
        }
    }

    fn supervises(&self, supervisor: &SupervisorHandle, now: Time, view: BranchView) -> Supervises {
        let child = |(id, child, below)| self.supervised(supervisor, now, id, (child, below));
        Supervises {
            flags: view.flags,
            restarts_in_window: view.restarts_in_window,
            abandoned: view.abandoned,
            children: view.children.into_iter().map(child).collect(),
        }
    }

    fn supervised(
        &self,
        supervisor: &SupervisorHandle,
        now: Time,
        id: ChildId,
        (view, below): (ChildView, Option<BranchView>),
    ) -> Supervised {
        let info = supervisor.child_info(id);
        let (mailbox, own_process) = self.apps.mailbox(id).unzip();
        let thread = info.as_ref().and_then(|info| info.place.as_ref()).map(|place| place.thread.clone());
        let place = if own_process == Some(true) { Some("own process".to_owned()) } else { thread };
        let tid = info.as_ref().and_then(|info| info.tid);
        let missing = tid.map(|tid| lock(&self.state.sync.core).missing(now, tid.app)).unwrap_or_default();
        let is_paused = !missing.is_empty() && self.apps.pauses(id);
        Supervised {
            tid,
            name: info.map_or_else(|| id.to_string(), |info| info.name),
            state: state(&view, is_paused),
            // A child that was never started has waited since the node's start. A child that cannot start is
            // retried: the state counts from its first failure.
            since: now.since(view.cannot_start_since.unwrap_or(view.since).max(self.began)),
            generation: view.generation,
            restarts: view.restarts,
            last_reason: view.last_reason.map(|reason| supervisor.name_children(reason)),
            place,
            mailbox: mailbox.map(|mailbox| MailboxState {
                depth: mailbox.depth(),
                high_water: mailbox.high_water(),
                oldest: mailbox.oldest(),
                ages: mailbox.ages(),
            }),
            missing,
            abandoned: view.abandoned,
            supervises: below.map(|below| self.supervises(supervisor, now, below)),
        }
    }
}

fn state(view: &ChildView, is_paused: bool) -> LifeState {
    match view.state {
        ChildState::Down if view.waits_for_release => LifeState::WaitsForRequirements,
        ChildState::Down if view.wanted => LifeState::WaitsForItsTurn,
        ChildState::Down => LifeState::Down,
        ChildState::BackingOff(_) => LifeState::BacksOff,
        ChildState::Starting(_) => LifeState::Starts,
        ChildState::Ready if is_paused => LifeState::Paused,
        ChildState::Ready => LifeState::Ready,
        ChildState::Stopping(_) => LifeState::Stops,
    }
}

impl fmt::Display for LifeState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::WaitsForRequirements => "waits for what it requires",
            Self::WaitsForItsTurn => "waits for its turn",
            Self::BacksOff => "backs off",
            Self::Starts => "starts",
            Self::Ready => "ready",
            Self::Paused => "paused",
            Self::Stops => "stops",
            Self::Down => "down",
        })
    }
}

impl fmt::Display for SupervisionTree {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.node)?;
        show_all(&self.supervisors, "", f)
    }
}

fn show_all(children: &[Supervised], indent: &str, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    for (index, child) in children.iter().enumerate() {
        let is_last = index + 1 == children.len();
        write!(f, "\n{indent}{} {child}", if is_last { "`-" } else { "|-" })?;
        if let Some(below) = &child.supervises {
            let deeper = format!("{indent}{}", if is_last { "   " } else { "|  " });
            show_all(&below.children, &deeper, f)?;
        }
    }
    Ok(())
}

/// Displays one line, without the children.
impl fmt::Display for Supervised {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, state, since, generation, restarts, .. } = self;
        write!(
            f,
            "{name}: {state} for {:.1} s, life {generation}, {restarts} restarts",
            since.as_secs_f32()
        )?;
        if let Some(reason) = &self.last_reason {
            write!(f, ", the last one {reason}")?;
        }
        if let Some(tid) = self.tid {
            write!(f, ", {tid}")?;
        }
        if let Some(place) = &self.place {
            write!(f, ", on {place}")?;
        }
        if let Some(MailboxState { depth, high_water, .. }) = self.mailbox {
            write!(f, ", mailbox {depth} (at most {high_water})")?;
        }
        for Absence { name, why, .. } in &self.missing {
            write!(f, ", without {name} ({why})")?;
        }
        if self.abandoned > 0 {
            write!(f, ", {} former lives keep their threads", self.abandoned)?;
        }
        let Some(Supervises { flags, restarts_in_window, abandoned, .. }) = &self.supervises else {
            return Ok(());
        };
        let strategy = match flags.strategy {
            Strategy::OneForOne => "one-for-one",
            Strategy::RestForOne => "rest-for-one",
            Strategy::OneForAll => "one-for-all",
        };
        let (max, window) = (flags.intensity.restarts_max, flags.intensity.window.as_secs_f32());
        write!(f, ", {strategy}, {restarts_in_window} of {max} restarts in {window} s")?;
        if *abandoned > 0 {
            write!(f, ", {abandoned} of {} lives that keep their threads", flags.abandoned_max)?;
        }
        Ok(())
    }
}
