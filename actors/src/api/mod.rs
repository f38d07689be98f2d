//! NodeAPI: for applications in processes of their own.
//!
//! A program connects to the node on its host through the node's unix socket, registers one or more transport
//! addresses, and sends and receives on them from plain threads; it needs no async runtime. Each [`Endpoint`] is one
//! address with one connection, and belongs to one thread at a time. A task of tokio has the same as [`AsyncEndpoint`], a
//! program in C or C++ through `bindings/c`: three forms, one semantics.
//!
//! | the paper's name | here |
//! | --- | --- |
//! | RegisterTransportAddress | [`NodeApi::register_transport_address`] |
//! | CreateMessage | [`Endpoint::create_message`] |
//! | SendMessage | [`Endpoint::send_message`], [`send_message_confirmed`](Endpoint::send_message_confirmed), [`ask_message`](Endpoint::ask_message); typed: [`Endpoint::send`], [`send_confirmed`](Endpoint::send_confirmed), [`ask`](Endpoint::ask) |
//! | ReceiveMessage | [`Endpoint::receive`] |
//!
//! ```no_run
//! use std::time::Duration;
//!
//! use serde::{Deserialize, Serialize};
//! use sinew::{NodeApi, Payload, Registration};
//!
//! #[derive(Serialize, Deserialize)]
//! struct JointAngle { degrees: f32 }
//!
//! impl Payload for JointAngle {
//!     const NAME: &'static str = "demo.joint_angle";
//! }
//!
//! let node = NodeApi::connect("/run/sinew/knee.sock")?;
//! let mut sensor = node.register_transport_address(Registration::new().name("knee.sensor"))?;
//! let drive = sensor.resolve("knee.drive", Duration::from_secs(1))?.expect("the drive is registered");
//! sensor.send(drive, &JointAngle { degrees: 12.5 })?;
//! while let Some(received) = sensor.receive(Duration::from_millis(10))? {
//!     println!("{} says something of kind {}", received.source(), received.kind());
//! }
//! # Ok::<(), sinew::ApiError>(())
//! ```
//!
//! The protocol underneath is `docs/protocol/lncl.md`; it can be spoken from any language.

mod async_endpoint;
mod direct;
mod endpoint;
mod error;
mod form;
mod inbox;
mod incoming;
mod lent;
mod link;
mod outgoing;
mod patience;
mod raw;
mod reactor;
mod received;
mod returning;
mod routes;
#[cfg(test)]
mod tests;
mod to_node;
mod untaken;
mod within;

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use sinew_runtime::{
    tid::AppAddress,
    time::Time,
    wire::{Kind, Payload},
};
use sinew_shm::{BellKind, Spin};

pub use async_endpoint::AsyncEndpoint;
pub use endpoint::Endpoint;
pub use error::ApiError;
pub use lent::LentMessage;
pub use link::Transport;
pub use received::Received;
pub use untaken::Untaken;

use self::{
    link::{Greeting, Link, LinkOptions},
    returning::Returning,
};
use crate::lncl::payload::Register;

/// The way to the node of this host, at the path of its socket.
#[derive(Clone, Debug)]
pub struct NodeApi {
    path: PathBuf,
}

impl NodeApi {
    /// Looks whether a node listens at `path`: its configuration's `lncl.socket`.
    ///
    /// # Errors
    /// Nobody listens there, or this user may not connect.
    pub fn connect(path: impl AsRef<Path>) -> Result<Self, ApiError> {
        let path = path.as_ref().to_owned();
        link::connect(&path)?;
        Ok(Self { path })
    }

    /// Asks for a transport address, and waits until everything that the application requires is ready
    /// (the paper's RegisterTransportAddress).
    ///
    /// A process may have up to 256 addresses, one for each of its threads if it likes.
    ///
    /// # Errors
    /// The node refused, in words; or the deadline passed. Nothing stays registered.
    pub fn register_transport_address(&self, registration: Registration) -> Result<Endpoint, ApiError> {
        Endpoint::register(&self.path, registration)
    }

    /// The same for a task of tokio, which is not blocked meanwhile. Dropped, it gives up within a tenth of a second.
    ///
    /// # Errors
    /// As [`register_transport_address`](Self::register_transport_address).
    pub async fn register_transport_address_async(
        &self,
        registration: Registration,
    ) -> Result<AsyncEndpoint, ApiError> {
        AsyncEndpoint::register(&self.path, registration).await
    }
}

/// What an application asks for when it registers.
#[derive(Clone, Debug)]
pub struct Registration {
    register: Register,
    deadline: Duration,
    inbox_capacity: usize,
    link: LinkOptions,
    returning: Returning,
}

impl Default for Registration {
    fn default() -> Self {
        Self {
            register: Register { pid: std::process::id(), ..Register::default() },
            deadline: Duration::from_secs(60),
            inbox_capacity: 256,
            link: LinkOptions {
                transport: Transport::Ring,
                spin: Spin::Off,
                patience: Duration::from_secs(1),
                bell: BellKind::Futex,
                direct_ring_bytes: direct::RING_BYTES,
            },
            returning: Returning::Always,
        }
    }
}

