//! The list that a node publishes about itself: payload of `Kind::SYNC_DIRECTORY`, a MessagePack map.
//!
//! A list is parsed once, here, and is legal afterwards: `docs/protocol/sync.md` has the fields and the bounds.

use std::{borrow::Borrow, collections::BTreeSet, fmt, marker::PhantomData, ops::Deref, sync::Arc};

use bytes::Bytes;
use serde::{
    Deserialize, Deserializer, Serialize,
    de::{Error as _, SeqAccess, Visitor},
};
use sinew_runtime::{
    app::Requirement,
    name::is_invisible,
    tid::{AppAddress, Incarnation},
    wire::Kind,
};

/// Applications in one list at most.
pub(crate) const ENTRIES_MAX: usize = 1_024;
/// Groups in one list at most.
pub(crate) const GROUPS_MAX: usize = 1_024;
/// Of these at most so many that only guests are in, where the robot's own leave room.
pub(crate) const GUESTS_GROUPS_MAX: usize = 128;
/// Requirements of one application at most, as far as a list says.
pub(crate) const REQUIRES_MAX: usize = 64;
/// Phases that one application has reached at most.
pub(crate) const PHASES_MAX: usize = 16;
/// Kinds of payloads that one application handles at most, as far as a list says.
pub(crate) const KINDS_MAX: usize = 64;
/// Bytes of a group in a list.
const GROUP_BYTES: usize = 5;
/// Longest name in bytes.
pub(crate) const NAME_BYTES_MAX: usize = 63;

/// What a node says about itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct List {
    /// Which life of the node this is about.
    pub(crate) incarnation: Incarnation,
    /// Counts the changes in that life, from 1.
    pub(crate) version: u64,
    /// The node's applications that have a name.
    #[serde(deserialize_with = "at_most::<_, _, ENTRIES_MAX>")]
    pub(crate) entries: Vec<Entry>,
    /// The groups that have members on the node: those of the robot's own first, as what has no room is left out from the end.
    #[serde(default, deserialize_with = "at_most::<_, _, GROUPS_MAX>")]
    pub(crate) groups: Vec<AppAddress>,
}

/// One application in a list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Entry {
    /// Its name, unique on its node.
    pub(crate) name: Name,
    /// Its address on its node.
    pub(crate) app: AppAddress,
    /// Whether it has started and takes messages.
    pub(crate) ready: bool,
    /// How its former life ended, while it is not ready again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) ended: Option<Ended>,
    /// The phases that it has reached in its present life.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, PHASES_MAX>"
    )]
    pub(crate) phases: Vec<Name>,
    /// What it requires, so that every node can see a cycle.
    #[serde(default, deserialize_with = "at_most::<_, _, REQUIRES_MAX>")]
    pub(crate) requires: Vec<Requirement>,
    /// The payloads that it handles, as far as it tells.
    #[serde(default, deserialize_with = "at_most::<_, _, KINDS_MAX>")]
    pub(crate) kinds: Vec<Kind>,
}

/// How a life of an application ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Ended {
    /// By a fault.
    Failed,
    /// In order.
    Stopped,
}

/// A legal name: 1 to 63 bytes of UTF-8, no control characters (they would forge log lines).
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub(crate) struct Name(String);

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

/// The groups that a node says it has members of, and how many it does not.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Published {
    /// Those with a member among the robot's own, then those that only guests are in; each in the order of their addresses.
    pub(crate) groups: Vec<AppAddress>,
    /// How many of these are the former.
    pub(crate) own: usize,
    /// Of the former, those for which there is no room.
    pub(crate) own_left_out: usize,
    /// The same of the latter.
    pub(crate) guests_left_out: usize,
}

impl Published {
    /// Of these groups with their members, of whom these are `guests`: who joins without end displaces no group of the robot's own.
    pub(crate) fn of(groups: Vec<(AppAddress, Arc<[AppAddress]>)>, guests: &BTreeSet<AppAddress>) -> Self {
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

    /// What has no room, and what to do; `None` where all has.
    pub(crate) fn left_out(&self) -> Option<LeftOut> {
        let Self { own_left_out, guests_left_out, .. } = *self;
        (own_left_out + guests_left_out > 0).then_some(LeftOut { own_left_out, guests_left_out })
    }
}

/// Groups that are not in a node's list, in words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LeftOut {
    own_left_out: usize,
    guests_left_out: usize,
}

