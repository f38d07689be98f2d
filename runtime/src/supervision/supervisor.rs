//! The shell of the supervisor: an actix actor that executes the decisions of its core.

mod notes;
mod plan;

use std::{cell::RefCell, collections::BTreeMap, rc::Rc};

use actix::{Actor, ActorContext, AsyncContext, Context, SpawnHandle, StreamHandler};

pub use self::plan::{ChildSpec, Launch, PlannedChild, SupervisorPlan};
use crate::{
    event_queue::EventQueue,
    supervision::{
        ReadyGate, Reason, SupervisorHandle, Threads,
        actor_handle::{ActorEvent, ActorHandle},
        child::Child,
        core::{ChildCommandError, ChildId, Command, Flags, Generation, Input, Order},
        deferred_drop::DropQueue,
        guard::Guard,
        liveness::Liveness,
        orphans::{Listener, Orphan, OrphanSlot, Orphans, RELEASE_WITHIN},
        panics::install_hook,
        unsupervised::overseen,
        watchdog::DeadlineExtension,
    },
    time::Time,
};

/// A fact that a supervisor reports to its owner.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SupervisorFact {
    /// A new incarnation of this child is about to be started. Reported before the start.
    Starting(ChildId, Generation),
    /// This child is ready and takes messages.
    Ready(ChildId),
    /// This child failed or was stopped, and will be started again in its turn.
    Failed(ChildId, Reason),
    /// This child has ended. Only a command, or a restart of its group, starts it again.
    Gone(ChildId, Reason),
    /// This child was deleted.
    Deleted(ChildId),
    /// All wanted children are ready.
    AllReady,
    /// A command was executed.
    Done(Command, ChildId),
    /// A command was refused.
    Refused(Command, ChildId, ChildCommandError),
    /// No child is alive any more.
    Ended(Reason),
}

/// The progress of a supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    Planned,
    Runs,
    HasEnded,
}

/// Supervises children; ends when all of them have ended.
pub struct Supervisor {
    own_handle: SupervisorHandle,
    children: BTreeMap<ChildId, Child>,
    threads: Rc<RefCell<Threads>>,
    drop_queue: DropQueue,
    queue: EventQueue<Input>,
    listener: Listener,
    alarm: Option<SpawnHandle>,
    progress: Progress,
    /// The overseer's slot for its children if it fails, if there is an overseer.
    orphan_slot: Option<OrphanSlot>,
}

/// Maximum number of queued events of a supervisor. Each child causes a few; only a fault could fill the queue.
const EVENT_QUEUE_CAPACITY: usize = 16_384;

impl Supervisor {
    /// Creates a supervisor called `name` of children that are not supervisors, and its event queue; see
    /// [`of`](Self::of).
    pub fn new(
        name: &str,
        flags: impl Into<Flags>,
        children: Vec<ChildSpec>,
        threads: Rc<RefCell<Threads>>,
        listener: impl FnMut(SupervisorFact) + 'static,
    ) -> (Self, EventQueue<Input>) {
        let plan = SupervisorPlan {
            // The ID of no child: this supervisor has no parent.
            id: ChildId(u64::MAX),
            name: name.to_owned(),
            flags: flags.into(),
            children: children.into_iter().map(PlannedChild::Worker).collect(),
        };
        let supervisor = Self::of(plan, threads, listener);
        let queue = supervisor.queue.clone();
        (supervisor, queue)
    }

    /// Creates a tree of supervisors, all of them in this one actor. `listener` receives each fact on the
    /// supervisor's thread, at once, before the next fact occurs.
    pub fn of(
        plan: SupervisorPlan,
        threads: Rc<RefCell<Threads>>,
        listener: impl FnMut(SupervisorFact) + 'static,
    ) -> Self {
        let (queue, drop_queue) = (EventQueue::new(EVENT_QUEUE_CAPACITY), threads.borrow().drop_queue());
        let (own_handle, workers) = SupervisorHandle::new(plan, seed(), queue.clone());
        Self {
            own_handle,
            children: workers.into_iter().map(|spec| (spec.id, Child::new(spec))).collect(),
            threads,
            drop_queue,
            queue,
            listener: Box::new(listener),
            alarm: None,
            progress: Progress::Planned,
            orphan_slot: None,
        }
    }

