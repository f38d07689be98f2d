//! The supervisor's shell: an actix actor that carries out what its core decides.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc};

use actix::{Actor, ActorContext, AsyncContext, Context, SpawnHandle, StreamHandler};

use crate::{
    post::Post,
    supervision::{
        Life, Place, ReadyGate, Reason, Roster, Threads,
        alone::overseen,
        burial::Burials,
        child::Child,
        core::{ChildId, Command, Flags, Generation, Input, Order, Policy, Refusal},
        guard::Guard,
        orphans::{LETTING_GO, Legacy, Listener, Orphan, Orphans},
        panics::install_hook,
        roster::Standing,
        tenant::{Fate, Tenant},
        vitals::Vitals,
        watchdog::Reprieve,
    },
    tid::Tid,
    time::Time,
};

/// Makes a new instance of a child, on the child's thread. A panic in it is a failed start.
pub type Launch = Arc<dyn Fn(ReadyGate) -> Box<dyn Life> + Send + Sync>;

/// One child of a supervisor.
pub struct ChildSpec {
    /// Which child of its node it is.
    pub id: ChildId,
    /// Its name, for people.
    pub name: String,
    /// Its address, if it has one; for people, too.
    pub tid: Option<Tid>,
    /// What its supervisor may do with it.
    pub policy: Policy,
    /// Where it runs.
    pub place: Place,
    /// How it is made.
    pub launch: Launch,
}

/// A supervisor to be.
pub struct SupervisorPlan {
    /// Which child of its node it is.
    pub id: ChildId,
    /// Its name, for people.
    pub name: String,
    /// How it treats its children.
    pub flags: Flags,
    /// Its children, in the order of their start.
    pub children: Vec<PlannedChild>,
}

/// A child to be.
pub enum PlannedChild {
    /// An actor.
    Worker(ChildSpec),
    /// A supervisor, and what its parent may do with it; its deadlines are those of its children.
    Supervisor(SupervisorPlan, Policy),
}

/// What a supervisor says to its owner.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SupervisorFact {
    /// A new life of this child is about to be started. Said before it is.
    Starting(ChildId, Generation),
    /// This child takes messages.
    Ready(ChildId),
    /// This child failed or was stopped, and is started again if its turn comes.
    Failed(ChildId, Reason),
    /// This child is gone. It is not started again unless by a command, or together with its group.
    Gone(ChildId, Reason),
    /// This child is forgotten.
    Deleted(ChildId),
    /// All children that are wanted are ready.
    AllReady,
    /// A command is carried out.
    Done(Command, ChildId),
    /// A command is not carried out.
    Refused(Command, ChildId, Refusal),
    /// No child lives any more.
    Ended(Reason),
}

/// How far a supervisor is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    Planned,
    Runs,
    HasEnded,
}

/// Supervises children; ends when none of them lives any more.
pub struct Supervisor {
    roster: Roster,
    children: BTreeMap<ChildId, Child>,
    threads: Rc<RefCell<Threads>>,
    burials: Burials,
    post: Post<Input>,
    listener: Listener,
    alarm: Option<SpawnHandle>,
    progress: Progress,
    /// Who takes its children over if it fails, where somebody does.
    heir: Option<Legacy>,
}

/// Events that wait for a supervisor at most. Each child causes a handful; only a fault could fill this.
const POST_CAPACITY: usize = 16_384;

impl Supervisor {
    /// A supervisor called `name` of children that are no supervisors, and the post through which it hears; see
    /// [`of`](Self::of).
    pub fn new(
        name: &str,
        flags: impl Into<Flags>,
        children: Vec<ChildSpec>,
        threads: Rc<RefCell<Threads>>,
        listener: impl FnMut(SupervisorFact) + 'static,
    ) -> (Self, Post<Input>) {
        let plan = SupervisorPlan {
            // Nobody's child: any id that no child has.
            id: ChildId(u64::MAX),
            name: name.to_owned(),
            flags: flags.into(),
            children: children.into_iter().map(PlannedChild::Worker).collect(),
        };
        let supervisor = Self::of(plan, threads, listener);
        let post = supervisor.post.clone();
        (supervisor, post)
    }

    /// A tree of supervisors, all of them in this one actor. `listener` is told of what happens, on the supervisor's thread
    /// and at once: before the next thing happens.
    pub fn of(
        plan: SupervisorPlan,
        threads: Rc<RefCell<Threads>>,
        listener: impl FnMut(SupervisorFact) + 'static,
    ) -> Self {
        let (post, burials) = (Post::new(POST_CAPACITY), threads.borrow().burials());
        let (roster, workers) = Roster::new(plan, seed(), post.clone());
        Self {
            roster,
            children: workers.into_iter().map(|spec| (spec.id, Child::new(spec))).collect(),
            threads,
            burials,
            post,
            listener: Box::new(listener),
            alarm: None,
            progress: Progress::Planned,
            heir: None,
        }
    }

