//! The root actor: forwards events between the supervisors, the sync manager and the node's owner.

mod events;
mod progress;
mod registration;
mod signals;
mod systemd;

use std::{
    cell::RefCell,
    collections::BTreeMap,
    rc::Rc,
    sync::{Arc, Weak, atomic::Ordering, mpsc::SyncSender},
    time::Duration,
};

use actix::{Actor, ActorContext, AsyncContext, Context, StreamHandler};
use sinew_model::{events::LayerReport, leave_reason::LeaveReason};
use sinew_runtime::{
    event_queue::EventQueue,
    lock,
    supervision::{
        ChildId, ChildIds, DropQueue, Input, PlannedChild, Reason, Supervisor, SupervisorFact,
        SupervisorHandle, SupervisorPlan, Threads, detach_threads,
    },
    tid::AppAddress,
    time::Time,
};

pub(crate) use self::events::{RootEvent, RootQueue};

use super::{
    NodeEnd, StartError,
    apps::Apps,
    commands::Answers,
    down_policies::DownPolicies,
    layers,
    progress::{IdleClients, Stalls},
    reply_waiters::ReplySender,
    shutdown::{self, Branch, SupervisorHandles},
    supervisor_spec::SupervisorSpec,
};
use crate::{NodeState, process, systemd::Notifier};

/// Maximum number of confirmed messages and requests in flight per application.
pub(crate) const WAITS_MAX: usize = 1_024;

/// The phase of the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    StartingLayers,
    Running,
    StoppingApps,
    StoppingLayers,
}

/// Names that require each other in a cycle, the first one repeated at the end.
struct Cycle {
    names: Vec<String>,
    /// The same with the names of other nodes.
    labels: Vec<String>,
    /// The applications of this node among them.
    ours: Vec<ChildId>,
}

/// The time for which a node that ends because of a cycle stays for the other nodes of that cycle. They
/// find the cycle in its directory, which a node that ended at once might not have sent yet.
const CYCLE_NOTICE_TIME: Duration = Duration::from_secs(1);

/// Time limit for dropping the values that applications captured, after the end of their node.
const DROP_TIMEOUT: Duration = Duration::from_secs(1);

pub(super) struct Root {
    pub(super) state: Arc<NodeState>,
    pub(super) threads: Rc<RefCell<Threads>>,
    pub(super) drop_queue: DropQueue,
    supervisors: SupervisorHandles,
    pub(super) phase: Phase,
    pub(super) began: Time,
    end: NodeEnd,
    declared: Option<SupervisorSpec>,
    child_ids: ChildIds,
    pub(super) apps: Apps,
    pub(super) down_policies: DownPolicies,
    pub(super) answers: Answers,
    pub(super) turns: Stalls,
    pub(super) clients: IdleClients,
    /// The applications in processes of their own, which report themselves whether they stall.
    pub(super) hosted: BTreeMap<String, Weak<process::Link>>,
    pub(super) layer_supervisor: Option<SupervisorHandle>,
    pub(super) app_supervisor: Option<SupervisorHandle>,
    last_layer_fault: Option<String>,
    /// The process that has the node's address; the node ends because of it.
    address_taken: Option<String>,
    cycle: Option<Cycle>,
    started: Option<SyncSender<Result<(), StartError>>>,
    ended: SyncSender<NodeEnd>,
    running_waiters: Vec<ReplySender>,
    heeds_signals: bool,
    /// Only the node itself handles its end.
    runs_alone: bool,
    /// Set if systemd expects notifications.
    notifier: Option<Notifier>,
}

/// Runs the root thread.
pub(super) fn run(
    state: Arc<NodeState>,
    declared: SupervisorSpec,
    started: SyncSender<Result<(), StartError>>,
    ended: SyncSender<NodeEnd>,
) {
    let made = tokio::runtime::Builder::new_current_thread().enable_all().build().and_then(|reactor| {
        let system = actix::System::with_tokio_rt(|| reactor);
        detach_threads().map(|()| system)
    });
    let system = match made {
        Ok(system) => system,
        Err(error) => {
            // The owner waits for this answer alone.
            let _ = started.send(Err(StartError::Thread(error)));
            return;
        }
    };
    let supervisors = SupervisorHandles::default();
    let (kept, end_sender) = (state.clone(), ended.clone());
    let queue = state.root.clone();
    let threads = Rc::new(RefCell::new(Threads::default()));
    let drop_queue = threads.borrow().drop_queue();
    let root = Root {
        threads: threads.clone(),
        drop_queue: drop_queue.clone(),
        supervisors: supervisors.clone(),
        phase: Phase::StartingLayers,
        began: Time::now(),
        end: NodeEnd::Stopped,
        declared: Some(declared),
        child_ids: ChildIds::default(),
        apps: Apps::default(),
        down_policies: DownPolicies::new(state.clone()),
        answers: Answers::default(),
        turns: Stalls::default(),
        clients: IdleClients::default(),
        hosted: BTreeMap::new(),
        layer_supervisor: None,
        app_supervisor: None,
        last_layer_fault: None,
        address_taken: None,
        cycle: None,
        started: Some(started),
        ended,
        running_waiters: Vec::new(),
        heeds_signals: false,
        runs_alone: false,
        notifier: None,
        state,
    };
    // Until the root's own end: a program that stops the current actor system does not end the node.
    system.block_on(shutdown::oversee(root, supervisors, kept, end_sender));
    threads.borrow_mut().stop();
    // Callers that wait for an answer are notified now that there will be none.
    drop_queue.push("orders that came too late", queue.close());
    drop_queue.wait(DROP_TIMEOUT);
}