    /// Runs the supervisor on the calling thread, which must be an actix arbiter's. The future ends with it,
    /// and returns the reason. If the supervisor itself fails, its children are stopped, each within its
    /// declared time, and each end is reported to the listener as a failure; then the future ends. Dropping
    /// the future abandons the children.
    pub fn oversee(mut self) -> impl Future<Output = Reason> + use<> {
        let orphan_slot = OrphanSlot::default();
        self.orphan_slot = Some(orphan_slot.clone());
        let ended = overseen("supervisor", self);
        async move {
            let reason = ended.await;
            let left = orphan_slot.take();
            if let Some(mut left) = left {
                let why = Reason::GaveUp(format!("its supervisor {reason}"));
                crate::log::error!(%reason, "a supervisor failed itself; its children are stopped");
                left.stop_all(&why).await;
            }
            reason
        }
    }

    /// Returns a handle of this supervisor, for its owner.
    #[must_use]
    pub fn new_handle(&self) -> SupervisorHandle {
        self.own_handle.clone()
    }

    fn feed(&mut self, input: Input, context: &mut Context<Self>) {
        #[cfg(feature = "fault-points")]
        self.own_handle.strike();
        self.decide(input);
        loop {
            let next = self.own_handle.tree.borrow_mut().poll();
            let Some(order) = next else { break };
            self.execute(order, context);
        }
        if let Some(alarm) = self.alarm.take() {
            context.cancel_future(alarm);
        }
        let next_wake = self.own_handle.tree.borrow().next_wake();
        if let Some(wake) = next_wake {
            let wait = wake.since(Time::now());
            self.alarm = Some(context.run_later(wait, |this, context| {
                this.alarm = None;
                this.feed(Input::TimePassed, context);
            }));
        }
    }

    /// Extends deadlines that passed without enough CPU time.
    fn extend_deadlines(&mut self, now: Time) {
        let mut tree = self.own_handle.tree.borrow_mut();
        if tree.next_wake().is_none_or(|wake| wake > now) {
            return;
        }
        for (id, child) in &mut self.children {
            let Some(view) = tree.child(*id) else { continue };
            if let Some(until) = child.extended_deadline(view.state, now) {
                tree.handle(now, Input::DeadlineExtended(*id, view.generation, until));
            }
        }
    }

    fn decide(&mut self, input: Input) {
        let now = Time::now();
        self.extend_deadlines(now);
        let pending_child = match &input {
            Input::AddChild(id, _) => self.own_handle.take_pending(*id),
            Input::Started
            | Input::Released(_)
            | Input::BecameReady(..)
            | Input::Hung(..)
            | Input::Ended(..)
            | Input::DeadlineExtended(..)
            | Input::TimePassed
            | Input::StopOrdered
            | Input::TerminateChild(_)
            | Input::RestartChild(_)
            | Input::DeleteChild(_) => None,
        };
        let mut tree = self.own_handle.tree.borrow_mut();
        match pending_child {
            Some((under, spec)) => {
                let (id, policy) = (spec.id, spec.policy.clone());
                self.children.insert(id, Child::new(spec));
                tree.add(now, under, id, policy);
            }
            None => tree.handle(now, input),
        }
    }

