//! The list that a node publishes about itself: payload of `Kind::SYNC_DIRECTORY`, a MessagePack map.
//!
//! The parser here checks all bounds once: `docs/protocol/sync.md` has the fields and the bounds.

use std::{borrow::Borrow, collections::BTreeSet, fmt, ops::Deref, sync::Arc};

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_model::{bounded::at_most, facts::TypeHash, limits::NAME_BYTES_MAX};
use sinew_runtime::{
    app::Requirement,
    name::is_invisible,
    tid::{AppAddress, Incarnation},
    wire::Kind,
};

/// Maximum number of applications in one list.
pub const ENTRIES_MAX: usize = 1_024;
/// Maximum number of groups in one list.
pub const GROUPS_MAX: usize = 1_024;
/// Maximum number of groups with only guests in one list, if the robot's own groups leave room.
pub const GUESTS_GROUPS_MAX: usize = 128;
/// Maximum number of requirements of one application in a list.
pub const REQUIRES_MAX: usize = 64;
/// Maximum number of phases that one application has reached.
pub const PHASES_MAX: usize = 16;
/// Maximum number of payload kinds of one application in a list.
pub const KINDS_MAX: usize = 64;
/// Size of a group in a list, in bytes.
const GROUP_BYTES: usize = 5;

/// The list of a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct List {
    /// The incarnation of the node.
    pub incarnation: Incarnation,
    /// Counter of the changes in that incarnation, from 1.
    pub version: u64,
    /// The node's applications that have a name.
    #[serde(deserialize_with = "at_most::<_, _, ENTRIES_MAX>")]
    pub entries: Vec<Entry>,
    /// The groups that have members on the node. Groups of the robot's own come first, because groups without
    /// room are left out from the end.
    #[serde(default, deserialize_with = "at_most::<_, _, GROUPS_MAX>")]
    pub groups: Vec<AppAddress>,
}

/// One application in a list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// The application's name, unique on its node.
    pub name: Name,
    /// The application's address on its node.
    pub app: AppAddress,
    /// Whether the application has started and accepts messages.
    pub ready: bool,
    /// How the previous life ended, while the application is not ready again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ended: Option<Ended>,
    /// The phases that the application has reached in its current life.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, PHASES_MAX>"
    )]
    pub phases: Vec<Name>,
    /// The requirements, so that every node can detect a cycle.
    #[serde(default, deserialize_with = "at_most::<_, _, REQUIRES_MAX>")]
    pub requires: Vec<Requirement>,
    /// The payloads that the application handles, as far as it reports them.
    #[serde(default, deserialize_with = "at_most::<_, _, KINDS_MAX>")]
    pub kinds: Vec<Kind>,
    /// The structures of the types that the application handles, as far as they are known.
    #[serde(default, skip_serializing_if = "Vec::is_empty", deserialize_with = "at_most::<_, _, KINDS_MAX>")]
    pub handles: Vec<TypeHash>,
    /// The structures of the types that the application sends, as far as they are known.
    #[serde(default, skip_serializing_if = "Vec::is_empty", deserialize_with = "at_most::<_, _, KINDS_MAX>")]
    pub sends: Vec<TypeHash>,
}

/// How a life of an application ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Ended {
    /// The life ended by a fault.
    Failed,
    /// The life was stopped in order.
    Stopped,
}

/// A legal name: 1 to 63 bytes of UTF-8 without control characters, which would forge log lines.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct Name(String);

impl TryFrom<String> for Name {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        if text.is_empty() || text.len() > NAME_BYTES_MAX {
            return Err("a name has 1 to 63 bytes");
        }
        if text.chars().any(is_invisible) {
            return Err("a name has no control characters and no invisible ones");
        }
        Ok(Self(text))
    }
}

impl Deref for Name {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

impl Borrow<str> for Name {
    fn borrow(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The groups that a node publishes, and the number of those without room.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Published {
    /// The published groups: those with a member among the robot's own applications, then those with only
    /// guests. Each part is in the order of addresses.
    pub groups: Vec<AppAddress>,
    /// How many of the published groups have a member among the robot's own.
    pub own: usize,
    /// The number of the robot's own groups without room.
    pub own_left_out: usize,
    /// The number of groups with only guests without room.
    pub guests_left_out: usize,
}

impl Published {
    /// Selects the published groups. Groups with only guests never displace a group of the robot's own.
    pub fn of(groups: Vec<(AppAddress, Arc<[AppAddress]>)>, guests: &BTreeSet<AppAddress>) -> Self {
        let is_own = |members: &[AppAddress]| members.iter().any(|app| !guests.contains(app));
        let (own, foreign): (Vec<_>, Vec<_>) = groups.into_iter().partition(|(_, members)| is_own(members));
        let room = GROUPS_MAX.saturating_sub(own.len()).min(GUESTS_GROUPS_MAX);
        let (own_left_out, guests_left_out) =
            (own.len().saturating_sub(GROUPS_MAX), foreign.len().saturating_sub(room));
        let own_listed = own.len() - own_left_out;
        let listed = own.into_iter().take(own_listed).chain(foreign.into_iter().take(room));
        let groups = listed.map(|(group, _)| group).collect();
        Self { groups, own: own_listed, own_left_out, guests_left_out }
    }

    /// Returns the groups without room, with a remedy. Returns `None` if all groups are published.
    pub fn left_out(&self) -> Option<LeftOut> {
        let Self { own_left_out, guests_left_out, .. } = *self;
        (own_left_out + guests_left_out > 0).then_some(LeftOut { own_left_out, guests_left_out })
    }
}

/// Groups that are not in a node's list. Their `Display` is the message for the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LeftOut {
    own_left_out: usize,
    guests_left_out: usize,
}

impl fmt::Display for LeftOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { own_left_out, guests_left_out } = self;
        if *own_left_out > 0 {
            write!(
                f,
                "{own_left_out} groups of the robot's own are not in this node's directory, which has at most {GROUPS_MAX}: messages of other nodes \
                 to these groups do not arrive here; use fewer groups, or more nodes"
            )?;
        }
        if *own_left_out > 0 && *guests_left_out > 0 {
            f.write_str("; ")?;
        }
        if *guests_left_out > 0 {
            write!(
                f,
                "{guests_left_out} groups that only guests are in are not in this node's directory, which has at most {GUESTS_GROUPS_MAX} of these: \
                 messages of other nodes to these groups do not arrive here; allow fewer `groups` in [[client]] of the access list"
            )?;
        }
        Ok(())
    }
}

