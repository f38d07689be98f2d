//! What stands under an outlet's mutex: the socket, the frame being written, and all that waits.

use std::{collections::VecDeque, io, sync::Arc, task::Waker};

use sinew_runtime::{
    mailbox::{Bounds, Budget, ClassQueue},
    outcome::{Outcome, Receipt, Rejection},
    router::Refused,
    time::Time,
    wire::{Checksum, Class, Flags, Kind, Message},
};

use super::{
    Left, LinkNumber, OutletCounts, OutletLimits, Socket,
    account::{Tally, is_for_the_program},
    after::After,
    batch::{Pace, is_left_to_the_drainer, is_patient},
    outcomes::messages_in,
    outstanding::{Open, Sent, Shares, owed_by},
    partial::{Partial, Sort, Written},
    resume::Session,
    waiting::Waiting,
};

pub(super) enum Link<S> {
    Down,
    Up(S),
    /// A sender's write failed; the drainer takes the error to the layer.
    Failed(io::Error),
    Closed(Rejection),
}

/// Whether a message is refused where too many wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Bound {
    Kept,
    /// Whoever submits it bounds how many there are.
    Waived,
}

/// Whether a sender's thread has more to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Done,
    /// A long frame of its own is on its way; the lock was given back in between.
    More,
}

pub(super) struct Half<S> {
    pub(super) limits: OutletLimits,
    /// Longest payload that both sides take.
    pub(super) payload_max: usize,
    pub(super) link: Link<S>,
    pub(super) number: u64,
    /// What makes a message arrive once through any number of connections; `None` where there is only ever one.
    pub(super) session: Option<Session>,
    pub(super) partial: Option<Partial>,
    /// The frame that was being written when the last connection ended. No peer can have handled it: it goes first.
    pub(super) interrupted: Option<Message>,
    pub(super) queue: Waiting,
    /// Frames that go ahead of the queue, in their order.
    pub(super) urgent: VecDeque<Message>,
    /// What is sent when nothing waits any more, on whichever connection there is then; nothing is taken after it.
    pub(super) last: Option<Message>,
    /// It was said on the present connection.
    pub(super) has_said_last: bool,
    /// What the session takes next was said on the present connection, or is about to be.
    has_begun: bool,
    finishing: bool,
    /// No waiting message expires before this.
    pub(super) next_expiry: Time,
    /// Confirmed messages that wait, and receipts of those that were sent.
    pub(super) receipts: Arc<Open>,
    /// What the peer has said of messages before their writes had returned, to be settled when the lock is free again.
    pub(super) said: Vec<(Receipt, Outcome)>,
    pub(super) drainer: Option<Waker>,
    pub(super) pace: Pace,
    pub(super) counts: OutletCounts,
    /// The rest of what an audit needs.
    pub(super) tally: Tally,
    /// What the socket had written when it had the last message for the program at the other end.
    pub(super) due: u64,
    /// What the peer had taken when a write failed, where that can be known.
    taken_at_last: u64,
}

impl<S: Socket> Half<S> {
    pub(super) fn new(limits: OutletLimits, session: Option<Session>) -> Self {
        let receipts = Arc::new(Open::new(Shares::of(limits, session.as_ref())));
        Self {
            limits,
            payload_max: limits.payload_max,
            link: Link::Down,
            number: 0,
            session,
            partial: None,
            interrupted: None,
            queue: Waiting::new(ClassQueue::new(bounds(limits))),
            urgent: VecDeque::new(),
            last: None,
            has_said_last: false,
            has_begun: false,
            finishing: false,
            next_expiry: Time::MAX,
            receipts,
            said: Vec::new(),
            drainer: None,
            pace: Pace::new(),
            counts: OutletCounts::default(),
            tally: Tally::default(),
            due: 0,
            taken_at_last: u64::MAX,
        }
    }

    /// What waits counts in `budget`, too. Before anything waits.
    pub(super) fn share(&mut self, budget: Arc<Budget>) {
        self.queue = Waiting::new(ClassQueue::sharing(bounds(self.limits), budget));
    }

    /// Whether this is the latest connection.
    pub(super) const fn is_present(&self, link: LinkNumber) -> bool {
        link.0 == self.number
    }

    pub(super) const fn is_connected(&self) -> bool {
        matches!(self.link, Link::Up(_))
    }

