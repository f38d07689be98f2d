//! NodeAPI for tasks of tokio: the same endpoint, whose waits give the thread back.

#[cfg(test)]
mod tests;

use std::{path::Path, sync::Arc, time::Duration};

use sinew_runtime::{
    outcome::Outcome,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Kind, Message, Payload},
};
use sinew_shm::BellKind;
use tokio::task::{coop, spawn_blocking};

use super::{
    ApiError, Endpoint, LoanedMessage, Received, Registration, Transport, Undelivered, form::Form,
    outgoing::Request, reactor::Reactor, returning::LOOK,
};

/// A registered transport address for a task: an [`Endpoint`] whose calls await instead of blocking. The same semantics, word
/// for word: both are one piece of code. Asked for with
/// [`NodeApi::register_transport_address_async`](super::NodeApi::register_transport_address_async).
///
/// Any future of it may be dropped at any time. [`receive`](Self::receive) loses nothing by that. A send that is dropped has
/// sent its message, will with the next call, or has not: nobody says which. An answer that nobody waits for is forgotten.
///
/// It belongs to the runtime in which it was registered, with I/O and time enabled. A wait costs one wake of the task's
/// thread, of which none is this endpoint's own: only registering, and coming back to a node, take a thread of the runtime's
/// pool for blocking work meanwhile. With a direct link it looks every 20 ms, as a thread does that waits; for room in one that
/// is full it is woken by what the peer takes.
#[derive(Debug)]
pub struct AsyncEndpoint {
    pub(super) endpoint: Endpoint,
}

impl AsyncEndpoint {
    pub(super) async fn register(path: &Path, mut registration: Registration) -> Result<Self, ApiError> {
        registration.link.bell = BellKind::Socket.into();
        let wanted = Arc::new(());
        let (is_wanted, path) = (Arc::downgrade(&wanted), path.to_owned());
        let registered = spawn_blocking(move || {
            let link = registration.greet(&path, LOOK, || is_wanted.strong_count() > 0);
            link.map(|link| (path, registration, link))
        });
        let ended = |why: String| ApiError::Closed(why);
        let registered = registered.await.map_err(|why| ended(why.to_string()))?;
        let (path, registration, link) = registered?;
        let reactor = Reactor::new(&link.reader, &link.writer).map_err(|why| ended(why.to_string()))?;
        drop(wanted);
        let form = Form::Reactor(Box::new(reactor));
        Ok(Self { endpoint: Endpoint::new(&path, registration, link, form) })
    }

    /// The address that was registered.
    #[must_use]
    pub const fn tid(&self) -> Tid {
        self.endpoint.tid()
    }

    /// What carries the messages: what was asked for, or the socket where the system or the node has no rings.
    #[must_use]
    pub fn transport(&self) -> Transport {
        self.endpoint.transport()
    }

    /// The name of the node.
    #[must_use]
    pub fn node_name(&self) -> &str {
        self.endpoint.node_name()
    }

