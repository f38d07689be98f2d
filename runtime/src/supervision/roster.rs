//! Who is supervised: shared by a supervisor and its owner, who live on one thread.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, time::Duration};

use crate::{
    post::Post,
    supervision::{
        Burials, ChildSpec, Place,
        core::{BranchView, ChildId, Generation, Input, Plan, Planned, Policy, Reason, Tree},
        supervisor::{PlannedChild, SupervisorPlan},
    },
    tid::Tid,
    time::Time,
};

/// Who a child is, for people.
#[derive(Clone, Debug)]
pub struct Listed {
    /// Its name.
    pub name: String,
    /// Its address, if it has one.
    pub tid: Option<Tid>,
    /// Where it runs; `None` for a supervisor, which runs on its owner's thread.
    pub place: Option<Place>,
    /// Time that it has to stop; none for a supervisor, whose children have theirs.
    pub stop_within: Duration,
}

/// Whose child one is, and in which life.
#[derive(Clone, Debug, Default)]
pub(super) struct Standing {
    pub(super) supervisor: String,
    pub(super) generation: Generation,
    pub(super) restarts: u64,
}

/// The children of a supervisor and of those below it. Clones are the same roster.
#[derive(Clone)]
pub struct Roster {
    pub(super) tree: Rc<RefCell<Tree>>,
    listed: Rc<RefCell<BTreeMap<ChildId, Listed>>>,
    /// What was told of each child last.
    standings: Rc<RefCell<BTreeMap<ChildId, Standing>>>,
    arrivals: Rc<RefCell<BTreeMap<ChildId, (ChildId, ChildSpec)>>>,
    post: Post<Input>,
    /// A test wants the supervisor to panic.
    #[cfg(feature = "fault-points")]
    fails: Rc<std::cell::Cell<bool>>,
}

impl std::fmt::Debug for Roster {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Roster({} children)", self.listed.borrow().len())
    }
}

impl Roster {
    /// The roster of what is planned, and the children that are not supervisors.
    pub(super) fn new(plan: SupervisorPlan, seed: u64, post: Post<Input>) -> (Self, Vec<ChildSpec>) {
        let (mut listed, mut workers) = (BTreeMap::new(), Vec::new());
        let plan = enter(plan, &mut listed, &mut workers);
        let roster = Self {
            tree: Rc::new(RefCell::new(Tree::new(plan, seed))),
            listed: Rc::new(RefCell::new(listed)),
            standings: Rc::default(),
            arrivals: Rc::default(),
            post,
            #[cfg(feature = "fault-points")]
            fails: Rc::default(),
        };
        (roster, workers)
    }

    /// Brings a child, to be the last one of the supervisor `under`. Its answer comes as a fact.
    ///
    /// # Errors
    /// The supervisor's post is full; the child is given back.
    pub fn bring(&self, under: ChildId, spec: ChildSpec) -> Result<(), Box<ChildSpec>> {
        let (id, policy) = (spec.id, spec.policy.clone());
        self.arrivals.borrow_mut().insert(id, (under, spec));
        self.post.post(Input::AddChild(id, policy)).map_err(|_| {
            let (_, spec) = self.arrivals.borrow_mut().remove(&id).expect("it was put there just now");
            Box::new(spec)
        })
    }

    /// The supervisor itself, to bring children under.
    #[must_use]
    pub fn top(&self) -> ChildId {
        self.tree.borrow().top()
    }

    /// Tells the supervisor something.
    ///
    /// # Errors
    /// Its post is full; the input is given back.
    pub fn tell(&self, input: Input) -> Result<(), Input> {
        self.post.post(input)
    }

    /// Makes the supervisor itself panic.
    #[cfg(feature = "fault-points")]
    pub fn fail(&self) {
        self.fails.set(true);
        // A full post is read all the same.
        let _ = self.tell(Input::TimePassed);
    }