impl Drop for Root {
    fn drop(&mut self) {
        // The layers did not start: the values captured by the applications are dropped on another thread nevertheless.
        if let Some(declared) = self.declared.take() {
            self.drop_queue.push("a node that did not start", declared);
        }
    }
}

impl Actor for Root {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        // First the events that are queued already: an order to handle signals may be among them.
        context.add_stream(self.state.root.attach());
        let deadline = self.state.ctx.config.sync.layer_deadline;
        let layers = layers::specs(&self.state, &self.child_ids, deadline);
        let queue = self.state.root.clone();
        let listener = move |fact| post_event(&queue, RootEvent::Layers(fact));
        let plan = SupervisorPlan {
            id: self.child_ids.next(),
            name: layers::SUPERVISOR.to_owned(),
            flags: self.state.ctx.config.supervision.layers(),
            children: layers.into_iter().map(PlannedChild::Worker).collect(),
        };
        let supervisor = Supervisor::of(plan, self.threads.clone(), listener);
        let handle = self.supervisors.run(Branch::Layers, supervisor, &self.state, RootEvent::Layers);
        self.layer_supervisor = Some(handle);
    }
}

fn post_event(queue: &EventQueue<RootEvent>, event: RootEvent) {
    if let Err(lost) = queue.post(event) {
        sinew_runtime::log::error!(?lost, "the root's event queue is full");
    }
}

impl StreamHandler<RootEvent> for Root {
    fn handle(&mut self, event: RootEvent, context: &mut Context<Self>) {
        match event {
            RootEvent::Layer(LayerReport::Release { app }) => self.release(app),
            RootEvent::Layer(LayerReport::RequirementCycle { names, labels }) => {
                let ours = names.iter().skip(1).filter_map(|name| self.apps.named(name)).collect();
                self.cycle = Some(Cycle { names, labels, ours });
                // First: the other node of the cycle may have ended because of it already.
                self.end_on_cycle(context);
                self.notify_if_running();
            }
            RootEvent::RunsAlone => {
                self.runs_alone = true;
                self.begin_notifications(context);
                self.notify_if_running();
                self.end_on_cycle(context);
            }
            RootEvent::Layers(fact) => self.handle_layers_fact(fact, context),
            RootEvent::Apps(fact) => self.handle_apps_fact(fact),
            RootEvent::Ordered(ordered) => self.execute(ordered),
            // The caller may have stopped waiting.
            RootEvent::QueryTree(answer) => _ = answer.try_send(self.tree()),
            RootEvent::Layer(LayerReport::AddressTaken(words)) => self.address_taken(words),
            RootEvent::Layer(LayerReport::CannotStart(words)) => self.layer_cannot_start(words),
            RootEvent::Layer(LayerReport::RequestProgress(answer)) => _ = answer.send(self.progress()),
            RootEvent::HeedSignals => self.heed_signals(context),
            RootEvent::StopOrdered => self.stop_apps(),
            RootEvent::OwnerPanicked => {
                self.gives_up("the thread that owns the node panicked".to_owned());
                self.stop_apps();
            }
            #[cfg(feature = "fault-points")]
            RootEvent::Fail => panic!("a fault was planned for the root"),
            #[cfg(feature = "fault-points")]
            RootEvent::FailSupervisor => self.app_supervisor.iter().for_each(SupervisorHandle::fail),
            RootEvent::NotifyWhenRunning(waiter) => {
                waiter.join(&mut self.running_waiters);
                self.notify_if_running();
            }
        }
    }
}

