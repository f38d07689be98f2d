//! Frames to the node, one after the other; one piece of code for threads and tasks.
//!
//! A message is sent when it is whole in the ring; one that is not when its time is over is taken back. From a socket nothing can be
//! taken back: there it is sent when it has begun, and the rest goes out with later calls. A node that takes little never costs the
//! connection.

use sinew_runtime::time::Time;

use super::{
    ApiError, Endpoint,
    form::Form,
    link::{Progress, ring::Rest},
    loan::Draft,
    stall_timeout::{Limit, Waiting},
};

impl Endpoint {
    /// How long a send waits if its caller says nothing.
    pub(super) const fn stall_timeout(&self) -> Limit {
        Limit::stall_timeout(self.home.options.stall_timeout)
    }

    /// Writes a message to the node; waits for room as long as `limit` allows.
    ///
    /// # Errors
    /// Nothing of it is received. [`ApiError::Closed`]: or the connection ended before it was whole.
    pub(super) async fn write(&mut self, draft: Draft, limit: Limit) -> Result<(), ApiError> {
        // Who takes nothing costs a stall timeout once, and not with each message.
        let has_stalled = self.stalled.is_some_and(|taken| taken == self.taken());
        let mut waiting = if has_stalled { Waiting::after_a_stall(limit) } else { Waiting::new(limit) };
        let written = self.write_within(draft, &mut waiting).await;
        // Where there was room at once, as nearly always, there is nothing to ask the clock or the node's end of the ring.
        if self.stalled.is_some() || waiting.has_begun() {
            let taken = self.taken();
            let is_stalled = waiting.is_out_of_patience(Time::now()) || self.stalled == Some(taken);
            self.stalled = is_stalled.then_some(taken);
        }
        written
    }

    async fn write_within(&mut self, draft: Draft, waiting: &mut Waiting) -> Result<(), ApiError> {
        while !self.go_on() {
            self.await_room(0, waiting).await?;
        }
        let Some(mut message) = self.writer.send_in_place(draft) else { return Ok(()) };
        let length = message.size();
        self.rest = loop {
            message = match self.writer.begin(message)? {
                Progress::Whole => return Ok(()),
                Progress::Part(rest) => break rest,
                Progress::Full(message) => message,
            };
            self.await_room(length, waiting).await?;
        };
        while !self.go_on() {
            match self.await_room(0, waiting).await {
                Ok(()) => {}
                Err(error @ ApiError::Stalled(_)) => return self.withdraw().map_or(Ok(()), |()| Err(error)),
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Takes back what was begun; `None` if it lies with a socket, where the rest goes out with later calls.
    fn withdraw(&mut self) -> Option<()> {
        self.rest.as_mut().map(Rest::withdraw)
    }

    /// Writes on what was begun, as far as there is room now; whether nothing is left of it.
    pub(super) fn go_on(&mut self) -> bool {
        // An error shows itself again when the ring is read.
        if self.rest.as_mut().is_some_and(|rest| rest.go_on().unwrap_or(true)) {
            self.rest = None;
        }
        self.writer.pay();
        !self.is_within_frame()
    }

    /// Whether the last frame was written in part.
    pub(super) fn is_within_frame(&self) -> bool {
        self.rest.is_some() || self.writer.is_within_frame()
    }

    /// Waits until there may be room for a frame of `length` bytes, or for the rest of one.
    async fn await_room(&mut self, length: usize, waiting: &mut Waiting) -> Result<(), ApiError> {
        let Some(until) = waiting.until(self.taken(), Time::now()) else {
            return Err(waiting.in_vain());
        };
        match (&mut self.form, &mut self.rest) {
            (Form::Thread, Some(rest)) => rest.await_room(until.since(Time::now())),
            (Form::Thread, None) => self.writer.await_room(length, until),
            (Form::Reactor(reactor), rest) => reactor.room(&self.writer, rest, length, until).await,
        }
        // There is no room to come any more.
        if self.reader.has_ended_now() {
            Err(ApiError::Closed("the node has gone".to_owned()))
        } else {
            Ok(())
        }
    }

    /// A count of what the node takes.
    fn taken(&mut self) -> u32 {
        match &mut self.rest {
            Some(rest) => rest.taken(),
            None => self.writer.taken(),
        }
    }
}
