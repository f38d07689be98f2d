//! Faults on purpose, as a node's owner plans them: in code, by the environment, at run time.

use sinew_runtime::{
    app::DynApp,
    supervision::{
        Launch,
        fault::{Fault, FaultError, FaultPlan, Lives},
    },
};

use super::{NodeBuilder, NodeHandle, root::LAYERS};
use crate::stores::Stores;

/// The environment's plan: for every node of the process, so that it may name actors of others.
const VARIABLE: &str = "SINEW_FAULTS";

impl NodeBuilder {
    /// Faults strike actors of this node: `NAME:FAULT, NAME:FAULT`, as in `knee.drive:panic@1000, GNCL:hang(200ms)@5`. A
    /// layer is called LNCL, sync, GNCL or NDL. The environment's `SINEW_FAULTS` adds to it, in the same words. A plan
    /// that cannot be read, or that names nobody of this node, fails the start.
    #[must_use]
    pub fn fault(mut self, plan: impl Into<String>) -> Self {
        self.faults.push(plan.into());
        self
    }
}

impl NodeHandle {
    /// Lets a fault strike the actor called `name` now: it is woken for it. A fault on the n-th event counts from here.
    ///
    /// # Errors
    /// This node has no actor of this name, or too many faults wait for it already.
    pub fn inject(&self, name: &str, fault: Fault) -> Result<(), FaultError> {
        let name = full_name(name);
        tracing::warn!(actor = name, %fault, "a fault is injected");
        self.stores.faults.inject(name, fault)
    }

    /// How often the actor called `name` was started and became ready, if this node has one of this name.
    #[must_use]
    pub fn lives(&self, name: &str) -> Option<Lives> {
        self.stores.faults.lives(full_name(name))
    }
}

/// Reads and keeps what was planned for a node with these applications.
pub(super) fn plan(stores: &Stores, texts: &[String], apps: &[&DynApp]) -> Result<(), FaultError> {
    let is_known = |name: &str| LAYERS.contains(&name) || apps.iter().any(|app| app.name() == name);
    for text in texts {
        for (name, fault) in text.parse::<FaultPlan>()?.faults() {
            let name = full_name(name);
            if !is_known(name) {
                let apps: Vec<_> = apps.iter().map(|app| app.name()).collect();
                let why = format!(
                    "this node has the layers {} and the applications {}",
                    LAYERS.join(", "),
                    apps.join(", ")
                );
                return Err(FaultError { fault: format!("{name}:{fault}"), why });
            }
            keep(stores, name, fault)?;
        }
    }
    let environment = std::env::var(VARIABLE).unwrap_or_default();
    for (name, fault) in environment.parse::<FaultPlan>()?.faults() {
        keep(stores, full_name(name), fault)?;
    }
    Ok(())
}

/// The launch of an application, with the faults of its own declaration and those of its node around it.
pub(super) fn arm(stores: &Stores, app: &DynApp, launch: Launch) -> Launch {
    for fault in app.faults() {
        if let Err(error) = keep(stores, app.name(), fault) {
            tracing::error!(%error, "a fault is not planned");
        }
    }
    stores.faults.arm(app.name(), launch)
}

fn keep(stores: &Stores, name: &str, fault: &Fault) -> Result<(), FaultError> {
    tracing::warn!(node = stores.config.name, actor = name, %fault, "a fault is planned");
    stores.faults.plan(name, fault.clone())
}

fn full_name(name: &str) -> &str {
    if name == "sync" { "sync manager" } else { name }
}
