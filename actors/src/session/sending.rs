//! The sending half: numbers, keeps, and sends again.

use std::collections::VecDeque;

use super::{Ack, FIRST, Sent};

/// How much is kept without an acknowledgement. At least one message always is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Window {
    /// Messages at most. A further one waits.
    pub(crate) messages: usize,
    /// Bytes of frames from which on a further message waits: one message more than this is the bound.
    pub(crate) bytes: usize,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Kept<M> {
    /// `None`: it has lost its use.
    message: Option<M>,
    bytes: usize,
}

/// What an [`Ack`] has changed.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Heard<M> {
    /// Some of what was kept has arrived, or nothing is new.
    Known,
    /// The connection can be used: what was kept and has not arrived is sent again now.
    Resumed,
    /// The peer does not know what it took in this epoch. A new one has begun, of which nothing goes out before the peer is
    /// [told](Sending::told); whether these messages, oldest first, have arrived nobody can say.
    Reset(Vec<M>),
}

/// What one node sends to another.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Sending<M> {
    window: Window,
    epoch: u64,
    /// Number of the oldest message that is kept.
    base: u64,
    kept: VecDeque<Kept<M>>,
    /// Those of them that have lost their use.
    voids: usize,
    bytes: usize,
    /// Number of what is written next on the present connection; `None` until the peer has said where to go on.
    cursor: Option<u64>,
    /// The memory of the peer that this epoch's messages were for.
    peer: Option<u64>,
    /// This epoch began on the present connection, and the peer has not been told: nothing of it goes out.
    is_untold: bool,
    /// Bytes of this epoch's messages that have arrived.
    arrived: u64,
    /// How far the peer has said that it has room: before this number, and for messages that begin before so many bytes. spec: CREDIT-5
    until: Option<(u64, u64)>,
}

impl<M> Sending<M> {
    /// Nothing was sent yet. `epoch` is larger than any before it between the same two lives of nodes, and not 0.
    pub(crate) const fn new(epoch: u64, window: Window) -> Self {
        Self {
            window,
            epoch,
            base: FIRST,
            kept: VecDeque::new(),
            voids: 0,
            bytes: 0,
            cursor: None,
            peer: None,
            is_untold: false,
            arrived: 0,
            until: None,
        }
    }

    /// The epoch that the peer is told.
    pub(crate) const fn epoch(&self) -> u64 {
        self.epoch
    }

    /// The number of the next message that has none yet.
    fn end(&self) -> u64 {
        self.base + self.kept.len() as u64
    }

    /// Whether a message that was never sent may be sent now.
    pub(crate) fn has_room(&self) -> bool {
        let has_room = self.kept.len() < self.window.messages && self.bytes < self.window.bytes;
        self.cursor == Some(self.end()) && (has_room || self.kept.is_empty()) && self.peer_has_room()
    }

    fn peer_has_room(&self) -> bool {
        let begins_at = self.arrived + self.bytes as u64;
        self.until.is_none_or(|(number, bytes)| self.end() < number && begins_at < bytes)
    }

    /// Whether everything that has a number was written on this connection, or has arrived.
    pub(crate) fn is_through(&self) -> bool {
        self.kept.is_empty() || self.cursor == Some(self.end())
    }

    /// Messages that were written, and that the peer has not said to have.
    pub(crate) fn kept(&self) -> usize {
        self.kept.len()
    }

    /// Those of them that have not become voids.
    pub(crate) fn kept_with_a_use(&self) -> usize {
        self.kept.len() - self.voids
    }

    /// Of the messages that have not become voids, those of which this is true.
    pub(crate) fn kept_that(&self, is_one: impl Fn(&M) -> bool) -> usize {
        self.kept.iter().filter_map(|kept| kept.message.as_ref()).filter(|message| is_one(message)).count()
    }

    /// How far the peer is, as far as is known here, for an audit.
    pub(crate) fn position(&self) -> Sent {
        let Self { epoch, peer, base, .. } = *self;
        Sent { epoch, memory: peer, acknowledged: base, next: self.end() }
    }

    /// Messages that are to be written again.
    pub(crate) fn behind(&self) -> usize {
        self.cursor.map_or(0, |cursor| (self.end() - cursor) as usize)
    }