impl Root {
    fn release(&self, app: AppAddress) {
        match (self.apps.with_address(app), &self.app_supervisor) {
            (Some(id), Some(supervisor)) => order(supervisor, Input::Released(id)),
            // Not an application of this process: LNCL knows its client.
            (None, _) => {
                if self.state.ctx.event_queues.lncl.post(sinew_lncl::Event::Released { app }).is_err() {
                    sinew_runtime::log::error!(%app, "LNCL's event queue is full: a client's registration ends at its deadline");
                }
            }
            // The node stops: no child is started any more.
            (Some(_), None) => {}
        }
    }

    fn handle_layers_fact(&mut self, fact: SupervisorFact, context: &mut Context<Self>) {
        match fact {
            SupervisorFact::AllReady if self.phase == Phase::StartingLayers => self.start_apps(),
            SupervisorFact::Failed(id, reason) | SupervisorFact::Gone(id, reason) if reason.is_failure() => {
                let child = self.layer_supervisor.as_ref().and_then(|supervisor| supervisor.child_info(id));
                self.last_layer_fault = child.map(|child| layers::fault_in_one_line(&child.name, &reason));
                // The system gave this layer no thread.
                if let (Phase::StartingLayers, Reason::GaveUp(_), Some(words)) =
                    (self.phase, &reason, self.last_layer_fault.clone())
                {
                    self.layer_cannot_start(words);
                }
            }
            SupervisorFact::Failed(..) | SupervisorFact::Gone(..) => {}
            SupervisorFact::Ended(reason) => self.layers_ended(&reason, context),
            SupervisorFact::AllReady
            | SupervisorFact::Starting(..)
            | SupervisorFact::Ready(_)
            | SupervisorFact::Deleted(_)
            | SupervisorFact::Done(..)
            | SupervisorFact::Refused(..) => {}
        }
    }

    fn layers_ended(&mut self, reason: &Reason, context: &mut Context<Self>) {
        if let Reason::GaveUp(why) = reason {
            self.gives_up(format!("layers: {why}"));
            if matches!(self.phase, Phase::StartingLayers | Phase::Running) {
                // The node's own NDL has ended, and the applications must still stop.
                let _ = self.state.ctx.gave_up.set(LeaveReason::of(why));
                sinew_ndl::send_leaves(&self.state.ndl);
            }
        }
        self.layer_supervisor = None;
        if let Some(started) = self.started.take() {
            let error = match self.last_layer_fault.take() {
                // A signal came before the layers were ready.
                None if *reason == Reason::Shutdown => StartError::Ended,
                fault => StartError::Layers(fault.unwrap_or_else(|| reason.to_string())),
            };
            // The owner may have stopped waiting.
            let _ = started.send(Err(error));
        }
        match self.phase {
            // Applications without layers: they are stopped, which brings their outputs to a safe value.
            Phase::Running => self.stop_apps(),
            Phase::StoppingApps => {}
            Phase::StartingLayers | Phase::StoppingLayers => self.finish(context),
        }
    }

    /// Ends the node, its applications first: no restart of a layer can fix this. // spec: NDL-5.5
    fn address_taken(&mut self, words: String) {
        match self.phase {
            Phase::StartingLayers | Phase::Running => {}
            // The node releases the address in any case.
            Phase::StoppingApps | Phase::StoppingLayers => return,
        }
        self.end = NodeEnd::GaveUp(words.clone());
        self.address_taken = Some(words.clone());
        // Not an error: the owner receives this text and reports it, but possibly late or never.
        sinew_runtime::log::warn!(node = self.state.ctx.config.name, "{words}");
        if let Some(started) = self.started.take() {
            // The owner may have stopped waiting.
            let _ = started.send(Err(StartError::AddressTaken(words)));
        }
        self.stop_apps();
    }

    /// Fails the start with the first error: another try within the limit of restarts would meet the same one.
    fn layer_cannot_start(&mut self, words: String) {
        self.gives_up(format!("layers: {words}"));
        if let Some(started) = self.started.take() {
            // The owner may have stopped waiting.
            let _ = started.send(Err(StartError::Layers(words)));
        }
        self.stop_apps();
    }

    fn start_apps(&mut self) {
        self.phase = Phase::Running;
        self.state.ctx.has_started.store(true, Ordering::Release);
        let declared = self.declared.take().map(|spec| self.plan(spec).map(|(plan, _)| plan));
        let answer = match declared.transpose() {
            Ok(plan) => {
                plan.into_iter().for_each(|plan| self.supervise(plan));
                Ok(())
            }
            Err(error) => Err(error),
        };
        let failed = answer.is_err();
        if let Some(started) = self.started.take() {
            // The owner may have stopped waiting; then it stops the node.
            let _ = started.send(answer);
        }
        if failed {
            self.stop_apps();
        }
    }

