//! The retained values of a node, with their bounds. Pure.

use std::collections::BTreeMap;

use bytes::Bytes;

use crate::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message},
};

/// Maximum number of retained values of the applications of one node.
pub(super) const VALUES_MAX: usize = 256;
/// Maximum size of the retained values of the applications of one node, in bytes.
pub(super) const BYTES_MAX: usize = 1024 * 1024;
/// How many full nodes the retained values of all other nodes may be as large as.
pub(super) const OTHERS_MAX: usize = 8;
/// Maximum size of one retained value, in bytes.
pub(super) const VALUE_BYTES_MAX: usize = 64 * 1024;

/// The values of one sender and type in one group, of which the latest is retained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Key {
    pub(super) group: AppAddress,
    pub(super) source: Tid,
    pub(super) kind: Kind,
}

impl Key {
    /// The smallest key.
    pub(super) const MIN: Self = Self::first(AppAddress::new(0));
    /// The greatest key.
    pub(super) const MAX: Self = Self::last(AppAddress::new(u32::MAX));

    pub(super) const fn of(header: &Header) -> Self {
        Self { group: header.destination.app, source: header.source, kind: header.kind }
    }

    /// The smallest key of a group.
    const fn first(group: AppAddress) -> Self {
        Self { group, source: Tid::from_bits(0), kind: Kind::from_bits(0) }
    }

    /// The greatest key of a group.
    const fn last(group: AppAddress) -> Self {
        Self { group, source: Tid::from_bits(u64::MAX), kind: Kind::from_bits(u32::MAX) }
    }
}

/// The reason why a value is not retained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum KeepError {
    #[error("it has {0} bytes, and a retained value at most {VALUE_BYTES_MAX}; send a shorter value")]
    TooLong(usize),
    #[error(
        "{VALUES_MAX} values or {BYTES_MAX} bytes of the applications of its node are retained already, \
         or {OTHERS_MAX} times as much of all other nodes; \
         retain fewer types, set a time to live for them, or use more nodes"
    )]
    Full,
}

/// A retained value.
#[derive(Debug)]
struct Value {
    header: Header,
    /// A copy: the payload of a message may hold the much longer buffer that it was received in.
    payload: Bytes,
}

/// The room that values take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Share {
    values: usize,
    bytes: usize,
}

impl Share {
    const fn of(value: &Value) -> Self {
        Self { values: 1, bytes: value.payload.len() }
    }

    const fn plus(self, other: Self) -> Self {
        Self { values: self.values + other.values, bytes: self.bytes + other.bytes }
    }

    const fn minus(self, other: Self) -> Self {
        Self { values: self.values - other.values, bytes: self.bytes - other.bytes }
    }

    /// Returns whether it is at most that of so many full nodes.
    const fn is_within(self, nodes: usize) -> bool {
        self.values <= nodes * VALUES_MAX && self.bytes <= nodes * BYTES_MAX
    }
}

/// The latest value of each key. Each node has a share of its own, so that it takes no room from another one.
#[derive(Debug, Default)]
pub(super) struct Store {
    values: BTreeMap<Key, Value>,
    /// The shares of the senders' nodes, of which none is empty.
    shares: BTreeMap<NodeAddress, Share>,
    all: Share,
}

impl Store {
    /// Retains the value in place of the former one of its key. `own` is this node.
    ///
    /// # Errors
    /// The reason why it is not retained. The former value stays.
    pub(super) fn keep(&mut self, own: NodeAddress, now: Time, message: &Message) -> Result<(), KeepError> {
        let (key, length) = (Key::of(&message.header), message.payload.len());
        if length > VALUE_BYTES_MAX {
            return Err(KeepError::TooLong(length));
        }
        if !self.has_room(own, key, length) {
            self.forget(|header| header.is_expired(now));
        }
        if !self.has_room(own, key, length) {
            return Err(KeepError::Full);
        }
        self.remove(key);
        let value = Value { header: message.header, payload: Bytes::copy_from_slice(&message.payload) };
        let share = Share::of(&value);
        self.all = self.all.plus(share);
        self.shares.insert(key.source.node, self.share_of(key.source.node).plus(share));
        self.values.insert(key, value);
        Ok(())
    }

    fn share_of(&self, node: NodeAddress) -> Share {
        self.shares.get(&node).copied().unwrap_or_default()
    }

    fn has_room(&self, own: NodeAddress, key: Key, length: usize) -> bool {
        let former = self.values.get(&key).map(Share::of).unwrap_or_default();
        let fits = |share: Share, nodes: usize| {
            share.minus(former).plus(Share { values: 1, bytes: length }).is_within(nodes)
        };
        let node = key.source.node;
        fits(self.share_of(node), 1) && (node == own || fits(self.all.minus(self.share_of(own)), OTHERS_MAX))
    }

