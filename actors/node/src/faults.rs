//! Injected faults, planned by a node's owner: in code, by the environment, or at run time.

use sinew_runtime::{
    app::DynApp,
    supervision::{
        Launch,
        fault::{Fault, FaultError, FaultPlan, FaultPoints, Lives},
    },
};

use super::{NodeBuilder, NodeHandle, SupervisorSpec, layers::LAYERS};
use crate::NodeState;

/// The environment's plan: for every node of the process, so that it may name actors of others.
const VARIABLE: &str = "SINEW_FAULTS";

impl NodeBuilder {
    /// Injects faults into actors of this node: `NAME:FAULT, NAME:FAULT`, as in `knee.drive:panic@1000,
    /// GNCL:hang(200ms)@5`. A layer is called LNCL, sync, GNCL or NDL. The environment variable
    /// `SINEW_FAULTS` adds to it, with the same syntax. A plan that is invalid, or that names no actor of
    /// this node, fails the start.
    #[must_use]
    pub fn fault(mut self, plan: impl Into<String>) -> Self {
        self.faults.push(plan.into());
        self
    }
}

impl NodeHandle {
    /// Injects a fault into the actor called `name` now: the actor is woken for it. A fault on the n-th event
    /// counts from here.
    ///
    /// # Errors
    /// This node has no actor of this name, or too many faults are pending for it.
    pub fn inject(&self, name: &str, fault: Fault) -> Result<(), FaultError> {
        let name = full_name(name);
        sinew_runtime::log::warn!(actor = name, %fault, "a fault is injected");
        self.state.ctx.faults.inject(name, fault)
    }

    /// Makes the root of the node panic: the only fault that ends the node.
    pub fn fail_root(&self) {
        // A node that has ended cannot fail any more.
        let _ = self.send_to_root(super::RootEvent::Fail);
    }

    /// Makes the supervisor of all applications panic.
    pub fn fail_supervisor(&self) {
        let _ = self.send_to_root(super::RootEvent::FailSupervisor);
    }

    /// Returns how often the actor called `name` was started and became ready, if this node has one of this name.
    #[must_use]
    pub fn lives(&self, name: &str) -> Option<Lives> {
        self.state.ctx.faults.lives(full_name(name))
    }
}

/// Reads the planned faults for a node with these applications. Applications keep their own faults, also in a
/// process of their own. The others are for the layers, and for actors that the environment names and this
/// node may not have.
pub(super) fn read(texts: &[String], tree: &mut SupervisorSpec) -> Result<Vec<(String, Fault)>, FaultError> {
    let mut others = Vec::new();
    let mut planned = Vec::new();
    for text in texts {
        for (name, fault) in text.parse::<FaultPlan>()?.faults() {
            check_name(full_name(name), fault, &tree.apps())?;
            planned.push((full_name(name).to_owned(), fault.clone()));
        }
    }
    let environment: FaultPlan = std::env::var(VARIABLE).unwrap_or_default().parse()?;
    planned
        .extend(environment.faults().iter().map(|(name, fault)| (full_name(name).to_owned(), fault.clone())));
    for (name, fault) in planned {
        match tree.app_mut(&name) {
            Some(app) => app.plan_fault(fault),
            None => others.push((name, fault)),
        }
    }
    Ok(others)
}

fn check_name(name: &str, fault: &Fault, apps: &[&DynApp]) -> Result<(), FaultError> {
    if LAYERS.contains(&name) || apps.iter().any(|app| app.name() == name) {
        return Ok(());
    }
    let apps: Vec<_> = apps.iter().map(|app| app.name()).collect();
    let (layers, apps) = (LAYERS.join(", "), apps.join(", "));
    let why = format!("this node has the layers {layers} and the applications {apps}");
    Err(FaultError { fault: format!("{name}:{fault}"), why })
}

/// Keeps the faults that are not for applications.
pub(super) fn keep(state: &NodeState, faults: &[(String, Fault)]) -> Result<(), FaultError> {
    let mut keep = faults.iter();
    keep.try_for_each(|(name, fault)| plan(&state.ctx.faults, name, fault))
}

/// Wraps the launch of an application in its faults. An application in its own process takes its planned
/// faults along; only injected ones remain here.
pub(super) fn arm(state: &NodeState, app: &DynApp, launch: Launch) -> Launch {
    if app.place().own_process {
        return state.ctx.faults.arm(app.name(), launch);
    }
    arm_at(&state.ctx.faults, app, launch)
}

/// The same in the process of the application: each process counts its events anew.
pub(crate) fn arm_alone(app: &DynApp, launch: Launch) -> Launch {
    arm_at(&FaultPoints::default(), app, launch)
}

fn arm_at(points: &FaultPoints, app: &DynApp, launch: Launch) -> Launch {
    for fault in app.faults() {
        if let Err(error) = plan(points, app.name(), fault) {
            sinew_runtime::log::error!(%error, "a fault is not planned");
        }
    }
    points.arm(app.name(), launch)
}

fn plan(points: &FaultPoints, name: &str, fault: &Fault) -> Result<(), FaultError> {
    sinew_runtime::log::warn!(actor = name, %fault, "a fault is planned");
    points.plan(name, fault.clone())
}

fn full_name(name: &str) -> &str {
    if name == "sync" { "sync manager" } else { name }
}
