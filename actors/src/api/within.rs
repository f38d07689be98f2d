//! Sends that wait for room no longer than their caller says: for a control loop, which has better to do.
//!
//! Each is its namesake without `_within`, but for the wait. [`Duration::ZERO`]: it does not wait at all, and makes no system
//! call that could. Where there is no room in time that is [`ApiError::Stalled`], and nothing of the message is received. One that is
//! longer than half the ring goes out in pieces; if the last one finds no room in time the others are taken back. So who has no
//! time sends nothing that is longer than the ring. Only from a plain socket nothing can be taken back: there a message is sent
//! when its first byte is, and the rest follows with later calls, ahead of all that is sent then.
//!
//! These do not look for a node that has gone, since to register takes time: they say [`ApiError::Disconnected`], and
//! [`Endpoint::receive`], or a send without a time, brings the endpoint back.

use std::time::Duration;

use sinew_runtime::{
    tid::Tid,
    wire::{Message, Payload},
};

use super::{
    ApiError, AsyncEndpoint, Endpoint, LoanedMessage, Received, form::at_once, outgoing::Request,
    stall_timeout::Limit,
};

impl Endpoint {
    /// As [`send`](Self::send), and waits for room for `within` at most instead of its stall timeout; zero: not at all.
    /// For a loop with a period: a message that finds no room is skipped, not waited for.
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use sinew::{ApiError, Endpoint, Tid};
    /// # sinew::payload!("doc.setpoint" => struct Setpoint { degrees: f32 });
    /// # fn step(endpoint: &mut Endpoint, drive: Tid, setpoint: &Setpoint, skipped: &mut u32) -> Result<(), ApiError> {
    /// match endpoint.send_within(drive, setpoint, Duration::from_micros(200)) {
    ///     Ok(()) => {}
    ///     Err(ApiError::Stalled(_)) => *skipped += 1,
    ///     Err(other) => return Err(other),
    /// }
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// It was not sent. [`ApiError::Stalled`]: there was no room in time. A node that has gone is not looked for here
    /// ([`ApiError::Disconnected`]): [`receive`](Self::receive), or a send without a time, does.
    pub fn send_within<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<(), ApiError> {
        let limit = Limit::in_all(within);
        let message = self.typed(destination, value, limit)?;
        at_once(self.dispatch(message.into(), limit)).map(drop)
    }

    /// As [`send_message`](Self::send_message), for `within` at most: see [`send_within`](Self::send_within). Memory that
    /// [is in place](LoanedMessage::is_in_place) has its room already.
    ///
    /// # Errors
    /// It was not sent, and its memory is given back.
    pub fn send_message_within(&mut self, message: LoanedMessage, within: Duration) -> Result<(), ApiError> {
        at_once(self.dispatch(message.into(), Limit::in_all(within))).map(drop)
    }

    /// As [`reply`](Self::reply), for `within` at most: see [`send_within`](Self::send_within).
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub fn reply_within<R: Payload>(
        &mut self,
        request: &Received,
        value: &R,
        within: Duration,
    ) -> Result<(), ApiError> {
        let message = Message::typed(self.tid, request.source(), value);
        at_once(self.answer(Request::of(request, self.tid())?, message.into(), Limit::in_all(within)))
    }

    /// As [`reply_message`](Self::reply_message), for `within` at most: see [`send_within`](Self::send_within).
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub fn reply_message_within(
        &mut self,
        request: &Received,
        message: LoanedMessage,
        within: Duration,
    ) -> Result<(), ApiError> {
        at_once(self.answer(Request::of(request, self.tid())?, message.into(), Limit::in_all(within)))
    }
}

impl AsyncEndpoint {
    /// As [`Endpoint::send_within`]. Unlike a timeout around [`send`](Self::send), it says whether the message was sent.
    ///
    /// # Errors
    /// It was not sent.
    pub async fn send_within<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<(), ApiError> {
        let limit = Limit::in_all(within);
        let message = self.endpoint.typed(destination, value, limit)?;
        self.endpoint.dispatch(message.into(), limit).await.map(drop)
    }

    /// As [`Endpoint::send_message_within`].
    ///
    /// # Errors
    /// It was not sent, and its memory is given back.
    pub async fn send_message_within(
        &mut self,
        message: LoanedMessage,
        within: Duration,
    ) -> Result<(), ApiError> {
        self.endpoint.dispatch(message.into(), Limit::in_all(within)).await.map(drop)
    }

    /// As [`Endpoint::reply_within`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub async fn reply_within<R: Payload>(
        &mut self,
        request: &Received,
        value: &R,
        within: Duration,
    ) -> Result<(), ApiError> {
        let request = Request::of(request, self.tid())?;
        let message = Message::typed(self.tid(), request.source, value);
        self.endpoint.answer(request, message.into(), Limit::in_all(within)).await
    }

    /// As [`Endpoint::reply_message_within`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub async fn reply_message_within(
        &mut self,
        request: &Received,
        message: LoanedMessage,
        within: Duration,
    ) -> Result<(), ApiError> {
        let request = Request::of(request, self.tid())?;
        self.endpoint.answer(request, message.into(), Limit::in_all(within)).await
    }
}