    fn execute(&mut self, order: Order, context: &mut Context<Self>) {
        match order {
            Order::Spawn(id, generation) => {
                self.note(id, "starting");
                self.note_restart(id);
                (self.listener)(SupervisorFact::Starting(id, generation));
                self.spawn(id, generation);
            }
            Order::Stop(id, _) => {
                self.note(id, "ordered to stop");
                if let Some(Child { spec, handle: Some(handle), extension, .. }) = self.children.get_mut(&id)
                {
                    *extension =
                        Some(self.threads.borrow().deadline_extension(handle, spec.policy.stop_within));
                    handle.stop();
                }
            }
            Order::Abandon(id, _) => self.abandon(id, context),
            Order::Failed(id, reason) => {
                let reason = self.own_handle.name_children(reason);
                self.note_end(id, &reason);
                (self.listener)(SupervisorFact::Failed(id, reason));
                self.mark_reported(id);
            }
            Order::Ready(id) => {
                self.note(id, "ready");
                let former = self.children.get_mut(&id).and_then(|child| {
                    child.extension = None;
                    child.cannot_start.take()
                });
                if former.is_some() {
                    // Its failed starts were logged as warnings.
                    let child = self.own_handle.name(id);
                    crate::log::info!(
                        child,
                        tid = self.tid_of(id),
                        "{child} has started, after starts that failed"
                    );
                }
                (self.listener)(SupervisorFact::Ready(id));
            }
            Order::Gone(id, reason) => {
                let reason = self.own_handle.name_children(reason);
                self.note_end(id, &reason);
                (self.listener)(SupervisorFact::Gone(id, reason));
                self.mark_reported(id);
            }
            Order::Deleted(id) => {
                self.note(id, "deleted");
                self.forget(id);
                (self.listener)(SupervisorFact::Deleted(id));
            }
            Order::Done(command, id) => (self.listener)(SupervisorFact::Done(command, id)),
            Order::Refused(command, id, why) => {
                if command == Command::Add && why != ChildCommandError::Present {
                    self.forget(id);
                }
                (self.listener)(SupervisorFact::Refused(command, id, why));
            }
            Order::AllReady => (self.listener)(SupervisorFact::AllReady),
            Order::Ended(reason) => {
                let reason = self.own_handle.name_children(reason);
                self.progress = Progress::HasEnded;
                (self.listener)(SupervisorFact::Ended(reason));
                context.stop();
            }
        }
    }

    /// Marks the end of this incarnation as reported. Called before the report, because the listener may
    /// panic, and orphans are then reported again.
    fn mark_reported(&mut self, id: ChildId) {
        if let Some(child) = self.children.get_mut(&id) {
            child.has_unreported_end = false;
            child.extension = None;
        }
    }

    fn forget(&mut self, id: ChildId) {
        if let Some(child) = self.children.remove(&id) {
            self.threads.borrow_mut().leave(&child.spec.place);
            child.discard(&self.drop_queue);
        }
        self.own_handle.remove(id);
    }

    fn spawn(&mut self, id: ChildId, generation: Generation) {
        install_hook();
        let Some(Child { spec, handle: held, extension, has_unreported_end, .. }) =
            self.children.get_mut(&id)
        else {
            return;
        };
        let mut threads = self.threads.borrow_mut();
        let queue = self.queue.clone();
        let (thread, slot) = match threads.get(&spec.place) {
            Ok(found) => found,
            Err(why) => return post_input(&queue, Input::Ended(id, generation, Reason::GaveUp(why))),
        };
        let report = Box::new(move |event| match event {
            ActorEvent::Hung(reason) => post_input(&queue, Input::Hung(id, generation, reason)),
            ActorEvent::Ended(reason) => post_input(&queue, Input::Ended(id, generation, reason)),
        });
        let liveness = Liveness::of(&*spec.name, spec.tid);
        let handle = ActorHandle::new(liveness, Some(slot), spec.policy.progress_within, report);
        threads.register(&handle);
        *extension = Some(threads.deadline_extension(&handle, spec.policy.start_within));
        (*held, *has_unreported_end) = (Some(handle.clone()), true);
        let ready = {
            let (queue, liveness) = (self.queue.clone(), handle.liveness().clone());
            ReadyGate::new(move || {
                liveness.set_ready();
                post_input(&queue, Input::BecameReady(id, generation));
            })
        };
        let (launch, pending, drop_queue) =
            (spec.launch.clone(), PendingStart(Some(handle)), self.drop_queue.clone());
        // A thread that has ended drops the closure, which is reported: the next start creates a new thread.
        thread.spawn_fn(move || start(&launch, ready, pending, drop_queue));
    }

