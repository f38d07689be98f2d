//! Asks the nodes for the structures of types, and for the types that are protected.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use sinew::client::ApiError;
use sinew_bridge_node::NodeClient;
use sinew_zenoh_rules::Encoding;
use tokio::{sync::Notify, time::sleep};
use tracing::{debug, warn};

use crate::{
    forward::ignore,
    shared::{Shared, destination},
};

/// Time between two rounds: an application can declare a structure some time after its registration.
const EVERY: Duration = Duration::from_secs(2);
/// Time between two rounds after changes of the directory.
const SOONEST: Duration = Duration::from_millis(100);
/// Time limit for the answer of a node.
const WITHIN: Duration = Duration::from_millis(500);

/// Asks once, for all routes into Sinew.
pub(crate) async fn refresh(shared: &Shared, client: &mut NodeClient) -> Result<(), ApiError> {
    let protected = client.protected_types(WITHIN).await?;
    if protected.is_incomplete {
        debug!("a node does not report its protected types; their receivers refuse unprotected commands");
    }
    shared.set_protected(protected);
    let mut structures = BTreeMap::new();
    for (index, route) in shared.config.rules.inward().iter().enumerate() {
        if route.encoding == Encoding::Raw {
            continue;
        }
        let to = destination(&route.address.target);
        match client.structure_handled(route.kind, &to, WITHIN).await {
            Ok(Some(schema)) => drop(structures.insert(index, Arc::new(schema))),
            // The application is not there, or its node does not answer: no message reaches it either.
            Ok(None) | Err(ApiError::UnknownName { .. } | ApiError::NoReply(_) | ApiError::Ended(_)) => {}
            Err(other) => return Err(other),
        }
    }
    shared.set_structures(structures);
    Ok(())
}

/// Asks again after each change of the directory, and every two seconds.
pub(crate) async fn run(shared: Arc<Shared>, mut client: NodeClient, changed: Arc<Notify>) {
    loop {
        tokio::select! {
            () = ignore_all(&mut client) => {}
            () = changed.notified() => {}
            () = sleep(EVERY) => {}
        }
        if let Err(why) = refresh(&shared, &mut client).await {
            warn!("the types are not known: {why}");
        }
        sleep(SOONEST).await;
    }
}

/// Takes the messages to all applications, which reach this client, too. Ends with the connection.
async fn ignore_all(client: &mut NodeClient) {
    loop {
        match client.receive().await {
            Ok(seen) => ignore(seen),
            Err(why) => return debug!("{why}"),
        }
    }
}
