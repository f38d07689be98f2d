//! The endpoints that send in the names of the recorded applications.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew::{
    Endpoint, NodeApi, Registration, Tid,
    client::{ApiError, DirectLinks},
    events::Undelivered,
    inspect::{AppsReport, AskApps},
};
use sinew_player::Recorded;

use super::route::Sender;
use crate::{
    system::{System, SystemError},
    table::clean,
};

/// Maximum number of sources.
pub(crate) const SOURCES_MAX: usize = 200;
/// Time limit of one registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(5);
/// Longest wait for room for one message.
const ROOM_WITHIN: Duration = Duration::from_millis(100);
/// Maximum number of messages that are taken from one endpoint at once.
const TAKEN_MAX: usize = 256;

/// The endpoints.
#[derive(Debug, Default)]
pub(crate) struct Sources(BTreeMap<Sender, Endpoint>);

impl Sources {
    /// Registers all of them.
    ///
    /// # Errors
    /// There are too many, or the node refuses one.
    pub(crate) fn register(api: &NodeApi, senders: BTreeSet<&Sender>) -> Result<Self, SystemError> {
        if senders.len() > SOURCES_MAX {
            return Err(SystemError::Bag(format!(
                "{} applications send in this recording, and {SOURCES_MAX} can be played at once; choose some: \
                 --source NAME",
                senders.len()
            )));
        }
        let mut sources = Self::default();
        for sender in senders {
            let registration = Registration::new()
                .deadline(REGISTERED_WITHIN)
                .stall_timeout(ROOM_WITHIN)
                .direct(DirectLinks::Never);
            let (registration, name) = match sender {
                Sender::Named(name) => (registration.name(name.as_str()), clean(name)),
                Sender::Unnamed(tid) => (registration, tid.to_string()),
            };
            let endpoint = api.register_transport_address(registration).map_err(|why| {
                SystemError::Bag(format!(
                    "{name} cannot be played: {why}. Leave it out with --source, or stop the other one"
                ))
            })?;
            sources.0.insert(sender.clone(), endpoint);
        }
        Ok(sources)
    }

    /// Returns the current addresses.
    pub(crate) fn addresses(&self) -> BTreeSet<Tid> {
        self.0.values().map(Endpoint::tid).collect()
    }

    /// Sends a message as one of these applications.
    pub(crate) fn send(&mut self, sender: &Sender, to: Tid, message: &Recorded) -> Result<(), ApiError> {
        let endpoint = self.0.get_mut(sender).expect("all senders of the recording are registered");
        let mut lent = endpoint.create_message(to, message.channel.kind, message.payload.len())?;
        lent.copy_from_slice(&message.payload);
        lent.set_class(message.channel.class);
        if message.header.time_to_live_us > 0 {
            lent.set_expires_after(Duration::from_micros(message.header.time_to_live_us.into()));
        }
        endpoint.loaned(lent).send()
    }

    /// Takes the messages that have arrived, so that no other application waits for room here. Returns the reports of
    /// messages that were not delivered.
    ///
    /// # Errors
    /// The node is lost.
    pub(crate) fn drain(&mut self) -> Result<Vec<(Sender, Undelivered)>, ApiError> {
        let mut undelivered = Vec::new();
        for (sender, endpoint) in &mut self.0 {
            for _ in 0..TAKEN_MAX {
                if endpoint.receive(Duration::ZERO)?.is_none() {
                    break;
                }
            }
            while let Some(report) = endpoint.take_undelivered() {
                undelivered.push((sender.clone(), report));
            }
        }
        Ok(undelivered)
    }

    /// Releases all names.
    pub(crate) fn leave(self) {
        for endpoint in self.0.into_values() {
            // They are released in any case when the connection ends.
            let _ = endpoint.unregister();
        }
    }
}

/// Refuses to play in the name of an application that is there, on any node.
///
/// # Errors
/// There is one, at an address that is not among `own`.
pub(crate) fn check_names(
    system: &mut System,
    senders: &BTreeSet<&Sender>,
    own: &BTreeSet<Tid>,
) -> Result<(), SystemError> {
    let here = system.here()?;
    for answer in system.ask_all::<AskApps, AppsReport>(&here) {
        let apps = answer.result.map(|report| report.apps).unwrap_or_default();
        for app in apps.into_iter().filter(|app| !own.contains(&app.tid)) {
            let Some(name) = app.name else { continue };
            if senders.contains(&Sender::Named(name.clone())) {
                let (name, node, tid) = (clean(&name), clean(&answer.name), app.tid);
                return Err(SystemError::Bag(format!(
                    "an application called {name} is there, at {tid} on node {node}: two would send under one name. \
                     Stop it, or leave it out: --source with the names of the others"
                )));
            }
        }
    }
    Ok(())
}
