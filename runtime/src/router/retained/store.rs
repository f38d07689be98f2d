//! The retained values of a node, with their bounds. Pure.

use std::collections::BTreeMap;

use crate::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message},
};

/// Maximum number of retained values of a node.
pub(super) const VALUES_MAX: usize = 256;
/// Maximum size of all retained values of a node, in bytes.
pub(super) const BYTES_MAX: usize = 1024 * 1024;
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
        "the node retains {VALUES_MAX} values or {BYTES_MAX} bytes already; \
         retain fewer types, set a time to live for them, or use more nodes"
    )]
    Full,
}

/// A retained value.
#[derive(Debug)]
struct Value {
    header: Header,
    /// A copy: the payload of a message may hold the much longer buffer that it was received in.
    payload: Vec<u8>,
}

/// The latest value of each key.
#[derive(Debug, Default)]
pub(super) struct Store {
    values: BTreeMap<Key, Value>,
    bytes: usize,
}

impl Store {
    /// Retains the value in place of the former one of its key.
    ///
    /// # Errors
    /// The reason why it is not retained. The former value stays.
    pub(super) fn keep(&mut self, now: Time, message: &Message) -> Result<(), KeepError> {
        let (key, length) = (Key::of(&message.header), message.payload.len());
        if length > VALUE_BYTES_MAX {
            return Err(KeepError::TooLong(length));
        }
        if !self.has_room(key, length) {
            self.forget(|header| header.is_expired(now));
        }
        if !self.has_room(key, length) {
            return Err(KeepError::Full);
        }
        let mut payload = self.take(key).map_or_else(Vec::new, |former| former.payload);
        if payload.capacity() > 2 * length {
            payload = Vec::new();
        }
        payload.clear();
        payload.extend_from_slice(&message.payload);
        self.bytes += length;
        self.values.insert(key, Value { header: message.header, payload });
        Ok(())
    }

    fn has_room(&self, key: Key, length: usize) -> bool {
        let former = self.values.get(&key);
        let values = self.values.len() - usize::from(former.is_some());
        let bytes = self.bytes - former.map_or(0, |former| former.payload.len());
        values < VALUES_MAX && bytes + length <= BYTES_MAX
    }

    fn take(&mut self, key: Key) -> Option<Value> {
        let value = self.values.remove(&key)?;
        self.bytes -= value.payload.len();
        Some(value)
    }

    /// Removes the value of a key. Returns its header.
    pub(super) fn remove(&mut self, key: Key) -> Option<Header> {
        self.take(key).map(|value| value.header)
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
            value.header.sequence == message.header.sequence && *value.payload == *message.payload
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
        self.bytes
    }
}

/// Returns the retained value as a message to a later member. It has the send time of the value and no receipt.
fn handed_over(value: &Value) -> Message {
    let flags = Flags::KEEP.with(Flags::RETAINED);
    Message::new(Header { flags, correlation: 0, ..value.header }, value.payload.clone().into())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bytes::Bytes;
    use proptest::prelude::*;

    use super::*;

    const GROUP: AppAddress = AppAddress::group("legs");

    fn value(app: u32, length: usize, sequence: u64) -> Message {
        let source = Tid::new(NodeAddress::new(1), AppAddress::new(0x1000 + app));
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
                } else if store.keep(Time::ZERO, &message).is_ok() {
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
    fn value_beyond_each_bound_is_refused_and_the_former_stays() {
        let mut store = Store::default();
        for app in 0..256 {
            assert_eq!(store.keep(Time::ZERO, &value(app, 10, 1)), Ok(()));
        }
        assert_eq!(store.keep(Time::ZERO, &value(256, 10, 1)), Err(KeepError::Full));
        assert_eq!(store.keep(Time::ZERO, &value(0, VALUE_BYTES_MAX, 2)), Ok(()), "it replaces one");
        let long = VALUE_BYTES_MAX + 1;
        assert_eq!(store.keep(Time::ZERO, &value(0, long, 3)), Err(KeepError::TooLong(long)));
        assert_eq!(sequences(&store, Time::ZERO)[0], 2);
    }

    #[test]
    fn bytes_of_all_values_are_bounded() {
        let mut store = Store::default();
        for app in 0..16 {
            assert_eq!(store.keep(Time::ZERO, &value(app, VALUE_BYTES_MAX, 1)), Ok(()));
        }
        assert_eq!(store.keep(Time::ZERO, &value(16, 1, 1)), Err(KeepError::Full));
        store.remove(Key::of(&value(3, 0, 0).header));
        assert_eq!(store.keep(Time::ZERO, &value(16, VALUE_BYTES_MAX, 1)), Ok(()));
    }

    #[test]
    fn expired_value_is_not_handed_over_and_makes_room() {
        let mut store = Store::default();
        for app in 0..256 {
            let mut message = value(app, 10, 1);
            let _ = message.header.set_time_to_live(Duration::from_secs(1));
            assert_eq!(store.keep(Time::ZERO, &message), Ok(()));
        }
        let (young, old) = (Time::from_nanos(1_000_000_000), Time::from_nanos(1_000_000_001));
        assert_eq!((sequences(&store, young).len(), sequences(&store, old).len()), (256, 0));
        assert_eq!(store.keep(young, &value(256, 10, 1)), Err(KeepError::Full));
        assert_eq!(store.keep(old, &value(256, 10, 9)), Ok(()));
        assert_eq!((store.len(), sequences(&store, old)), (1, vec![9]));
    }

    #[test]
    fn value_is_handed_over_without_a_receipt_and_with_its_time() {
        let mut store = Store::default();
        let mut message = value(1, 10, 5);
        message.header.flags = Flags::KEEP.with(Flags::CONFIRM);
        (message.header.sent, message.header.correlation) = (Time::from_nanos(77), 3);
        assert_eq!(store.keep(Time::from_nanos(99), &message), Ok(()));
        let handed_over =
            store.of_key(Key::of(&message.header), Time::from_nanos(99)).expect("it is retained");
        let Header { flags, sent, correlation, .. } = handed_over.header;
        assert_eq!(flags, Flags::KEEP.with(Flags::RETAINED));
        assert_eq!((sent, correlation, handed_over.payload), (Time::from_nanos(77), 0, message.payload));
    }
}
