//! The connection to the node: frames one after the other; the same code for threads and tasks.
//!
//! A message counts as sent when it is completely in the ring; one that is incomplete at its deadline is
//! withdrawn. On a socket nothing can be withdrawn: there a message counts as sent with its first byte, and
//! later calls write the rest. A slow node never costs the connection.

use std::{sync::Arc, time::Duration};

use sinew_runtime::{time::Time, wire::Message};

use super::{
    ApiError,
    link::{
        Arrived, Ended, Progress, Reader, Writer,
        ring::{CHECK_INTERVAL, Rest},
    },
    loan::Draft,
    stall_timeout::{Limit, Waiting},
    wait_mode::WaitMode,
};

/// Interval between checks whether there is room for the rest of a long frame.
const REST_RETRY: Duration = Duration::from_millis(1);

/// The connection of an endpoint to its node.
pub(super) struct NodeLink {
    pub(super) writer: Arc<Writer>,
    pub(super) reader: Reader,
    /// Why the connection has ended, once it has.
    pub(super) ended: Option<Ended>,
    /// The rest of a frame that is partly in the ring.
    rest: Option<Rest>,
    /// The node's read counter when a send reached its stall timeout.
    stalled: Option<u32>,
}

impl NodeLink {
    pub(super) const fn new(writer: Arc<Writer>, reader: Reader) -> Self {
        Self { writer, reader, ended: None, rest: None, stalled: None }
    }

    /// Records the end of the connection. The first reason is kept. Returns whether it is this one.
    pub(super) fn end(&mut self, ended: Ended) -> bool {
        let is_first = self.ended.is_none();
        if is_first {
            self.ended = Some(ended);
        }
        is_first
    }

    /// Writes a message; waits for room as long as `limit` allows.
    ///
    /// # Errors
    /// The receiver gets nothing of the message. [`ApiError::Closed`]: or the connection ended before it was
    /// complete.
    pub(super) async fn write(
        &mut self,
        draft: Draft,
        limit: Limit,
        wait_mode: &mut WaitMode,
    ) -> Result<(), ApiError> {
        // A node that does not read costs one stall timeout, not one per message.
        let has_stalled = self.stalled.is_some_and(|taken| taken == self.taken());
        let mut waiting = if has_stalled { Waiting::after_stall(limit) } else { Waiting::new(limit) };
        let written = self.write_within(draft, &mut waiting, wait_mode).await;
        // With room at once, the usual case, neither the clock nor the node's end of the ring is read.
        if self.stalled.is_some() || waiting.has_begun() {
            let taken = self.taken();
            let is_stalled = waiting.has_stalled(Time::now()) || self.stalled == Some(taken);
            self.stalled = is_stalled.then_some(taken);
        }
        written
    }

    async fn write_within(
        &mut self,
        draft: Draft,
        waiting: &mut Waiting,
        wait_mode: &mut WaitMode,
    ) -> Result<(), ApiError> {
        while !self.continue_writing() {
            self.await_room(0, waiting, wait_mode).await?;
        }
        let Some(mut message) = self.writer.send_in_place(draft) else { return Ok(()) };
        let length = message.size();
        self.rest = loop {
            message = match self.writer.begin(message)? {
                Progress::Whole => return Ok(()),
                Progress::Part(rest) => break rest,
                Progress::Full(message) => message,
            };
            self.await_room(length, waiting, wait_mode).await?;
        };
        while !self.continue_writing() {
            match self.await_room(0, waiting, wait_mode).await {
                Ok(()) => {}
                Err(error @ ApiError::Stalled(_)) => return self.withdraw().map_or(Ok(()), |()| Err(error)),
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Returns whether a poll would find nothing to read, here and on direct links, and has nothing to write here.
    pub(super) fn is_quiet(&self, now: Time) -> bool {
        self.is_idle() && self.reader.look(now) == Some(Arrived::Nothing)
    }

    /// Returns whether the connection has not ended and nothing is to be written.
    pub(super) fn is_idle(&self) -> bool {
        self.ended.is_none() && self.rest.is_none() && !self.writer.has_pending()
    }

    /// Writes a message if there is room. Returns whether it need not be tried again.
    pub(super) fn try_write(&mut self, message: Message) -> bool {
        if let Some(message) = self.writer.send_in_place(message.into()) {
            match self.writer.begin(message) {
                // A send in progress holds the ring.
                Ok(Progress::Full(_)) | Err(ApiError::LoanActive) => return false,
                Ok(Progress::Part(rest)) => self.rest = rest,
                // The error appears again when the ring is read.
                Ok(Progress::Whole) | Err(_) => {}
            }
        }
        true
    }

    /// Withdraws a partly written frame. Returns `None` if it is on a socket, where later calls write the
    /// rest.
    fn withdraw(&mut self) -> Option<()> {
        self.rest.as_mut().map(Rest::withdraw)
    }

    /// Continues a partly written frame, as far as there is room now. Returns whether nothing is left of it.
    pub(super) fn continue_writing(&mut self) -> bool {
        // The error appears again when the ring is read.
        if self.rest.as_mut().is_some_and(|rest| rest.continue_writing().unwrap_or(true)) {
            self.rest = None;
        }
        self.writer.flush_pending();
        !self.is_within_frame()
    }

    /// Returns whether the last frame was written in part.
    fn is_within_frame(&self) -> bool {
        self.rest.is_some() || self.writer.is_within_frame()
    }

    /// Returns the latest time of the next check, at most `deadline`: the rest of a frame is written
    /// meanwhile; its withdrawal is not urgent.
    pub(super) fn wake_by(&self, deadline: Time, now: Time) -> Time {
        match &self.rest {
            Some(rest) if rest.is_withdrawn() => deadline.min(now + CHECK_INTERVAL),
            None if !self.is_within_frame() => deadline,
            Some(_) | None => deadline.min(now + REST_RETRY),
        }
    }

    /// Waits for the full stall timeout again, because the node may be about to read again.
    pub(super) const fn forget_stall(&mut self) {
        self.stalled = None;
    }

    /// Waits until there may be room for a frame of `length` bytes, or for the rest of one.
    async fn await_room(
        &mut self,
        length: usize,
        waiting: &mut Waiting,
        wait_mode: &mut WaitMode,
    ) -> Result<(), ApiError> {
        let Some(until) = waiting.until(self.taken(), Time::now()) else {
            return Err(waiting.error());
        };
        if matches!(wait_mode, WaitMode::Polled(_)) && self.reader.has_ended_now() {
            // Its event may have been taken by a poll that did not wait for room.
            return Err(gone());
        }
        match (wait_mode, &mut self.rest) {
            (WaitMode::Blocking, Some(rest)) => rest.await_room(until.since(Time::now())),
            (WaitMode::Blocking, None) => self.writer.await_room(length, until),
            (WaitMode::Async(reactor), rest) => reactor.room(&self.writer, rest, length, until).await,
            (WaitMode::Polled(events), rest) => events.room(&self.writer, rest, length, until).await,
        }
        // No room will become available any more.
        if self.reader.has_ended_now() { Err(gone()) } else { Ok(()) }
    }

    /// Returns the node's read counter.
    fn taken(&mut self) -> u32 {
        match &mut self.rest {
            Some(rest) => rest.taken(),
            None => self.writer.taken(),
        }
    }
}

fn gone() -> ApiError {
    ApiError::Closed("the node has gone".to_owned())
}