    /// Removes the value of a key. Returns its header.
    pub(super) fn remove(&mut self, key: Key) -> Option<Header> {
        let value = self.values.remove(&key)?;
        let node = key.source.node;
        let share = self.share_of(node).minus(Share::of(&value));
        self.all = self.all.minus(Share::of(&value));
        if share == Share::default() {
            self.shares.remove(&node);
        } else {
            self.shares.insert(node, share);
        }
        Some(value.header)
    }

    /// Removes the values with such headers. Returns the headers.
    pub(super) fn forget(&mut self, mut is_over: impl FnMut(&Header) -> bool) -> Vec<Header> {
        let over: Vec<Key> =
            self.values.iter().filter(|(_, value)| is_over(&value.header)).map(|(key, _)| *key).collect();
        over.into_iter().filter_map(|key| self.remove(key)).collect()
    }

    pub(super) fn contains(&self, key: Key) -> bool {
        self.values.contains_key(&key)
    }

    /// Returns whether the message is the retained value itself.
    pub(super) fn is_known(&self, message: &Message) -> bool {
        self.values.get(&Key::of(&message.header)).is_some_and(|value| {
            value.header.sequence == message.header.sequence && value.payload == message.payload
        })
    }

    /// Returns the values of a group that have not expired, as messages that are marked as retained.
    pub(super) fn of_group(&self, group: AppAddress, now: Time) -> impl Iterator<Item = Message> {
        let values = self.values.range(Key::first(group)..=Key::last(group));
        values.filter(move |(_, value)| !value.header.is_expired(now)).map(|(_, value)| handed_over(value))
    }

    /// Returns the value of a key, as [`of_group`](Self::of_group) does.
    pub(super) fn of_key(&self, key: Key, now: Time) -> Option<Message> {
        self.values.get(&key).filter(|value| !value.header.is_expired(now)).map(handed_over)
    }

    /// Returns the groups in which an application of this node has a retained value, each once.
    pub(super) fn groups_from(&self, node: NodeAddress) -> Vec<AppAddress> {
        let own = self.values.keys().filter(|key| key.source.node == node);
        let mut groups: Vec<AppAddress> = own.map(|key| key.group).collect();
        groups.dedup();
        groups
    }

    pub(super) fn len(&self) -> usize {
        self.values.len()
    }

    pub(super) const fn bytes(&self) -> usize {
        self.all.bytes
    }
}

