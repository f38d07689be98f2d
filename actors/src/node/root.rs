//! The root actor: carries events between the supervisors, the sync manager and the node's owner.

mod events;

use std::{
    cell::RefCell,
    collections::BTreeMap,
    rc::Rc,
    sync::{Arc, Weak, atomic::Ordering, mpsc::SyncSender},
    time::Duration,
};

use actix::{Actor, ActorContext, AsyncContext, Context, StreamHandler, fut::WrapFuture};
use sinew_runtime::{
    app::{AppWiring, DynApp},
    mailbox::{Bounds, Mailbox},
    pending::{AppOutlet, Pending},
    post::Post,
    router::Outlet,
    sender::Sender,
    supervision::{
        Burials, ChildId, ChildIds, ChildSpec, Input, Place, PlannedChild, Policy, Reason, Roster,
        Supervisor, SupervisorFact, SupervisorPlan, Threads, part_from_threads,
    },
    tid::AppAddress,
    time::Time,
};

pub(crate) use self::events::RootEvent;
use super::{
    NodeEnd, StartError,
    absences::Absences,
    apps::Apps,
    asker::Asker,
    commands::Answers,
    directory::NodeDirectory,
    layers,
    progress::{IdleClients, Stalls},
    supervisor_spec::{Member, SupervisorSpec},
    wind_up::{self, Branch, Heirs},
};
use crate::{
    last_words::LastWords,
    lncl, ndl, process,
    signals::StopSignals,
    stores::{Stores, lock},
};

/// Confirmed messages and requests of one application under way at most.
pub(crate) const WAITS_MAX: usize = 1_024;

/// How far the node is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    StartingLayers,
    Running,
    StoppingApps,
    StoppingLayers,
}

/// Names that require each other in a circle, the first one again at the end.
struct Cycle {
    names: Vec<String>,
    /// The same with the names of other nodes.
    labels: Vec<String>,
    /// Those of them that are applications of this node.
    ours: Vec<ChildId>,
}

/// Time that what applications captured has to be dropped when their node has ended, before nobody waits for it any more.
const BURIED_WITHIN: Duration = Duration::from_secs(1);

pub(super) struct Root {
    pub(super) stores: Arc<Stores>,
    pub(super) threads: Rc<RefCell<Threads>>,
    pub(super) burials: Burials,
    heirs: Heirs,
    pub(super) phase: Phase,
    pub(super) began: Time,
    end: NodeEnd,
    declared: Option<SupervisorSpec>,
    child_ids: ChildIds,
    pub(super) apps: Apps,
    pub(super) absences: Absences,
    pub(super) answers: Answers,
    pub(super) turns: Stalls,
    pub(super) clients: IdleClients,
    /// The applications in processes of their own, which say themselves whether they stall.
    pub(super) hosted: BTreeMap<String, Weak<process::Link>>,
    pub(super) layer_supervisor: Option<Roster>,
    pub(super) app_supervisor: Option<Roster>,
    last_layer_fault: Option<String>,
    /// Who has the node's address; the node ends of it.
    address_taken: Option<String>,
    cycle: Option<Cycle>,
    started: Option<SyncSender<Result<(), StartError>>>,
    ended: SyncSender<NodeEnd>,
    tell_when_running: Vec<Asker>,
    heeds_signals: bool,
    /// Nobody but the node itself handles an end.
    runs_alone: bool,
}

/// The root thread's whole life.
pub(super) fn run(
    stores: Arc<Stores>,
    declared: SupervisorSpec,
    started: SyncSender<Result<(), StartError>>,
    ended: SyncSender<NodeEnd>,
) {
    let system = actix::System::new();
    let heirs = Heirs::default();
    let (kept, last_word) = (stores.clone(), ended.clone());
    let post = stores.posts.root.clone();
    let threads = Rc::new(RefCell::new(Threads::default()));
    let burials = threads.borrow().burials();
    let root = Root {
        threads: threads.clone(),
        burials: burials.clone(),
        heirs: heirs.clone(),
        phase: Phase::StartingLayers,
        began: Time::now(),
        end: NodeEnd::Stopped,
        declared: Some(declared),
        child_ids: ChildIds::default(),
        apps: Apps::default(),
        absences: Absences::new(stores.clone()),
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
        tell_when_running: Vec::new(),
        heeds_signals: false,
        runs_alone: false,
        stores,
    };
    part_from_threads();
    // To the root's own end: whoever stops the system that he finds does not end the node.
    system.block_on(wind_up::oversee(root, heirs, kept, last_word));
    threads.borrow_mut().stop();
    // Whoever waits for an answer has it now: there will be none.
    burials.bury("orders that came too late", post.close());
    burials.wait(BURIED_WITHIN);
}

