//! What waits for applications that take nothing: at the receiver until they take it, at the sender until they may be sent to.
//!
//! ```text
//!  sender                                   receiver
//!  queue ─────────────► number, keep, write ────► counted ──► mailbox
//!    └─ held ► its line ─┐                          └─ full ► shelf, held ──► (tried again) ──► mailbox
//!       ▲                └─ released: queue                     │
//!       └───────────────────────── ACK: who is held ◄───────────┘
//! ```
//!
//! A destination is held as long as the receiver has a line for it. The receiver says so before it acknowledges what it put there, and
//! the sender keeps no more than its window unacknowledged: so a line is never longer than a window, and other destinations are
//! sent to all the while. Where many destinations take nothing, the receiver says how much may come at all: half of the room that is left, so
//! that each further one of them costs less, and one message always. Who heeds this is refused nothing before the bytes of all lines are
//! used up, and then only what is for one that takes nothing; others pass.
//!
//! | rule | what it says |
//! | --- | --- |
//! | CREDIT-1 | What a full destination does not take waits in its line at the receiver, and all that comes for it behind it. |
//! | CREDIT-2 | Each Ack names all that are held, with the number of the last change; of two the later change counts. |
//! | CREDIT-3 | The sender gives no number to a message for one that is held; it waits in a line of its own, others pass. |
//! | CREDIT-4 | Every line and all lines together are bounded; what comes then is refused as if the destination's queue were full. |
//! | CREDIT-5 | Each Ack says how much may come: what there is room for in lines, and one message always. Who heeds it is refused nothing while there is room. |

use std::{
    collections::{BTreeMap, BTreeSet},
    hash::{Hash, Hasher},
};

use sinew_runtime::time::Time;

use super::Window;

/// Messages of a session that no line counts though they may come into one: one that is just taken, and one that is just offered.
const IN_HAND: usize = 2;
/// The number of the first message of a line: as many can be put back before it as come behind it.
const MIDDLE: u64 = 1 << 63;

/// What may wait in a line.
pub(crate) trait Waits {
    /// When it loses its use; [`Time::MAX`]: never.
    fn expiry(&self) -> Time {
        Time::MAX
    }
}

/// How much waits in lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct ShelfLimits {
    /// Lines at most.
    pub(crate) lines: usize,
    /// Messages in one line at most.
    pub(crate) line_messages: usize,
    /// Bytes in one line from which on no further message is taken.
    pub(crate) line_bytes: usize,
    /// Messages in all lines at most.
    pub(crate) messages: usize,
    /// Bytes in all lines from which on no further message is taken.
    pub(crate) bytes: usize,
}

/// One destination's messages by numbers that rise, oldest first, each with its bytes.
#[derive(Clone, Debug)]
struct Line<M> {
    messages: BTreeMap<u64, (M, usize)>,
    bytes: usize,
    /// The first message is with somebody who offers it; the line stands meanwhile, even an empty one.
    is_offered: bool,
}

impl<M> Default for Line<M> {
    fn default() -> Self {
        Self { messages: BTreeMap::new(), bytes: 0, is_offered: false }
    }
}

/// The numbers say nothing but the order.
impl<M: PartialEq> PartialEq for Line<M> {
    fn eq(&self, other: &Self) -> bool {
        self.is_offered == other.is_offered && self.messages.values().eq(other.messages.values())
    }
}

impl<M: Eq> Eq for Line<M> {}

impl<M: Hash> Hash for Line<M> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.is_offered.hash(state);
        self.messages.len().hash(state);
        self.messages.values().for_each(|message| message.hash(state));
    }
}

/// The receiver's lines. `K` names a destination.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Shelf<K, M> {
    limits: ShelfLimits,
    lines: BTreeMap<K, Line<M>>,
    /// What loses its use one day, the first of it first: its line, and its number there.
    expiries: BTreeSet<(Time, K, u64)>,
    messages: usize,
    bytes: usize,
    /// Counts how often it changed who is held.
    change: u64,
}