    /// Abandons a child. Its thread may have other actors, so the thread is abandoned only if it does not
    /// release the child.
    fn abandon(&mut self, id: ChildId, context: &mut Context<Self>) {
        let Some(Child { spec, handle, .. }) = self.children.get_mut(&id) else { return };
        let Some(handle) = handle.take() else { return };
        crate::log::error!(
            supervisor = self.own_handle.record(id).supervisor,
            child = spec.name,
            "the incarnation is abandoned"
        );
        handle.kill();
        if handle.blocked_since().is_some() {
            self.threads.borrow_mut().abandon(&handle);
            return;
        }
        let extension = self.threads.borrow().deadline_extension(&handle, RELEASE_WITHIN);
        await_release(handle, extension, Time::now() + RELEASE_WITHIN, context);
    }
}

/// Abandons the thread of an abandoned incarnation that has not ended by `deadline`.
fn await_release(
    handle: ActorHandle,
    mut extension: DeadlineExtension,
    deadline: Time,
    context: &mut Context<Supervisor>,
) {
    context.run_later(deadline.since(Time::now()), move |this, context| {
        if handle.has_ended() {
            return;
        }
        match extension.until(deadline, Time::now(), handle.liveness().is_ending()) {
            Some(later) => await_release(handle, extension, later, context),
            None => this.threads.borrow_mut().abandon(&handle),
        }
    });
}

/// Returns a random seed from the operating system, so that equal programs that start at one instant have
/// different waits.
fn seed() -> u64 {
    std::hash::BuildHasher::hash_one(&std::hash::RandomState::new(), 0_u8)
}

/// Starts a child, on its thread.
fn start(launch: &Launch, ready: ReadyGate, mut pending: PendingStart, drop_queue: DropQueue) {
    if let Some(handle) = pending.0.take()
        && let Some(guard) = Guard::make(launch, ready, handle, drop_queue)
    {
        actix_rt::spawn(guard);
    }
}

/// A child that its thread has not started yet, and perhaps never will.
struct PendingStart(Option<ActorHandle>);

impl Drop for PendingStart {
    fn drop(&mut self) {
        if let Some(handle) = self.0.take() {
            handle.liveness().set_ended();
            handle.report(ActorEvent::Ended(Reason::ThreadEnded));
        }
    }
}

fn post_input(queue: &EventQueue<Input>, input: Input) {
    if let Err(lost) = queue.post(input) {
        crate::log::error!(
            ?lost,
            "a supervisor was not notified: its event queue is full, or the sender was replaced; its deadlines will notice"
        );
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.own_handle.drop_pending(&self.drop_queue);
        let mut orphans = Vec::new();
        for (id, child) in std::mem::take(&mut self.children) {
            let stop_within = child.spec.policy.stop_within;
            let has_unreported_end = child.has_unreported_end;
            let handle = child.discard(&self.drop_queue).filter(|_| has_unreported_end);
            orphans.extend(handle.map(|handle| (id, Orphan { handle, stop_within })));
        }
        match self.progress {
            // No child is alive.
            Progress::Planned | Progress::HasEnded => return,
            // The supervisor panicked, or was dropped: its children have no supervisor any more.
            Progress::Runs => {}
        }
        let listener = std::mem::replace(&mut self.listener, Box::new(|_| {}));
        let (threads, queue) = (self.threads.clone(), self.queue.clone());
        let orphans = Orphans::take_over(orphans.into_iter(), threads, queue, listener);
        match &self.orphan_slot {
            Some(orphan_slot) => _ = orphan_slot.replace(Some(orphans)),
            None => orphans.stop_detached(),
        }
    }
}

impl Actor for Supervisor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.progress = Progress::Runs;
        context.add_stream(self.queue.attach());
        self.feed(Input::Started, context);
    }
}

impl StreamHandler<Input> for Supervisor {
    fn handle(&mut self, input: Input, context: &mut Context<Self>) {
        self.feed(input, context);
    }
}
