//! The reading half of a ring link.

use std::{
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net::UnixStream,
    },
    sync::Arc,
    time::Duration,
};

use sinew_protocol::ring::{RingFrames, Taken};
use sinew_runtime::{time::Time, wire::Message};
use sinew_shm::{
    Any, AnyError, Armed, Consumer, CorruptError, Ends, HangUp, PollResult, Polling, WaitSet, Waiter,
};

use super::{CHECK_INTERVAL, ENOUGH, end_reason};
use crate::{
    ApiError,
    link::{Ended, LinkOptions, Read, socket},
};

/// The reading half.
pub(crate) struct Reader {
    end: End,
    /// The set of all rings of the endpoint, if it has one.
    set: Option<WaitSet>,
    frames: RingFrames,
    waiter: Waiter,
    /// When the socket is checked next.
    next_check: Time,
    /// Why no more data will arrive, after the data that has arrived was taken.
    ended: Option<Ended>,
    /// Data that has arrived is not taken either.
    is_stopped: bool,
}

/// What has arrived in the rings of a set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrived {
    Nothing,
    /// Something in the ring at this place of the set, or with this index of those without a set, and nothing else.
    Only(u8),
    /// Something in several rings, or another thread has woken the endpoint.
    Several,
}

impl Arrived {
    fn of(set: &WaitSet) -> Self {
        set.only_ready().map_or(Self::Several, Self::Only)
    }
}

/// Returns what a thread waits with.
pub(crate) fn waiter(options: &LinkOptions) -> Waiter {
    let waiter = Waiter::new(options.spin);
    match options.set() {
        Some(set) => waiter.of_set(set.clone()),
        None => waiter,
    }
}

/// The ring and the socket to wait for.
pub(crate) struct End {
    socket: Arc<UnixStream>,
    consumer: Consumer,
}

impl Ends for End {
    fn count(&self) -> usize {
        1
    }

    fn consumer(&self, _: usize) -> &Consumer {
        &self.consumer
    }

    fn consumer_mut(&mut self, _: usize) -> &mut Consumer {
        &mut self.consumer
    }

    fn hang_up(&self, _: usize) -> Option<HangUp<'_>> {
        Some(HangUp::Socket(self.socket.as_fd()))
    }
}

impl Reader {
    pub(in crate::link) fn new(
        socket: Arc<UnixStream>,
        consumer: Consumer,
        payload_max: usize,
        options: &LinkOptions,
    ) -> Self {
        let (end, frames) = (End { socket, consumer }, RingFrames::new(payload_max));
        let (waiter, set) = (waiter(options), options.set().cloned());
        if let Some(set) = &set {
            set.set_open(&end.consumer, true);
        }
        Self { end, set, frames, waiter, next_check: Time::ZERO, ended: None, is_stopped: false }
    }

