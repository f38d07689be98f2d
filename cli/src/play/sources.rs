//! The endpoints that send in the names of the recorded applications.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew::{
    Endpoint, NodeAddress, NodeApi, Registration, Tid,
    client::{ApiError, DirectLinks},
    events::Undelivered,
    inspect::{AppsReport, AskApps},
};
use sinew_player::Recorded;

use super::{route::Sender, target::Target};
use crate::{
    system::{Answer, SystemError, present},
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

    /// Returns whether one of them has this address.
    pub(crate) fn has(&self, tid: Tid) -> bool {
        self.0.values().any(|endpoint| endpoint.tid() == tid)
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

/// Refuses to play in the name of an application that is there, on any node. The present nodes of a live system must
/// list all of them: a controller that is not listed would send beside its recording. Returns the lost nodes, which
/// cannot list theirs.
///
/// # Errors
/// There is one, at an address that is not among `own`; or a present node of a live system does not list all
/// applications.
pub(crate) fn check_names(
    target: &mut Target,
    senders: &BTreeSet<&Sender>,
    own: &BTreeSet<Tid>,
) -> Result<Vec<NodeAddress>, SystemError> {
    let is_live = !target.is_own();
    let here = target.system.here()?;
    if is_live && here.left_out > 0 {
        return Err(unlisted(&format!("{} nodes are not listed by the node of the socket", here.left_out)));
    }
    let answers = target.system.ask_these::<AskApps, AppsReport>(present(&here));
    answers.into_iter().try_for_each(|answer| check_answer(answer, is_live, senders, own))?;
    Ok(here.peers.iter().filter(|peer| !peer.is_there).map(|peer| peer.node).collect())
}

/// Checks the applications of one node.
fn check_answer(
    answer: Answer<AppsReport>,
    is_live: bool,
    senders: &BTreeSet<&Sender>,
    own: &BTreeSet<Tid>,
) -> Result<(), SystemError> {
    let (name, node) = (clean(&answer.name), answer.node);
    let apps = match answer.result {
        Ok(AppsReport { left_out: 1.., .. }) if is_live => {
            return Err(unlisted(&format!("node {name} at {node} has more applications than it lists")));
        }
        Err(why) if is_live => {
            return Err(unlisted(&format!("node {name} at {node} does not list its applications: {why}")));
        }
        Ok(report) => report.apps,
        Err(_) => return Ok(()),
    };
    for app in apps.into_iter().filter(|app| !own.contains(&app.tid)) {
        let Some(taken) = app.name else { continue };
        if senders.contains(&Sender::Named(taken.clone())) {
            let (taken, tid) = (clean(&taken), app.tid);
            return Err(SystemError::Bag(format!(
                "an application called {taken} is there, at {tid} on node {name}: two would send under one name. Stop \
                 it, or leave it out: --source with the names of the others"
            )));
        }
    }
    Ok(())
}

/// A live system that may have an application with the name of a source.
fn unlisted(why: &str) -> SystemError {
    let why = clean(why);
    SystemError::Bag(format!(
        "{why}: an application of the recording may run there. Wait until each node answers (`sinew nodes`), or give \
         it more time: --deadline-ms"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(left_out: u64) -> AppsReport {
        AppsReport {
            name: "knee".to_owned(),
            apps: Vec::new(),
            left_out,
            barriers: Vec::new(),
            barriers_left_out: 0,
            groups: Vec::new(),
            groups_left_out: 0,
        }
    }

    #[test]
    fn live_system_with_unlisted_applications_is_refused() {
        let check = |result, is_live| {
            let answer = Answer { node: NodeAddress::from([10, 0, 0, 2]), name: "knee".to_owned(), result };
            check_answer(answer, is_live, &BTreeSet::new(), &BTreeSet::new())
        };
        assert!(check(Ok(report(0)), true).is_ok());
        let silent = || Err("no answer within 1 s".to_owned());
        for (result, words) in [(silent(), "no answer within 1 s"), (Ok(report(3)), "more applications")] {
            let refused = check(result, true).unwrap_err().to_string();
            assert!(refused.contains("node knee at 10.0.0.2") && refused.contains(words), "{refused}");
        }
        // And: no robot is in the own project
        assert!(check(silent(), false).is_ok() && check(Ok(report(3)), false).is_ok());
    }
}
