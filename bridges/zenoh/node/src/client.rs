//! The client of a node: registration, messages, outcomes and replies.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use sinew::{
    AppAddress, AsyncEndpoint, NodeApi, Registration, Tid,
    client::{ApiError, DirectLinks, LoanedMessage, MessageBuilder, Received},
    events::{DirectoryEvent, NodeEvent, Undelivered},
    message::{Class, Kind, MemberOutcome, Outcome},
    protection::raw::Protected,
};

use crate::seen::Seen;

/// Maximum number of types that a registration names. Further ones are sent and received all the same.
const NAMED_MAX: usize = 64;
/// Maximum number of names with a kept address. At more names all are looked up again.
const ADDRESSES_MAX: usize = 1_024;
/// Time after which the address of a name is looked up again, if no change of the directory came before.
const ADDRESS_KEPT: Duration = Duration::from_millis(500);
/// Time limit for the node's answer to a name.
const NAMED_WITHIN: Duration = Duration::from_secs(1);

/// The settings with which a client registers.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// The name of the application; `None`: it has none.
    pub name: Option<String>,
    /// A fixed address, as guards of protected commands name their sender; `None`: the node chooses one.
    pub address: Option<AppAddress>,
    /// Names of the types that it sends or receives. The node finds collisions of their ids.
    pub types: Vec<String>,
    /// Whether it receives changes of the directory and of nodes.
    pub has_events: bool,
    /// Time limit of the registration.
    pub within: Duration,
}

/// A destination.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Destination {
    /// An address: of an application, a group or all applications.
    Tid(Tid),
    /// The application that has this name at the time of the message.
    Name(String),
}

/// A message to send.
#[derive(Clone, Copy, Debug)]
pub struct Outgoing<'m> {
    /// Its destination.
    pub to: &'m Destination,
    /// The type of its payload.
    pub kind: Kind,
    /// Its class.
    pub class: Class,
    /// Its payload, as the type has it on the wire: MessagePack.
    pub payload: &'m [u8],
    /// Time after which it expires where it waits; `None`: never.
    pub expires_after: Option<Duration>,
}

/// A registered client. One operation runs at a time.
#[derive(Debug)]
pub struct NodeClient {
    pub(crate) endpoint: AsyncEndpoint,
    /// The addresses of names, and when each was looked up.
    addresses: BTreeMap<String, (Tid, Instant)>,
}

impl NodeClient {
    /// Registers at a node.
    ///
    /// # Errors
    /// The node refused, or did not answer in time.
    pub async fn register(node: &NodeApi, options: &Options) -> Result<Self, ApiError> {
        let mut registration = Registration::new().deadline(options.within).direct(DirectLinks::Never);
        if let Some(name) = &options.name {
            registration = registration.name(name);
        }
        if let Some(address) = options.address {
            registration = registration.fixed_address(address);
        }
        for name in options.types.iter().take(NAMED_MAX) {
            registration = registration.handles_named(name);
        }
        if options.has_events {
            registration = registration.subscribe::<NodeEvent>().subscribe::<DirectoryEvent>();
        }
        let endpoint = node.register_transport_address_async(registration).await?;
        Ok(Self { endpoint, addresses: BTreeMap::new() })
    }

