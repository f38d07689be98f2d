//! What the sync manager says to applications and to the node's root.

use std::{borrow::Cow, fmt, time::Duration};

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::{AppAddress, Tid},
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
    /// The application's name, or its address where it has none.
    pub application: String,
    /// The names that are not ready, since when, and the last that is known of each: `registered, not ready`, `failed, not ready
    /// again`, `stopped in order, not ready again`, `its node has restarted, its directory has not come yet`, `its node is linked again, its directory has not come yet`, `its link is down`, `its node left`, `its
    /// node was lost`, `unregistered`, `not there`, `part of a cycle of requirements`.
    pub missing: Vec<Absence>,
    /// How long it has waited.
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

/// Who is waited for and not there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Absence {
    /// The name; of a pattern, or so many of several, what was asked for, and who of it.
    pub name: String,
    /// The last that is known of it.
    pub why: Cow<'static, str>,
    /// For how long this node has known that it is missing; not longer than somebody here has waited for it, or lacks it.
    pub since: Duration,
}

impl fmt::Display for Absence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}; missing for {:.1} s)", self.name, self.why, self.since.as_secs_f64())
    }
}

/// An application that has a name, on this node or on another.
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
    /// Its name.
    pub name: String,
    /// Its address.
    pub tid: Tid,
    /// Whether it has started, takes messages, and can be reached now.
    pub ready: bool,
    /// The payloads that it handles, 64 at most; of an application in a process of its own, those that it named when it
    /// registered.
    pub kinds: Vec<Kind>,
}

/// The directory of names changed. An application that handles this payload hears, when it is ready, of every entry, then of each
/// change; what its mailbox does not take comes later, in the form that is true then.
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
    /// An application is there, or something of what is said of it is new.
    Is(DirectoryEntry),
    /// It is not there any more: it has gone, or its node was lost.
    Gone {
        /// Its name.
        name: String,
        /// Its address.
        tid: Tid,
    },
}

impl Payload for DirectoryEvent {
    const NAME: &'static str = "sinew.directory_event";
    const CLASS: Class = Class::Control;
}

/// An application of this node, as a tool sees it.
pub(crate) struct OwnApp {
    /// Its address.
    pub(crate) app: AppAddress,
    /// Its name, if it has one.
    pub(crate) name: Option<String>,
    /// Whether it has started and takes messages.
    pub(crate) ready: bool,
    /// What it lacks of what it requires, since when and why.
    pub(crate) missing: Vec<Absence>,
    /// How long it has waited at the start-up barrier or at a phase, if it waits there.
    pub(crate) waits: Option<Duration>,
    /// How its former life ended, while this one is not ready.
    pub(crate) ended: Option<&'static str>,
    /// The payloads that it handles, as far as it tells.
    pub(crate) kinds: Vec<Kind>,
}
