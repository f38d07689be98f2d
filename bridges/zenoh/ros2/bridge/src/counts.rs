//! Counts of published, sent and refused messages; the log of refusals; `/diagnostics`.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    thread,
    time::{Duration, Instant},
};

use sinew_ros2_core::{Attachment, Catalog, Cause, EndpointKind, GraphNode, Refusal, Value, encode};
use tracing::{info, warn};
use zenoh::{Wait as _, bytes::Encoding, qos::CongestionControl};

use crate::{clock, graph::Graph};

/// Time between two lines of the log about one cause of refusals of one topic.
const LOGGED_EVERY: Duration = Duration::from_secs(1);
/// Maximum number of topics with counts of their own. Messages of further ones are counted together.
const TOPICS_MAX: usize = 256;
/// The name of the counts of further topics.
const OTHERS: &str = "others";
const PERIOD: Duration = Duration::from_secs(1);
/// Levels of a `DiagnosticStatus`.
const OK: u64 = 0;
const WARN: u64 = 1;

/// The counts of a topic or service.
#[derive(Clone, Debug, Default)]
struct Counted {
    /// Messages that were published, commands that were sent, or requests that were answered.
    passed: u64,
    refused: [u64; Cause::ALL.len()],
    /// When each cause was last logged, and the refusals since then.
    logged: [Option<Instant>; Cause::ALL.len()],
    unlogged: [u64; Cause::ALL.len()],
}

/// The counts of all topics and services.
#[derive(Clone, Debug, Default)]
pub(crate) struct Counts(Arc<Mutex<BTreeMap<String, Counted>>>);

impl Counts {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Counted>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn with(&self, topic: &str, change: impl FnOnce(&mut Counted)) {
        let mut all = self.lock();
        let has_room = all.len() < TOPICS_MAX;
        match all.get_mut(topic) {
            Some(counted) => change(counted),
            None => change(all.entry(if has_room { topic } else { OTHERS }.to_owned()).or_default()),
        }
    }

    /// Counts a message, a command or a request that passed.
    pub(crate) fn pass(&self, topic: &str) {
        self.with(topic, |counted| counted.passed += 1);
    }

    /// Counts a refusal, and logs it, at most once a second for each cause.
    pub(crate) fn refuse(&self, topic: &str, refusal: &Refusal, count: u64) {
        let (place, mut logged) = (refusal.cause.place(), None);
        self.with(topic, |counted| {
            counted.refused[place] += count;
            counted.unlogged[place] += count;
            let last = &mut counted.logged[place];
            if last.is_none_or(|last| last.elapsed() >= LOGGED_EVERY) {
                *last = Some(Instant::now());
                logged = Some(std::mem::take(&mut counted.unlogged[place]));
            }
        });
        if let Some(count) = logged {
            warn!("refused {count} of {topic}: {refusal}");
        }
    }

    /// Returns the statuses of a `DiagnosticArray`.
    fn statuses(&self, node: &str) -> Vec<Value> {
        let pair = |key: &str, count: u64| {
            Value::Message(vec![Value::Text(key.to_owned()), Value::Text(count.to_string())])
        };
        let status = |(topic, counted): (&String, &Counted)| {
            let refused = Cause::ALL.iter().zip(counted.refused).filter(|(_, count)| *count > 0);
            let refused: Vec<_> = refused.map(|(cause, count)| pair(cause.name(), count)).collect();
            let level = if refused.is_empty() { OK } else { WARN };
            let message = if refused.is_empty() { "none refused" } else { "some were refused" };
            let values = std::iter::once(pair("passed", counted.passed)).chain(refused).collect();
            Value::Message(vec![
                Value::Unsigned(level),
                Value::Text(format!("sinew-ros2: {topic}")),
                Value::Text(message.to_owned()),
                Value::Text(node.to_owned()),
                Value::List(values),
            ])
        };
        self.lock().iter().map(status).collect()
    }
}

/// Publishes the counts on `/diagnostics` once a second.
///
/// # Errors
/// The router connection is closed.
pub(crate) fn publish(
    counts: &Counts,
    graph: &Graph,
    node: &GraphNode,
    (app, catalog): (&str, &Catalog),
) -> Result<(), String> {
    let message = catalog.message("diagnostic_msgs/msg/DiagnosticArray").map_err(|why| why.to_string())?;
    let declared =
        graph.endpoint(node, EndpointKind::Publisher, "/diagnostics", (&message.name, &message))?;
    let publisher = graph
        .session
        .declare_publisher(declared.key)
        .encoding(Encoding::APPLICATION_CDR)
        .congestion_control(CongestionControl::Drop)
        .wait()
        .map_err(|why| format!("zenoh: {why}"))?;
    info!("publishes its counts on /diagnostics");
    let mut sequence = 0;
    loop {
        thread::sleep(PERIOD);
        sequence += 1;
        let time_ns = clock::wall_ns();
        let seconds = time_ns.div_euclid(1_000_000_000);
        let stamp = Value::Message(vec![
            Value::Signed(seconds),
            Value::Unsigned(time_ns.rem_euclid(1_000_000_000).unsigned_abs()),
        ]);
        let header = Value::Message(vec![stamp, Value::Text(String::new())]);
        let value = Value::Message(vec![header, Value::List(counts.statuses(app))]);
        match encode(&message, &value) {
            Ok(bytes) => {
                let attachment = Attachment { sequence, time_ns, gid: declared.gid }.encode();
                // Without a router nobody misses it.
                let _ = publisher.put(bytes).attachment(&attachment[..]).wait();
            }
            Err(why) => warn!("/diagnostics: {why}"),
        }
    }
}
