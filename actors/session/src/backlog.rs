//! Messages for applications that accept nothing: the receiver keeps them until they are taken, the sender
//! until it may send them.
//!
//! ```text
//!  sender                                   receiver
//!  queue ─────────────► number, keep, write ────► counted ──► mailbox
//!    └─ held ► its queue ┐                          └─ full ► backlog, held ──► (tried again) ──► mailbox
//!       ▲                └─ released: queue                     │
//!       └───────────────────────── ACK: held keys ◄─────────────┘
//! ```
//!
//! A destination is held while the receiver has a queue for it. The receiver announces this before it
//! acknowledges the messages in the queue, and the sender's unacknowledged messages are bounded by its
//! window. So a queue is never longer than a window, and messages to other destinations continue meanwhile.
//! If many destinations accept nothing, the receiver limits how much may arrive at all. The limit is half of
//! the remaining room, so that each further such destination costs less, and always at least one message. A
//! sender that respects this limit is never refused before the bytes of all queues are used up. After that
//! only messages for destinations that accept nothing are refused; others pass.
//!
//! | rule | meaning |
//! | --- | --- |
//! | CREDIT-1 | A message that a full destination does not accept waits in its queue at the receiver, and all later ones wait behind it. |
//! | CREDIT-2 | Each Ack names all held destinations, with the number of the last change; of two Acks the later change counts. |
//! | CREDIT-3 | The sender assigns no number to a message for a held destination; it waits in a queue of its own, others pass. |
//! | CREDIT-4 | Every queue and all queues together are bounded; further messages are refused as if the destination's queue were full. |
//! | CREDIT-5 | Each Ack states how much may arrive: the room in queues, and always one message. Within it nothing is refused while there is room. |

use std::{
    collections::{BTreeMap, BTreeSet},
    hash::{Hash, Hasher},
};

use sinew_runtime::time::Time;

use super::Window;

/// Messages of a session that no queue counts though they may join one: one just received, and one just
/// offered.
const IN_TRANSIT: usize = 2;
/// The number of the first message of a queue. As many can be put back before it as can arrive behind it.
const MIDDLE: u64 = 1 << 63;

/// A message that may wait in a queue.
pub trait Expires {
    /// Returns the time at which the message expires; [`Time::MAX`] if it never does.
    fn expiry(&self) -> Time {
        Time::MAX
    }
}

/// Bounds of the messages in queues.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BacklogLimits {
    /// Maximum number of queues.
    pub queues: usize,
    /// Maximum number of messages in one queue.
    pub queue_messages: usize,
    /// Bytes in one queue at which no further message is accepted.
    pub queue_bytes: usize,
    /// Maximum number of messages in all queues.
    pub messages: usize,
    /// Bytes in all queues at which no further message is accepted.
    pub bytes: usize,
}

/// One destination's messages by rising numbers, oldest first, each with its size in bytes.
#[derive(Clone, Debug)]
struct DestinationQueue<M> {
    messages: BTreeMap<u64, (M, usize)>,
    bytes: usize,
    /// Whether the first message is being offered to the destination. The queue is kept meanwhile, even if it
    /// is empty.
    is_offered: bool,
}

impl<M> Default for DestinationQueue<M> {
    fn default() -> Self {
        Self { messages: BTreeMap::new(), bytes: 0, is_offered: false }
    }
}

/// Compares the order of the messages; the numbers themselves have no meaning.
impl<M: PartialEq> PartialEq for DestinationQueue<M> {
    fn eq(&self, other: &Self) -> bool {
        self.is_offered == other.is_offered && self.messages.values().eq(other.messages.values())
    }
}

impl<M: Eq> Eq for DestinationQueue<M> {}

impl<M: Hash> Hash for DestinationQueue<M> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.is_offered.hash(state);
        self.messages.len().hash(state);
        self.messages.values().for_each(|message| message.hash(state));
    }
}

/// The receiver's queues. `K` identifies a destination.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ReceiveBacklog<K, M> {
    limits: BacklogLimits,
    queues: BTreeMap<K, DestinationQueue<M>>,
    /// Messages that can expire, in the order of expiry: the queue, and the number in it.
    expiries: BTreeSet<(Time, K, u64)>,
    messages: usize,
    bytes: usize,
    /// Counts the changes of the set of held destinations.
    change: u64,
}