    /// Longest payload that the node takes, in bytes.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.endpoint.payload_max()
    }

    /// How often this endpoint has registered, as [`Endpoint::registrations`].
    #[must_use]
    pub const fn registrations(&self) -> u64 {
        self.endpoint.registrations()
    }

    /// Writable memory for a raw payload, as [`Endpoint::create_message`]. Never waits.
    ///
    /// # Errors
    /// It would be longer than the node takes, `kind` is one of the layers' own, or another message is lent.
    pub fn create_message(
        &mut self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<LoanedMessage, ApiError> {
        self.endpoint.create_message(destination, kind, length)
    }

    /// Sends memory that [`create_message`](Self::create_message) lent, as [`Endpoint::send_message`].
    ///
    /// # Errors
    /// It was not sent.
    pub async fn send_message(&mut self, message: LoanedMessage) -> Result<(), ApiError> {
        self.endpoint.dispatch(message.into(), self.endpoint.stall_timeout()).await.map(drop)
    }

    /// The same, and waits for what becomes of it, as [`send_confirmed`](Self::send_confirmed).
    ///
    /// # Errors
    /// It was not sent.
    pub async fn send_message_confirmed(
        &mut self,
        message: LoanedMessage,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        self.endpoint.confirm(message.into(), within).await
    }

    /// Sends it as a request and waits for the reply, as [`Endpoint::ask_message`].
    ///
    /// # Errors
    /// It was not sent or not handled, or no reply came `within` this time.
    pub async fn ask_message(
        &mut self,
        message: LoanedMessage,
        within: Duration,
    ) -> Result<Received, ApiError> {
        self.endpoint.await_reply(message.into(), within).await.map(Received::new)
    }

    /// Sends it as the reply to `request`, as [`Endpoint::reply_message`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub async fn reply_message(
        &mut self,
        request: &Received,
        message: LoanedMessage,
    ) -> Result<(), ApiError> {
        let request = Request::of(request, self.tid())?;
        self.endpoint.answer(request, message.into(), self.endpoint.stall_timeout()).await
    }

    /// Sends a value, as [`Endpoint::send`].
    ///
    /// # Errors
    /// It was not sent.
    pub async fn send<P: Payload>(&mut self, destination: Tid, value: &P) -> Result<(), ApiError> {
        let message = self.endpoint.typed(destination, value, self.endpoint.stall_timeout())?;
        self.endpoint.dispatch(message.into(), self.endpoint.stall_timeout()).await.map(drop)
    }

    /// Sends a value and waits for what becomes of it, as [`Endpoint::send_confirmed`].
    ///
    /// # Errors
    /// It was not sent. If the connection ends before the outcome is known that is [`Outcome::Unknown`].
    pub async fn send_confirmed<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        let message = self.endpoint.typed(destination, value, self.endpoint.stall_timeout())?;
        self.endpoint.confirm(message.into(), within).await
    }

    /// Sends a request and waits for the reply, as [`Endpoint::ask`].
    ///
    /// # Errors
    /// It was not sent or not handled, no reply came `within` this time, or the reply is not an `R`.
    pub async fn ask<P: Payload, R: Payload>(
        &mut self,
        destination: Tid,
        request: &P,
        within: Duration,
    ) -> Result<R, ApiError> {
        const { assert!(R::PROTECTION.is_none(), "a protected payload is sent, not asked for") };
        let message = Message::typed(self.tid(), destination, request);
        Ok(self.endpoint.await_reply(message.into(), within).await?.decode()?)
    }

    /// Answers a request, as [`Endpoint::reply`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub async fn reply<R: Payload>(&mut self, request: &Received, value: &R) -> Result<(), ApiError> {
        let request = Request::of(request, self.tid())?;
        let message = Message::typed(self.tid(), request.source, value);
        self.endpoint.answer(request, message.into(), self.endpoint.stall_timeout()).await
    }

    /// Waits for a message, in the order of [`Endpoint::receive`]. May be dropped at any time without losing one. When the
    /// connection has ended it says so once with [`ApiError::Disconnected`]; later calls wait for the node's return, too. Messages that are there
    /// already count for tokio's budget: other tasks of the thread have their turn between them.
    ///
    /// # Errors
    /// The connection has ended, and everything that came before was received.
    pub async fn receive(&mut self) -> Result<Received, ApiError> {
        // What is there already is not waited for. A task that is sent more than it handles would have its thread for itself.
        coop::consume_budget().await;
        loop {
            // There is always a later time.
            if let Some(received) = self.endpoint.receive_until(Time::MAX, Time::now()).await? {
                return Ok(received);
            }
        }
    }

    /// What the node has said about messages that nobody has taken, as [`Endpoint::take_undelivered`]. Never waits.
    pub fn take_undelivered(&mut self) -> Option<Undelivered> {
        self.endpoint.take_undelivered()
    }

    /// Joins the group called `name`, as [`Endpoint::join`].
    ///
    /// # Errors
    /// It is a member of 256 groups already, or its user or node has as many memberships as it may ([`ApiError::TooManyGroups`]); the node's access
    /// list does not let its user join this one ([`ApiError::Ended`], `NotAllowed`); or the node did not answer.
    pub async fn join(&mut self, name: &str) -> Result<(), ApiError> {
        self.endpoint.set_member(super::endpoint::group_named(name)?, true).await
    }

    /// Leaves the group called `name`.
    ///
    /// # Errors
    /// The node did not answer.
    pub async fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        self.endpoint.set_member(AppAddress::group(name), false).await
    }

    /// The TID that has `name` now, on any node; `None` if nobody has it.
    ///
    /// # Errors
    /// The node did not answer `within` this time.
    pub async fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        self.endpoint.look_up(name.to_owned(), within).await
    }

    /// Gives the address back and waits until the node has taken it: the name is free when this returns.
    ///
    /// # Errors
    /// The node did not answer. The address is given back in any case.
    pub async fn unregister(mut self) -> Result<(), ApiError> {
        self.endpoint.take_leave().await
    }
}
