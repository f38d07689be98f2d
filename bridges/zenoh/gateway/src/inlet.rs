//! Puts and queries of Zenoh, as they arrive on its threads. Only rules are looked up here; the rest waits in a queue.

use std::{
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use sinew_zenoh_rules::{Arrival, Encoding, Refusal, attachment, outcome, rules::Act};
use tokio::sync::mpsc::Sender;
use zenoh::{
    bytes::ZBytes,
    query::Query,
    sample::{Sample, SampleKind},
    time::Timestamp,
};

use crate::{shared::Shared, zenoh_sender::ZenohSender};

/// Maximum time that a timestamp may be ahead of this host's clock.
const AHEAD_MAX: Duration = Duration::from_millis(500);

/// A put that its rule lets pass.
pub(crate) struct Put {
    /// The index of its route.
    pub(crate) route: usize,
    pub(crate) payload: Vec<u8>,
    /// When it has arrived.
    pub(crate) arrived: Instant,
}

/// A query that its rule lets pass.
pub(crate) struct Request {
    pub(crate) route: usize,
    pub(crate) payload: Vec<u8>,
    pub(crate) arrived: Instant,
    pub(crate) query: Query,
}

/// The entry of messages from Zenoh.
pub(crate) struct Inlet {
    pub(crate) shared: Arc<Shared>,
    pub(crate) puts: Sender<Put>,
    pub(crate) requests: Sender<Request>,
    pub(crate) zenoh_sender: ZenohSender,
}

impl Inlet {
    pub(crate) fn put_received(&self, sample: &Sample) {
        let key = sample.key_expr().as_str();
        let act = match sample.kind() {
            SampleKind::Put => Act::Put,
            SampleKind::Delete => Act::Delete,
        };
        let arrival = Arrival {
            key,
            act,
            length: sample.payload().len(),
            age: sample.timestamp().and_then(age_of),
            is_from_bridge: is_from_bridge(sample.attachment()),
        };
        let refused = match self.shared.config.rules.admit(&arrival, self.shared.payload_max()) {
            Ok(None) => return,
            Err(why) => why,
            Ok(Some(route)) => {
                let payload = sample.payload().to_bytes().into_owned();
                let put = Put { route, payload, arrived: Instant::now() };
                if self.puts.try_send(put).is_ok() {
                    return;
                }
                Refusal::QueueFull
            }
        };
        self.shared.refuse(refused, key, "");
    }

    pub(crate) fn query_received(&self, query: Query) {
        let key = query.key_expr().as_str().to_owned();
        let payload = query.payload().cloned().unwrap_or_default();
        let arrival = Arrival {
            key: &key,
            act: Act::Get,
            length: payload.len(),
            // A query has no timestamp, and waits nowhere: its sender waits for it.
            age: Some(Duration::ZERO),
            is_from_bridge: is_from_bridge(query.attachment()),
        };
        let (why, query, encoding) = match self.shared.config.rules.admit(&arrival, self.shared.payload_max())
        {
            Ok(None) => return,
            Err(why) => (why, query, Encoding::Json),
            Ok(Some(route)) => {
                let payload = payload.to_bytes().into_owned();
                let request = Request { route, payload, arrived: Instant::now(), query };
                match self.requests.try_send(request) {
                    Ok(()) => return,
                    Err(full) => (
                        Refusal::QueueFull,
                        full.into_inner().query,
                        self.shared.config.rules.inward()[route].encoding,
                    ),
                }
            }
        };
        self.shared.refuse(why, &key, "");
        let error = outcome::error(&why.to_string(), None, encoding);
        self.zenoh_sender.reply(query, Err(error), encoding);
    }
}

fn is_from_bridge(attachment: Option<&ZBytes>) -> bool {
    attachment.is_some_and(|bytes| attachment::is_of_bridge(&bytes.to_bytes()))
}

/// Returns the age by a timestamp; `None` if it is ahead of this host's clock.
#[expect(clippy::disallowed_methods, reason = "Zenoh's timestamps are of the wall clock")]
fn age_of(timestamp: &Timestamp) -> Option<Duration> {
    match SystemTime::now().duration_since(timestamp.get_time().to_system_time()) {
        Ok(age) => Some(age),
        Err(ahead) if ahead.duration() <= AHEAD_MAX => Some(Duration::ZERO),
        Err(_) => None,
    }
}