impl<K: Copy + Ord, M: Expires> ReceiveBacklog<K, M> {
    /// Creates a backlog without messages.
    pub const fn new(limits: BacklogLimits) -> Self {
        Self { limits, queues: BTreeMap::new(), expiries: BTreeSet::new(), messages: 0, bytes: 0, change: 0 }
    }

    /// Whether no message waits and no destination is held.
    pub fn is_empty(&self) -> bool {
        self.queues.is_empty()
    }

    /// Whether a destination has a queue, so that its messages must wait there.
    pub fn holds(&self, key: K) -> bool {
        // There is nearly always none.
        !self.queues.is_empty() && self.queues.contains_key(&key)
    }

    /// Whether the maximum number of destinations is held, and this is not one of them.
    pub fn lacks_queue_for(&self, key: K) -> bool {
        self.queues.len() >= self.limits.queues && !self.queues.contains_key(&key)
    }

    /// Returns the held destinations, in order.
    pub fn held(&self) -> Vec<K> {
        self.queues.keys().copied().collect()
    }

    /// Returns the number of the last change of the held destinations.
    pub const fn change(&self) -> u64 {
        self.change
    }

    /// Returns how much may arrive, at most a `window`. It is half of the room in queues, so that some
    /// remains for the next full destination. One message at a time may arrive in any case: its destination
    /// may accept it, otherwise it is refused. For that, one place per queue is reserved. `longest` is the
    /// size of the longest message. spec: CREDIT-5
    pub fn room(&self, window: Window, longest: usize) -> Window {
        let Self { limits, messages, bytes, .. } = self;
        let messages = limits.messages.saturating_sub(messages + IN_TRANSIT + limits.queues) / 2;
        // One message may exceed the room that it began in.
        let bytes = limits.bytes.saturating_sub(bytes + (IN_TRANSIT + 1) * longest) / 2;
        Window { messages: messages.clamp(1, window.messages), bytes: bytes.clamp(1, window.bytes) }
    }

    /// Returns the number of waiting messages.
    pub const fn messages(&self) -> usize {
        self.messages
    }

    /// Returns the number of waiting bytes.
    #[cfg(test)]
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Returns by how much the waiting messages exceed the bounds of all queues; `None` if they do not.
    fn excess(&self) -> Option<Window> {
        let Self { limits, messages, bytes, .. } = self;
        let messages = messages.saturating_sub(limits.messages);
        let bytes = bytes.saturating_sub(limits.bytes);
        (messages > 0 || bytes > 0).then_some(Window { messages, bytes })
    }

    /// Appends a message of `bytes` to its queue. spec: CREDIT-1
    ///
    /// # Errors
    /// Returns the message if there is no room. spec: CREDIT-4
    pub fn put(&mut self, key: K, message: M, bytes: usize) -> Result<(), M> {
        let BacklogLimits { queues, queue_messages, queue_bytes, .. } = self.limits;
        let has_queue = match self.queues.get(&key) {
            Some(queue) => queue.messages.len() < queue_messages && queue.bytes < queue_bytes,
            None => self.queues.len() < queues,
        };
        if !has_queue || self.messages >= self.limits.messages || self.bytes >= self.limits.bytes {
            return Err(message);
        }
        self.append(key, message, bytes);
        Ok(())
    }

    /// Same as [`put`](Self::put), without the bounds.
    fn append(&mut self, key: K, message: M, bytes: usize) {
        if !self.queues.contains_key(&key) {
            self.change += 1;
        }
        let number = self.queues.get(&key).and_then(|queue| queue.messages.last_key_value());
        let number = number.map_or(MIDDLE, |(last, _)| last + 1);
        self.insert((key, number), message, bytes);
    }

    fn insert(&mut self, (key, number): (K, u64), message: M, bytes: usize) {
        let expiry = message.expiry();
        if expiry != Time::MAX {
            self.expiries.insert((expiry, key, number));
        }
        let queue = self.queues.entry(key).or_default();
        queue.messages.insert(number, (message, bytes));
        queue.bytes += bytes;
        self.messages += 1;
        self.bytes += bytes;
    }