impl<K: Copy + Ord, M: Waits> Shelf<K, M> {
    /// Nothing waits.
    pub(crate) const fn new(limits: ShelfLimits) -> Self {
        Self { limits, lines: BTreeMap::new(), expiries: BTreeSet::new(), messages: 0, bytes: 0, change: 0 }
    }

    /// Whether nothing waits and nobody is held.
    pub(crate) fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// Whether a destination has a line, so that what comes for it goes there.
    pub(crate) fn holds(&self, key: K) -> bool {
        // Nearly always there is none.
        !self.lines.is_empty() && self.lines.contains_key(&key)
    }

    /// Whether as many destinations as may be are held, and this one is another.
    pub(crate) fn has_no_line_for(&self, key: K) -> bool {
        self.lines.len() >= self.limits.lines && !self.lines.contains_key(&key)
    }

    /// Who is held, in order.
    pub(crate) fn held(&self) -> Vec<K> {
        self.lines.keys().copied().collect()
    }

    /// The number of the last change of who is held.
    pub(crate) const fn change(&self) -> u64 {
        self.change
    }

    /// How much may come, at most a `window`: of what has room in lines half, so that there is always some left for the next destination
    /// that is full. One message may come in any case, one after the other: it may be for somebody who takes it, and else it is refused.
    /// For that a place is kept for each line. `longest` is the size of the longest message. spec: CREDIT-5
    pub(crate) fn room(&self, window: Window, longest: usize) -> Window {
        let Self { limits, messages, bytes, .. } = self;
        let messages = limits.messages.saturating_sub(messages + IN_HAND + limits.lines) / 2;
        // One may reach beyond the room that it began in.
        let bytes = limits.bytes.saturating_sub(bytes + (IN_HAND + 1) * longest) / 2;
        Window { messages: messages.clamp(1, window.messages), bytes: bytes.clamp(1, window.bytes) }
    }

    /// Messages that wait.
    pub(crate) const fn messages(&self) -> usize {
        self.messages
    }

    /// Bytes that wait.
    #[cfg(test)]
    pub(crate) const fn bytes(&self) -> usize {
        self.bytes
    }

    /// How much more waits than the bounds of all lines say; `None` if it is not more.
    fn beyond(&self) -> Option<Window> {
        let Self { limits, messages, bytes, .. } = self;
        let messages = messages.saturating_sub(limits.messages);
        let bytes = bytes.saturating_sub(limits.bytes);
        (messages > 0 || bytes > 0).then_some(Window { messages, bytes })
    }

    /// Puts a message of `bytes` behind all others of its line. spec: CREDIT-1
    ///
    /// # Errors
    /// The message: there is no room. spec: CREDIT-4
    pub(crate) fn put(&mut self, key: K, message: M, bytes: usize) -> Result<(), M> {
        let ShelfLimits { lines, line_messages, line_bytes, .. } = self.limits;
        let has_line = match self.lines.get(&key) {
            Some(line) => line.messages.len() < line_messages && line.bytes < line_bytes,
            None => self.lines.len() < lines,
        };
        if !has_line || self.messages >= self.limits.messages || self.bytes >= self.limits.bytes {
            return Err(message);
        }
        self.append(key, message, bytes);
        Ok(())
    }

    /// As [`put`](Self::put), whatever the bounds.
    fn append(&mut self, key: K, message: M, bytes: usize) {
        if !self.lines.contains_key(&key) {
            self.change += 1;
        }
        let number = self.lines.get(&key).and_then(|line| line.messages.last_key_value());
        let number = number.map_or(MIDDLE, |(last, _)| last + 1);
        self.insert((key, number), message, bytes);
    }

    fn insert(&mut self, (key, number): (K, u64), message: M, bytes: usize) {
        let expiry = message.expiry();
        if expiry != Time::MAX {
            self.expiries.insert((expiry, key, number));
        }
        let line = self.lines.entry(key).or_default();
        line.messages.insert(number, (message, bytes));
        line.bytes += bytes;
        self.messages += 1;
        self.bytes += bytes;
    }

