//! The handle of a supervisor, for its owner on the same thread: the list of supervised actors, and commands.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, time::Duration};

use crate::{
    event_queue::EventQueue,
    supervision::{
        ChildSpec, DropQueue, Place,
        core::{BranchView, ChildId, Generation, Input, Plan, Planned, Policy, Reason, Tree},
        supervisor::{PlannedChild, SupervisorPlan},
    },
    tid::Tid,
    time::Time,
};

/// The description of a child, for people.
#[derive(Clone, Debug)]
pub struct ChildInfo {
    /// The name of the child.
    pub name: String,
    /// The address of the child, if it has one.
    pub tid: Option<Tid>,
    /// The place of the child; `None` for a supervisor, which runs on its owner's thread.
    pub place: Option<Place>,
    /// The time for its stop; zero for a supervisor, because its children have their own.
    pub stop_within: Duration,
}

/// The supervisor of a child, and its incarnation.
#[derive(Clone, Debug, Default)]
pub(super) struct ChildRecord {
    pub(super) supervisor: String,
    pub(super) generation: Generation,
    pub(super) restarts: u64,
}

/// A handle of a supervisor and of all supervisors below it. Clones share one list of children.
#[derive(Clone)]
pub struct SupervisorHandle {
    pub(super) tree: Rc<RefCell<Tree>>,
    infos: Rc<RefCell<BTreeMap<ChildId, ChildInfo>>>,
    /// The last known record of each child.
    records: Rc<RefCell<BTreeMap<ChildId, ChildRecord>>>,
    /// Added children that the supervisor has not accepted yet, each with its parent.
    pending: Rc<RefCell<BTreeMap<ChildId, (ChildId, ChildSpec)>>>,
    queue: EventQueue<Input>,
    /// Whether a test requested a panic of the supervisor.
    #[cfg(feature = "fault-points")]
    fails: Rc<std::cell::Cell<bool>>,
}

impl std::fmt::Debug for SupervisorHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SupervisorHandle({} children)", self.infos.borrow().len())
    }
}

impl SupervisorHandle {
    /// Creates the handle of a planned supervisor. Also returns the children that are not supervisors.
    pub(super) fn new(plan: SupervisorPlan, seed: u64, queue: EventQueue<Input>) -> (Self, Vec<ChildSpec>) {
        let (mut infos, mut workers) = (BTreeMap::new(), Vec::new());
        let plan = enter(plan, &mut infos, &mut workers);
        let handle = Self {
            tree: Rc::new(RefCell::new(Tree::new(plan, seed))),
            infos: Rc::new(RefCell::new(infos)),
            records: Rc::default(),
            pending: Rc::default(),
            queue,
            #[cfg(feature = "fault-points")]
            fails: Rc::default(),
        };
        (handle, workers)
    }

    /// Adds a child as the last one of the supervisor `under`. The result is reported as a fact.
    ///
    /// # Errors
    /// The supervisor's event queue is full; the child is returned.
    pub fn add_child(&self, under: ChildId, spec: ChildSpec) -> Result<(), Box<ChildSpec>> {
        let (id, policy) = (spec.id, spec.policy.clone());
        self.pending.borrow_mut().insert(id, (under, spec));
        self.queue.post(Input::AddChild(id, policy)).map_err(|_| {
            let (_, spec) = self.pending.borrow_mut().remove(&id).expect("it was put there just now");
            Box::new(spec)
        })
    }

    /// Returns the top supervisor, to add children under it.
    #[must_use]
    pub fn top(&self) -> ChildId {
        self.tree.borrow().top()
    }

    /// Sends an input to the supervisor.
    ///
    /// # Errors
    /// Its event queue is full; the input is returned.
    pub fn send(&self, input: Input) -> Result<(), Input> {
        self.queue.post(input)
    }

    /// Makes the supervisor itself panic.
    #[cfg(feature = "fault-points")]
    pub fn fail(&self) {
        self.fails.set(true);
        // A full queue wakes the supervisor too.
        let _ = self.send(Input::TimePassed);
    }

