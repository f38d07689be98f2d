//! The applications of a node: how the root registers them, and starts their supervisor.

use std::sync::Arc;

use sinew_lncl::CommandPort;
use sinew_runtime::{
    app::{AppWiring, CommandReadiness, DynApp},
    mailbox::{Bounds, Mailbox},
    pending::{AppSink, Pending},
    router::MessageSink,
    sender::Sender,
    supervision::{ChildSpec, Place, PlannedChild, Policy, Supervisor, SupervisorPlan},
};

use super::{
    super::{
        StartError,
        directory::NodeDirectory,
        shutdown::Branch,
        supervisor_spec::{Member, SupervisorSpec},
    },
    Root, RootEvent, WAITS_MAX, post_event,
};
use crate::process;

impl Root {
    /// Registers the applications of a supervisor and of all below it.
    pub(super) fn plan(&mut self, spec: SupervisorSpec) -> Result<(SupervisorPlan, Policy), StartError> {
        let SupervisorSpec { name, flags, policy, members } = spec;
        let id = self.child_ids.next();
        self.apps.add_supervisor(id, &name);
        let (mut children, mut members) = (Vec::new(), members.into_iter());
        while let Some(member) = members.next() {
            match self.plan_member(member) {
                Ok(child) => children.push(child),
                Err(error) => {
                    self.drop_queue.push(name, (children, members));
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
                // Not dropped here: its captured values belong to the user.
                self.drop_queue.push(app.name().to_owned(), app);
                spec.map(PlannedChild::Worker)
            }
            Member::Supervisor(below) => {
                let (plan, policy) = self.plan(below)?;
                Ok(PlannedChild::Supervisor(plan, policy))
            }
        }
    }

    pub(super) fn supervise(&mut self, plan: SupervisorPlan) {
        let queue = self.state.root.clone();
        let (down_policies, apps, state) =
            (self.down_policies.clone(), self.apps.clone(), self.state.clone());
        let listener = move |fact| {
            // Called directly, not through the event queue: before the next event is handled.
            down_policies.handle(&fact);
            apps.handle(&state, &fact);
            post_event(&queue, RootEvent::Apps(fact));
        };
        let supervisor = Supervisor::of(plan, self.threads.clone(), listener);
        let handle = self.supervisors.run(Branch::Apps, supervisor, &self.state, RootEvent::Apps);
        self.app_supervisor = Some(handle);
        self.notify_if_running();
    }

    /// Returns the place of an application that is a command, with its readiness.
    fn command_port(
        &self,
        app: &DynApp,
        mailbox: &Arc<Mailbox>,
    ) -> Result<Option<(Arc<CommandPort>, CommandReadiness)>, StartError> {
        let Some(line) = app.command() else { return Ok(None) };
        if self.state.ctx.config.lncl.socket.is_none() {
            let why = "it is a command: its program joins at the node's socket; set `lncl.socket`".to_owned();
            return Err(StartError::Application { name: app.name().to_owned(), why });
        }
        let awaits_ready = line.readiness == CommandReadiness::Called;
        Ok(Some((CommandPort::new(app.name(), mailbox.clone(), awaits_ready), line.readiness)))
    }

    /// Assigns an application its address, its mailbox and its routes.
    pub(crate) fn register(&mut self, app: &DynApp) -> Result<ChildSpec, StartError> {
        let config = &self.state.ctx.config;
        if let Some(why) = app.fault() {
            return Err(StartError::Application { name: app.name().to_owned(), why });
        }
        self.apps.check_parameters(app)?;
        let mailbox = Mailbox::new(Bounds { messages: config.mailbox_capacity, bytes: config.mailbox_bytes });
        let pending = Pending::new(WAITS_MAX);
        let command = self.command_port(app, &mailbox)?;
        let is_hosted = app.place().own_process && command.is_none();
        let hosted = is_hosted.then(|| process::Link::new(&self.state, mailbox.clone()));
        let sink: Arc<dyn MessageSink> = match (&hosted, &command) {
            (Some(link), _) => link.clone(),
            (None, Some((port, _))) => port.clone(),
            (None, None) => Arc::new(AppSink { pending: pending.clone(), inbox: mailbox.clone() }),
        };
        let kinds = app.kinds();
        let local = sinew_lncl::LocalApp {
            name: Some(app.name().to_owned()),
            address: app.address(),
            requires: app.requires().to_vec(),
            kinds: kinds
                .iter()
                .filter(|(_, name)| *name != "raw")
                .map(|(_, name)| (*name).to_owned())
                .collect(),
            sink,
            events: kinds.iter().map(|(kind, _)| *kind).collect(),
        };
        let registered = match &command {
            Some((port, _)) => sinew_lncl::register_command(&self.state.lncl, local, port.clone()),
            None => sinew_lncl::register_local(&self.state.lncl, local),
        };
        let tid = registered.map_err(|error| StartError::Application {
            name: app.name().to_owned(),
            why: error.to_string(),
        })?;
        self.state.types.register(tid.app, app.types(), app.sends());
        self.state.contracts.register(tid, app);
        let directory = Arc::new(NodeDirectory(self.state.clone()));
        let sender = Sender::new(tid, self.state.ctx.router.clone(), directory, pending, config.payload_max);
        let id = self.child_ids.next();
        mailbox.report_refusals(tid, self.state.lncl.undelivered.clone());
        self.state.lncl.book.add_mailbox(tid.app, app.name(), &mailbox);
        self.apps.add(id, app, tid, mailbox.clone());
        let wiring = AppWiring { sender, mailbox };
        self.down_policies.insert(id, app.down_state(wiring.clone()));
        if let Some(link) = &hosted {
            self.hosted.insert(app.name().to_owned(), Arc::downgrade(link));
        }
        let mut policy = app.policy().clone();
        if app.place().own_process && policy.progress_within.is_some() {
            // The process of the application is supervised. The link shares a thread with the node's layers,
            // and has the same limits.
            policy.progress_within = Policy::default().progress_within;
        }
        let (place, launch) = match (hosted, command) {
            (Some(link), _) => (Place::io(), link.launch(&self.state, wiring.sender, app)),
            (None, Some((port, readiness))) => {
                (Place::io(), process::Command::launch(&self.state, port, tid, readiness, app))
            }
            (None, None) => (app.place().clone(), app.launch(wiring)),
        };
        #[cfg(feature = "fault-points")]
        let launch = super::super::faults::arm(&self.state, app, launch);
        let name = app.name().to_owned();
        Ok(ChildSpec { id, name, tid: Some(tid), policy, place, launch })
    }
}