/// Returns the retained value as a message to a later member. It has the send time of the value and no receipt.
fn handed_over(value: &Value) -> Message {
    let flags = Flags::KEEP.with(Flags::RETAINED);
    Message::new(Header { flags, correlation: 0, ..value.header }, value.payload.clone())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use proptest::prelude::*;

    use super::*;

    const OWN: NodeAddress = NodeAddress::new(1);
    const GROUP: AppAddress = AppAddress::group("legs");

    fn value(app: u32, length: usize, sequence: u64) -> Message {
        value_of(OWN, app, length, sequence)
    }

    fn value_of(node: NodeAddress, app: u32, length: usize, sequence: u64) -> Message {
        let source = Tid::new(node, AppAddress::new(0x1000 + app));
        let mut header = Header::new(Kind::named("test.mode"), source, Tid::new(NodeAddress::ALL, GROUP));
        (header.flags, header.sequence) = (Flags::KEEP, sequence);
        Message::new(header, Bytes::from(vec![7; length]))
    }

    fn sequences(store: &Store, now: Time) -> Vec<u64> {
        store.of_group(GROUP, now).map(|message| message.header.sequence).collect()
    }

    proptest! {
        #[test]
        fn bounds_hold_for_any_values(
            values in prop::collection::vec((0..300u32, 1..2 * VALUE_BYTES_MAX, any::<bool>()), 0..400)
        ) {
            let mut store = Store::default();
            let mut expected = BTreeMap::new();
            for (sequence, (app, length, removes)) in (1..).zip(values) {
                let message = value(app, length, sequence);
                if removes {
                    store.remove(Key::of(&message.header));
                    expected.remove(&app);
                } else if store.keep(OWN, Time::ZERO, &message).is_ok() {
                    expected.insert(app, (sequence, length));
                }
                prop_assert!(store.len() <= VALUES_MAX && store.bytes() <= BYTES_MAX);
                prop_assert_eq!(store.len(), expected.len());
                prop_assert_eq!(store.bytes(), expected.values().map(|(_, length)| length).sum::<usize>());
            }
            let newest: Vec<u64> = expected.values().map(|(sequence, _)| *sequence).collect();
            prop_assert_eq!(sequences(&store, Time::ZERO), newest);
        }
    }

    #[test]
    fn value_beyond_bound_is_refused_and_former_stays() {
        let mut store = Store::default();
        for app in 0..256 {
            assert_eq!(store.keep(OWN, Time::ZERO, &value(app, 10, 1)), Ok(()));
        }
        assert_eq!(store.keep(OWN, Time::ZERO, &value(256, 10, 1)), Err(KeepError::Full));
        assert_eq!(store.keep(OWN, Time::ZERO, &value(0, VALUE_BYTES_MAX, 2)), Ok(()), "it replaces one");
        let long = VALUE_BYTES_MAX + 1;
        assert_eq!(store.keep(OWN, Time::ZERO, &value(0, long, 3)), Err(KeepError::TooLong(long)));
        assert_eq!(sequences(&store, Time::ZERO)[0], 2);
    }

    #[test]
    fn bytes_of_all_values_are_bounded() {
        let mut store = Store::default();
        for app in 0..16 {
            assert_eq!(store.keep(OWN, Time::ZERO, &value(app, VALUE_BYTES_MAX, 1)), Ok(()));
        }
        assert_eq!(store.keep(OWN, Time::ZERO, &value(16, 1, 1)), Err(KeepError::Full));
        store.remove(Key::of(&value(3, 0, 0).header));
        assert_eq!(store.keep(OWN, Time::ZERO, &value(16, VALUE_BYTES_MAX, 1)), Ok(()));
    }

    #[test]
    fn full_node_takes_no_room_from_another_one() {
        let mut store = Store::default();
        let mut fill = |node: u32| {
            let node = NodeAddress::new(node);
            let fitting =
                (0..256).filter(|app| store.keep(OWN, Time::ZERO, &value_of(node, *app, 10, 1)).is_ok());
            let count = fitting.count();
            let further = store.keep(OWN, Time::ZERO, &value_of(node, 256, 10, 1));
            assert_eq!(further, Err(KeepError::Full));
            count
        };
        // Given: as many other nodes as there is room for, each with as many values as it may have
        for node in 2..10 {
            assert_eq!(fill(node), 256);
        }
        // Then: one more has no room, and this node has all of its own
        assert_eq!((fill(10), fill(1)), (0, 256));
        // And: a value of a full node is replaced
        assert_eq!(store.keep(OWN, Time::ZERO, &value_of(NodeAddress::new(2), 0, 10, 2)), Ok(()));
        store.forget(|header| header.source.node == NodeAddress::new(2));
        assert_eq!(store.keep(OWN, Time::ZERO, &value_of(NodeAddress::new(10), 0, 10, 1)), Ok(()));
        assert_eq!((store.len(), store.bytes()), (8 * 256 + 1, (8 * 256 + 1) * 10));
    }

    #[test]
    fn expired_value_is_not_handed_over_and_makes_room() {
        let mut store = Store::default();
        for app in 0..256 {
            let mut message = value(app, 10, 1);
            let _ = message.header.set_time_to_live(Duration::from_secs(1));
            assert_eq!(store.keep(OWN, Time::ZERO, &message), Ok(()));
        }
        let (young, old) = (Time::from_nanos(1_000_000_000), Time::from_nanos(1_000_000_001));
        assert_eq!((sequences(&store, young).len(), sequences(&store, old).len()), (256, 0));
        assert_eq!(store.keep(OWN, young, &value(256, 10, 1)), Err(KeepError::Full));
        assert_eq!(store.keep(OWN, old, &value(256, 10, 9)), Ok(()));
        assert_eq!((store.len(), sequences(&store, old)), (1, vec![9]));
    }

    #[test]
    fn value_has_no_receipt_and_keeps_its_time() {
        let mut store = Store::default();
        let mut message = value(1, 10, 5);
        message.header.flags = Flags::KEEP.with(Flags::CONFIRM);
        (message.header.sent, message.header.correlation) = (Time::from_nanos(77), 3);
        assert_eq!(store.keep(OWN, Time::from_nanos(99), &message), Ok(()));
        let handed_over =
            store.of_key(Key::of(&message.header), Time::from_nanos(99)).expect("it is retained");
        let Header { flags, sent, correlation, .. } = handed_over.header;
        assert_eq!(flags, Flags::KEEP.with(Flags::RETAINED));
        assert_eq!((sent, correlation, handed_over.payload), (Time::from_nanos(77), 0, message.payload));
    }
}