    pub(super) fn connect(
        &mut self,
        socket: S,
        payload_max: usize,
        preface: Option<Message>,
        after: &mut After,
    ) -> LinkNumber {
        self.cut(after);
        self.number += 1;
        if !matches!(self.link, Link::Closed(_)) {
            self.link = Link::Up(socket);
            (self.due, self.taken_at_last) = (0, u64::MAX);
            (self.has_said_last, self.has_begun) = (false, false);
            self.payload_max = self.limits.payload_max.min(payload_max);
            self.partial = preface.map(|message| self.frill(message));
        }
        LinkNumber(self.number)
    }

    pub(super) fn cut(&mut self, after: &mut After) {
        self.disconnect(LinkNumber(self.number), after);
    }

    pub(super) fn disconnect(&mut self, link: LinkNumber, after: &mut After) -> bool {
        if link.0 != self.number || matches!(self.link, Link::Closed(_)) {
            return true;
        }
        let has_gathered = self.gathered() > 0;
        self.link = Link::Down;
        self.urgent.clear();
        self.wake_drainer(after);
        let partial = self.partial.take();
        let was_whole = !has_gathered && partial.as_ref().is_none_or(|partial| partial.written == 0);
        if self.session.is_some() {
            self.pause(partial);
        } else {
            self.unknown(after);
            self.interrupt(partial);
        }
        was_whole
    }

    /// What was sent and not confirmed may have been handled or not.
    pub(super) fn unknown(&mut self, after: &mut After) {
        after.settle(self.receipts.take_all().map(|sent| (sent.receipt, Outcome::Unknown)));
        after.room.extend(self.receipts.awaited_no_more());
    }

    /// The frame that was being written goes out on the next connection.
    fn interrupt(&mut self, partial: Option<Partial>) {
        // The connection's own frames are not the next one's.
        let Some(Partial { message, .. }) = partial.filter(|partial| partial.sort == Sort::Message) else {
            return;
        };
        self.next_expiry = self.next_expiry.min(message.header.expiry());
        if message.header.class == Class::Stream {
            // A newer value that waits takes its place; nothing that waits makes room for it.
            self.counts.superseded += u64::from(self.queue.put_back(message).is_some());
        } else {
            self.interrupted = Some(message);
        }
    }

    /// Takes out all that waits to be sent for the first time.
    fn take_waiting(&mut self) -> Vec<Message> {
        let mut waiting: Vec<_> = self.interrupted.take().into_iter().chain(self.queue.drain_all()).collect();
        waiting.extend(self.empty_lines());
        waiting
    }

    pub(super) fn close(&mut self, why: Rejection, after: &mut After) {
        self.cut(after);
        self.unknown(after);
        self.forget_kept();
        self.link = Link::Closed(why);
        after.room.extend(self.queue.awaited_no_more());
        let waiting = self.take_waiting();
        for message in waiting {
            self.counts.lost += 1;
            after.settle(message.receipt.map(|receipt| (receipt, Outcome::PeerLost)));
        }
        self.receipts.none_waits();
        self.next_expiry = Time::MAX;
    }

    pub(super) fn end(&mut self, left: Left, after: &mut After) {
        let why = Rejection::Closed;
        let taken =
            if let Link::Up(socket) = &mut self.link { socket.account().taken } else { self.taken_at_last };
        after.settle(self.receipts.take_all().map(|Sent { receipt, written, .. }| {
            let outcome = match left {
                Left::Somebody => Outcome::Unknown,
                Left::Nobody if written > taken => Outcome::Rejected(why),
                Left::Nobody => Outcome::Failed,
            };
            (receipt, outcome)
        }));
        self.cut(after);
        // Nobody ever has the rest of a frame that was begun.
        let waiting = self.take_waiting();
        for message in waiting {
            self.counts.lost += 1;
            after.settle(message.receipt.map(|receipt| (receipt, Outcome::Rejected(why))));
        }
        self.close(why, after);
    }

    pub(super) fn submit(
        &mut self,
        message: Message,
        bound: Bound,
        after: &mut After,
    ) -> Result<Step, Refused> {
        let is_own = !message.header.kind.is_user();
        let step = self.take(message, bound, after)?;
        self.tally.taken += 1;
        self.tally.own += u64::from(is_own);
        Ok(step)
    }