    /// Takes one out; its line stands, even an empty one.
    fn remove(&mut self, (key, number): (K, u64)) -> Option<(M, usize)> {
        let line = self.lines.get_mut(&key)?;
        let (message, bytes) = line.messages.remove(&number)?;
        line.bytes -= bytes;
        self.messages -= 1;
        self.bytes -= bytes;
        self.expiries.remove(&(message.expiry(), key, number));
        Some((message, bytes))
    }

    /// Takes the first message of a line out, to be offered to its destination; then say what came of it:
    /// [`taken`](Self::taken) or [`put_back`](Self::put_back). `None` while another one is offered.
    pub(crate) fn offer(&mut self, key: K) -> Option<(M, usize)> {
        let line = self.lines.get_mut(&key).filter(|line| !line.is_offered)?;
        let number = *line.messages.first_key_value()?.0;
        line.is_offered = true;
        self.remove((key, number))
    }

    /// What was offered was taken, or is refused for good. Returns whether its destination is held no more.
    pub(crate) fn taken(&mut self, key: K) -> bool {
        let Some(line) = self.lines.get_mut(&key) else { return false };
        line.is_offered = false;
        let is_over = line.messages.is_empty();
        if is_over {
            self.lines.remove(&key);
            self.change += 1;
        }
        is_over
    }

    /// What was offered was not taken: it is the next one again.
    pub(crate) fn put_back(&mut self, key: K, message: M, bytes: usize) {
        let line = self.lines.entry(key).or_default();
        line.is_offered = false;
        let number = line.messages.first_key_value().map_or(MIDDLE, |(first, _)| first - 1);
        self.insert((key, number), message, bytes);
    }

    /// Takes out of a line, the newest first, the one message that `is_it`, unless it is offered.
    pub(crate) fn take_back(&mut self, key: K, mut is_it: impl FnMut(&M) -> bool) -> Option<M> {
        let mut messages = self.lines.get(&key)?.messages.iter().rev();
        let number = *messages.find(|(_, (message, _))| is_it(message))?.0;
        let (message, _) = self.remove((key, number))?;
        self.end_empty_lines();
        Some(message)
    }

    /// Whoever was offering has ended; what it had in its hand is gone.
    pub(crate) fn forget_offers(&mut self) {
        self.lines.values_mut().for_each(|line| line.is_offered = false);
        self.end_empty_lines();
    }

    /// A line in which nothing is left is over, but for one of which a message is offered.
    fn end_empty_lines(&mut self) {
        let lines = self.lines.len();
        self.lines.retain(|_, line| line.is_offered || !line.messages.is_empty());
        self.change += u64::from(self.lines.len() < lines);
    }

    /// Takes all of one line out, oldest first.
    fn take_line(&mut self, key: K) -> impl Iterator<Item = M> {
        let line = self.lines.remove(&key).unwrap_or_default();
        self.messages -= line.messages.len();
        self.bytes -= line.bytes;
        for (number, (message, _)) in &line.messages {
            self.expiries.remove(&(message.expiry(), key, *number));
        }
        line.messages.into_values().map(|(message, _)| message)
    }

    /// When something here loses its use next; [`Time::MAX`] if nothing does.
    pub(crate) fn next_expiry(&self) -> Time {
        self.expiries.first().map_or(Time::MAX, |(expiry, ..)| *expiry)
    }

    /// Takes out what has lost its use by `now`, `at_most` so many, the one that lost it first first: nothing else is looked at. A line
    /// in which nothing is left is over, but for one of which a message is offered.
    pub(crate) fn take_expired(&mut self, now: Time, at_most: usize) -> Vec<M> {
        let over = self.expiries.iter().take_while(|(expiry, ..)| *expiry < now).take(at_most);
        let over: Vec<_> = over.map(|(_, key, number)| (*key, *number)).collect();
        self.take_out(over)
    }