/// The error of a malformed list. The peer is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub enum ListError {
    /// The bytes are not the MessagePack map of a list, or exceed its bounds.
    #[error("this is not a directory: {0}")]
    Malformed(#[from] rmp_serde::decode::Error),
    /// The address belongs to no application.
    #[error("{0} is not an application's address")]
    Address(AppAddress),
    /// The address belongs to no group.
    #[error("{0} is not a group's address")]
    Group(AppAddress),
    /// A name, an address or a group occurs twice.
    #[error("{0} occurs twice")]
    Twice(String),
}

/// The parts of a list that did not fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Omitted {
    /// The number of entries and groups.
    pub elements: usize,
    /// The number of entries without the structures of their types.
    pub types_of: usize,
}

impl List {
    /// Parses the list of a peer. Allocates at most the legal bounds, even if the bytes claim larger lengths.
    pub fn parse(bytes: &[u8]) -> Result<Self, ListError> {
        // spec: SYNC-4
        let mut list: Self = sinew_runtime::wire::decode(bytes)?;
        for Entry { handles, sends, .. } in &mut list.entries {
            keep_first_of_each_kind(handles);
            keep_first_of_each_kind(sends);
        }
        let (mut names, mut apps, mut groups) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
        for Entry { name, app, .. } in &list.entries {
            if !(app.is_fixed() || app.is_dynamic()) {
                return Err(ListError::Address(*app));
            }
            if !names.insert(name) || !apps.insert(*app) {
                return Err(ListError::Twice(format!("{name} ({app})")));
            }
        }
        for group in &list.groups {
            if !group.is_group() {
                return Err(ListError::Group(*group));
            }
            if !groups.insert(*group) {
                return Err(ListError::Twice(format!("group {group}")));
            }
        }
        Ok(list)
    }

    /// Returns the encoded list, and the number of elements that were left out. All its groups count as the robot's
    /// own.
    #[cfg(any(test, feature = "fuzzing"))]
    pub fn encode(self, bytes_max: usize) -> (Bytes, usize) {
        let own_groups = self.groups.len();
        let (bytes, omitted) = self.encode_within(bytes_max, own_groups);
        (bytes, omitted.elements)
    }

    /// Returns the encoded list, at most `bytes_max` bytes (64 for an empty list). Elements that do not fit
    /// are left out, the last ones first. The order is: the structures of the types of entries, of which the robot's
    /// own are first, groups behind the first `own_groups`, which have only guests, then entries, then the remaining
    /// groups.
    pub fn encode_within(mut self, bytes_max: usize, own_groups: usize) -> (Bytes, Omitted) {
        let whole = self.entries.len() + self.groups.len();
        let mut omitted = Omitted::default();
        self.groups.truncate(GROUPS_MAX);
        self.entries.truncate(ENTRIES_MAX);
        loop {
            let bytes = encode(&self);
            if bytes.len() <= bytes_max || (self.entries.is_empty() && self.groups.is_empty()) {
                omitted.elements = whole - self.entries.len() - self.groups.len();
                return (bytes.into(), omitted);
            }
            let excess = bytes.len() - bytes_max;
            let without_types = self.drop_structures_worth(excess);
            if without_types > 0 {
                omitted.types_of += without_types;
                continue;
            }
            let has_guests_groups = self.groups.len() > own_groups;
            if has_guests_groups || self.entries.is_empty() {
                let kept = if has_guests_groups { own_groups } else { 0 };
                let fitting = self.groups.len().saturating_sub(excess.div_ceil(GROUP_BYTES));
                self.groups.truncate(fitting.max(kept));
            } else {
                self.drop_entries_worth(excess);
            }
        }
    }

    /// Removes the structures of types from the end until they amount to `bytes`. Returns the number of entries that
    /// had any. Without them the types of an application are not compared.
    fn drop_structures_worth(&mut self, bytes: usize) -> usize {
        let (mut freed, mut count) = (0, 0);
        for entry in self.entries.iter_mut().rev() {
            if freed >= bytes {
                break;
            }
            if entry.handles.is_empty() && entry.sends.is_empty() {
                continue;
            }
            let before = encode(entry).len();
            entry.handles.clear();
            entry.sends.clear();
            freed += before - encode(entry).len();
            count += 1;
        }
        count
    }

    /// Removes entries from the end until they amount to `bytes`.
    fn drop_entries_worth(&mut self, bytes: usize) {
        let mut freed = 0;
        while freed < bytes
            && let Some(entry) = self.entries.pop()
        {
            freed += encode(&entry).len();
        }
    }
}

/// Removes the types of a kind behind the first one. An application has one of each kind.
fn keep_first_of_each_kind(types: &mut Vec<TypeHash>) {
    let mut kinds = BTreeSet::new();
    types.retain(|(kind, _)| kinds.insert(*kind));
}

fn encode<T: Serialize>(value: &T) -> Vec<u8> {
    rmp_serde::to_vec_named(value).expect("maps of numbers, texts and truths into memory cannot fail")
}

#[cfg(test)]
mod tests;