impl Drop for Root {
    fn drop(&mut self) {
        // Its layers did not come up: what the applications captured is dropped elsewhere all the same.
        if let Some(declared) = self.declared.take() {
            self.burials.bury("a node that did not start", declared);
        }
    }
}

impl Actor for Root {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        // First of all what is in the post already: perhaps an order to heed signals.
        context.add_stream(self.stores.posts.root.attach());
        let deadline = self.stores.config.sync.layer_deadline;
        let layers = layers::specs(&self.stores, &self.child_ids, deadline);
        let post = self.stores.posts.root.clone();
        let listener = move |fact| tell(&post, RootEvent::Layers(fact));
        let plan = SupervisorPlan {
            id: self.child_ids.next(),
            name: layers::SUPERVISOR.to_owned(),
            flags: self.stores.config.supervision.layers(),
            children: layers.into_iter().map(PlannedChild::Worker).collect(),
        };
        let supervisor = Supervisor::of(plan, self.threads.clone(), listener);
        let roster = self.heirs.run(Branch::Layers, supervisor, &self.stores, RootEvent::Layers);
        self.layer_supervisor = Some(roster);
    }
}

fn tell(post: &Post<RootEvent>, event: RootEvent) {
    if let Err(lost) = post.post(event) {
        crate::log::error!(?lost, "the root's post is full");
    }
}

impl StreamHandler<RootEvent> for Root {
    fn handle(&mut self, event: RootEvent, context: &mut Context<Self>) {
        match event {
            RootEvent::Release { app } => self.release(app),
            RootEvent::RequirementCycle { names, labels } => {
                let ours = names.iter().filter_map(|name| self.apps.named(name)).collect();
                self.cycle = Some(Cycle { names, labels, ours });
                self.tell_if_running();
                self.end_on_circle();
            }
            RootEvent::RunsAlone => {
                self.runs_alone = true;
                self.tell_if_running();
                self.end_on_circle();
            }
            RootEvent::Layers(fact) => self.layers_said(fact, context),
            RootEvent::Apps(fact) => self.apps_said(fact),
            RootEvent::Ordered(ordered) => self.ordered(ordered),
            // Who asked may have stopped waiting.
            RootEvent::TellTree(answer) => _ = answer.try_send(self.tree()),
            RootEvent::AddressTaken(words) => self.address_taken(words),
            RootEvent::TellProgress(answer) => _ = answer.send(self.progress()),
            RootEvent::HeedSignals => self.heed_signals(context),
            RootEvent::StopOrdered => self.stop_apps(),
            RootEvent::OwnerPanicked => {
                self.gives_up("the thread that owns the node panicked".to_owned());
                self.stop_apps();
            }
            #[cfg(feature = "fault-points")]
            RootEvent::Fail => panic!("a fault was planned for the root"),
            #[cfg(feature = "fault-points")]
            RootEvent::FailSupervisor => self.app_supervisor.iter().for_each(Roster::fail),
            RootEvent::TellWhenRunning(asker) => {
                asker.join(&mut self.tell_when_running);
                self.tell_if_running();
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
                if self.stores.posts.lncl.post(lncl::Event::Released { app }).is_err() {
                    crate::log::error!(%app, "LNCL's post is full; a client's registration ends at its deadline");
                }
            }
            // The node stops: nothing is started any more.
            (Some(_), None) => {}
        }
    }

    fn layers_said(&mut self, fact: SupervisorFact, context: &mut Context<Self>) {
        match fact {
            SupervisorFact::AllReady if self.phase == Phase::StartingLayers => self.start_apps(),
            SupervisorFact::Failed(id, reason) | SupervisorFact::Gone(id, reason) if reason.is_failure() => {
                let who = self.layer_supervisor.as_ref().and_then(|roster| roster.who(id));
                self.last_layer_fault = who.map(|who| layers::fault_in_one_line(&who.name, &reason));
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
                // Its own NDL is gone, and the applications have yet to stop.
                let _ = self.stores.gave_up.set(LastWords::of(why));
                ndl::say_goodbye(&self.stores);
            }
        }
        self.layer_supervisor = None;
        if let Some(started) = self.started.take() {
            let why = self.last_layer_fault.take().unwrap_or_else(|| reason.to_string());
            // The owner may have lost its patience already.
            let _ = started.send(Err(StartError::Layers(why)));
        }
        match self.phase {
            // Applications without layers: they are told to stop, which brings their outputs to a safe value.
            Phase::Running => self.stop_apps(),
            Phase::StoppingApps => {}
            Phase::StartingLayers | Phase::StoppingLayers => self.finish(context),
        }
    }

