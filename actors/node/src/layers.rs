//! The layers of a node, as children of its supervisor.

use std::{sync::Arc, time::Duration};

use actix::{Actor, Context};
use sinew_runtime::supervision::{
    ChildIds, ChildSpec, Launch, Place, Policy, ReadyGate, Reason, running_actor,
};

use crate::NodeState;

/// The layers' names, in the paper's order of start (section 6).
pub(super) const LAYERS: [&str; 4] = ["LNCL", "sync manager", "GNCL", "NDL"];

/// NDL's real-time priority, if available: above ordinary threads, so that a busy node is not considered
/// lost, and below every control loop with a real-time priority.
const NDL_PRIORITY: u8 = 1;

/// The name of their supervisor.
pub(super) const SUPERVISOR: &str = "layers";

/// Returns the specifications of the layers in that order.
pub(super) fn specs(state: &Arc<NodeState>, ids: &ChildIds, deadline: Duration) -> Vec<ChildSpec> {
    let child = |name: &str, place: Place, launch: Launch| ChildSpec {
        id: ids.next(),
        name: name.to_owned(),
        tid: None,
        policy: Policy { start_within: deadline, ..Policy::default() },
        place,
        #[cfg(feature = "fault-points")]
        launch: state.ctx.faults.arm(name, launch),
        #[cfg(not(feature = "fault-points"))]
        launch,
    };
    let mut gncl = child(LAYERS[2], Place::io(), layer(&state.gncl, sinew_gncl::Gncl::new));
    // Peers read their queued messages while it stops.
    gncl.policy.stop_within += sinew_gncl::LINGER;
    vec![
        child(LAYERS[0], Place::io(), layer(&state.lncl, sinew_lncl::Lncl::new)),
        child(LAYERS[1], Place::layer("sync"), layer(&state.sync, sinew_sync::SyncManager::new)),
        gncl,
        child(
            LAYERS[3],
            Place::layer("ndl").realtime_at_best(NDL_PRIORITY),
            layer(&state.ndl, sinew_ndl::NdlActor::new),
        ),
    ]
}

/// Returns the launch of a layer, which creates a new actor each time.
fn layer<S, A>(state: &Arc<S>, make: fn(Arc<S>, ReadyGate) -> A) -> Launch
where
    S: Send + Sync + 'static,
    A: Actor<Context = Context<A>>,
{
    let state = state.clone();
    Arc::new(move |ready| running_actor(Context::new().into_future(make(state.clone(), ready))))
}

/// Returns the reason of a layer's failure, for the program that started the node. Most often the cause is
/// not the layer, but its environment.
pub(super) fn fault_in_one_line(layer: &str, reason: &Reason) -> String {
    let why = if let Reason::Panic(text) = reason { text.clone() } else { reason.to_string() };
    format!("{layer}: {}", why.split_whitespace().collect::<Vec<_>>().join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layer_failure_is_one_line_starting_with_its_name() {
        let panic =
            Reason::Panic("address 127.0.0.1 is used already;\n    set `address` at ndl.rs:1".to_owned());
        assert_eq!(
            fault_in_one_line("NDL", &panic),
            "NDL: address 127.0.0.1 is used already; set `address` at ndl.rs:1"
        );
        assert_eq!(
            fault_in_one_line("GNCL", &Reason::StartTimeout),
            "GNCL: did not become ready in its time"
        );
    }
}
