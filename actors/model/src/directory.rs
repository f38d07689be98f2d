//! The directory of names, and the applications that wait for names: reports of the sync manager.

use std::{borrow::Cow, fmt, time::Duration};

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::Tid,
    wire::{Class, Kind, Payload},
};

/// An application that waits at the start-up barrier.
///
/// # Examples
///
/// ```
/// use sinew::{NodeHandle, barrier::Waiting};
///
/// /// The application that has waited longest at the start-up barrier.
/// fn slowest(handle: &NodeHandle) -> Option<Waiting> {
///     handle.waiting().into_iter().max_by_key(|waiting| waiting.since)
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// The application's name, or its address if it has none.
    pub application: String,
    /// The names that are not ready, since when, and the last known state of each.
    /// The states are: `registered, not ready`, `failed, not ready again`, `stopped in order, not ready again`, `its
    /// node has restarted, its directory has not come yet`, `its node is linked again, its directory has not come yet`,
    /// `its link is down`, `its node left`, `its node was lost`, `unregistered`, `not there`, `part of a cycle of
    /// requirements`.
    pub missing: Vec<Absence>,
    /// How long the application has waited.
    pub since: Duration,
}

impl fmt::Display for Waiting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} has waited {:.1} s for", self.application, self.since.as_secs_f64())?;
        for (place, absence) in self.missing.iter().enumerate() {
            write!(f, "{} {absence}", if place == 0 { "" } else { "," })?;
        }
        Ok(())
    }
}

/// A missing application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Absence {
    /// The name. Of a pattern, or of a count of several names, the requirement and the missing part of it.
    pub name: String,
    /// The last known state of the name.
    pub why: Cow<'static, str>,
    /// How long this node has known that the name is missing. The time is at most as long as a local
    /// application has waited for it, or lacked it.
    pub since: Duration,
}

impl fmt::Display for Absence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}; missing for {:.1} s)", self.name, self.why, self.since.as_secs_f64())
    }
}

/// An application that has a name, on any node.
///
/// # Examples
///
/// ```
/// use sinew::{Payload, events::DirectoryEntry, payload};
///
/// payload!("demo.home" => struct Home;);
///
/// /// Whether this application can be homed now.
/// fn can_be_homed(entry: &DirectoryEntry) -> bool {
///     entry.ready && entry.kinds.contains(&Home::KIND)
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DirectoryEntry {
    /// The application's name.
    pub name: String,
    /// The application's address.
    pub tid: Tid,
    /// Whether the application has started, accepts messages, and is reachable now.
    pub ready: bool,
    /// The payloads that the application handles, at most 64. An application in its own process lists them
    /// when it registers.
    pub kinds: Vec<Kind>,
}

/// A change of the directory of names. A subscribed application receives every entry when it is ready, then
/// each change. An event that its mailbox rejects is sent later, in the state of that time.
///
/// # Examples
///
/// ```
/// use sinew::{events::DirectoryEvent, prelude::*};
///
/// struct Display { drives: usize }
/// # impl Actor for Display { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<DirectoryEvent>> for Display {
///     type Result = ();
///     fn handle(&mut self, event: Delivery<DirectoryEvent>, _: &mut Self::Context) {
///         match &event.payload {
///             DirectoryEvent::Is(entry) => println!("{} has {}, ready: {}", entry.tid, entry.name, entry.ready),
///             DirectoryEvent::Gone { name, .. } => println!("{name} is not there any more"),
///         }
///     }
/// }
///
/// let display = AppSpec::new("display", || Display { drives: 0 }).handles::<DirectoryEvent>();
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum DirectoryEvent {
    /// An application was added, or its entry changed.
    Is(DirectoryEntry),
    /// An application was removed, or its node was lost.
    Gone {
        /// The application's name.
        name: String,
        /// The application's address.
        tid: Tid,
    },
}

impl Payload for DirectoryEvent {
    const NAME: &'static str = "sinew.directory_event";
    const CLASS: Class = Class::Control;
}
