//! A message of Sinew as a put or a query of Zenoh.

use std::sync::Arc;

use sinew::{Outcome, Time, client::Received, message::Rejection};
use sinew_bridge_node::Seen;
use sinew_zenoh_rules::{
    OutRoute, Passed, Refusal,
    attachment::{Header, attachment},
    payload::outward,
    rules::Origin,
};

use crate::{
    shared::Shared,
    zenoh_sender::{Job, ZenohSender},
};

/// The way to Zenoh.
#[derive(Clone)]
pub(crate) struct ToZenoh {
    pub(crate) shared: Arc<Shared>,
    pub(crate) zenoh_sender: ZenohSender,
    /// The id of the session, by which other bridges know the origin of a message.
    pub(crate) bridge: String,
}

/// A message that its rule lets pass.
pub(crate) struct Prepared<'r> {
    pub(crate) route: &'r OutRoute,
    pub(crate) key: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) attachment: String,
}

impl ToZenoh {
    /// Puts a message, or refuses it.
    pub(crate) fn put(&self, received: Received, origin: Option<&Origin>) {
        if self.shared.is_own(received.source()) {
            // The bridge has sent it to a group of its own.
            return received.settle(Outcome::Rejected(Rejection::Unsupported));
        }
        if let Err((why, rejection)) = self.try_put(&received, origin) {
            self.refuse(why, &received, origin);
            received.settle(Outcome::Rejected(rejection));
        }
    }

    fn try_put(&self, received: &Received, origin: Option<&Origin>) -> Result<(), (Refusal, Rejection)> {
        if received.wants_reply() {
            return Err((Refusal::NoRuleOut, Rejection::Unsupported));
        }
        let Prepared { route, key, payload, attachment } = self.prepare(received, origin)?;
        let put = Job::Put { key, payload, encoding: route.encoding, attachment };
        let sent = self.zenoh_sender.send(received.class(), put);
        sent.map_err(|_| (Refusal::QueueFullOut, Rejection::QueueFull))?;
        self.shared.pass(Passed::PutOut);
        Ok(())
    }

    /// Returns the put of a message.
    pub(crate) fn prepare(
        &self,
        received: &Received,
        origin: Option<&Origin>,
    ) -> Result<Prepared<'_>, (Refusal, Rejection)> {
        let rules = &self.shared.config.rules;
        let route = origin.and_then(|origin| rules.outward_of(origin, received.kind()));
        let route = route.ok_or((Refusal::NoRuleOut, Rejection::UnknownKind))?;
        let payload = outward(received.bytes(), route.encoding);
        let payload = payload.map_err(|_| (Refusal::MalformedOut, Rejection::Malformed))?;
        let header = Header {
            source: received.source(),
            sequence: received.sequence(),
            class: received.class(),
            age: received.age(Time::now()).zip(received.age_error()),
        };
        let attachment = attachment(&header, &self.bridge);
        Ok(Prepared { route, key: route.address.key(rules.project()), payload, attachment })
    }

    /// Counts a refused message of Sinew.
    pub(crate) fn refuse(&self, why: Refusal, received: &Received, origin: Option<&Origin>) {
        let to = match origin {
            Some(Origin::Name(name)) => format!("to {name}"),
            Some(Origin::Group(name)) => format!("to group {name}"),
            Some(Origin::All) => "to all applications".to_owned(),
            None => "to the bridge itself".to_owned(),
        };
        let what = format!("type {} from {} {to}", received.kind(), received.source());
        self.shared.refuse(why, &what, "");
    }
}

/// Takes a message that is for no part of the bridge.
pub(crate) fn ignore(seen: Seen) {
    match seen {
        Seen::Message(received) => received.settle(Outcome::Rejected(Rejection::UnknownKind)),
        Seen::Directory(_) | Seen::Node(_) | Seen::Other => {}
    }
}