    /// Runs the supervisor on the calling thread, which is an arbiter's of actix. The future ends with it, and says how. If
    /// it fails itself, its children are told to stop, each has the time for it that it was declared with, and the listener
    /// is told of each end, as of a failure; the future ends then. Whoever drops the future takes their lives.
    pub fn oversee(mut self) -> impl Future<Output = Reason> + use<> {
        let legacy = Legacy::default();
        self.heir = Some(legacy.clone());
        let ended = overseen("supervisor", self);
        async move {
            let reason = ended.await;
            let left = legacy.take();
            if let Some(mut left) = left {
                let why = Reason::GaveUp(format!("its supervisor {reason}"));
                crate::log::error!(%reason, "a supervisor failed itself; its children are told to stop");
                left.end_all(&why).await;
            }
            reason
        }
    }

    /// Who is supervised, for the owner.
    #[must_use]
    pub fn roster(&self) -> Roster {
        self.roster.clone()
    }

    fn feed(&mut self, input: Input, context: &mut Context<Self>) {
        #[cfg(feature = "fault-points")]
        self.roster.strike();
        self.decide(input);
        loop {
            let next = self.roster.tree.borrow_mut().poll();
            let Some(order) = next else { break };
            self.obey(order, context);
        }
        if let Some(alarm) = self.alarm.take() {
            context.cancel_future(alarm);
        }
        let next_wake = self.roster.tree.borrow().next_wake();
        if let Some(wake) = next_wake {
            let wait = wake.since(Time::now());
            self.alarm = Some(context.run_later(wait, |this, context| {
                this.alarm = None;
                this.feed(Input::TimePassed, context);
            }));
        }
    }

    /// Whoever's time is over and was not given to it has more of it.
    fn reprieve_the_late(&mut self, now: Time) {
        let mut tree = self.roster.tree.borrow_mut();
        if tree.next_wake().is_none_or(|wake| wake > now) {
            return;
        }
        for (id, child) in &mut self.children {
            let Some(view) = tree.child(*id) else { continue };
            if let Some(until) = child.reprieved(view.state, now) {
                tree.handle(now, Input::Reprieved(*id, view.generation, until));
            }
        }
    }

    fn decide(&mut self, input: Input) {
        let now = Time::now();
        self.reprieve_the_late(now);
        let arrival = match &input {
            Input::AddChild(id, _) => self.roster.take_arrival(*id),
            Input::Started
            | Input::Released(_)
            | Input::BecameReady(..)
            | Input::Hung(..)
            | Input::Ended(..)
            | Input::Reprieved(..)
            | Input::TimePassed
            | Input::StopOrdered
            | Input::TerminateChild(_)
            | Input::RestartChild(_)
            | Input::DeleteChild(_) => None,
        };
        let mut tree = self.roster.tree.borrow_mut();
        match arrival {
            Some((under, spec)) => {
                let (id, policy) = (spec.id, spec.policy.clone());
                self.children.insert(id, Child::new(spec));
                tree.add(now, under, id, policy);
            }
            None => tree.handle(now, input),
        }
    }

    fn obey(&mut self, order: Order, context: &mut Context<Self>) {
        match order {
            Order::Spawn(id, generation) => {
                self.note(id, "starting");
                (self.listener)(SupervisorFact::Starting(id, generation));
                self.spawn(id, generation);
            }
            Order::Stop(id, _) => {
                self.note(id, "told to stop");
                if let Some(Child { spec, tenant: Some(tenant), reprieve, .. }) = self.children.get_mut(&id) {
                    *reprieve = Some(self.threads.borrow().reprieve(tenant, spec.policy.stop_within));
                    tenant.stop();
                }
            }
            Order::Abandon(id, _) => self.abandon(id, context),
            Order::Failed(id, reason) => {
                let reason = self.roster.name_children(reason);
                self.note_end(id, &reason);
                (self.listener)(SupervisorFact::Failed(id, reason));
                self.settle(id);
            }
            Order::Ready(id) => {
                self.note(id, "ready");
                if let Some(child) = self.children.get_mut(&id) {
                    child.reprieve = None;
                    child.cannot_start = None;
                }
                (self.listener)(SupervisorFact::Ready(id));
            }
            Order::Gone(id, reason) => {
                let reason = self.roster.name_children(reason);
                self.note_end(id, &reason);
                (self.listener)(SupervisorFact::Gone(id, reason));
                self.settle(id);
            }
            Order::Deleted(id) => {
                self.note(id, "deleted");
                self.forget(id);
                (self.listener)(SupervisorFact::Deleted(id));
            }
            Order::Done(command, id) => (self.listener)(SupervisorFact::Done(command, id)),
            Order::Refused(command, id, why) => {
                if command == Command::Add && why != Refusal::Present {
                    self.forget(id);
                }
                (self.listener)(SupervisorFact::Refused(command, id, why));
            }
            Order::AllReady => (self.listener)(SupervisorFact::AllReady),
            Order::Ended(reason) => {
                let reason = self.roster.name_children(reason);
                self.progress = Progress::HasEnded;
                (self.listener)(SupervisorFact::Ended(reason));
                context.stop();
            }
        }
    }