    /// Takes everything out that `has_no_use`, oldest first in each line. A line in which nothing is left is over, but for one of which
    /// a message is offered.
    pub(crate) fn take_useless(&mut self, mut has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        let lines = self.lines.iter();
        let all =
            lines.flat_map(|(key, line)| line.messages.iter().map(|(number, kept)| (*key, *number, kept)));
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
        self.end_empty_lines();
        taken
    }
}

/// The sender's lines, and who is held.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Held<K, M> {
    keys: BTreeSet<K>,
    /// The last change that was heard of on the present connection.
    change: Option<u64>,
    shelf: Shelf<K, M>,
}

/// What the peer's word has changed.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Turn<M> {
    /// Whether some are held that were not: what waits for them in the queue belongs into their lines.
    pub(crate) holds_more: bool,
    /// What waited for those that are held no more: in each line oldest first.
    pub(crate) released: Vec<M>,
}

impl<K: Copy + Ord, M: Waits> Held<K, M> {
    /// Nobody is held.
    pub(crate) const fn new(limits: ShelfLimits) -> Self {
        Self { keys: BTreeSet::new(), change: None, shelf: Shelf::new(limits) }
    }

    /// Whether this destination is held.
    pub(crate) fn holds(&self, key: K) -> bool {
        !self.keys.is_empty() && self.keys.contains(&key)
    }

    /// Whether any destination is held.
    pub(crate) fn holds_any(&self) -> bool {
        !self.keys.is_empty()
    }

    /// Messages in lines.
    pub(crate) const fn messages(&self) -> usize {
        self.shelf.messages()
    }

    /// A new connection: the first word on it counts, whatever its number.
    pub(crate) const fn link_ended(&mut self) {
        self.change = None;
    }

    /// How much more waits than the bounds of all lines say, as it was [put beyond](Self::put_beyond) them; `None` if it is not more.
    pub(crate) fn beyond(&self) -> Option<Window> {
        self.shelf.beyond()
    }

    /// The peer has said who is held. spec: CREDIT-2
    pub(crate) fn heard(&mut self, change: u64, keys: impl IntoIterator<Item = K>) -> Turn<M> {
        if self.change.is_some_and(|heard| change <= heard) {
            return Turn { holds_more: false, released: Vec::new() };
        }
        self.change = Some(change);
        let former =
            std::mem::replace(&mut self.keys, keys.into_iter().take(self.shelf.limits.lines).collect());
        let holds_more = self.keys.difference(&former).next().is_some();
        let mut released = Vec::new();
        for key in former.difference(&self.keys) {
            released.extend(self.shelf.take_line(*key));
        }
        Turn { holds_more, released }
    }

    /// Puts a message for one that is held into its line. spec: CREDIT-3
    ///
    /// # Errors
    /// The message: there is no room. spec: CREDIT-4
    pub(crate) fn put(&mut self, key: K, message: M, bytes: usize) -> Result<(), M> {
        self.shelf.put(key, message, bytes)
    }

    /// As [`put`](Self::put), whatever the bounds: it was taken before its destination was held. Who takes messages takes fewer while there is
    /// more than [they say](Self::beyond).
    pub(crate) fn put_beyond(&mut self, key: K, message: M, bytes: usize) {
        self.shelf.append(key, message, bytes);
    }

    /// When something in a line loses its use next; [`Time::MAX`] if nothing does.
    pub(crate) fn next_expiry(&self) -> Time {
        self.shelf.next_expiry()
    }

    /// Takes out of the lines what has lost its use by `now`.
    pub(crate) fn take_expired(&mut self, now: Time) -> Vec<M> {
        self.shelf.take_expired(now, usize::MAX)
    }

    /// Takes out of the lines what `has_no_use`.
    pub(crate) fn take_useless(&mut self, has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        self.shelf.take_useless(has_no_use)
    }
}
