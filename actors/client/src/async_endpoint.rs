//! NodeAPI for tokio tasks: the same endpoint, with waits that yield the thread.

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
    reactor::Reactor,
    reconnect::WANTED_CHECK,
    wait_mode::WaitMode,
};

/// A registered transport address for a task: an [`Endpoint`] with calls that await instead of blocking. The
/// semantics are identical, because both share one implementation. Created by
/// [`NodeApi::register_transport_address_async`](super::NodeApi::register_transport_address_async).
///
/// Any of its futures may be dropped at any time. A dropped [`receive`](Self::receive) loses no message. A
/// dropped send has sent its message, sends it with the next call, or has not sent it; which one is not
/// reported. An answer that is not awaited any more is dropped.
///
/// The endpoint belongs to the runtime in which it was registered, with I/O and time enabled. A wait costs
/// one wake of the task's thread; the endpoint has no thread of its own. Only a registration, and a
/// reconnection to a node, use a thread of the runtime's blocking pool. With a direct link the endpoint polls
/// every 20 ms, as a waiting thread does. While a direct link is full, the peer's reads wake it.
///
/// One that is registered on the event loop of another library belongs to that [`EventLoop`](super::EventLoop), and
/// needs no runtime.
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
            let link = registration.register_at(&path, WANTED_CHECK, || is_wanted.strong_count() > 0);
            link.map(|link| (path, registration, link))
        });
        let ended = |why: String| ApiError::Closed(why);
        let registered = registered.await.map_err(|why| ended(why.to_string()))?;
        let (path, registration, link) = registered?;
        let reactor = Reactor::new(&link.reader, &link.writer).map_err(|why| ended(why.to_string()))?;
        drop(wanted);
        let wait_mode = WaitMode::Async(Box::new(reactor));
        Ok(Self { endpoint: Endpoint::new(&path, registration, link, wait_mode) })
    }

    /// Returns the registered address.
    #[must_use]
    pub const fn tid(&self) -> Tid {
        self.endpoint.tid()
    }

    /// Returns the transport of the messages: the requested one, or the socket if the system or the node has
    /// no rings.
    #[must_use]
    pub fn transport(&self) -> Transport {
        self.endpoint.transport()
    }

    /// Returns the name of the node.
    #[must_use]
    pub fn node_name(&self) -> &str {
        self.endpoint.node_name()
    }

    /// Returns the longest payload that the node accepts, in bytes.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.endpoint.payload_max()
    }

    /// Returns how often this endpoint has registered, like [`Endpoint::registrations`].
    #[must_use]
    pub const fn registrations(&self) -> u64 {
        self.endpoint.registrations()
    }

    /// Lends writable memory for a raw payload, like [`Endpoint::create_message`]. Never waits.
    ///
    /// # Errors
    /// The payload is longer than the node accepts, `kind` is one of the layers' own, or another message is
    /// lent.
    pub fn create_message(
        &mut self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<LoanedMessage, ApiError> {
        self.endpoint.create_message(destination, kind, length)
    }

    /// Sends a value with the settings of its type, like [`Endpoint::send`].
    ///
    /// # Errors
    /// The message was not sent.
    pub async fn send<'a, P: Payload>(
        &mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> Result<(), ApiError> {
        self.endpoint.send_as(Value::new(to, value), SendTerms::PLAIN).await
    }

    /// Returns a builder for a value with other settings than those of its type, like [`Endpoint::message`]:
    /// see [`MessageBuilder`].
    pub fn message<'a, P: Payload>(
        &'a mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> MessageBuilder<'a, Self, Value<'a, P>> {
        MessageBuilder::new(self, Value::new(to, value))
    }

    /// The same for memory that [`create_message`](Self::create_message) lent, like [`Endpoint::loaned`].
    pub const fn loaned(&mut self, message: LoanedMessage) -> MessageBuilder<'_, Self, LoanedMessage> {
        MessageBuilder::new(self, message)
    }

    /// Answers a request, like [`Endpoint::reply`].
    ///
    /// # Errors
    /// The request does not ask for a reply, or the reply was not sent.
    pub async fn reply<R: Payload>(&mut self, request: &Received, value: &R) -> Result<(), ApiError> {
        self.endpoint.reply_as(request, Value::new(request.source(), value), SendTerms::PLAIN).await
    }

    /// Waits for a message, in the order of [`Endpoint::receive`]. The future may be dropped at any time
    /// without losing a message. When the connection has ended, the call returns [`ApiError::Disconnected`]
    /// once; later calls also wait for the node's return. Messages that have arrived already count for
    /// tokio's budget: other tasks of the thread run between them.
    ///
    /// # Errors
    /// The connection has ended, and all earlier messages were received.
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
        // Messages that have arrived already need no wait. A task that is sent more than it handles would
        // otherwise occupy its thread.
        coop::consume_budget().await;
        loop {
            // There is always a later time.
            if let Some(received) = self.endpoint.receive_until(Time::MAX, Time::now()).await? {
                return Ok(received);
            }
        }
    }

    /// Returns the next report of messages that were not delivered, like [`Endpoint::take_undelivered`].
    /// Never waits.
    pub fn take_undelivered(&mut self) -> Option<Undelivered> {
        self.endpoint.take_undelivered()
    }

    /// Joins the group called `name`, like [`Endpoint::join`].
    ///
    /// # Errors
    /// The endpoint is a member of 256 groups already, or its user or node has the maximum of memberships
    /// ([`ApiError::TooManyGroups`]); the node's access list does not allow its user to join this group
    /// ([`ApiError::Ended`], `NotAllowed`); or the node did not answer.
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

    /// Removes a value that the node retains for later members of a group, like [`Endpoint::clear_retained`].
    ///
    /// # Errors
    /// The node does not accept the message.
    pub async fn clear_retained<P: Payload>(&mut self, name: &str) -> Result<(), ApiError> {
        self.endpoint.send_clear::<P>(name).await
    }

    /// Returns the TID of the application that has `name` now, on any node, or `None`.
    ///
    /// # Errors
    /// The node did not answer `within` this time.
    pub async fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        self.endpoint.look_up(name, within).await
    }

    /// Reports to the node that this program is ready, like [`Endpoint::ready`].
    ///
    /// # Errors
    /// The node does not accept the message.
    pub async fn ready(&mut self) -> Result<(), ApiError> {
        self.endpoint.send_ready().await
    }

    /// Releases the address and waits for the node's confirmation: the name is free when this returns.
    ///
    /// # Errors
    /// The node did not answer. The address is released in any case.
    pub async fn unregister(mut self) -> Result<(), ApiError> {
        self.endpoint.take_leave().await
    }
}