    /// The end of this child's life is told: now, because whoever is told may panic, and is told again then.
    fn settle(&mut self, id: ChildId) {
        if let Some(child) = self.children.get_mut(&id) {
            child.is_owed = false;
            child.reprieve = None;
        }
    }

    fn forget(&mut self, id: ChildId) {
        if let Some(child) = self.children.remove(&id) {
            self.threads.borrow_mut().leave(&child.spec.place);
            child.bury(&self.burials);
        }
        self.roster.remove(id);
    }

    /// One event for each change, for whoever reads them.
    fn note(&self, id: ChildId, what: &'static str) {
        let Standing { supervisor, generation, restarts } = self.roster.standing(id);
        let (child, tid, waiting) = (self.roster.name(id), self.tid_of(id), self.waiting(id));
        crate::log::debug!(supervisor, child, tid, generation, restarts, waiting, "{what}");
    }

    fn note_end(&mut self, id: ChildId, reason: &Reason) {
        if let Reason::StartFailed(why) = reason
            && let Some(child) = self.children.get_mut(&id)
            && child.cannot_start.replace(why.clone()).as_ref() == Some(why)
        {
            // That was logged when it failed so first.
            return self.note(id, "cannot start yet");
        }
        let Standing { supervisor, generation, restarts } = self.roster.standing(id);
        let (child, tid, waiting) = (self.roster.name(id), self.tid_of(id), self.waiting(id));
        if let Reason::StartFailed(why) = reason {
            return crate::log::warn!(
                supervisor,
                child,
                tid,
                generation,
                waiting,
                "{child} cannot start: {why}. It is tried again, and this is logged again when the reason changes"
            );
        }
        if *reason == Reason::Shutdown {
            return crate::log::debug!(supervisor, child, tid, generation, restarts, waiting, %reason, "a child ended");
        }
        if !reason.is_failure() {
            return crate::log::info!(supervisor, child, tid, generation, restarts, waiting, %reason, "a child ended");
        }
        // What a panic said, the panic hook has written.
        let place = if let Reason::Panic(words) = reason { words.rsplit_once(" at ") } else { None };
        let reason = place.map_or_else(|| reason.to_string(), |(_, place)| format!("a panic at {place}"));
        crate::log::error!(supervisor, child, tid, generation, restarts, waiting, reason, "a child failed");
    }

    /// Messages that wait for it; `None` where that is not known here, or somebody is in its mailbox.
    fn waiting(&self, id: ChildId) -> Option<usize> {
        let tenant = self.children.get(&id)?.tenant.as_ref()?;
        tenant.vitals().backlog().map(|(waiting, _)| waiting)
    }

    fn tid_of(&self, id: ChildId) -> Option<String> {
        self.children.get(&id).and_then(|child| child.spec.tid).map(|tid| tid.to_string())
    }

