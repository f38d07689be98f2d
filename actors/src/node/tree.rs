//! The supervision tree as data: who is there, in which state, since when, and what became of their last lives.

use std::{fmt, sync::atomic::Ordering, time::Duration};

use sinew_runtime::{
    supervision::{BranchView, ChildId, ChildState, ChildView, Flags, Reason, Roster, Strategy},
    tid::Tid,
    time::Time,
};

use super::{
    CommandError, NodeHandle, Told,
    root::{Root, RootEvent},
};
use crate::{stores::lock, sync::Absence};

/// Time for the root's answer. It waits for nobody, so that this is over only if the root itself hangs.
const WITHIN: Duration = Duration::from_secs(10);

/// Who is supervised on a node, as it was when asked. Shown with `{}` it is a tree to read.
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
    /// Where it is in its life.
    pub state: LifeState,
    /// How long it has been in this state: for one that is ready, its uptime.
    pub since: Duration,
    /// Which life of it this is, from 1; 0 before its first.
    pub generation: u64,
    /// How often it was started again.
    pub restarts: u64,
    /// How its last life ended.
    pub last_reason: Option<Reason>,
    /// Where it runs: the name of its thread, or that it has a process of its own. `None` for a supervisor, which runs on the
    /// root's thread.
    pub place: Option<String>,
    /// What waits for it; `None` where there is no mailbox.
    pub mailbox: Option<MailboxState>,
    /// The names that it lacks of those that it requires, since when, and why each is not ready: before its start what it waits for, later
    /// what it lost.
    pub missing: Vec<Absence>,
    /// Former lives of it that were taken, because they hung or did not stop, and have not let go of their threads.
    pub abandoned: usize,
    /// Whom it supervises, if it is a supervisor.
    pub supervises: Option<Supervises>,
}

/// Where an actor or a supervisor is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LifeState {
    /// What it requires is not ready.
    WaitsForRequirements,
    /// Those before it are not ready, or have not stopped.
    WaitsForItsTurn,
    /// It failed; the wait before its restart is not over.
    BacksOff,
    /// It was started and is not ready yet.
    Starts,
    /// It is ready.
    Ready,
    /// It is ready, has lost what it requires, and was declared to pause then.
    Paused,
    /// It was told to stop.
    Stops,
    /// It was stopped or has ended, and is not started again by itself.
    Down,
}

/// What waits in a mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MailboxState {
    /// Messages that wait now.
    pub depth: usize,
    /// The most that ever waited at once.
    pub high_water: usize,
}

/// What a supervisor does, and whom it has.
#[derive(Clone, Debug)]
pub struct Supervises {
    /// How it treats its children.
    pub flags: Flags,
    /// Restarts in the window that ends now; `flags.intensity` says how many may be.
    pub restarts_in_window: usize,
    /// Lives that were taken and have not let go of their threads.
    pub abandoned: usize,
    /// Its children, in the order of their start.
    pub children: Vec<Supervised>,
}

impl NodeHandle {
    /// The supervision tree as it is now: layers, applications and the supervisors between. Asks the root, and nobody else: what
    /// hangs or floods is shown like all others, and no message takes longer for it.
    ///
    /// # Errors
    /// The node does not run, or its root has too many orders.
    pub fn tree(&self) -> Result<SupervisionTree, CommandError> {
        self.tree_within(WITHIN)
    }

    /// The same, with the time that the root has for its answer.
    pub(crate) fn tree_within(&self, within: Duration) -> Result<SupervisionTree, CommandError> {
        if self.is_bystander || self.stores.stopping.load(Ordering::Relaxed) {
            return Err(CommandError::NotRunning);
        }
        let (answer, answered) = std::sync::mpsc::sync_channel(1);
        if self.tell(RootEvent::TellTree(answer)) == Told::TooMany {
            return Err(CommandError::Busy);
        }
        answered.recv_timeout(within).map_err(|_| CommandError::NotRunning)
    }
}

impl SupervisionTree {
    /// The child called `name`, wherever it is.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<&Supervised> {
        self.supervisors.iter().find_map(|supervised| supervised.find(name))
    }
}

impl Supervised {
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
        let rosters = [&self.layer_supervisor, &self.app_supervisor].into_iter().flatten();
        SupervisionTree {
            node: self.stores.config.name.clone(),
            supervisors: rosters.map(|roster| self.top(roster, now)).collect(),
        }
    }

    fn top(&self, roster: &Roster, now: Time) -> Supervised {
        let view = roster.view(now);
        let state = if view.is_ending { LifeState::Stops } else { LifeState::Ready };
        Supervised {
            name: roster.who(view.id).map_or_else(|| view.id.to_string(), |who| who.name),
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
            supervises: Some(self.supervises(roster, now, view)),
        }
    }

    fn supervises(&self, roster: &Roster, now: Time, view: BranchView) -> Supervises {
        let child = |(id, child, below)| self.supervised(roster, now, id, (child, below));
        Supervises {
            flags: view.flags,
            restarts_in_window: view.restarts_in_window,
            abandoned: view.abandoned,
            children: view.children.into_iter().map(child).collect(),
        }
    }

    fn supervised(
        &self,
        roster: &Roster,
        now: Time,
        id: ChildId,
        (view, below): (ChildView, Option<BranchView>),
    ) -> Supervised {
        let who = roster.who(id);
        let (mailbox, own_process) = self.apps.mailbox(id).unzip();
        let thread = who.as_ref().and_then(|who| who.place.as_ref()).map(|place| place.thread.clone());
        let place = if own_process == Some(true) { Some("own process".to_owned()) } else { thread };
        let tid = who.as_ref().and_then(|who| who.tid);
        let missing = tid.map(|tid| lock(&self.stores.sync).missing(now, tid.app)).unwrap_or_default();
        let is_paused = !missing.is_empty() && self.apps.pauses(id);
        Supervised {
            tid,
            name: who.map_or_else(|| id.to_string(), |who| who.name),
            state: state(&view, is_paused),
            // One that was never started has waited since the node's start.
            // One that cannot start is tried again and again: since its first failure.
            since: now.since(view.cannot_start_since.unwrap_or(view.since).max(self.began)),
            generation: view.generation,
            restarts: view.restarts,
            last_reason: view.last_reason.map(|reason| roster.name_children(reason)),
            place,
            mailbox: mailbox
                .map(|mailbox| MailboxState { depth: mailbox.depth(), high_water: mailbox.high_water() }),
            missing,
            abandoned: view.abandoned,
            supervises: below.map(|below| self.supervises(roster, now, below)),
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

/// One line, without those below.
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
        if let Some(MailboxState { depth, high_water }) = self.mailbox {
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