    /// No restart of a layer mends it: the node ends, its applications first. // spec: NDL-5.5
    fn address_taken(&mut self, words: String) {
        match self.phase {
            Phase::StartingLayers | Phase::Running => {}
            // It gives the address up in any case.
            Phase::StoppingApps | Phase::StoppingLayers => return,
        }
        self.end = NodeEnd::GaveUp(words.clone());
        self.address_taken = Some(words.clone());
        // No error: the owner says that, who is given these words. But he may read them late, or never.
        crate::log::warn!(node = self.stores.config.name, "{words}");
        if let Some(started) = self.started.take() {
            // The owner may have lost its patience already.
            let _ = started.send(Err(StartError::AddressTaken(words)));
        }
        self.stop_apps();
    }

    fn start_apps(&mut self) {
        self.phase = Phase::Running;
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
            // The owner may have lost its patience already; then it stops the node.
            let _ = started.send(answer);
        }
        if failed {
            self.stop_apps();
        }
    }

    /// Registers the applications of a supervisor and of all below it.
    fn plan(&mut self, spec: SupervisorSpec) -> Result<(SupervisorPlan, Policy), StartError> {
        let SupervisorSpec { name, flags, policy, members } = spec;
        let id = self.child_ids.next();
        self.apps.add_supervisor(id, &name);
        let (mut children, mut members) = (Vec::new(), members.into_iter());
        while let Some(member) = members.next() {
            match self.plan_member(member) {
                Ok(child) => children.push(child),
                Err(error) => {
                    self.burials.bury(name, (children, members));
                    return Err(error);
                }
            }
        }
        Ok((SupervisorPlan { id, name, flags, children }, policy))
    }

    fn plan_member(&mut self, member: Member) -> Result<PlannedChild, StartError> {
        match member {
            Member::App(app) => {
                let spec = self.register(&app);
                // Not here: what it captured is the user's.
                self.burials.bury(app.name().to_owned(), app);
                spec.map(PlannedChild::Worker)
            }
            Member::Supervisor(below) => {
                let (plan, policy) = self.plan(below)?;
                Ok(PlannedChild::Supervisor(plan, policy))
            }
        }
    }

    fn supervise(&mut self, plan: SupervisorPlan) {
        let post = self.stores.posts.root.clone();
        let (absences, apps, stores) = (self.absences.clone(), self.apps.clone(), self.stores.clone());
        let listener = move |fact| {
            // At once, not through the post: before the next thing happens.
            absences.hear(&fact);
            apps.hear(&stores, &fact);
            tell(&post, RootEvent::Apps(fact));
        };
        let supervisor = Supervisor::of(plan, self.threads.clone(), listener);
        let roster = self.heirs.run(Branch::Apps, supervisor, &self.stores, RootEvent::Apps);
        self.app_supervisor = Some(roster);
        self.tell_if_running();
    }

    /// Gives an application its address, its mailbox and its routes.
    pub(super) fn register(&mut self, app: &DynApp) -> Result<ChildSpec, StartError> {
        let config = &self.stores.config;
        if let Some(why) = app.fault() {
            return Err(StartError::Application { name: app.name().to_owned(), why });
        }
        let mailbox = Mailbox::new(Bounds { messages: config.mailbox_capacity, bytes: config.mailbox_bytes });
        let pending = Pending::new(WAITS_MAX);
        let hosted = app.place().own_process.then(|| process::Link::new(&self.stores, mailbox.clone()));
        let outlet: Arc<dyn Outlet> = match &hosted {
            Some(link) => link.clone(),
            None => Arc::new(AppOutlet { pending: pending.clone(), inbox: mailbox.clone() }),
        };
        let kinds = app.kinds();
        let local = lncl::LocalApp {
            name: Some(app.name().to_owned()),
            address: app.address(),
            requires: app.requires().to_vec(),
            kinds: kinds
                .iter()
                .filter(|(_, name)| *name != "raw")
                .map(|(_, name)| (*name).to_owned())
                .collect(),
            outlet,
            events: kinds.iter().map(|(kind, _)| *kind).collect(),
        };
        let tid = lncl::register_local(&self.stores, local).map_err(|error| StartError::Application {
            name: app.name().to_owned(),
            why: error.to_string(),
        })?;
        let directory = Arc::new(NodeDirectory(self.stores.clone()));
        let sender = Sender::new(tid, self.stores.router.clone(), directory, pending, config.payload_max);
        let id = self.child_ids.next();
        mailbox.report_refusals(tid, self.stores.undelivered.clone());
        self.stores.book.add_mailbox(tid.app, app.name(), &mailbox);
        self.apps.add(id, app, tid, mailbox.clone());
        let wiring = AppWiring { sender, mailbox };
        self.absences.keep(id, app.absence(wiring.clone()));
        if let Some(link) = &hosted {
            self.hosted.insert(app.name().to_owned(), Arc::downgrade(link));
        }
        let mut policy = app.policy().clone();
        if hosted.is_some() && policy.progress_within.is_some() {
            // Its process is held to it. The link shares a thread with the node's layers, and is judged as they are.
            policy.progress_within = Policy::default().progress_within;
        }
        let (place, launch) = match hosted {
            Some(link) => (Place::io(), link.launch(&self.stores, wiring.sender, app)),
            None => (app.place().clone(), app.launch(wiring)),
        };
        #[cfg(feature = "fault-points")]
        let launch = super::faults::arm(&self.stores, app, launch);
        let name = app.name().to_owned();
        Ok(ChildSpec { id, name, tid: Some(tid), policy, place, launch })
    }

    fn apps_said(&mut self, fact: SupervisorFact) {
        self.answered(&fact);
        match fact {
            SupervisorFact::Ready(_)
            | SupervisorFact::Gone(..)
            | SupervisorFact::Deleted(_)
            | SupervisorFact::Refused(..) => self.tell_if_running(),
            SupervisorFact::Starting(..)
            | SupervisorFact::Failed(..)
            | SupervisorFact::AllReady
            | SupervisorFact::Done(..) => {}
            SupervisorFact::Ended(reason) => self.apps_ended(&reason),
        }
    }

    /// Applications of this node can never start: it ends, but only while none of its applications has run. spec: SYNC-7
    fn end_on_circle(&mut self) {
        let is_new = matches!(self.phase, Phase::StartingLayers | Phase::Running) && !self.apps.any_ran();
        let Some(cycle) =
            self.cycle.as_ref().filter(|cycle| self.runs_alone && is_new && !cycle.ours.is_empty())
        else {
            return;
        };
        let why = StartError::Cycle(cycle.labels.clone()).to_string();
        self.gives_up(why);
        self.stop_apps();
    }

    /// The first reason counts: what fails while the node stops follows from it.
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
        self.answer_all_that_wait();
        self.apps.close();
        self.stop_layers();
    }

    fn tell_if_running(&mut self) {
        match self.phase {
            Phase::StartingLayers | Phase::Running => {}
            // Applications that have ended for good are no applications that run.
            Phase::StoppingApps | Phase::StoppingLayers => {
                for asker in self.tell_when_running.drain(..) {
                    // Dropped, it says that the node ends.
                    if let Some(words) = &self.address_taken {
                        asker.answer(Err(StartError::AddressTaken(words.clone())));
                    }
                }
                return;
            }
        }
        let is_running = self.app_supervisor.is_some() && self.apps.all_run();
        // Once one of them is removed, here or elsewhere, or requires less, the circle is open.
        self.cycle.take_if(|cycle| {
            !cycle.ours.iter().all(|id| self.apps.contains(*id))
                || !lock(&self.stores.sync).has_cycle(&cycle.names)
        });
        if is_running || self.cycle.is_some() {
            for asker in self.tell_when_running.drain(..) {
                asker.answer(match &self.cycle {
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
        crate::log::info!(node = self.stores.config.name, "the node stops");
        self.phase = Phase::StoppingApps;
        self.tell_if_running();
        match &self.app_supervisor {
            Some(supervisor) => order(supervisor, Input::StopOrdered),
            None => self.stop_layers(),
        }
    }

    fn stop_layers(&mut self) {
        self.phase = Phase::StoppingLayers;
        if let NodeEnd::GaveUp(why) = &self.end {
            // Before its layers say goodbye. spec: NDL-4.8
            let _ = self.stores.gave_up.set(LastWords::of(why));
        }
        self.stores.stopping.store(true, Ordering::Relaxed);
        match &self.layer_supervisor {
            Some(supervisor) => order(supervisor, Input::StopOrdered),
            // They ended before: what is left is to hear of it.
            None => tell(&self.stores.posts.root, RootEvent::Layers(SupervisorFact::Ended(Reason::Shutdown))),
        }
    }

    fn finish(&self, context: &mut Context<Self>) {
        self.stores.close();
        // The owner may be gone: then nobody wants to know.
        let _ = self.ended.try_send(self.end.clone());
        context.stop();
    }

    fn heed_signals(&mut self, context: &mut Context<Self>) {
        if std::mem::replace(&mut self.heeds_signals, true) {
            return;
        }
        let post = self.stores.posts.root.clone();
        let mut signals = match StopSignals::listen() {
            Ok(signals) => signals,
            Err(error) => {
                let remedy = "stop this node by its handle";
                crate::log::error!(%error, remedy, "SIGINT, SIGTERM and SIGHUP cannot be handled and end this process at once");
                return;
            }
        };
        let heed = async move {
            let which = signals.recv().await;
            crate::log::info!(signal = which, "a signal asks for a stop");
            tell(&post, RootEvent::StopOrdered);
        };
        context.spawn(heed.into_actor(self));
    }
}

fn order(supervisor: &Roster, input: Input) {
    if let Err(lost) = supervisor.tell(input) {
        crate::log::error!(?lost, "a supervisor's post is full");
    }
}