    /// Keeps a message whose frame of `bytes` is written now, and gives it its number. Only where there is
    /// [room](Self::has_room).
    pub(crate) fn keep(&mut self, message: M, bytes: usize) -> u64 {
        // spec: SESSION-1
        debug_assert!(self.has_room(), "numbers go out in their order");
        let number = self.end();
        self.kept.push_back(Kept { message: Some(message), bytes });
        self.bytes += bytes;
        self.cursor = Some(number + 1);
        number
    }

    /// Takes the number back from the message that was kept last: nothing of it was written.
    pub(crate) fn take_back(&mut self) {
        if let Some(kept) = self.kept.pop_back() {
            self.bytes -= kept.bytes;
            self.voids -= usize::from(kept.message.is_none());
            self.cursor = self.cursor.map(|cursor| cursor.min(self.end()));
        }
    }

    /// What is to be written again next, with its number; the message is `None` for a void.
    pub(crate) fn again(&mut self) -> Option<(u64, Option<&M>)> {
        let number = self.cursor.filter(|cursor| *cursor < self.end())?;
        self.cursor = Some(number + 1);
        let kept = &self.kept[(number - self.base) as usize];
        Some((number, kept.message.as_ref()))
    }

    /// Makes voids of the kept messages that `has_no_use`, newest first, and gives them back. spec: SESSION-6
    pub(crate) fn void(&mut self, mut has_no_use: impl FnMut(&M) -> bool) -> Vec<M> {
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

    /// The connection has ended.
    pub(crate) const fn link_ended(&mut self) {
        self.cursor = None;
        self.is_untold = false;
    }

    /// An [`Ack`] that names `epoch` goes out on the present connection, ahead of all that is sent from now on: if that is the epoch that began
    /// there, its messages may follow now. Returns whether it is. spec: SESSION-5
    pub(crate) fn told(&mut self, epoch: u64) -> bool {
        let follows = self.is_untold && epoch == self.epoch;
        if follows {
            self.is_untold = false;
            self.cursor = Some(FIRST);
        }
        follows
    }

    /// The peer has said what it takes next.
    pub(crate) fn heard(&mut self, ack: &Ack) -> Heard<M> {
        let remembers = self.peer.is_none_or(|peer| peer == ack.memory) || self.end() == FIRST;
        self.peer = Some(ack.memory);
        // A peer that has not heard of this epoch yet has taken nothing of it.
        let next = if ack.of == self.epoch { ack.next } else { FIRST };
        if remembers && (self.base..=self.end()).contains(&next) {
            let heard = self.arrived(next);
            self.allow(ack.room);
            return heard;
        }
        if remembers && next < self.base && self.cursor.is_some() {
            // Two threads said it, and the older word came last.
            return Heard::Known;
        }
        let heard = self.reset();
        self.allow(ack.room);
        heard
    }

    /// The peer has room for so much from the oldest message on that is kept. It never takes its word back: an earlier one may have
    /// reached further.
    fn allow(&mut self, room: Option<(u64, u64)>) {
        let Some((messages, bytes)) = room else { return };
        let (number, at) = self.until.unwrap_or_default();
        self.until = Some((
            number.max(self.base.saturating_add(messages)),
            at.max(self.arrived.saturating_add(bytes)),
        ));
    }

    /// The peer has everything before `next`. spec: SESSION-2, SESSION-3
    fn arrived(&mut self, next: u64) -> Heard<M> {
        while self.base < next {
            let kept = self.kept.pop_front().expect("a number between base and end is kept");
            self.bytes -= kept.bytes;
            self.voids -= usize::from(kept.message.is_none());
            self.arrived += kept.bytes as u64;
            self.base += 1;
        }
        match self.cursor {
            Some(cursor) => {
                self.cursor = Some(cursor.max(next));
                Heard::Known
            }
            // The peer's word is about an epoch that is over.
            None if self.is_untold => Heard::Known,
            None => {
                self.cursor = Some(next);
                Heard::Resumed
            }
        }
    }

    /// spec: SESSION-5
    fn reset(&mut self) -> Heard<M> {
        let lost = self.drain();
        self.epoch += 1;
        self.base = FIRST;
        (self.arrived, self.until) = (0, None);
        self.is_untold = true;
        Heard::Reset(lost)
    }

    /// Gives up all that is kept, oldest first.
    pub(crate) fn drain(&mut self) -> Vec<M> {
        (self.bytes, self.voids) = (0, 0);
        // There is nothing that the connection could go on with.
        self.cursor = None;
        self.kept.drain(..).filter_map(|kept| kept.message).collect()
    }
}