impl Registration {
    /// Asks for a dynamic address without a name, and requires nothing.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks for a name: 1 to 63 bytes without control characters, unique on the node.
    #[must_use]
    pub fn name(mut self, name: impl Into<String>) -> Self {
        self.register.name = Some(name.into());
        self
    }

    /// Asks for this address of the fixed range (`0x1000..=0x7fff_ffff`) instead of a dynamic one.
    #[must_use]
    pub const fn fixed(mut self, address: AppAddress) -> Self {
        self.register.address = Some(address);
        self
    }

    /// Adds names that must be ready, on this node or any, before this application is; at most 64.
    #[must_use]
    pub fn requires<N: Into<String>>(mut self, names: impl IntoIterator<Item = N>) -> Self {
        self.register.requires.extend(names.into_iter().map(Into::into));
        self
    }

    /// Subscribes to a layer's events: [`NodeEvent`](crate::NodeEvent), [`RequirementEvent`](crate::RequirementEvent).
    #[must_use]
    pub fn subscribe<P: Payload>(self) -> Self {
        self.subscribe_kind(P::KIND)
    }

    /// Names a payload type that the application sends or handles, so that a collision of its id with another type's
    /// is found at registration; at most 64.
    #[must_use]
    pub fn handles<P: Payload>(mut self) -> Self {
        self.register.kinds.push(P::NAME.to_owned());
        self
    }

    /// The same for a type that Rust does not know, by its name.
    #[must_use]
    pub fn handles_named(mut self, name: impl Into<String>) -> Self {
        self.register.kinds.push(name.into());
        self
    }

    /// How long the registration may take, waiting for what is required included. Default 60 s.
    #[must_use]
    pub const fn deadline(mut self, deadline: Duration) -> Self {
        self.deadline = deadline;
        self
    }

    /// How many received messages wait in this process at most, each class by itself. Default 256.
    #[must_use]
    pub const fn inbox_capacity(mut self, messages: usize) -> Self {
        self.inbox_capacity = messages;
        self
    }

    /// How long a send waits while the node or, on a direct link, the peer takes nothing; whatever it takes begins that time
    /// anew. Default 1 s. For one send alone, and in all: [`Endpoint::send_within`].
    #[must_use]
    pub const fn patience(mut self, patience: Duration) -> Self {
        self.link.patience = patience;
        self
    }

    /// Whether messages to and from other processes of the node may go directly, through rings of their own, where LNCL
    /// introduces the two and both want it; else all of them go through the node. A link is made at the first message to
    /// another process. It costs a ring of each side ([`direct_ring_bytes`](Self::direct_ring_bytes)), allocated at once, and some
    /// time in the call in which it is made.
    /// Default false; only with [`Transport::Ring`].
    #[must_use]
    pub const fn direct(mut self, direct: bool) -> Self {
        self.register.direct = direct;
        self
    }

    /// Bytes of this side's ring of each direct link, from 4 KiB to 1 MiB, rounded up to a power of two and never more than the
    /// node's `lncl.ring_bytes`. A message longer than half of it goes in pieces. All rings for direct links that a process
    /// makes take 64 MiB at most: beyond that messages go through the node, which a line of the log says once. Default 64 KiB.
    #[must_use]
    pub const fn direct_ring_bytes(mut self, bytes: usize) -> Self {
        self.link.direct_ring_bytes = if bytes > 1 << 20 { 1 << 20 } else { bytes };
        self
    }

    /// Does not register again when the connection has ended: then every call says [`ApiError::Closed`]. Without this the
    /// endpoint comes back by itself, under the same name, to the same address if it is free, and to its groups.
    #[must_use]
    pub const fn for_one_connection(mut self) -> Self {
        self.returning = Returning::Never;
        self
    }

    /// What carries the messages between this process and the node. Default [`Transport::Ring`].
    #[must_use]
    pub const fn transport(mut self, transport: Transport) -> Self {
        self.link.transport = transport;
        self
    }

    /// What the thread does before it sleeps at a ring: looks for a while, or sleeps at once. Looking keeps a CPU busy and
    /// saves the wake, which is most of a short message's way. Default [`Spin::Off`].
    #[must_use]
    pub const fn spin(mut self, spin: Spin) -> Self {
        self.link.spin = spin;
        self
    }

    /// Registers, and blocks meanwhile. Each `look` it is looked whether that is still wanted.
    fn greet(&self, path: &Path, look: Duration, is_wanted: impl Fn() -> bool) -> Result<Link, ApiError> {
        let deadline = Time::now() + self.deadline;
        let mut greeting = Greeting::begin(path, &self.register, self.link)?;
        while is_wanted() {
            if let Some(link) = greeting.wait(deadline.min(Time::now() + look))? {
                return Ok(link);
            }
            if Time::now() >= deadline {
                break;
            }
        }
        Err(if self.register.requires.is_empty() {
            ApiError::NoAnswer(self.deadline)
        } else {
            ApiError::Waiting { requires: self.register.requires.clone(), waited: self.deadline }
        })
    }

    fn subscribe_kind(mut self, kind: Kind) -> Self {
        self.register.events.push(kind);
        self
    }
}