    fn take(&mut self, mut message: Message, bound: Bound, after: &mut After) -> Result<Step, Refused> {
        if let Err(why) = self.admit(&message, bound) {
            self.counts.refused += 1;
            return Err(Refused::new(message, why));
        }
        message.header.flags = match message.receipt {
            Some(_) => message.header.flags.with(Flags::CONFIRM),
            None => message.header.flags.without(Flags::CONFIRM),
        };
        if message.header.time_to_live_us != 0 && message.header.is_expired(Time::now()) {
            self.expired(message, after);
            return Ok(Step::Done);
        }
        if let Some(key) = self.held_line(&message.header) {
            return self.put_in_line(key, message).map(|()| Step::Done);
        }
        // Asked in any case: what comes while others wait counts, too.
        let (is_one_of_a_flood, is_left) =
            (self.is_one_of_a_flood(&message), is_left_to_the_drainer(&message));
        if self.waiting() > 0 || !self.takes_new() || is_one_of_a_flood || is_left {
            let is_patient = is_patient(&message);
            self.enqueue(message, bound)?;
            if !is_left {
                self.help(after);
            }
            self.rouse(is_patient, after);
            return Ok(Step::Done);
        }
        let mut frame = self.frame(message);
        self.receipts.waits(owed_by(&frame.message));
        match self.write(&mut frame) {
            Written::Whole => {
                self.sent(frame);
                self.note_pace();
            }
            Written::Piece => {
                self.partial = Some(frame);
                return Ok(Step::More);
            }
            Written::InPart if frame.written > 0 => {
                self.partial = Some(frame);
                self.wake_drainer(after);
            }
            Written::InPart | Written::Broken => {
                return self.requeue(frame, bound, after).map(|()| Step::Done);
            }
        }
        Ok(Step::Done)
    }

    pub(super) fn submit_urgent(
        &mut self,
        message: Message,
        waiting_max: usize,
        after: &mut After,
    ) -> Result<(), Refused> {
        if !matches!(self.link, Link::Up(_)) {
            return Err(Refused::new(message, Rejection::Closed));
        }
        // Nothing of a session goes ahead of what it takes next, whichever thread has something to say. spec: SESSION-3
        self.has_begun |= message.header.kind == Kind::GNCL_ACK || self.session.is_none();
        if !self.has_begun {
            return Err(Refused::new(message, Rejection::Closed));
        }
        if message.header.kind == Kind::GNCL_ACK
            && let Some(older) = self.urgent.iter_mut().find(|older| older.header.kind == Kind::GNCL_ACK)
        {
            // The newer one says all that the older one does. So it is never one too many: without the last one, the peer would keep for
            // ever what was taken, and hold back what is for an application that takes again.
            *older = message;
            return Ok(());
        }
        // At most one of them waits.
        if self.urgent.len() >= waiting_max && message.header.kind != Kind::GNCL_ACK {
            return Err(Refused::new(message, Rejection::QueueFull));
        }
        self.urgent.push_back(message);
        if self.partial.is_none() && self.gathered() == 0 && self.urgent.len() == 1 {
            self.write_next(after);
        }
        if self.urgent_left() > 0 {
            self.wake_drainer(after);
        }
        Ok(())
    }

    /// Urgent frames that the socket has not taken to their last byte; what is gathered counts as one, as one may be in it.
    pub(super) fn urgent_left(&self) -> usize {
        let is_frill = self.partial.as_ref().is_some_and(|partial| partial.sort == Sort::Frill);
        self.urgent.len() + usize::from(is_frill) + usize::from(self.gathered() > 0)
    }

    pub(super) fn finish(&mut self, last: Message, after: &mut After) {
        self.finishing = true;
        self.last = Some(last);
        if self.waiting() == 1 && self.has_frame() && matches!(self.link, Link::Up(_)) {
            self.write_next(after);
        }
        self.wake_drainer(after);
    }

    /// A frame that was to be written at once and could not be: it waits like any other.
    fn requeue(&mut self, frame: Partial, bound: Bound, after: &mut After) -> Result<(), Refused> {
        self.receipts.waits_no_more(owed_by(&frame.message));
        self.take_back();
        self.enqueue(frame.message, bound)?;
        self.rouse(false, after);
        Ok(())
    }

    fn admit(&self, message: &Message, bound: Bound) -> Result<(), Rejection> {
        let confirmed = message.receipt.is_some();
        if let Link::Closed(why) = self.link {
            Err(why)
        } else if self.finishing {
            Err(Rejection::Closed)
        } else if message.payload.len() > self.payload_max {
            Err(Rejection::TooLong)
        } else if confirmed && message.header.class == Class::Stream {
            // It may be superseded, and then there is no outcome that tells the truth.
            Err(Rejection::Unsupported)
        } else if let Some(destination) = owed_by(message)
            && bound == Bound::Kept
            && self.receipts.has_too_many(destination)
        {
            Err(Rejection::QueueFull)
        } else {
            Ok(())
        }
    }