    /// Removes one message. The queue is kept, even if it is empty.
    fn remove(&mut self, (key, number): (K, u64)) -> Option<(M, usize)> {
        let queue = self.queues.get_mut(&key)?;
        let (message, bytes) = queue.messages.remove(&number)?;
        queue.bytes -= bytes;
        self.messages -= 1;
        self.bytes -= bytes;
        self.expiries.remove(&(message.expiry(), key, number));
        Some((message, bytes))
    }

    /// Removes the first message of a queue, to offer it to its destination. The caller reports the result
    /// with [`taken`](Self::taken) or [`put_back`](Self::put_back). Returns `None` while another message is
    /// offered.
    pub fn offer(&mut self, key: K) -> Option<(M, usize)> {
        let queue = self.queues.get_mut(&key).filter(|queue| !queue.is_offered)?;
        let number = *queue.messages.first_key_value()?.0;
        queue.is_offered = true;
        self.remove((key, number))
    }

    /// Records that the offered message was taken, or refused permanently. Returns whether its destination is
    /// no longer held.
    pub fn taken(&mut self, key: K) -> bool {
        let Some(queue) = self.queues.get_mut(&key) else { return false };
        queue.is_offered = false;
        let is_over = queue.messages.is_empty();
        if is_over {
            self.queues.remove(&key);
            self.change += 1;
        }
        is_over
    }

    /// Returns the offered message, which was not taken, to the front of its queue.
    pub fn put_back(&mut self, key: K, message: M, bytes: usize) {
        let queue = self.queues.entry(key).or_default();
        queue.is_offered = false;
        let number = queue.messages.first_key_value().map_or(MIDDLE, |(first, _)| first - 1);
        self.insert((key, number), message, bytes);
    }

    /// Removes the newest message of a queue that satisfies `is_it`, unless it is offered.
    pub fn take_back(&mut self, key: K, mut is_it: impl FnMut(&M) -> bool) -> Option<M> {
        let mut messages = self.queues.get(&key)?.messages.iter().rev();
        let number = *messages.find(|(_, (message, _))| is_it(message))?.0;
        let (message, _) = self.remove((key, number))?;
        self.remove_empty_queues();
        Some(message)
    }

    /// Ends all offers after the offering task has ended; the offered messages are lost.
    pub fn forget_offers(&mut self) {
        self.queues.values_mut().for_each(|queue| queue.is_offered = false);
        self.remove_empty_queues();
    }

    /// Removes empty queues, except those of which a message is offered.
    fn remove_empty_queues(&mut self) {
        let queues = self.queues.len();
        self.queues.retain(|_, queue| queue.is_offered || !queue.messages.is_empty());
        self.change += u64::from(self.queues.len() < queues);
    }

    /// Removes all messages of one queue, oldest first.
    fn take_queue(&mut self, key: K) -> impl Iterator<Item = M> {
        let queue = self.queues.remove(&key).unwrap_or_default();
        self.messages -= queue.messages.len();
        self.bytes -= queue.bytes;
        for (number, (message, _)) in &queue.messages {
            self.expiries.remove(&(message.expiry(), key, *number));
        }
        queue.messages.into_values().map(|(message, _)| message)
    }

    /// Returns the next time at which a message expires; [`Time::MAX`] if none does.
    pub fn next_expiry(&self) -> Time {
        self.expiries.first().map_or(Time::MAX, |(expiry, ..)| *expiry)
    }

    /// Removes up to `at_most` messages that have expired by `now`, the earliest expiry first. No other
    /// message is visited. Then removes empty queues, except those of which a message is offered.
    pub fn take_expired(&mut self, now: Time, at_most: usize) -> Vec<M> {
        let over = self.expiries.iter().take_while(|(expiry, ..)| *expiry < now).take(at_most);
        let over: Vec<_> = over.map(|(_, key, number)| (*key, *number)).collect();
        self.take_out(over)
    }

    /// Removes all messages that satisfy `has_no_use`, oldest first in each queue. Then removes empty queues,
    /// except those of which a message is offered.
    pub fn take_useless(&mut self, mut has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        let queues = self.queues.iter();
        let all =
            queues.flat_map(|(key, queue)| queue.messages.iter().map(|(number, kept)| (*key, *number, kept)));
        let useless = all.filter(|(_, _, (message, _))| has_no_use(message));
        let useless: Vec<_> = useless.map(|(key, number, _)| (key, number)).collect();
        self.take_out(useless)
    }