    /// Panics if that is wanted.
    #[cfg(feature = "fault-points")]
    pub(super) fn strike(&self) {
        assert!(!self.fails.get(), "a fault was planned for a supervisor");
    }

    /// What is known of all children.
    #[must_use]
    pub fn view(&self, now: Time) -> BranchView {
        self.tree.borrow().view(now)
    }

    /// Time that all children have to stop, one after the other.
    #[must_use]
    pub fn stop_within(&self) -> Duration {
        let each = self.listed.borrow();
        each.values().fold(Duration::ZERO, |sum, child| sum.saturating_add(child.stop_within))
    }

    /// Who a child is.
    #[must_use]
    pub fn who(&self, id: ChildId) -> Option<Listed> {
        self.listed.borrow().get(&id).cloned()
    }

    /// The name of a child; its id, if it is not known.
    pub(super) fn name(&self, id: ChildId) -> String {
        self.listed.borrow().get(&id).map_or_else(|| id.to_string(), |listed| listed.name.clone())
    }

    /// Whose child it is and in which life. Of one that its own end has removed, what was known last.
    pub(super) fn standing(&self, id: ChildId) -> Standing {
        let known = {
            let tree = self.tree.borrow();
            tree.owner(id).zip(tree.child(id))
        };
        let mut standings = self.standings.borrow_mut();
        if let Some((owner, child)) = known {
            let standing = Standing {
                supervisor: self.name(owner),
                generation: child.generation,
                restarts: child.restarts,
            };
            standings.insert(id, standing);
        }
        standings.get(&id).cloned().unwrap_or_default()
    }

    /// Replaces ids by names in what a supervisor says of why it gave up.
    #[must_use]
    pub fn name_children(&self, reason: Reason) -> Reason {
        let Reason::GaveUp(why) = reason else { return reason };
        let listed = self.listed.borrow();
        let with_name = |text: String, (id, listed): (&ChildId, &Listed)| {
            text.replace(&format!(" {id},"), &format!(" '{}',", listed.name))
        };
        Reason::GaveUp(listed.iter().fold(why, with_name))
    }

    pub(super) fn take_arrival(&self, id: ChildId) -> Option<(ChildId, ChildSpec)> {
        let (under, spec) = self.arrivals.borrow_mut().remove(&id)?;
        self.listed.borrow_mut().insert(id, listed(&spec));
        Some((under, spec))
    }

    /// Those that were brought to a supervisor that has ended before it took them in.
    pub(super) fn bury_arrivals(&self, burials: &Burials) {
        for (_, (_, spec)) in std::mem::take(&mut *self.arrivals.borrow_mut()) {
            burials.bury(spec.name, spec.launch);
        }
    }

    pub(super) fn remove(&self, id: ChildId) {
        self.listed.borrow_mut().remove(&id);
        self.standings.borrow_mut().remove(&id);
    }
}

fn listed(spec: &ChildSpec) -> Listed {
    Listed {
        name: spec.name.clone(),
        tid: spec.tid,
        place: Some(spec.place.clone()),
        stop_within: spec.policy.stop_within,
    }
}

/// Lists a plan's children; gives the plan without what only the shell needs.
fn enter(
    plan: SupervisorPlan,
    listed_children: &mut BTreeMap<ChildId, Listed>,
    workers: &mut Vec<ChildSpec>,
) -> Plan {
    let mut children = Vec::new();
    for child in plan.children {
        children.push(match child {
            PlannedChild::Worker(spec) => {
                let (id, policy): (ChildId, Policy) = (spec.id, spec.policy.clone());
                listed_children.insert(id, listed(&spec));
                workers.push(spec);
                Planned::Worker(id, policy)
            }
            PlannedChild::Supervisor(below, policy) => {
                Planned::Supervisor(enter(below, listed_children, workers), policy)
            }
        });
    }
    let supervisor = Listed { name: plan.name, tid: None, place: None, stop_within: Duration::ZERO };
    listed_children.insert(plan.id, supervisor);
    Plan { id: plan.id, flags: plan.flags, children }
}