    fn enqueue(&mut self, message: Message, bound: Bound) -> Result<(), Refused> {
        let (owed_by, expiry) = (owed_by(&message), message.header.expiry());
        match bound {
            Bound::Waived => self.queue.push_beyond(message),
            Bound::Kept if !self.has_room_beside_lines(&message) => {
                self.counts.refused += 1;
                return Err(Refused::new(message, Rejection::QueueFull));
            }
            Bound::Kept => match self.queue.push(message) {
                Ok(superseded) => self.counts.superseded += u64::from(superseded.is_some()),
                Err(refused) => {
                    self.counts.refused += 1;
                    return Err(refused);
                }
            },
        }
        self.receipts.waits(owed_by);
        self.next_expiry = self.next_expiry.min(expiry);
        Ok(())
    }

    /// What found no room is not refused: its sender keeps it.
    pub(super) fn is_offered_again(&mut self, message: &Message, room: Option<&Waker>, after: &mut After) {
        self.counts.refused -= 1;
        if !owed_by(message).is_some_and(|destination| self.receipts.await_fewer(destination, room)) {
            after.room.extend(room.and_then(|room| self.queue.offered(message, room)));
        }
    }

    /// Whether a message that was never sent may be written now.
    fn takes_new(&self) -> bool {
        matches!(self.link, Link::Up(_)) && self.session_has_room()
    }

    /// A message as it goes to the connection that there is now.
    pub(super) fn frame(&mut self, mut message: Message) -> Partial {
        self.number(&mut message);
        Partial::new(message, self.checksum(), Sort::Message)
    }

    pub(super) fn checksum(&self) -> Checksum {
        match &self.link {
            Link::Up(socket) => socket.checksum(),
            // It is not written; whoever writes it later makes it a frame again.
            Link::Down | Link::Failed(_) | Link::Closed(_) => Checksum::Crc,
        }
    }

    pub(super) fn frill(&self, message: Message) -> Partial {
        Partial::new(message, self.checksum(), Sort::Frill)
    }

    pub(super) fn write(&mut self, frame: &mut Partial) -> Written {
        let Link::Up(socket) = &mut self.link else { return Written::Broken };
        let ticket = frame.message.receipt.as_ref().map(Receipt::ticket);
        // Its outcome may come before the write has returned, and finds no lock that is held meanwhile.
        ticket.into_iter().for_each(|ticket| self.receipts.writes(ticket));
        let written = match frame.write_to(socket) {
            Ok(written) => written,
            Err(error) => self.note(error),
        };
        if ticket.is_some() && !matches!(written, Written::Whole) {
            // Nobody can have handled it: who says so is not heeded.
            self.receipts.writes_no_more();
        }
        written
    }

    /// A write has failed: for now, or for good.
    pub(super) fn note(&mut self, error: io::Error) -> Written {
        if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) {
            return Written::InPart;
        }
        self.fail(error);
        Written::Broken
    }

    /// The connection cannot be written to any more.
    pub(super) fn fail(&mut self, error: io::Error) {
        if let Link::Up(socket) = &mut self.link {
            self.taken_at_last = socket.account().taken;
        }
        self.link = Link::Failed(error);
    }

    pub(super) fn sent(&mut self, frame: Partial) {
        if frame.sort == Sort::Message {
            self.counts.sent += messages_in(&frame.message);
            if let Link::Up(socket) = &self.link
                && is_for_the_program(&frame.message.header)
            {
                self.due = socket.written();
            }
        }
        let expiry = frame.message.header.expiry();
        if let Some(receipt) = frame.message.receipt {
            let written = if let Link::Up(socket) = &mut self.link { socket.account().written } else { 0 };
            self.said.extend(self.receipts.sent(Sent { receipt, expiry, written }));
        }
    }

    pub(super) fn waiting(&self) -> usize {
        let single =
            [self.partial.is_some(), self.gathered() > 0, self.interrupted.is_some(), self.has_last_to_say()];
        self.queue.len()
            + self.urgent.len()
            + self.behind()
            + single.into_iter().filter(|waits| *waits).count()
    }

    pub(super) const fn has_last_to_say(&self) -> bool {
        self.last.is_some() && !self.has_said_last
    }

    pub(super) const fn counts(&self) -> OutletCounts {
        self.counts
    }
}

const fn bounds(limits: OutletLimits) -> Bounds {
    Bounds { messages: limits.queue_capacity, bytes: limits.queue_bytes }
}