impl fmt::Display for LeftOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { own_left_out, guests_left_out } = self;
        if *own_left_out > 0 {
            write!(
                f,
                "{own_left_out} groups of the robot's own are not in this node's directory, which has at most {GROUPS_MAX}: what other nodes send \
                 to these does not come here; use fewer groups, or more nodes"
            )?;
        }
        if *own_left_out > 0 && *guests_left_out > 0 {
            f.write_str("; ")?;
        }
        if *guests_left_out > 0 {
            write!(
                f,
                "{guests_left_out} groups that only guests are in are not in this node's directory, which has at most {GUESTS_GROUPS_MAX} of these: \
                 what other nodes send to these does not come here; have `groups` in [[client]] of the access list allow fewer"
            )?;
        }
        Ok(())
    }
}

/// Why bytes are not a list that this node uses. The peer is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ListError {
    /// Not the MessagePack map of a list, or outside of its bounds.
    #[error("this is not a directory: {0}")]
    Malformed(#[from] rmp_serde::decode::Error),
    /// The address belongs to no application.
    #[error("{0} is not an application's address")]
    Address(AppAddress),
    /// The address belongs to no group.
    #[error("{0} is not a group's address")]
    Group(AppAddress),
    /// The same name, address or group twice.
    #[error("{0} stands in it twice")]
    Twice(String),
}

impl List {
    /// Reads a list from a peer's bytes. Allocates no more than the legal bounds, whatever lengths the bytes claim.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, ListError> {
        // spec: SYNC-4
        let list: Self = sinew_runtime::wire::decode(bytes)?;
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

    /// The bytes of this list, of which all groups are the robot's own.
    #[cfg(any(test, feature = "fuzzing"))]
    pub(crate) fn encode(self, bytes_max: usize) -> (Bytes, usize) {
        let own_groups = self.groups.len();
        self.encode_within(bytes_max, own_groups)
    }

