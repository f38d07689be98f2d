//! The contracts of the node's applications, and the outputs that these guard.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
    time::Duration,
};

use sinew_model::{
    config::NdlConfig,
    contracts::{CONTRACTS_LISTED_MAX, CommandedOutput, ContractReport, ContractsReport, micros},
};
use sinew_runtime::{
    app::{Contract, DynApp, RequirementPolicy, Subject},
    lock,
    outcome::Rejection,
    protection::{OutputState, outputs},
    tid::{AppAddress, NodeAddress, Tid},
};

use crate::NodeState;

/// The contracts of the applications of a node. They have the bounds of the applications, times those of one.
#[derive(Default)]
pub(crate) struct Contracts(Mutex<BTreeMap<AppAddress, Vec<ContractReport>>>);

impl Contracts {
    /// Adds the contracts of an application.
    pub(crate) fn register(&self, tid: Tid, app: &DynApp) {
        let report = |contract: &Contract| {
            let report = ContractReport::new(tid, app.name(), contract);
            let turn =
                is_safe_without(app, contract.subject()).then(|| app.policy().progress_within).flatten();
            ContractReport { turn_us: turn.map(micros), own_process: app.place().own_process, ..report }
        };
        let contracts: Vec<_> = app.contracts().iter().map(report).collect();
        if !contracts.is_empty() {
            lock(&self.0).insert(tid.app, contracts);
        }
    }

    /// Removes the contracts of an application that is removed.
    pub(crate) fn remove(&self, app: AppAddress) {
        lock(&self.0).remove(&app);
    }
}

/// Returns whether the application enters its safe state when it loses the subject.
fn is_safe_without(app: &DynApp, subject: &Subject) -> bool {
    let Subject::Application(name) = subject else { return false };
    app.requirement_policy() == RequirementPolicy::SafeState && app.requires().contains(name)
}

/// Returns the contracts and the outputs of the node. spec: INSPECT-12
#[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
pub(super) fn declared(state: &Arc<NodeState>) -> Result<ContractsReport, Rejection> {
    let config = &state.ctx.config;
    let mut contracts: Vec<_> = lock(&state.contracts.0).values().flatten().cloned().collect();
    // spec: INSPECT-3
    let contracts_left_out = contracts.len().saturating_sub(CONTRACTS_LISTED_MAX) as u64;
    contracts.truncate(CONTRACTS_LISTED_MAX);
    let mut own = outputs();
    own.retain(|output| output.data_id.destination.node == state.ctx.node);
    let outputs_left_out = own.len().saturating_sub(CONTRACTS_LISTED_MAX) as u64;
    let names = Names::of(state);
    Ok(ContractsReport {
        node: state.ctx.node,
        name: config.name.clone(),
        slack_us: micros(config.contracts.slack),
        detection_us: micros(detection(&config.ndl)),
        dry_run: config.contracts.dry_run,
        contracts,
        contracts_left_out,
        outputs: own.iter().take(CONTRACTS_LISTED_MAX).map(|output| names.commanded(output)).collect(),
        outputs_left_out,
    })
}

/// Returns the time within which the discovery notices the loss of any other node.
fn detection(ndl: &NdlConfig) -> Duration {
    // One period until the first question that is not answered, and one until the last one is over.
    let lost = |period: Duration, missed_max: u32| period.saturating_mul(missed_max.saturating_add(2));
    let groups = ndl.watch.iter().map(|group| lost(group.period, group.missed_max));
    groups.fold(lost(ndl.period, ndl.missed_max), Duration::max)
}

/// The names of applications and nodes, as far as this node knows them.
struct Names {
    apps: BTreeMap<Tid, String>,
    nodes: BTreeMap<NodeAddress, String>,
}

impl Names {
    fn of(state: &NodeState) -> Self {
        let directory = lock(&state.sync.core).directory();
        let members = state.ctx.ports.members().map(|members| members.present()).unwrap_or_default();
        let own = (state.ctx.node, state.ctx.config.name.clone());
        Self {
            apps: directory.into_iter().map(|entry| (entry.tid, entry.name)).collect(),
            nodes: members.into_iter().map(|member| (member.node, member.name)).chain([own]).collect(),
        }
    }

    fn commanded(&self, output: &OutputState) -> CommandedOutput {
        let OutputState { data_id, protection, measured, .. } = output;
        let app = |tid| self.apps.get(&tid).cloned();
        CommandedOutput {
            receiver: data_id.destination,
            receiver_name: app(data_id.destination),
            sender: data_id.source,
            sender_name: app(data_id.source),
            sender_node: self.nodes.get(&data_id.source.node).cloned(),
            kind_name: data_id.name.to_owned(),
            within_us: micros(protection.within),
            age_max_us: micros(protection.age_max),
            measured_us: measured.map(micros),
        }
    }
}