    /// Returns its address. It may change when the node restarts.
    #[must_use]
    pub const fn tid(&self) -> Tid {
        self.endpoint.tid()
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

    /// Joins a group: from now on its messages are received here.
    ///
    /// # Errors
    /// The node or its access list refused, or the node did not answer.
    pub async fn join(&mut self, group: &str) -> Result<(), ApiError> {
        self.endpoint.join(group).await
    }

    /// Waits for a message or an event. The future may be dropped at any time without losing one. After the end of
    /// the connection one call returns [`ApiError::Disconnected`]; later ones wait for the node's return.
    ///
    /// # Errors
    /// The connection has ended.
    pub async fn receive(&mut self) -> Result<Seen, ApiError> {
        let seen = Seen::of(self.endpoint.receive().await?);
        if let Seen::Directory(DirectoryEvent::Is(entry)) = &seen {
            self.addresses.remove(&entry.name);
        }
        if let Seen::Directory(DirectoryEvent::Gone { name, .. }) = &seen {
            self.addresses.remove(name);
        }
        Ok(seen)
    }

    /// Returns the next report of unconfirmed messages that were not delivered. Never waits.
    pub fn take_undelivered(&mut self) -> Option<Undelivered> {
        self.endpoint.take_undelivered()
    }

    /// Returns the address of a destination now.
    ///
    /// # Errors
    /// No application has the name, or the node did not answer.
    pub async fn find(&mut self, to: &Destination) -> Result<Tid, ApiError> {
        let name = match to {
            Destination::Tid(tid) => return Ok(*tid),
            Destination::Name(name) => name,
        };
        if let Some((tid, found)) = self.addresses.get(name)
            && found.elapsed() < ADDRESS_KEPT
        {
            return Ok(*tid);
        }
        self.addresses.remove(name);
        let found = self.endpoint.resolve(name, NAMED_WITHIN).await?;
        let tid = found.ok_or_else(|| ApiError::UnknownName { name: name.clone(), nearest: Vec::new() })?;
        if self.addresses.len() >= ADDRESSES_MAX {
            self.addresses.clear();
        }
        self.addresses.insert(name.clone(), (tid, Instant::now()));
        Ok(tid)
    }

    /// Sends without a confirmation. A message that is rejected later is reported by
    /// [`take_undelivered`](Self::take_undelivered).
    ///
    /// # Errors
    /// The message was not sent.
    pub async fn send(&mut self, message: &Outgoing<'_>) -> Result<(), ApiError> {
        self.builder(message).await?.send().await
    }

    /// Sends, and waits for the outcome of each receiver, at most `within` this time.
    ///
    /// # Errors
    /// The message was not sent, or no member of a group has it.
    pub async fn confirm(
        &mut self,
        message: &Outgoing<'_>,
        within: Duration,
    ) -> Result<Vec<MemberOutcome>, ApiError> {
        let outcomes = self.builder(message).await?.confirmed_by_each(within).await;
        // An application that has another address now is found by the next message.
        if let Destination::Name(name) = message.to
            && !matches!(&outcomes, Ok(all) if all.iter().all(|one| one.outcome == Outcome::Delivered))
        {
            self.addresses.remove(name);
        }
        outcomes
    }

    /// Sends a request, and waits for the reply, at most `within` this time.
    ///
    /// # Errors
    /// There is no reply, and why.
    pub async fn ask(&mut self, message: &Outgoing<'_>, within: Duration) -> Result<Received, ApiError> {
        let reply = self.builder(message).await?.ask_raw(within).await;
        if let Destination::Name(name) = message.to
            && reply.is_err()
        {
            self.addresses.remove(name);
        }
        reply
    }

    /// Answers a request that this client received.
    ///
    /// # Errors
    /// The message requests no reply, or the reply was not sent.
    pub async fn reply(&mut self, request: &Received, kind: Kind, payload: &[u8]) -> Result<(), ApiError> {
        let mut lent = self.endpoint.create_message(request.source(), kind, payload.len())?;
        lent.copy_from_slice(payload);
        self.endpoint.loaned(lent).reply_to(request).await
    }

    /// Sends a protected payload: sealed for its receiver, with a counter and the newest echo. Echoes arrive while
    /// this client is in [`receive`](Self::receive).
    ///
    /// # Errors
    /// The message was not sent, or its destination is not one application.
    pub async fn send_protected(
        &mut self,
        message: &Outgoing<'_>,
        protected: &Protected,
    ) -> Result<(), ApiError> {
        let to = self.find(message.to).await?;
        self.endpoint.send_sealed(to, (protected, message.class), message.payload).await
    }

    /// Releases the address, and waits for the node's confirmation.
    ///
    /// # Errors
    /// The node did not answer. The address is released in any case.
    pub async fn unregister(self) -> Result<(), ApiError> {
        self.endpoint.unregister().await
    }

    async fn builder(
        &mut self,
        message: &Outgoing<'_>,
    ) -> Result<MessageBuilder<'_, AsyncEndpoint, LoanedMessage>, ApiError> {
        let to = self.find(message.to).await?;
        let mut lent = self.endpoint.create_message(to, message.kind, message.payload.len())?;
        lent.copy_from_slice(message.payload);
        let builder = self.endpoint.loaned(lent).class(message.class);
        Ok(match message.expires_after {
            Some(time) => builder.expires_after(time),
            None => builder,
        })
    }
}