    fn handle_apps_fact(&mut self, fact: SupervisorFact) {
        self.answer(&fact);
        match fact {
            SupervisorFact::Ready(_)
            | SupervisorFact::Gone(..)
            | SupervisorFact::Deleted(_)
            | SupervisorFact::Refused(..) => self.notify_if_running(),
            SupervisorFact::Starting(..)
            | SupervisorFact::Failed(..)
            | SupervisorFact::AllReady
            | SupervisorFact::Done(..) => {}
            SupervisorFact::Ended(reason) => self.apps_ended(&reason),
        }
    }

    /// Ends the node because some of its applications can never start. spec: SYNC-7
    fn end_on_cycle(&mut self, context: &mut Context<Self>) {
        let Some(cycle) = self.cycle.as_ref().filter(|cycle| self.runs_alone && !cycle.ours.is_empty())
        else {
            return;
        };
        let why = StartError::Cycle(cycle.labels.clone()).to_string();
        let is_local = cycle.ours.len() + 1 == cycle.names.len();
        if is_local {
            self.end_unless_any_ran(why);
        } else {
            context.run_later(CYCLE_NOTICE_TIME, |root, _| root.end_unless_any_ran(why));
        }
    }

    fn end_unless_any_ran(&mut self, why: String) {
        if matches!(self.phase, Phase::StartingLayers | Phase::Running) && !self.apps.any_ran() {
            self.gives_up(why);
            self.stop_apps();
        }
    }

    /// Records why the node gives up. The first reason counts: later failures during the stop follow from it.
    fn gives_up(&mut self, why: String) {
        if self.end == NodeEnd::Stopped {
            self.end = NodeEnd::GaveUp(why);
        }
    }

    fn apps_ended(&mut self, reason: &Reason) {
        if let Reason::GaveUp(why) = reason {
            self.gives_up(format!("applications: {why}"));
        }
        self.app_supervisor = None;
        self.answer_all();
        self.apps.close();
        self.stop_layers();
    }

    fn notify_if_running(&mut self) {
        match self.phase {
            Phase::StartingLayers | Phase::Running => {}
            // Applications that have ended for good do not run.
            Phase::StoppingApps | Phase::StoppingLayers => {
                for waiter in self.running_waiters.drain(..) {
                    // Dropping it reports that the node ends.
                    if let Some(words) = &self.address_taken {
                        waiter.answer(Err(StartError::AddressTaken(words.clone())));
                    }
                }
                return;
            }
        }
        let is_running = self.app_supervisor.is_some() && self.apps.all_run();
        // Once one of them is removed, here or elsewhere, or requires less, the cycle is broken.
        self.cycle.take_if(|cycle| {
            !cycle.ours.iter().all(|id| self.apps.contains(*id))
                || !lock(&self.state.sync.core).has_cycle(&cycle.names)
        });
        if is_running || self.cycle.is_some() {
            for waiter in self.running_waiters.drain(..) {
                waiter.answer(match &self.cycle {
                    Some(cycle) if !is_running => Err(StartError::Cycle(cycle.labels.clone())),
                    Some(_) | None => Ok(()),
                });
            }
        }
    }

    fn stop_apps(&mut self) {
        match self.phase {
            Phase::StartingLayers | Phase::Running => {}
            Phase::StoppingApps | Phase::StoppingLayers => return,
        }
        sinew_runtime::log::info!(node = self.state.ctx.config.name, "the node stops");
        self.phase = Phase::StoppingApps;
        self.notify_stop();
        self.state.recording.stop_ordered();
        self.notify_if_running();
        match &self.app_supervisor {
            Some(supervisor) => order(supervisor, Input::StopOrdered),
            None => self.stop_layers(),
        }
    }

    fn stop_layers(&mut self) {
        self.phase = Phase::StoppingLayers;
        if let NodeEnd::GaveUp(why) = &self.end {
            // Before its layers say goodbye. spec: NDL-4.8
            let _ = self.state.ctx.gave_up.set(LeaveReason::of(why));
        }
        self.state.ctx.stopping.store(true, Ordering::Relaxed);
        match &self.layer_supervisor {
            Some(supervisor) => order(supervisor, Input::StopOrdered),
            // The layers have ended before: only the event is missing.
            None => post_event(&self.state.root, RootEvent::Layers(SupervisorFact::Ended(Reason::Shutdown))),
        }
    }

    fn finish(&self, context: &mut Context<Self>) {
        self.state.close();
        // The owner may have been dropped.
        let _ = self.ended.try_send(self.end.clone());
        context.stop();
    }
}

fn order(supervisor: &SupervisorHandle, input: Input) {
    if let Err(lost) = supervisor.send(input) {
        sinew_runtime::log::error!(?lost, "a supervisor's event queue is full");
    }
}
