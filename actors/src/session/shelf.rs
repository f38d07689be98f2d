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

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::Window;

/// Messages of a session that no line counts though they may come into one: one that is just taken, and one that is just offered.
const IN_HAND: usize = 2;

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

/// One destination's messages, oldest first, each with its bytes.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Line<M> {
    messages: VecDeque<(M, usize)>,
    bytes: usize,
    /// The first message is with somebody who offers it; the line stands meanwhile, even an empty one.
    is_offered: bool,
}

impl<M> Default for Line<M> {
    fn default() -> Self {
        Self { messages: VecDeque::new(), bytes: 0, is_offered: false }
    }
}

/// The receiver's lines. `K` names a destination.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Shelf<K, M> {
    limits: ShelfLimits,
    lines: BTreeMap<K, Line<M>>,
    messages: usize,
    bytes: usize,
    /// Counts how often it changed who is held.
    change: u64,
}

impl<K: Copy + Ord, M> Shelf<K, M> {
    /// Nothing waits.
    pub(crate) const fn new(limits: ShelfLimits) -> Self {
        Self { limits, lines: BTreeMap::new(), messages: 0, bytes: 0, change: 0 }
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
        let line = self.lines.entry(key).or_default();
        line.messages.push_back((message, bytes));
        line.bytes += bytes;
        self.messages += 1;
        self.bytes += bytes;
    }

    /// Takes the first message of a line out, to be offered to its destination; then say what came of it:
    /// [`taken`](Self::taken) or [`put_back`](Self::put_back). `None` while another one is offered.
    pub(crate) fn offer(&mut self, key: K) -> Option<(M, usize)> {
        let line = self.lines.get_mut(&key).filter(|line| !line.is_offered)?;
        let (message, bytes) = line.messages.pop_front()?;
        line.is_offered = true;
        line.bytes -= bytes;
        self.messages -= 1;
        self.bytes -= bytes;
        Some((message, bytes))
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
        line.messages.push_front((message, bytes));
        line.bytes += bytes;
        self.messages += 1;
        self.bytes += bytes;
    }

    /// Takes out of a line, the newest first, the one message that `is_it`, unless it is offered.
    pub(crate) fn take_back(&mut self, key: K, is_it: impl FnMut(&M) -> bool) -> Option<M> {
        let line = self.lines.get_mut(&key)?;
        let mut is_it = is_it;
        let at = line.messages.iter().rposition(|(message, _)| is_it(message))?;
        let (message, bytes) = line.messages.remove(at)?;
        line.bytes -= bytes;
        (self.messages, self.bytes) = (self.messages - 1, self.bytes - bytes);
        if line.messages.is_empty() && !line.is_offered {
            self.lines.remove(&key);
            self.change += 1;
        }
        Some(message)
    }

    /// Whoever was offering has ended; what it had in its hand is gone.
    pub(crate) fn forget_offers(&mut self) {
        self.lines.values_mut().for_each(|line| line.is_offered = false);
        let lines = self.lines.len();
        self.lines.retain(|_, line| !line.messages.is_empty());
        self.change += u64::from(self.lines.len() < lines);
    }

    /// Takes all of one line out, oldest first.
    fn take_line(&mut self, key: K) -> impl Iterator<Item = M> {
        let line = self.lines.remove(&key).unwrap_or_default();
        self.messages -= line.messages.len();
        self.bytes -= line.bytes;
        line.messages.into_iter().map(|(message, _)| message)
    }

    /// Takes everything out that `has_no_use`, oldest first in each line. A line in which nothing is left is over, but for one of which
    /// a message is offered.
    pub(crate) fn take_useless(&mut self, mut has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        let mut useless = Vec::new();
        for line in self.lines.values_mut() {
            for (message, bytes) in std::mem::take(&mut line.messages) {
                if has_no_use(&message) {
                    line.bytes -= bytes;
                    (self.messages, self.bytes) = (self.messages - 1, self.bytes - bytes);
                    useless.push(message);
                } else {
                    line.messages.push_back((message, bytes));
                }
            }
        }
        let lines = self.lines.len();
        self.lines.retain(|_, line| line.is_offered || !line.messages.is_empty());
        self.change += u64::from(self.lines.len() < lines);
        useless
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

impl<K: Copy + Ord, M> Held<K, M> {
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

    /// As [`put`](Self::put), whatever the bounds: it was taken before its destination was held.
    pub(crate) fn put_beyond(&mut self, key: K, message: M, bytes: usize) {
        self.shelf.append(key, message, bytes);
    }

    /// Takes out of the lines what `has_no_use`.
    pub(crate) fn take_useless(&mut self, has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        self.shelf.take_useless(has_no_use)
    }
}
