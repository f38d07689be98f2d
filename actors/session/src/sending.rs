//! The sending half: numbers messages, keeps them and retransmits them.

use std::collections::VecDeque;

use super::{Ack, FIRST, SendPosition};

/// Bounds of the unacknowledged messages. At least one message is always allowed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Window {
    /// Maximum number of messages. A further one waits.
    pub messages: usize,
    /// Bytes of frames at which a further message waits. The actual bound is one message more.
    pub bytes: usize,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Kept<M> {
    /// The message; `None` for a void.
    message: Option<M>,
    bytes: usize,
}

/// The effect of an [`Ack`].
#[derive(Debug, PartialEq, Eq)]
pub enum AckEffect<M> {
    /// Some kept messages were acknowledged, or nothing is new.
    Known,
    /// The connection can be used: kept messages that have not arrived are retransmitted now.
    Resumed,
    /// The peer has lost its receive state of this epoch. A new epoch has begun, and nothing of it is sent
    /// before the peer is [notified](Sending::epoch_announced). It is unknown whether these messages, oldest
    /// first, have arrived.
    Reset(Vec<M>),
}

/// The send state of one node for the messages to another.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Sending<M> {
    window: Window,
    epoch: u64,
    /// Number of the oldest kept message.
    base: u64,
    kept: VecDeque<Kept<M>>,
    /// Number of kept voids.
    voids: usize,
    bytes: usize,
    /// Number of the next frame to write on the current connection; `None` until the peer's ACK sets it.
    cursor: Option<u64>,
    /// The identity of the peer's receive state in this epoch.
    peer: Option<u64>,
    /// Whether this epoch began on the current connection and was not announced to the peer. While it is
    /// true, nothing of the epoch is sent.
    awaits_epoch_ack: bool,
    /// Acknowledged bytes of this epoch's messages.
    arrived: u64,
    /// The limit of the peer's announced room: messages before this number that begin before this many bytes.
    /// spec: CREDIT-5
    until: Option<(u64, u64)>,
}

impl<M> Sending<M> {
    /// Creates a state in which nothing was sent. `epoch` is not 0, and larger than any earlier one between
    /// the same two incarnations of nodes.
    pub const fn new(epoch: u64, window: Window) -> Self {
        Self {
            window,
            epoch,
            base: FIRST,
            kept: VecDeque::new(),
            voids: 0,
            bytes: 0,
            cursor: None,
            peer: None,
            awaits_epoch_ack: false,
            arrived: 0,
            until: None,
        }
    }

    /// Returns the bounds of the unacknowledged messages.
    pub const fn window(&self) -> Window {
        self.window
    }

    /// Returns the epoch announced to the peer.
    pub const fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Returns the number of the next new message.
    fn end(&self) -> u64 {
        self.base + self.kept.len() as u64
    }

    /// Whether a message that was never sent may be sent now.
    pub fn has_room(&self) -> bool {
        let has_room = self.kept.len() < self.window.messages && self.bytes < self.window.bytes;
        self.cursor == Some(self.end()) && (has_room || self.kept.is_empty()) && self.peer_has_room()
    }

    fn peer_has_room(&self) -> bool {
        let begins_at = self.arrived + self.bytes as u64;
        self.until.is_none_or(|(number, bytes)| self.end() < number && begins_at < bytes)
    }

    /// Whether every numbered message was written on this connection or acknowledged.
    pub fn is_through(&self) -> bool {
        self.kept.is_empty() || self.cursor == Some(self.end())
    }

    /// Returns the number of written messages that the peer has not acknowledged.
    pub fn kept(&self) -> usize {
        self.kept.len()
    }

    /// Returns the number of kept messages that are no voids.
    pub fn kept_without_voids(&self) -> usize {
        self.kept.len() - self.voids
    }

    /// Returns the number of kept messages, without voids, that satisfy `is_one`.
    pub fn kept_that(&self, is_one: impl Fn(&M) -> bool) -> usize {
        self.kept.iter().filter_map(|kept| kept.message.as_ref()).filter(|message| is_one(message)).count()
    }

    /// Returns the known position of the peer, for an audit.
    pub fn position(&self) -> SendPosition {
        let Self { epoch, peer, base, .. } = *self;
        SendPosition { epoch, receiver_id: peer, acknowledged: base, next: self.end() }
    }

    /// Returns the number of messages to retransmit.
    pub fn behind(&self) -> usize {
        self.cursor.map_or(0, |cursor| (self.end() - cursor) as usize)
    }

    /// Returns the number that [`keep`](Self::keep) gives to the next message.
    pub fn next_number(&self) -> u64 {
        self.end()
    }

