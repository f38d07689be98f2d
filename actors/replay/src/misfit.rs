//! Inputs that the applications under test cannot decode: they are of another version of the type.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{Arc, Mutex},
};

use sinew_runtime::{
    lock,
    outcome::Rejection,
    tid::Tid,
    time::Time,
    undelivered::RefusalSink,
    wire::{Header, Kind},
};
use sinew_schema::{Schema, compare};

/// Maximum number of misfits with different types or ends; messages of further ones are not counted.
const MISFITS_MAX: usize = 64;
/// Maximum number of differences between two versions of a type that are named.
const DIFFERENCES_SHOWN: usize = 4;

/// Recorded messages that an application under test handles by their type, and that are no values of its version of
/// the type.
///
/// # Examples
///
/// ```
/// use sinew::replay::Misfit;
///
/// fn report(misfit: &Misfit) {
///     eprintln!("{misfit}");
///     misfit.differences.iter().for_each(|words| eprintln!("  {words}"));
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Misfit {
    /// The type of the payload.
    pub kind: Kind,
    /// The sender in the recording.
    pub sender: Tid,
    /// The application under test.
    pub receiver: Tid,
    /// When the first of them was sent.
    pub first: Time,
    /// The number of messages.
    pub count: u64,
    /// The differences between the recorded structure of the type and that of the application, in words. Empty without
    /// a recorded structure: then the log has the reason.
    pub differences: Vec<String>,
}

impl fmt::Display for Misfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, sender, receiver, first, count, differences } = self;
        let (messages, were) = if *count == 1 { ("message", "was") } else { ("messages", "were") };
        match kind.type_name() {
            Some(name) => write!(f, "{count} recorded {messages} of type {name}")?,
            None => write!(f, "{count} recorded {messages} of kind {kind}")?,
        }
        write!(
            f,
            " from {sender}, the first at {first:?}, {were} refused by {receiver}, which has another version of"
        )?;
        if differences.is_empty() {
            return write!(f, " this type; the log names the field");
        }
        write!(f, " this type: {}", differences.join("; "))
    }
}

/// The misfits of one replay.
#[derive(Debug, Default)]
pub(crate) struct Misfits {
    found: Mutex<Vec<Misfit>>,
}

impl Misfits {
    /// Returns the misfits so far, and forgets them. The structures of the recorded types explain them.
    pub(crate) fn take(&self, recorded: &BTreeMap<Kind, Schema>) -> Vec<Misfit> {
        let mut found = std::mem::take(&mut *lock(&self.found));
        for misfit in &mut found {
            misfit.differences = differences(misfit.kind, recorded);
        }
        found
    }
}

/// Returns the differences between a recorded type and that of this process.
fn differences(kind: Kind, recorded: &BTreeMap<Kind, Schema>) -> Vec<String> {
    let (Some(recorded), Some(Ok(own))) = (recorded.get(&kind), kind.schema()) else { return Vec::new() };
    let comparison = compare(recorded, own.schema());
    comparison.differences().iter().take(DIFFERENCES_SHOWN).map(ToString::to_string).collect()
}

impl RefusalSink for Misfits {
    fn refused(&self, receiver: Tid, header: &Header, why: Rejection, count: u64) {
        if why != Rejection::Malformed {
            return;
        }
        let mut found = lock(&self.found);
        let (kind, sender) = (header.kind, header.source);
        let is_it =
            |misfit: &&mut Misfit| (misfit.kind, misfit.sender, misfit.receiver) == (kind, sender, receiver);
        if let Some(misfit) = found.iter_mut().find(is_it) {
            misfit.count += count;
        } else if found.len() < MISFITS_MAX {
            let (first, differences) = (header.sent, Vec::new());
            found.push(Misfit { kind, sender, receiver, first, count, differences });
        }
    }
}

/// Returns the sink for a router.
pub(crate) fn sink(misfits: &Arc<Misfits>) -> Arc<dyn RefusalSink> {
    misfits.clone()
}
