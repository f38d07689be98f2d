//! The bridge's own client at the node: groups and broadcasts of Sinew, events of nodes and of the directory, and
//! unconfirmed and protected messages into Sinew.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use sinew::{
    AppAddress,
    client::ApiError,
    events::NodeEvent,
    protection::raw::{Protected, Reads},
};
use sinew_bridge_node::{NodeClient, Outgoing, Seen};
use sinew_zenoh_rules::{InRoute, Passed, Refusal, payload::inward, rules::Origin};
use tokio::{
    sync::{Notify, mpsc::Receiver},
    time::interval,
};
use tracing::{info, warn};

use crate::{
    forward::{ToZenoh, ignore},
    inlet::Put,
    liveness::Presence,
    shared::{Shared, destination},
};

/// Time between two looks at the reports of undelivered messages: a node combines them for that long.
const REPORTS_EVERY: Duration = Duration::from_millis(100);

/// The client, and the parts that it serves.
pub(crate) struct MainClient {
    shared: Arc<Shared>,
    client: NodeClient,
    puts: Receiver<Put>,
    to_zenoh: ToZenoh,
    presence: Presence,
    /// Told of each change of the directory.
    changed: Arc<Notify>,
    groups: BTreeMap<AppAddress, Origin>,
    /// The protected type of each route into Sinew that has one.
    protected: BTreeMap<usize, Protected>,
    is_connected: bool,
}

impl MainClient {
    pub(crate) fn new(
        client: NodeClient,
        puts: Receiver<Put>,
        to_zenoh: ToZenoh,
        presence: Presence,
        changed: Arc<Notify>,
    ) -> Self {
        let shared = to_zenoh.shared.clone();
        let rules = &shared.config.rules;
        let group = |name: &str| (AppAddress::group(name), Origin::Group(name.to_owned()));
        let groups = rules.groups().into_iter().map(group).collect();
        let routes = rules.inward().iter().enumerate();
        let protected = routes.filter_map(|(index, route)| Some((index, protected_type(route)?))).collect();
        shared.note_own(client.tid());
        Self { shared, client, puts, to_zenoh, presence, changed, groups, protected, is_connected: false }
    }

    /// Serves until the client ends. It registers again by itself when the node restarts.
    pub(crate) async fn run(mut self) -> ApiError {
        let mut reports = interval(REPORTS_EVERY);
        self.connected();
        loop {
            tokio::select! {
                seen = self.client.receive() => match seen {
                    Ok(seen) => self.take(seen),
                    Err(why @ ApiError::Disconnected(_)) => {
                        warn!("{why}");
                        self.is_connected = false;
                        self.presence.disconnected();
                    }
                    Err(why) => return why,
                },
                Some(put) = self.puts.recv() => self.put(put).await,
                _ = reports.tick() => self.take_reports(),
            }
        }
    }

    fn connected(&mut self) {
        self.is_connected = true;
        self.shared.note_own(self.client.tid());
        self.presence.connected(self.client.tid().node, &self.shared.config.rules);
    }

    fn take(&mut self, seen: Seen) {
        if !self.is_connected {
            info!("the node is there again, as {}", self.client.node_name());
            self.connected();
        }
        let rules = &self.shared.config.rules;
        match seen {
            Seen::Message(received) => {
                let app = received.destination().app;
                let origin = if app == AppAddress::ALL { Some(&Origin::All) } else { self.groups.get(&app) };
                self.to_zenoh.put(received, origin);
            }
            Seen::Directory(event) => {
                self.presence.directory_changed(event, rules);
                self.changed.notify_one();
            }
            Seen::Node(event) => {
                self.presence.node_changed(&event, rules);
                if matches!(event, NodeEvent::NodeFound { .. } | NodeEvent::NodeRestarted { .. }) {
                    self.changed.notify_one();
                }
            }
            other @ Seen::Other => ignore(other),
        }
    }

    async fn put(&mut self, put: Put) {
        let shared = self.shared.clone();
        let route = &shared.config.rules.inward()[put.route];
        if let Err((why, detail)) = self.try_put(&put, route).await {
            shared.refuse(why, &route.address.key(shared.config.rules.project()), &detail);
        }
    }

    async fn try_put(&mut self, put: &Put, route: &InRoute) -> Result<(), (Refusal, String)> {
        let payload = payload_for(&self.shared, (put.route, route), &put.payload)?;
        let to = destination(&route.address.target);
        let message = Outgoing {
            to: &to,
            kind: route.kind,
            class: route.class,
            payload: &payload,
            expires_after: route.expires_after,
        };
        let (sent, way) = match self.protected.get(&put.route) {
            // The seal says that the command is fresh.
            Some(protected) if put.arrived.elapsed() > protected.protection.age_max => {
                return Err((Refusal::TooOld, "the command has waited in the bridge".to_owned()));
            }
            Some(protected) => (self.client.send_protected(&message, protected).await, Passed::ProtectedIn),
            None => (self.client.send(&message).await, Passed::PutIn),
        };
        sent.map_err(|why| (Refusal::NotSent, why.to_string()))?;
        self.shared.pass(way);
        Ok(())
    }

    /// Counts the unconfirmed messages that were rejected.
    fn take_reports(&mut self) {
        while let Some(report) = self.client.take_undelivered() {
            self.shared.refuse_several(Refusal::Rejected, report.count, &report.to_string(), "");
        }
    }
}

/// Returns the payload of a message into Sinew.
pub(crate) fn payload_for(
    shared: &Shared,
    (index, route): (usize, &InRoute),
    bytes: &[u8],
) -> Result<Vec<u8>, (Refusal, String)> {
    if route.protection.is_none() && shared.is_protected(&route.address.payload_type) {
        return Err((Refusal::Unprotected, String::new()));
    }
    let schema = shared.structure(index);
    let payload = inward(bytes, route.encoding, schema.as_deref()).map_err(|why| {
        let detail = match &why {
            sinew_zenoh_rules::payload::PayloadError::Malformed(error) => error.to_string(),
            sinew_zenoh_rules::payload::PayloadError::Envelope => String::new(),
        };
        (why.refusal(), detail)
    })?;
    if payload.len() > shared.payload_max() {
        return Err((Refusal::TooLong, String::new()));
    }
    Ok(payload)
}

/// Returns the protected type of a route, if it has one.
fn protected_type(route: &InRoute) -> Option<Protected> {
    let protection = route.protection?;
    // Data IDs refer to the name until the process ends. Each rule of the file has one.
    let name: &'static str = Box::leak(route.address.payload_type.clone().into_boxed_str());
    Some(Protected { name, kind: route.kind, protection, reads: Reads::Any })
}