    /// Keeps a message at the write of its frame of `bytes`, and returns its number. Requires
    /// [room](Self::has_room).
    pub fn keep(&mut self, message: M, bytes: usize) -> u64 {
        // spec: SESSION-1
        debug_assert!(self.has_room(), "numbers go out in their order");
        let number = self.end();
        self.kept.push_back(Kept { message: Some(message), bytes });
        self.bytes += bytes;
        self.cursor = Some(number + 1);
        number
    }

    /// Removes the last kept message and its number, because no byte of it was written.
    pub fn take_back(&mut self) {
        if let Some(kept) = self.kept.pop_back() {
            self.bytes -= kept.bytes;
            self.voids -= usize::from(kept.message.is_none());
            self.cursor = self.cursor.map(|cursor| cursor.min(self.end()));
        }
    }

    /// Returns the next message to retransmit, with its number. The message is `None` for a void.
    pub fn again(&mut self) -> Option<(u64, Option<&M>)> {
        let number = self.cursor.filter(|cursor| *cursor < self.end())?;
        self.cursor = Some(number + 1);
        let kept = &self.kept[(number - self.base) as usize];
        Some((number, kept.message.as_ref()))
    }

    /// Replaces the kept messages that satisfy `has_no_use` by voids. Returns the messages, newest first.
    /// spec: SESSION-6
    pub fn void(&mut self, mut has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
        let mut void = Vec::new();
        for kept in self.kept.iter_mut().rev() {
            if kept.message.as_ref().is_some_and(&mut has_no_use) {
                void.extend(kept.message.take());
                self.bytes -= std::mem::take(&mut kept.bytes);
            }
        }
        self.voids += void.len();
        void
    }

    /// Processes the end of the connection.
    pub const fn link_ended(&mut self) {
        self.cursor = None;
        self.awaits_epoch_ack = false;
    }

    /// Records that an [`Ack`] naming `epoch` is sent on the current connection, ahead of later messages. If
    /// that epoch began there, its messages may follow now. Returns whether this is so. spec: SESSION-5
    pub fn epoch_announced(&mut self, epoch: u64) -> bool {
        let follows = self.awaits_epoch_ack && epoch == self.epoch;
        if follows {
            self.awaits_epoch_ack = false;
            self.cursor = Some(FIRST);
        }
        follows
    }

    /// Processes the peer's ACK.
    pub fn on_ack(&mut self, ack: &Ack) -> AckEffect<M> {
        let remembers = self.peer.is_none_or(|peer| peer == ack.receiver_id) || self.end() == FIRST;
        self.peer = Some(ack.receiver_id);
        // A peer that does not know this epoch yet has received nothing of it.
        let next = if ack.peer_epoch == self.epoch { ack.next } else { FIRST };
        if remembers && (self.base..=self.end()).contains(&next) {
            let effect = self.arrived(next);
            self.allow(ack.room);
            return effect;
        }
        if remembers && next < self.base && self.cursor.is_some() {
            // Two threads sent ACKs, and the older one arrived last.
            return AckEffect::Known;
        }
        let effect = self.reset();
        self.allow(ack.room);
        effect
    }

    /// Extends the limit to the peer's room, which counts from the oldest kept message. The limit never
    /// shrinks: an earlier ACK may have allowed more.
    fn allow(&mut self, room: Option<(u64, u64)>) {
        let Some((messages, bytes)) = room else { return };
        let (number, at) = self.until.unwrap_or_default();
        self.until = Some((
            number.max(self.base.saturating_add(messages)),
            at.max(self.arrived.saturating_add(bytes)),
        ));
    }

    /// Removes all messages before `next`, which the peer has received. spec: SESSION-2, SESSION-3
    fn arrived(&mut self, next: u64) -> AckEffect<M> {
        let count = next.saturating_sub(self.base) as usize;
        for kept in self.kept.range(..count) {
            self.bytes -= kept.bytes;
            self.voids -= usize::from(kept.message.is_none());
            self.arrived += kept.bytes as u64;
        }
        // They are dropped where they are: none is moved. A number between base and end is kept.
        self.kept.drain(..count);
        self.base += count as u64;
        match self.cursor {
            Some(cursor) => {
                self.cursor = Some(cursor.max(next));
                AckEffect::Known
            }
            // The ACK refers to an epoch that has ended.
            None if self.awaits_epoch_ack => AckEffect::Known,
            None => {
                self.cursor = Some(next);
                AckEffect::Resumed
            }
        }
    }

    /// spec: SESSION-5
    fn reset(&mut self) -> AckEffect<M> {
        let lost = self.drain();
        self.epoch += 1;
        self.base = FIRST;
        (self.arrived, self.until) = (0, None);
        self.awaits_epoch_ack = true;
        AckEffect::Reset(lost)
    }

    /// Removes and returns all kept messages, oldest first.
    pub fn drain(&mut self) -> Vec<M> {
        (self.bytes, self.voids) = (0, 0);
        // The connection has nothing left to continue with.
        self.cursor = None;
        self.kept.drain(..).filter_map(|kept| kept.message).collect()
    }
}
