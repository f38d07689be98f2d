//! NodeAPI for tasks of tokio: the same endpoint, whose waits give the thread back.

#[cfg(test)]
mod tests;

use std::{path::Path, sync::Arc, time::Duration};

use sinew_runtime::{
    sender::Destination,
    tid::{AppAddress, Tid},
    time::Time,
    undelivered::Undelivered,
    wire::{Kind, Payload},
};
use sinew_shm::BellKind;
use tokio::task::{coop, spawn_blocking};

use super::{
    ApiError, Endpoint, LoanedMessage, MessageBuilder, Received, Registration, Transport,
    builder::{SendTerms, Value},
    form::Form,
    reactor::Reactor,
    returning::LOOK,
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
///
/// # Examples
///
/// ```no_run
/// use sinew::{AsyncEndpoint, Payload, client::ApiError, payload};
///
/// payload!("demo.ask_angle" => struct AskAngle;);
/// payload!("demo.angle" => struct Angle { degrees: f32 });
///
/// /// A task that answers requests.
/// async fn serve(mut endpoint: AsyncEndpoint, degrees: f32) -> Result<(), ApiError> {
///     loop {
///         let request = endpoint.receive().await?;
///         if request.kind() == AskAngle::KIND {
///             endpoint.reply(&request, &Angle { degrees }).await?;
///         }
///     }
/// }
/// ```
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

    /// Sends a value as its type says, as [`Endpoint::send`].
    ///
    /// # Errors
    /// It was not sent.
    pub async fn send<'a, P: Payload>(
        &mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> Result<(), ApiError> {
        self.endpoint.send_as(Value::new(to, value), SendTerms::PLAIN).await
    }

    /// A value to be sent otherwise than as its type says, as [`Endpoint::message`]: see [`MessageBuilder`].
    pub fn message<'a, P: Payload>(
        &'a mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> MessageBuilder<'a, Self, Value<'a, P>> {
        MessageBuilder::new(self, Value::new(to, value))
    }

    /// The same for memory that [`create_message`](Self::create_message) lent, as [`Endpoint::loaned`].
    pub const fn loaned(&mut self, message: LoanedMessage) -> MessageBuilder<'_, Self, LoanedMessage> {
        MessageBuilder::new(self, message)
    }

    /// Answers a request, as [`Endpoint::reply`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub async fn reply<R: Payload>(&mut self, request: &Received, value: &R) -> Result<(), ApiError> {
        self.endpoint.reply_as(request, Value::new(request.source(), value), SendTerms::PLAIN).await
    }

    /// Waits for a message, in the order of [`Endpoint::receive`]. May be dropped at any time without losing one. When the
    /// connection has ended it says so once with [`ApiError::Disconnected`]; later calls wait for the node's return, too. Messages that are there
    /// already count for tokio's budget: other tasks of the thread have their turn between them.
    ///
    /// # Errors
    /// The connection has ended, and everything that came before was received.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{AsyncEndpoint, client::ApiError};
    ///
    /// /// Waits 100 ms at most. Nothing is lost when the time is over first.
    /// async fn receive_soon(endpoint: &mut AsyncEndpoint) -> Result<bool, ApiError> {
    ///     match tokio::time::timeout(Duration::from_millis(100), endpoint.receive()).await {
    ///         Ok(received) => received.map(|message| println!("from {}", message.source())).map(|()| true),
    ///         Err(_elapsed) => Ok(false),
    ///     }
    /// }
    /// ```
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

    /// Returns the next report of messages that were not delivered, as [`Endpoint::take_undelivered`]. Never waits.
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
        self.endpoint.look_up(name, within).await
    }

    /// Gives the address back and waits until the node has taken it: the name is free when this returns.
    ///
    /// # Errors
    /// The node did not answer. The address is given back in any case.
    pub async fn unregister(mut self) -> Result<(), ApiError> {
        self.endpoint.take_leave().await
    }
}
