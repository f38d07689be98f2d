//! The system as the page and the metrics see it. The command `sinew` implements it through the socket of one node.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew::{
    Tid, Time,
    parameters::{ParameterList, ParameterOutcome, SetParameters},
    stop::StopReport,
};

use crate::{snapshot::Snapshot, stop::StopAct};

/// Asks all nodes. Each call has a time limit of its own.
///
/// # Examples
///
/// ```
/// use sinew_view::{NoSystem, Source};
///
/// assert!(NoSystem.snapshot().entry.is_err());
/// assert!(NoSystem.parameters().is_ok_and(|apps| apps.is_empty()));
/// ```
pub trait Source: Send + Sync + 'static {
    /// Returns the state of the system. Nodes without an answer are part of it.
    fn snapshot(&self) -> Snapshot;

    /// Returns the parameters of all applications that have some.
    ///
    /// # Errors
    /// Why the system cannot be asked, with the remedy.
    fn parameters(&self) -> Result<Vec<AppParameters>, String>;

    /// Sets parameters of the application with this name, or undoes its last set. The application's node decides
    /// whether this program has the right.
    ///
    /// # Errors
    /// Why there is no outcome, with the remedy.
    fn set(&self, app: &str, set: &SetParameters) -> Result<ParameterOutcome, String>;

    /// Presses or releases the stop of the whole system, or asks for its state. A press returns when all nodes have
    /// confirmed, or after a second. The entry node decides whether this program may release.
    ///
    /// # Errors
    /// Why there is no report, with the remedy. The stop may be pressed nevertheless.
    fn stop(&self, act: StopAct) -> Result<StopReport, String>;

    /// Returns a reader of messages. It begins at the first call of [`Tap::poll`], and ends when it is dropped.
    fn tap(&self) -> Box<dyn Tap>;

    /// Returns a reader of channels and views, for Foxglove. It begins at the first call of [`Live::poll`], and ends
    /// when it is dropped.
    fn live(&self) -> Box<dyn Live>;
}

/// The parameters of an application.
#[derive(Clone, Debug)]
pub struct AppParameters {
    /// Its name, or its address if it has none.
    pub app: String,
    /// Its parameters, or why they are not known.
    pub result: Result<ParameterList, String>,
}

/// Reads copies of messages. No sender waits for it: a node drops copies that are not read in time.
///
/// # Examples
///
/// ```
/// use std::collections::BTreeSet;
///
/// use sinew_view::{NoSystem, Source};
///
/// let mut tap = NoSystem.tap();
/// let apps = BTreeSet::from(["knee.drive".to_owned()]);
/// let faults = tap.poll(&apps, &mut |seen| println!("{} from {}", seen.kind, seen.source));
/// assert!(faults.is_empty());
/// ```
pub trait Tap: Send {
    /// Hands over each message from or to these applications, given by their names, that has passed since the last
    /// call. It begins with the applications that are new, and ends with those that are missing.
    ///
    /// Returns why messages of an application cannot be read, for each such application.
    fn poll(&mut self, apps: &BTreeSet<String>, take: &mut dyn FnMut(&Sighting<'_>)) -> Vec<String>;
}

/// A message that a node has seen.
#[derive(Clone, Copy, Debug)]
pub struct Sighting<'m> {
    /// The name of its sender, or its address.
    pub source: &'m str,
    /// The name of its destination, or its address.
    pub destination: &'m str,
    /// The name of its payload type, or its number.
    pub kind: &'m str,
    /// When the node saw it, on the clock of this host.
    pub at: Time,
    /// Its age at that time; `None` if it is unknown.
    pub age: Option<Duration>,
    /// Whether it was rejected.
    pub is_rejected: bool,
    /// Its payload; empty if it was too long for a copy.
    pub payload: &'m [u8],
}

/// Finds the channels that recordings of the system would have, and reads views of their messages. No sender waits for
/// it. A node copies messages for it only while one of their topics is wanted.
///
/// # Examples
///
/// ```
/// use std::collections::BTreeSet;
///
/// use sinew_view::{LiveItem, NoSystem, Source};
///
/// let mut live = NoSystem.live();
/// let wanted = BTreeSet::from(["/knee.sensor/leg.angle/view".to_owned()]);
/// let faults = live.poll(&wanted, &mut |item| match item {
///     LiveItem::Channel(channel) => println!("{} is a channel", channel.topic),
///     LiveItem::Message { topic, data, .. } => println!("{topic}: {} bytes", data.len()),
///     LiveItem::Missed(count) => println!("{count} messages are missing"),
/// });
/// assert!(faults.is_empty());
/// ```
pub trait Live: Send {
    /// Hands over the channels that are new or have another schema, and the views of wanted topics, since the last
    /// call. It lasts some milliseconds, and longer where it asks nodes, each with a time limit.
    ///
    /// Returns why messages of a node cannot be read, for each such node.
    fn poll(&mut self, wanted: &BTreeSet<String>, take: &mut dyn FnMut(LiveItem<'_>)) -> Vec<String>;
}

/// A part of the stream of a [`Live`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LiveItem<'m> {
    /// A channel, before its first message.
    Channel(LiveChannel),
    /// A view.
    Message {
        /// The topic of its channel.
        topic: &'m str,
        /// When the node handed over the message, in nanoseconds of the wall clock.
        time_ns: u64,
        /// The view, as a recording has it.
        data: &'m [u8],
    },
    /// So many messages of wanted topics were not read in time.
    Missed(u64),
}

/// A channel of views, as a recording has it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveChannel {
    /// The topic, such as `/knee.sensor/leg.angle/view`.
    pub topic: String,
    /// The encoding of the messages: `protobuf` or `json`.
    pub encoding: String,
    /// The name of the schema.
    pub schema_name: String,
    /// The encoding of the schema: `protobuf` (a `FileDescriptorSet`) or `jsonschema`.
    pub schema_encoding: String,
    /// The schema.
    pub schema: Vec<u8>,
    /// The metadata that a recording has of it.
    pub metadata: BTreeMap<String, String>,
}

/// A system of which nothing is known, for tests and examples.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoSystem;

impl Source for NoSystem {
    fn snapshot(&self) -> Snapshot {
        Snapshot::without_entry(Time::now(), "there is no node".to_owned())
    }

    fn parameters(&self) -> Result<Vec<AppParameters>, String> {
        Ok(Vec::new())
    }

    fn set(&self, app: &str, _: &SetParameters) -> Result<ParameterOutcome, String> {
        Err(format!("there is no application {app}; start a node"))
    }

    fn stop(&self, _: StopAct) -> Result<StopReport, String> {
        Err("there is no node; start one".to_owned())
    }

    fn tap(&self) -> Box<dyn Tap> {
        Box::new(Self)
    }

    fn live(&self) -> Box<dyn Live> {
        Box::new(Self)
    }
}

impl Tap for NoSystem {
    fn poll(&mut self, _: &BTreeSet<String>, _: &mut dyn FnMut(&Sighting<'_>)) -> Vec<String> {
        Vec::new()
    }
}

impl Live for NoSystem {
    fn poll(&mut self, _: &BTreeSet<String>, _: &mut dyn FnMut(LiveItem<'_>)) -> Vec<String> {
        Vec::new()
    }
}

/// Returns the application's name, or its address.
pub(crate) fn name_or_tid(name: Option<&str>, tid: Tid) -> String {
    name.map_or_else(|| tid.to_string(), str::to_owned)
}