    /// Returns the next frame of those that were taken.
    pub(in crate::link) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        Ok(self.frames.next_message()?)
    }

    pub(in crate::link) fn has_frame(&self) -> bool {
        self.frames.has_frame()
    }

    /// Stops taking data.
    pub(in crate::link) fn stop_reading(&mut self) {
        self.leave_set();
        self.is_stopped = true;
        self.ended = Some(Ended::without_reason());
    }

    /// Looks what has arrived in the rings of the set. Returns `None` if this ring has more to do, or if there is no
    /// set: one look does not show it then.
    #[inline]
    pub(in crate::link) fn look_at_set(&self, now: Time) -> Option<Arrived> {
        let set = self.set.as_ref().filter(|_| self.is_idle(now))?;
        Some(if set.look() { Arrived::of(set) } else { Arrived::Nothing })
    }

    /// Returns what the last look has found.
    #[inline]
    pub(in crate::link) fn found(&self, now: Time) -> Option<Arrived> {
        self.set.as_ref().filter(|_| self.is_idle(now)).map(Arrived::of)
    }

    /// Returns whether a read would find nothing in this ring.
    pub(crate) fn is_ring_empty(&mut self, now: Time) -> bool {
        // Corrupt memory is detected when it is read.
        self.is_idle(now) && !self.end.consumer.is_ready().unwrap_or(true)
    }

    fn is_idle(&self, now: Time) -> bool {
        self.ended.is_none() && now < self.next_check && !self.frames.has_bytes()
    }

    /// The same for this ring alone.
    pub(in crate::link) fn is_empty(&self, now: Time) -> bool {
        let is_reported = |set: &WaitSet| set.look() && set.is_ready(&self.end.consumer);
        self.is_idle(now) && self.set.as_ref().is_some_and(|set| !is_reported(set))
    }

    /// Takes the data that has arrived, without waiting.
    pub(in crate::link) fn read(&mut self, now: Time) -> Read {
        if let (true, Some(why)) = (self.is_stopped, &self.ended) {
            return Read::Ended(why.clone());
        }
        match self.take() {
            Err(corrupt) => {
                self.leave_set();
                Read::Ended(Ended::permanent(format!("shared memory holds what it cannot: {corrupt}")))
            }
            Ok(Taken::Some) => Read::Some,
            Ok(Taken::Nothing) => match self.ended.clone() {
                Some(why) => {
                    self.leave_set();
                    Read::Ended(why)
                }
                // Data published before the end is taken by the next poll.
                None if self.has_ended(now) => Read::Some,
                None => Read::Nothing,
            },
        }
    }

    /// Takes the content of the ring, if it reports any or has ended.
    fn take(&mut self) -> Result<Taken, CorruptError> {
        let Some(set) = &self.set else { return self.frames.take(&mut self.end.consumer, ENOUGH) };
        set.look();
        if !set.is_ready(&self.end.consumer) && self.ended.is_none() {
            return Ok(Taken::Nothing);
        }
        let taken = self.frames.take(&mut self.end.consumer, ENOUGH)?;
        if taken == Taken::Nothing {
            set.was_emptied(&self.end.consumer);
        }
        Ok(taken)
    }

    /// Ends no wait any more: this ring is not read any longer.
    fn leave_set(&self) {
        if let Some(set) = &self.set {
            set.set_open(&self.end.consumer, false);
        }
    }

    /// Checks all rings of the set, including those without a report.
    pub(crate) fn check_all<'a, E: Ends>(
        &'a mut self,
        all: impl FnOnce(&'a mut End) -> E,
    ) -> Result<Any, AnyError> {
        self.waiter.check_all(&mut all(&mut self.end)).map(|()| Any::Ready)
    }

    /// Returns whether the node's end was observed. A ring accepts messages even after that end, and a caller
    /// that never waits must detect it, too; so the socket is checked periodically.
    pub(in crate::link) fn has_ended(&mut self, now: Time) -> bool {
        if self.ended.is_none() && now >= self.next_check {
            self.next_check = now + CHECK_INTERVAL;
            self.ended = socket::has_hung_up(&self.end.socket).then(|| end_reason(&self.end.socket));
        }
        self.ended.is_some()
    }

    /// Waits for a message, the node's end, or `CHECK_INTERVAL`.
    pub(in crate::link) fn wait(&mut self, left: Duration) {
        if self.ended.is_some() {
            return;
        }
        let ended = self.waiter.wait_within(&mut self.end, left.min(CHECK_INTERVAL));
        self.note(&ended);
    }

    /// Like [`wait`](Self::wait), for all ends that `all` returns: the node's, which is the first, and others.
    pub(crate) fn wait_for_all<'a, E: Ends>(
        &'a mut self,
        left: Duration,
        all: impl FnOnce(&'a mut End) -> E,
    ) -> Result<Any, AnyError> {
        self.waiter.wait_within(&mut all(&mut self.end), left.min(CHECK_INTERVAL))
    }

    /// Starts a task's check before it sleeps. Returns `None` if it must sleep at once.
    pub(crate) fn begin_spin(&mut self) -> Option<Polling> {
        self.waiter.begin()
    }

    /// Checks the ends that `all` returns: the node's and others.
    pub(crate) fn look<'a, E: Ends>(
        &'a mut self,
        looking: &Polling,
        all: impl FnOnce(&'a mut End) -> E,
    ) -> PollResult {
        looking.poll(&mut all(&mut self.end))
    }

    /// Ends the wait that started with this check.
    pub(crate) fn end_spin(&mut self, looking: &Polling) {
        self.waiter.end(looking);
    }

    /// Records the result of a wait for the node.
    pub(crate) fn note(&mut self, ended: &Result<Any, AnyError>) {
        match ended {
            Ok(Any::HungUp(0)) => self.ended = Some(end_reason(&self.end.socket)),
            Ok(Any::Message(_) | Any::Ready | Any::TimedOut | Any::HungUp(_))
            | Err(AnyError::Corrupt { index: 1.., .. }) => {}
            Err(error @ (AnyError::Corrupt { .. } | AnyError::System(_))) => {
                self.ended = Some(Ended::permanent(error.to_string()))
            }
        }
    }

    /// Announces that a task waits for a message. [`Armed::Ready`]: there is something to do.
    pub(crate) fn arm(&mut self) -> Armed {
        if self.ended.is_some() {
            return Armed::Ready;
        }
        // Corrupt memory is detected when it is read.
        self.end.consumer.arm().unwrap_or(Armed::Ready)
    }

    /// Records that the task is awake, and whether this ring has woken it.
    pub(crate) fn disarm(&mut self) {
        self.end.consumer.disarm_reported();
    }

    /// Makes the next poll of the ring check the socket, too.
    pub(crate) fn check_at_once(&mut self) {
        self.next_check = Time::ZERO;
    }

    /// Returns the descriptor that signals messages.
    pub(crate) fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.end.consumer.fd()
    }

    /// Returns the socket in addition to the ring.
    pub(crate) fn socket(&self) -> Arc<UnixStream> {
        self.end.socket.clone()
    }
}
