//! The layers of a node, as children of its supervisor.

use std::{sync::Arc, time::Duration};

use actix::{Actor, Context};
use sinew_runtime::supervision::{ChildIds, ChildSpec, Launch, Place, Policy, ReadyGate, Reason, life};

use crate::{gncl, lncl, ndl, stores::Stores, sync};

/// The layers' names, in the paper's order of start (section 6).
pub(super) const LAYERS: [&str; 4] = ["LNCL", "sync manager", "GNCL", "NDL"];

/// NDL's real-time priority, where there is one to be had: above ordinary threads, so that a busy node is not taken for a lost one, and
/// below every control loop that asks for one.
const NDL_PRIORITY: u8 = 1;

/// The name of their supervisor.
pub(super) const SUPERVISOR: &str = "layers";

/// The layers in that order.
pub(super) fn specs(stores: &Arc<Stores>, ids: &ChildIds, deadline: Duration) -> Vec<ChildSpec> {
    let child = |name: &str, place: Place, launch: Launch| ChildSpec {
        id: ids.next(),
        name: name.to_owned(),
        tid: None,
        policy: Policy { start_within: deadline, ..Policy::default() },
        place,
        #[cfg(feature = "fault-points")]
        launch: stores.faults.arm(name, launch),
        #[cfg(not(feature = "fault-points"))]
        launch,
    };
    let mut gncl = child(LAYERS[2], Place::io(), layer(stores, gncl::Gncl::new));
    // Peers take what waits for them while it stops.
    gncl.policy.stop_within += gncl::LINGER;
    vec![
        child(LAYERS[0], Place::io(), layer(stores, lncl::Lncl::new)),
        child(LAYERS[1], Place::layer("sync"), layer(stores, sync::SyncManager::new)),
        gncl,
        child(
            LAYERS[3],
            Place::layer("ndl").realtime_at_best(NDL_PRIORITY),
            layer(stores, ndl::NdlActor::new),
        ),
    ]
}

/// How a layer's actor is made, each time anew.
fn layer<A>(stores: &Arc<Stores>, make: fn(Arc<Stores>, ReadyGate) -> A) -> Launch
where
    A: Actor<Context = Context<A>>,
{
    let stores = stores.clone();
    Arc::new(move |ready| life(Context::new().into_future(make(stores.clone(), ready))))
}

/// What a layer failed of, for who started the node. Most often it is not a fault of the layer, but of what it was given.
pub(super) fn fault_in_one_line(layer: &str, reason: &Reason) -> String {
    let why = if let Reason::Panic(said) = reason { said.clone() } else { reason.to_string() };
    format!("{layer}: {}", why.split_whitespace().collect::<Vec<_>>().join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_layer_failed_of_is_one_line_that_begins_with_its_name() {
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