    /// The bytes of this list, at most `bytes_max` (of an empty one 64). What does not fit is left out, last ones first: groups behind the
    /// first `own_groups`, which only guests are in, then entries, of which the robot's own are the first, then its groups. Returns how many
    /// were.
    pub(crate) fn encode_within(mut self, bytes_max: usize, own_groups: usize) -> (Bytes, usize) {
        let whole = self.entries.len() + self.groups.len();
        self.groups.truncate(GROUPS_MAX);
        self.entries.truncate(ENTRIES_MAX);
        loop {
            let bytes = encode(&self);
            if bytes.len() <= bytes_max || (self.entries.is_empty() && self.groups.is_empty()) {
                return (bytes.into(), whole - self.entries.len() - self.groups.len());
            }
            let excess = bytes.len() - bytes_max;
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

    /// Removes entries from the end until they make up `bytes`.
    fn drop_entries_worth(&mut self, bytes: usize) {
        let mut freed = 0;
        while freed < bytes
            && let Some(entry) = self.entries.pop()
        {
            freed += encode(&entry).len();
        }
    }
}

fn encode<T: Serialize>(value: &T) -> Vec<u8> {
    rmp_serde::to_vec_named(value).expect("maps of numbers, texts and truths into memory cannot fail")
}

/// Reads a sequence of at most `N` elements and reserves nothing on the word of the sender.
pub(crate) fn at_most<'de, D, T, const N: usize>(deserializer: D) -> Result<Vec<T>, D::Error>
where
    D: Deserializer<'de>,
    T: Deserialize<'de>,
{
    deserializer.deserialize_seq(AtMost::<T, N>(PhantomData))
}

struct AtMost<T, const N: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const N: usize> Visitor<'de> for AtMost<T, N> {
    type Value = Vec<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a list of at most {N} elements")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut elements: A) -> Result<Vec<T>, A::Error> {
        let mut taken = Vec::new();
        while let Some(element) = elements.next_element()? {
            if taken.len() == N {
                return Err(A::Error::custom(format_args!("more than {N} elements")));
            }
            taken.push(element);
        }
        Ok(taken)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn name(text: &str) -> Name {
        Name::try_from(text.to_owned()).unwrap()
    }

    fn entry(index: u32, text: &str) -> Entry {
        Entry {
            name: name(text),
            app: AppAddress::fixed(index).unwrap(),
            ready: true,
            ended: None,
            phases: Vec::new(),
            requires: Vec::new(),
            kinds: Vec::new(),
        }
    }

    fn list(entries: Vec<Entry>) -> List {
        List { incarnation: Incarnation(7), version: 1, entries, groups: vec![AppAddress::group("drives")] }
    }

    fn many(count: u32) -> Vec<Entry> {
        (0..count).map(|n| entry(n, &format!("app{n}"))).collect()
    }

    fn any_list() -> impl Strategy<Value = List> {
        let entry = ("[a-z.]{1,63}", any::<bool>(), proptest::collection::vec("[a-z]{1,8}", 0..4));
        let entries = proptest::collection::vec(entry, 0..8);
        (any::<u64>(), any::<u64>(), entries).prop_map(|(incarnation, version, entries)| List {
            incarnation: Incarnation(incarnation),
            version,
            entries: (0u32..)
                .zip(entries)
                .map(|(n, (text, ready, requires))| Entry {
                    name: name(&format!("{n}{}", &text[..text.len().min(60)])),
                    app: AppAddress::fixed(n).unwrap(),
                    ready,
                    ended: (!ready).then_some(Ended::Failed),
                    phases: if ready { vec![name("homed")] } else { Vec::new() },
                    requires: requires.iter().map(|text| text.parse().unwrap()).collect(),
                    kinds: vec![Kind::named("demo.angle")],
                })
                .collect(),
            groups: Vec::new(),
        })
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(list in any_list()) {
            let (bytes, left_out) = list.clone().encode(usize::MAX);
            prop_assert_eq!(left_out, 0);
            prop_assert_eq!(List::parse(&bytes).unwrap(), list);
        }

        #[test]
        fn any_bytes_are_a_list_or_an_error(bytes: Vec<u8>) {
            let _ = List::parse(&bytes);
        }

        #[test]
        fn a_damaged_list_is_a_list_or_an_error(list in any_list(), at: prop::sample::Index, byte: u8, cut: prop::sample::Index) {
            let mut bytes = list.encode(usize::MAX).0.to_vec();
            let at = at.index(bytes.len());
            bytes[at] = byte;
            let _ = List::parse(&bytes);
            bytes.truncate(cut.index(bytes.len()));
            let _ = List::parse(&bytes);
        }
    }

    #[test]
    fn the_documented_bytes_are_a_list() {
        let text = include_str!("../../../docs/protocol/sync.md");
        let block = text.split("```").find(|block| block.starts_with("text\n84")).unwrap();
        let is_byte = |token: &&str| token.len() == 2 && u8::from_str_radix(token, 16).is_ok();
        let tokens = block.lines().flat_map(|line| line.split_whitespace().take_while(is_byte));
        let bytes: Vec<u8> = tokens.map(|token| u8::from_str_radix(token, 16).unwrap()).collect();
        let documented = List { version: 3, groups: Vec::new(), ..list(vec![entry(0, "knee.drive")]) };
        assert_eq!(encode(&documented), bytes);
        assert_eq!(List::parse(&bytes).unwrap(), documented);
    }

    #[test]
    fn lengths_that_are_not_there_reserve_nothing() {
        // A map with "entries": an array that claims 2^32 - 1 elements.
        let mut bytes = vec![0x81, 0xa7];
        bytes.extend_from_slice(b"entries");
        bytes.extend_from_slice(&[0xdd, 0xff, 0xff, 0xff, 0xff]);
        assert!(List::parse(&bytes).is_err());
        assert!(List::parse(&[0x91; 100_000]).is_err(), "depth without end is refused");
    }

    #[test]
    fn a_list_holds_its_maximum_of_entries_and_not_one_more() {
        assert!(List::parse(&encode(&list(many(ENTRIES_MAX as u32)))).is_ok());
        assert!(List::parse(&encode(&list(many(ENTRIES_MAX as u32 + 1)))).is_err());
    }

    #[test]
    fn names_of_1_to_63_bytes_are_legal() {
        for (text, legal) in
            [("", false), ("a", true), (&"x".repeat(63), true), (&"x".repeat(64), false), ("a\nb", false)]
        {
            assert_eq!(Name::try_from(text.to_owned()).is_ok(), legal, "{text:?}");
        }
    }

    #[test]
    fn doubles_and_foreign_addresses_are_refused() {
        let mut layer = entry(0, "a");
        layer.app = AppAddress::SYNC;
        let mut groups = list(Vec::new());
        groups.groups.push(groups.groups[0]);
        let mut no_group = list(Vec::new());
        no_group.groups.push(AppAddress::fixed(0).unwrap());
        let same_name = list(vec![entry(0, "a"), entry(1, "a")]);
        let same_app = list(vec![entry(0, "a"), entry(0, "b")]);
        for bad in [list(vec![layer]), groups, no_group, same_name, same_app] {
            assert!(List::parse(&encode(&bad)).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn a_list_above_the_payload_limit_leaves_out_what_does_not_fit() {
        let (bytes, left_out) = list(many(100)).encode(1_000);
        let read = List::parse(&bytes).unwrap();
        assert!(bytes.len() <= 1_000 && bytes.len() > 900, "{}", bytes.len());
        assert_eq!(read.entries.len() + left_out, 100);
        assert_eq!(list(many(2_000)).encode(usize::MAX).1, 2_000 - ENTRIES_MAX);
    }

    /// So many groups from this one on, each with these members.
    fn joined(first: u32, count: usize, members: &[AppAddress]) -> Vec<(AppAddress, Arc<[AppAddress]>)> {
        (first..)
            .take(count)
            .map(|number| (AppAddress::new(0xf000_0000 + number), Arc::from(members)))
            .collect()
    }

    #[test]
    fn groups_of_the_robots_own_come_first_and_guests_displace_none_of_them() {
        let [own, guest] = [0x1000, 0x8000_0000].map(AppAddress::new);
        let guests = BTreeSet::from([guest]);
        // Given: guests in more groups than a list has, all of lower addresses than those of the robot's own
        let low = joined(0, 1_280, &[guest]);
        for (count, room) in [(1, 128), (900, 124), (GROUPS_MAX, 0), (GROUPS_MAX + 3, 0)] {
            let its = joined(10_000, count, &[own]);
            // When
            let published = Published::of([low.clone(), its.clone()].concat(), &guests);
            // Then
            let listed = count.min(GROUPS_MAX);
            assert_eq!((published.groups.len(), published.own), (listed + room, listed));
            assert!(
                its.iter()
                    .take(listed)
                    .map(|(group, _)| *group)
                    .eq(published.groups[..listed].iter().copied())
            );
            assert_eq!((published.own_left_out, published.guests_left_out), (count - listed, 1_280 - room));
            let words = published.left_out().expect("guests have no room").to_string();
            assert!(words.contains("[[client]]") && !words.contains("payload_max"), "{words}");
            assert_eq!(words.contains("more nodes"), count > GROUPS_MAX, "{words}");
        }
    }

    #[test]
    fn a_group_that_a_guest_joins_stays_one_of_the_robots_own() {
        let [own, guest] = [0x1000, 0x8000_0000].map(AppAddress::new);
        let both = [joined(5, 1, &[own, guest]), joined(9, 1, &[guest])].concat();
        let published = Published::of([joined(1, 1, &[guest]), both].concat(), &BTreeSet::from([guest]));
        assert_eq!(published.groups, [5, 1, 9].map(|number| AppAddress::new(0xf000_0000 + number)));
        assert_eq!(published.left_out(), None);
        assert_eq!(Published::of(Vec::new(), &BTreeSet::new()), Published::default());
    }

    #[test]
    fn groups_that_do_not_fit_are_left_out_too() {
        let groups: Vec<_> = (0..100).map(|n| AppAddress::group(&n.to_string())).collect();
        let (bytes, left_out) = List { groups: groups.clone(), ..list(many(10)) }.encode(200);
        let read = List::parse(&bytes).unwrap();
        assert_eq!(read.groups, groups[..read.groups.len()], "the last ones go");
        assert!(bytes.len() <= 200 && bytes.len() > 190, "{}", bytes.len());
        assert_eq!((read.entries.len(), read.groups.len() + left_out), (0, 110));
        assert!(list(Vec::new()).encode(64).0.len() <= 64);
    }
}