    fn spawn(&mut self, id: ChildId, generation: Generation) {
        install_hook();
        let Some(Child { spec, tenant: held, reprieve, is_owed, .. }) = self.children.get_mut(&id) else {
            return;
        };
        let mut threads = self.threads.borrow_mut();
        let post = self.post.clone();
        let (thread, seat) = match threads.get(&spec.place) {
            Ok(found) => found,
            Err(why) => return say(&post, Input::Ended(id, generation, Reason::GaveUp(why))),
        };
        let report = Box::new(move |fate| match fate {
            Fate::Hung(reason) => say(&post, Input::Hung(id, generation, reason)),
            Fate::Ended(reason) => say(&post, Input::Ended(id, generation, reason)),
        });
        let vitals = Vitals::of(&*spec.name, spec.tid);
        let tenant = Tenant::new(vitals, Some(seat), spec.policy.progress_within, report);
        threads.settle(&tenant);
        *reprieve = Some(threads.reprieve(&tenant, spec.policy.start_within));
        (*held, *is_owed) = (Some(tenant.clone()), true);
        let ready = {
            let (post, vitals) = (self.post.clone(), tenant.vitals().clone());
            ReadyGate::new(move || {
                vitals.set_ready();
                say(&post, Input::BecameReady(id, generation));
            })
        };
        let (launch, unborn, burials) = (spec.launch.clone(), Unborn(Some(tenant)), self.burials.clone());
        // A thread that has ended drops this, which is reported: the next start makes a new thread.
        thread.spawn_fn(move || start(&launch, ready, unborn, burials));
    }

    /// Takes a child's life. Its thread may have other tenants: it is given up only if it does not let the child go.
    fn abandon(&mut self, id: ChildId, context: &mut Context<Self>) {
        let Some(Child { spec, tenant, .. }) = self.children.get_mut(&id) else { return };
        let Some(tenant) = tenant.take() else { return };
        crate::log::error!(
            supervisor = self.roster.standing(id).supervisor,
            child = spec.name,
            "its life is taken"
        );
        tenant.kill();
        if tenant.holds_its_thread().is_some() {
            self.threads.borrow_mut().give_up(&tenant);
            return;
        }
        let reprieve = self.threads.borrow().reprieve(&tenant, LETTING_GO);
        let_go(tenant, reprieve, Time::now() + LETTING_GO, context);
    }
}

/// Gives up the thread of a life that was taken and has not ended by `deadline`.
fn let_go(tenant: Tenant, mut reprieve: Reprieve, deadline: Time, context: &mut Context<Supervisor>) {
    context.run_later(deadline.since(Time::now()), move |this, context| {
        if tenant.has_ended() {
            return;
        }
        match reprieve.until(deadline, Time::now(), tenant.vitals().is_leaving()) {
            Some(later) => let_go(tenant, reprieve, later, context),
            None => this.threads.borrow_mut().give_up(&tenant),
        }
    });
}

/// Chance from the operating system: nodes that are one program and start at one instant wait for different times.
fn seed() -> u64 {
    std::hash::BuildHasher::hash_one(&std::hash::RandomState::new(), 0_u8)
}

/// Runs on the child's thread.
fn start(launch: &Launch, ready: ReadyGate, mut unborn: Unborn, burials: Burials) {
    if let Some(tenant) = unborn.0.take()
        && let Some(guard) = Guard::make(launch, ready, tenant, burials)
    {
        actix_rt::spawn(guard);
    }
}

/// A child whose thread has not come to it yet, and perhaps never will.
struct Unborn(Option<Tenant>);

impl Drop for Unborn {
    fn drop(&mut self) {
        if let Some(tenant) = self.0.take() {
            tenant.vitals().set_gone();
            tenant.report(Fate::Ended(Reason::ThreadEnded));
        }
    }
}

fn say(post: &Post<Input>, input: Input) {
    if let Err(lost) = post.post(input) {
        crate::log::error!(
            ?lost,
            "a supervisor was not told: its post is full, or who told it was replaced; its deadlines will notice"
        );
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.roster.bury_arrivals(&self.burials);
        let mut orphans = Vec::new();
        for (id, child) in std::mem::take(&mut self.children) {
            let stop_within = child.spec.policy.stop_within;
            let owed = child.is_owed;
            let tenant = child.bury(&self.burials).filter(|_| owed);
            orphans.extend(tenant.map(|tenant| (id, Orphan { tenant, stop_within })));
        }
        match self.progress {
            // None lives.
            Progress::Planned | Progress::HasEnded => return,
            // It panicked, or somebody dropped it: nobody decides for its children any more.
            Progress::Runs => {}
        }
        let listener = std::mem::replace(&mut self.listener, Box::new(|_| {}));
        let (threads, post) = (self.threads.clone(), self.post.clone());
        let orphans = Orphans::take_over(orphans.into_iter(), threads, post, listener);
        match &self.heir {
            Some(heir) => _ = heir.replace(Some(orphans)),
            None => orphans.end_apart(),
        }
    }
}

impl Actor for Supervisor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.progress = Progress::Runs;
        context.add_stream(self.post.attach());
        self.feed(Input::Started, context);
    }
}

impl StreamHandler<Input> for Supervisor {
    fn handle(&mut self, input: Input, context: &mut Context<Self>) {
        self.feed(input, context);
    }
}