    /// Panics if a test requested it.
    #[cfg(feature = "fault-points")]
    pub(super) fn strike(&self) {
        assert!(!self.fails.get(), "a fault was planned for a supervisor");
    }

    /// Returns the state of all children.
    #[must_use]
    pub fn view(&self, now: Time) -> BranchView {
        self.tree.borrow().view(now)
    }

    /// Returns the time that all children need to stop, one after the other.
    #[must_use]
    pub fn stop_within(&self) -> Duration {
        let each = self.infos.borrow();
        each.values().fold(Duration::ZERO, |sum, child| sum.saturating_add(child.stop_within))
    }

    /// Returns the description of a child.
    #[must_use]
    pub fn child_info(&self, id: ChildId) -> Option<ChildInfo> {
        self.infos.borrow().get(&id).cloned()
    }

    /// Returns the name of a child, or its ID if it is unknown.
    pub(super) fn name(&self, id: ChildId) -> String {
        self.infos.borrow().get(&id).map_or_else(|| id.to_string(), |info| info.name.clone())
    }

    /// Returns the supervisor and the incarnation of a child. For a child that its own end removed, the last
    /// known values.
    pub(super) fn record(&self, id: ChildId) -> ChildRecord {
        let known = {
            let tree = self.tree.borrow();
            tree.owner(id).zip(tree.child(id))
        };
        let mut records = self.records.borrow_mut();
        if let Some((owner, child)) = known {
            let record = ChildRecord {
                supervisor: self.name(owner),
                generation: child.generation,
                restarts: child.restarts,
            };
            records.insert(id, record);
        }
        records.get(&id).cloned().unwrap_or_default()
    }

    /// Replaces IDs by names in the reason why a supervisor gave up.
    #[must_use]
    pub fn name_children(&self, reason: Reason) -> Reason {
        let Reason::GaveUp(why) = reason else { return reason };
        let infos = self.infos.borrow();
        let with_name = |text: String, (id, info): (&ChildId, &ChildInfo)| {
            text.replace(&format!(" {id},"), &format!(" '{}',", info.name))
        };
        Reason::GaveUp(infos.iter().fold(why, with_name))
    }

    pub(super) fn take_pending(&self, id: ChildId) -> Option<(ChildId, ChildSpec)> {
        let (under, spec) = self.pending.borrow_mut().remove(&id)?;
        self.infos.borrow_mut().insert(id, info_of(&spec));
        Some((under, spec))
    }

    /// Drops the children that were added to a supervisor that ended before it accepted them.
    pub(super) fn drop_pending(&self, drop_queue: &DropQueue) {
        for (_, (_, spec)) in std::mem::take(&mut *self.pending.borrow_mut()) {
            drop_queue.push(spec.name, spec.launch);
        }
    }

    pub(super) fn remove(&self, id: ChildId) {
        self.infos.borrow_mut().remove(&id);
        self.records.borrow_mut().remove(&id);
    }
}

fn info_of(spec: &ChildSpec) -> ChildInfo {
    ChildInfo {
        name: spec.name.clone(),
        tid: spec.tid,
        place: Some(spec.place.clone()),
        stop_within: spec.policy.stop_within,
    }
}

/// Lists the children of a plan. Returns the plan without the parts that only the shell needs.
fn enter(
    plan: SupervisorPlan,
    infos: &mut BTreeMap<ChildId, ChildInfo>,
    workers: &mut Vec<ChildSpec>,
) -> Plan {
    let mut children = Vec::new();
    for child in plan.children {
        children.push(match child {
            PlannedChild::Worker(spec) => {
                let (id, policy): (ChildId, Policy) = (spec.id, spec.policy.clone());
                infos.insert(id, info_of(&spec));
                workers.push(spec);
                Planned::Worker(id, policy)
            }
            PlannedChild::Supervisor(below, policy) => {
                Planned::Supervisor(enter(below, infos, workers), policy)
            }
        });
    }
    let supervisor = ChildInfo { name: plan.name, tid: None, place: None, stop_within: Duration::ZERO };
    infos.insert(plan.id, supervisor);
    Plan { id: plan.id, flags: plan.flags, children }
}