    fn take_out(&mut self, these: Vec<(K, u64)>) -> Vec<M> {
        if these.is_empty() {
            return Vec::new();
        }
        let taken =
            these.into_iter().filter_map(|this| self.remove(this)).map(|(message, _)| message).collect();
        self.remove_empty_queues();
        taken
    }
}

/// The sender's queues, and the held destinations.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct SendBacklog<K, M> {
    keys: BTreeSet<K>,
    /// The last change received on the current connection.
    change: Option<u64>,
    backlog: ReceiveBacklog<K, M>,
}

/// The effect of a peer's announcement of held destinations.
#[derive(Debug, PartialEq, Eq)]
pub struct HeldChange<M> {
    /// Whether further destinations are held. Their queued messages must move to their queues.
    pub holds_more: bool,
    /// Messages of destinations that are no longer held, oldest first in each queue.
    pub released: Vec<M>,
}

impl<K: Copy + Ord, M: Expires> SendBacklog<K, M> {
    /// Creates a state in which no destination is held.
    pub const fn new(limits: BacklogLimits) -> Self {
        Self { keys: BTreeSet::new(), change: None, backlog: ReceiveBacklog::new(limits) }
    }

    /// Whether this destination is held.
    pub fn holds(&self, key: K) -> bool {
        !self.keys.is_empty() && self.keys.contains(&key)
    }

    /// Whether any destination is held.
    pub fn holds_any(&self) -> bool {
        !self.keys.is_empty()
    }

    /// Returns the number of messages in queues.
    pub const fn messages(&self) -> usize {
        self.backlog.messages()
    }

    /// Returns the last change received on the current connection; `None` before the first.
    pub const fn change(&self) -> Option<u64> {
        self.change
    }

    /// Resets the change number for a new connection: the first announcement on it always counts.
    pub const fn link_ended(&mut self) {
        self.change = None;
    }

    /// Returns by how much the [unbounded](Self::put_unbounded) messages exceed the bounds of all queues;
    /// `None` if they do not.
    pub fn excess(&self) -> Option<Window> {
        self.backlog.excess()
    }

    /// Applies the peer's announcement of held destinations. spec: CREDIT-2
    pub fn on_held(&mut self, change: u64, keys: impl IntoIterator<Item = K>) -> HeldChange<M> {
        if self.change.is_some_and(|last| change <= last) {
            return HeldChange { holds_more: false, released: Vec::new() };
        }
        self.change = Some(change);
        let former =
            std::mem::replace(&mut self.keys, keys.into_iter().take(self.backlog.limits.queues).collect());
        let holds_more = self.keys.difference(&former).next().is_some();
        let mut released = Vec::new();
        for key in former.difference(&self.keys) {
            released.extend(self.backlog.take_queue(*key));
        }
        HeldChange { holds_more, released }
    }

    /// Appends a message for a held destination to its queue. spec: CREDIT-3
    ///
    /// # Errors
    /// Returns the message if there is no room. spec: CREDIT-4
    pub fn put(&mut self, key: K, message: M, bytes: usize) -> Result<(), M> {
        self.backlog.put(key, message, bytes)
    }

    /// Same as [`put`](Self::put), without the bounds, because the message was accepted before its
    /// destination was held. The caller accepts fewer messages while the queues are [over their
    /// bounds](Self::excess).
    pub fn put_unbounded(&mut self, key: K, message: M, bytes: usize) {
        self.backlog.append(key, message, bytes);
    }

    /// Returns the next time at which a message in a queue expires; [`Time::MAX`] if none does.
    pub fn next_expiry(&self) -> Time {
        self.backlog.next_expiry()
    }

    /// Removes messages that have expired by `now` from the queues.
    pub fn take_expired(&mut self, now: Time) -> Vec<M> {
        self.backlog.take_expired(now, usize::MAX)
    }

    /// Removes messages that satisfy `has_no_use` from the queues.
    pub fn take_useless(&mut self, has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        self.backlog.take_useless(has_no_use)
    }
}
