//! NodeAPI: for applications in processes of their own.
//!
//! A program connects to the node on its host through the node's unix socket, registers one or more transport addresses
//! (*endpoints*), sends and receives on them. There are three forms of one semantics, which `docs/SEMANTICS.md` says on one page:
//!
//! | your program is | its form | it begins with |
//! | --- | --- | --- |
//! | a plain thread, as of a control loop; no async runtime | [`Endpoint`] | [`NodeApi::register_transport_address`] |
//! | a task of tokio | [`AsyncEndpoint`] | [`NodeApi::register_transport_address_async`] |
//! | in C or C++ | `sinew.h`, `sinew.hpp` | `bindings/c/README.md` |
//!
//! # What you can do
//!
//! The names are the same in both forms of Rust. What is sent is a type of yours ([`payload!`](crate::payload)) or, with `_message`
//! in the name, raw bytes.
//!
//! | to | Rust | C |
//! | --- | --- | --- |
//! | get an address, with a name, and give it back (RegisterTransportAddress) | [`Registration`], [`unregister`](Endpoint::unregister) or drop | `sinew_register_transport_address`, `sinew_unregister` |
//! | find somebody by name, on any node | [`resolve`](Endpoint::resolve), [`Registration::requires`] | `sinew_resolve` |
//! | send, and not ask what becomes of it | [`send`](Endpoint::send) | `sinew_send_bytes` |
//! | be told what became of it (confirm) | [`message`](Endpoint::message)`(to, &value)`[`.confirmed(within)`](MessageBuilder::confirmed): one [`Outcome`](crate::Outcome) | `sinew_send_message_confirmed` |
//! | ask, and wait for the reply | [`ask`](MessageBuilder::ask) of a message, [`reply`](Endpoint::reply) | `sinew_ask`, `sinew_reply` |
//! | wait for room 200 us at most, or not at all | [`room_within`](MessageBuilder::room_within) of a message | `sinew_room_within` of a message |
//! | write a payload where it travels from, so that sending it copies nothing (loan: CreateMessage, SendMessage) | [`create_message`](Endpoint::create_message), [`LoanedMessage`], [`loaned`](Endpoint::loaned) | `sinew_create_message`, `sinew_send_message` |
//! | receive, with a deadline (ReceiveMessage) | [`receive`](Endpoint::receive), [`Received`] | `sinew_receive_message`, `sinew_settle_message` |
//! | be told what became of it at each member of a group | [`.confirmed_by_each(within)`](MessageBuilder::confirmed_by_each): a [`MemberOutcome`](crate::message::MemberOutcome) for each | `sinew_send_message_confirmed_by_each` |
//! | speak to many at once (groups) | [`join`](Endpoint::join), [`leave`](Endpoint::leave), [`Tid::group`](crate::Tid::group) | `sinew_join_group`, `sinew_group` |
//! | take only the newest value of a sensor | [`Class::Stream`](crate::Class), at the type | `SINEW_STREAM` |
//! | protect commands from end to end, and make an output safe without them ([`protection`](crate::protection)) | [`Endpoint::guard`] | not there: `bindings/c/README.md` |
//! | hear of nodes that come and go | [`Registration::subscribe`] | `events` of `sinew_options` |
//! | go on when the node was restarted | nothing to do; [`ApiError::Disconnected`] says so once | `SINEW_ERROR_DISCONNECTED` |
//! | the shortest way to another process | [`Registration::direct`], [`Registration::spin`] | `SINEW_DIRECT`, `spin_ns` |
//! | know what went wrong | [`ApiError`]: cause, place, remedy | `sinew_last_error` |
//!
//! # A thread
//!
//! ```
//! use std::time::Duration;
//!
//! use sinew::{NodeApi, Registration, client::ApiError};
//!
//! sinew::payload!("demo.joint_angle", Stream => struct JointAngle { degrees: f32 });
//! sinew::payload!("demo.limit" => struct Limit { degrees: f32 });
//!
//! # let path = std::env::temp_dir().join(format!("sinew-doc-thread-{}.sock", std::process::id()));
//! # let mut builder = sinew::Node::builder("knee");
//! # builder = builder.configure(|config| {
//! #     (config.lncl.socket, config.ndl.multicast, config.ndl.mdns_port) = (Some(path.clone()), None, None);
//! # });
//! # let _node = builder.start().expect("a node for this example");
//! # let path = path.to_str().expect("a short path");
//! let node = NodeApi::connect(path)?; // the `lncl.socket` of the node, as "/run/sinew/knee.sock"
//! let mut drive = node.register_transport_address(Registration::new().name("knee.drive"))?;
//! let mut sensor = node.register_transport_address(Registration::new().requires(["knee.drive"]))?;
//! let second = Duration::from_secs(1);
//!
//! // The sensor finds the drive, and sends it an angle; if there is no room now, it is skipped.
//! let to = sensor.resolve("knee.drive", second)?.expect("it is registered");
//! match sensor.message(to, &JointAngle { degrees: 12.5 }).room_within(Duration::ZERO).send() {
//!     Ok(()) | Err(ApiError::Stalled(_)) => {}
//!     Err(other) => return Err(other),
//! }
//!
//! // The drive receives it. The message counts as handled when `received` goes out of scope.
//! let received = drive.receive(second)?.expect("an angle");
//! assert_eq!(received.decode::<JointAngle>()?.degrees, 12.5);
//!
//! // The drive tells its limit to who has spoken, in bytes that lie where they are read.
//! let mut limit = drive.create_message(received.source(), sinew::message::Kind::named("demo.raw"), 4)?;
//! limit.copy_from_slice(&90_f32.to_le_bytes());
//! drive.loaned(limit).send()?;
//! assert_eq!(sensor.receive(second)?.expect("the limit").bytes(), 90_f32.to_le_bytes());
//! # Ok::<(), ApiError>(())
//! ```
//!
//! # A task
//!
//! ```
//! use std::time::Duration;
//!
//! use sinew::{NodeApi, Outcome, Registration, client::ApiError};
//!
//! sinew::payload!("demo.torque" => #[derive(Debug, PartialEq)] struct Torque { newton_metres: f32 });
//!
//! # let path = std::env::temp_dir().join(format!("sinew-doc-task-{}.sock", std::process::id()));
//! # let mut builder = sinew::Node::builder("hip");
//! # builder = builder.configure(|config| {
//! #     (config.lncl.socket, config.ndl.multicast, config.ndl.mdns_port) = (Some(path.clone()), None, None);
//! # });
//! # let _node = builder.start().expect("a node for this example");
//! # let path = path.to_str().expect("a short path");
//! # let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
//! # runtime.block_on(async {
//! let node = NodeApi::connect(path)?;
//! let mut drive = node.register_transport_address_async(Registration::new().name("hip.drive")).await?;
//! let mut control = node.register_transport_address_async(Registration::new()).await?;
//! let (second, to) = (Duration::from_secs(1), drive.tid());
//!
//! let driving = async {
//!     // The first is confirmed at the end of its scope, the second is a request.
//!     drop(drive.receive().await?);
//!     let request = drive.receive().await?;
//!     let Torque { newton_metres } = request.decode()?;
//!     drive.reply(&request, &Torque { newton_metres: newton_metres / 2.0 }).await
//! };
//! let controlling = async {
//!     let outcome = control.message(to, &Torque { newton_metres: 3.0 }).confirmed(second).await?;
//!     assert_eq!(outcome, Outcome::Delivered);
//!     control.message(to, &Torque { newton_metres: 3.0 }).ask::<Torque>(second).await
//! };
//! let (driven, given) = tokio::join!(driving, controlling);
//! driven?;
//! assert_eq!(given?, Torque { newton_metres: 1.5 });
//! # Ok::<(), ApiError>(())
//! # })?;
//! # Ok::<(), ApiError>(())
//! ```
//!
//! # C
//!
//! This is `bindings/c/examples/hello.c`, which the tests compile and run; `bindings/c/README.md` has the commands for it, and
//! `greeter.c` beside it is whom it asks. C++ has a wrapper with scopes and exceptions.
//!
//! ```c
//! /* Waits for who is called "greeter", says its name to it, and prints the reply:  hello SOCKET */
//! #include <sinew.h>
//! #include <stdio.h>
//! #include <stdlib.h>
//!
//! #define TEN_SECONDS UINT64_C(10000000000)
//!
//! static sinew_status check(sinew_status status)
//! {
//!     if (status < 0) {
//!         fprintf(stderr, "hello: %s\n", sinew_last_error());
//!         exit(EXIT_FAILURE);
//!     }
//!     return status;
//! }
//!
//! int main(int argc, char **argv)
//! {
//!     const sinew_text name = SINEW_TEXT("greeter");
//!     const sinew_options options = { .size = sizeof options, .required = &name, .required_count = 1,
//!                                     .deadline_ns = TEN_SECONDS };
//!     sinew_endpoint *endpoint;
//!     sinew_message message;
//!     sinew_received reply;
//!     sinew_tid greeter;
//!     check(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), &options, &endpoint));
//!     if (check(sinew_resolve(endpoint, name, TEN_SECONDS, &greeter)) == SINEW_NOTHING) {
//!         fprintf(stderr, "hello: the greeter was there, and has gone\n");
//!         return EXIT_FAILURE;
//!     }
//!     check(sinew_create_message(endpoint, greeter, sinew_kind_named(SINEW_TEXT("demo.name")), SINEW_CONTROL, 5, &message));
//!     memcpy(message.bytes, "Ankle", 5); /* in the memory from which it is read */
//!     check(sinew_ask(endpoint, &message, TEN_SECONDS, &reply, NULL)); /* whatever this returns, the message is gone */
//!     printf("%.*s\n", (int)reply.length, (const char *)reply.bytes);
//!     check(sinew_settle_message(endpoint, &reply, SINEW_DELIVERED));
//!     check(sinew_unregister(&endpoint));
//!     return EXIT_SUCCESS;
//! }
//! ```
//!
//! The protocol underneath is `docs/protocol/lncl.md`; it can be spoken from any language.

mod async_endpoint;
mod barrier;
mod builder;
mod direct;
mod endpoint;
mod error;
mod form;
mod inbox;
mod incoming;
mod link;
mod loan;
mod outgoing;
mod protected;
mod reactor;
mod received;
mod returning;
mod routes;
mod stall_timeout;
#[cfg(test)]
mod tests;
mod to_node;
mod undelivered;

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use sinew_runtime::{
    tid::AppAddress,
    time::Time,
    wire::{Kind, Payload},
};
use sinew_shm::BellKind;

pub use async_endpoint::AsyncEndpoint;
pub use barrier::{Barrier, BarrierError, Meet, Meeting};
pub use builder::{MessageBuilder, Value};
pub use endpoint::Endpoint;
pub use error::ApiError;
pub use link::Transport;
pub use loan::LoanedMessage;
pub use received::Received;
pub use sinew_shm::Spin;

use self::{
    link::{Believed, Greeting, Link, LinkOptions},
    returning::ReconnectPolicy,
};
use crate::lncl::payload::Register;

/// The way to the node of this host, at the path of its socket.
///
/// # Examples
///
/// ```no_run
/// use sinew::{NodeApi, Registration};
///
/// let node = NodeApi::connect("/run/sinew/knee.sock")?;
/// let mut sensor = node.register_transport_address(Registration::new().name("knee.sensor"))?;
/// println!("{} on node {}", sensor.tid(), sensor.node_name());
/// # Ok::<(), sinew::client::ApiError>(())
/// ```
#[derive(Clone, Debug)]
pub struct NodeApi {
    path: PathBuf,
    believed: Believed,
}

impl NodeApi {
    /// Looks whether a node listens at `path`: its configuration's `lncl.socket`.
    ///
    /// Whoever listens there is believed, of whatever user: the path says whose node is meant. So it is to be in a directory to which nobody
    /// but the node's user and root can write, as `/run/sinew`; in `/tmp` anybody can listen at it while the node is not there. Where a node
    /// of this process's own user is meant, [`connect_found`](Self::connect_found) believes no other one.
    ///
    /// # Errors
    /// Nobody listens there, or this user may not connect.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::{NodeApi, client::ApiError};
    ///
    /// match NodeApi::connect("/run/sinew/knee.sock") {
    ///     Ok(_node) => println!("the node is there"),
    ///     Err(error @ ApiError::NoNode { .. }) => eprintln!("{error}"), // with what to do
    ///     Err(other) => return Err(other),
    /// }
    /// # Ok::<(), ApiError>(())
    /// ```
    pub fn connect(path: impl AsRef<Path>) -> Result<Self, ApiError> {
        Self::within(path.as_ref(), Believed::Anybody, link::CONNECT)
    }

    /// The same for a path that nobody has named, as of a socket that was found in `/tmp`: a node of this process's own user, or of root, is
    /// believed, and nobody else. The kernel says who listens, and is asked for each connection, also of an endpoint that comes back: another
    /// user who listens there then is not told a word. It takes no longer than `within`, nor than the 2 s that
    /// [`connect`](Self::connect) takes at most.
    ///
    /// # Errors
    /// Nobody listens there, or a process of another user does, or this user may not connect; or it takes nobody in time.
    pub fn connect_found(path: impl AsRef<Path>, within: Duration) -> Result<Self, ApiError> {
        Self::within(path.as_ref(), Believed::OwnUser, within)
    }

    fn within(path: &Path, believed: Believed, within: Duration) -> Result<Self, ApiError> {
        link::connect(path, believed, Time::now() + within)?;
        Ok(Self { path: path.to_owned(), believed })
    }

    /// What is asked for, of whom this believes.
    const fn asking(&self, mut registration: Registration) -> Registration {
        registration.link.believed = self.believed;
        registration
    }

    /// Asks for a transport address, and waits until everything that the application requires is ready
    /// (the paper's RegisterTransportAddress).
    ///
    /// A process may have several addresses, one for each of its threads if it likes: up to 64 by default
    /// (`lncl.clients_per_process_max`).
    ///
    /// # Errors
    /// The node refused, in words; or the deadline passed. Nothing stays registered.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use sinew::{NodeApi, Registration};
    ///
    /// let node = NodeApi::connect("/run/sinew/knee.sock")?;
    /// // Returns when the drive is ready.
    /// let registration = Registration::new().requires(["knee.drive"]).deadline(Duration::from_secs(30));
    /// let mut sensor = node.register_transport_address(registration)?;
    /// # Ok::<(), sinew::client::ApiError>(())
    /// ```
    pub fn register_transport_address(&self, registration: Registration) -> Result<Endpoint, ApiError> {
        Endpoint::register(&self.path, self.asking(registration))
    }

    /// The same for a task of tokio, which is not blocked meanwhile. Dropped, it gives up within a tenth of a second.
    ///
    /// # Errors
    /// As [`register_transport_address`](Self::register_transport_address).
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::{NodeApi, Registration, client::ApiError};
    ///
    /// async fn log_all() -> Result<(), ApiError> {
    ///     let node = NodeApi::connect("/run/sinew/knee.sock")?;
    ///     let mut logger = node.register_transport_address_async(Registration::new()).await?;
    ///     logger.join("log").await?;
    ///     loop {
    ///         let received = logger.receive().await?;
    ///         println!("{} bytes from {}", received.bytes().len(), received.source());
    ///     }
    /// }
    /// ```
    pub async fn register_transport_address_async(
        &self,
        registration: Registration,
    ) -> Result<AsyncEndpoint, ApiError> {
        AsyncEndpoint::register(&self.path, self.asking(registration)).await
    }
}

/// What an application asks for when it registers.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
///
/// use sinew::{AppAddress, Registration, events::NodeEvent};
///
/// let registration = Registration::new()
///     .name("knee.sensor")
///     .fixed_address(AppAddress::new(0x1001))
///     .requires(["knee.drive", "camera ?2s"])
///     .subscribe::<NodeEvent>()
///     .deadline(Duration::from_secs(30));
/// ```
#[derive(Clone, Debug)]
pub struct Registration {
    register: Register,
    deadline: Duration,
    inbox_capacity: usize,
    link: LinkOptions,
    returning: ReconnectPolicy,
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
                stall_timeout: Duration::from_secs(1),
                bell: BellKind::Futex.into(),
                direct_ring_bytes: direct::RING_BYTES,
                believed: Believed::Anybody,
            },
            returning: ReconnectPolicy::Always,
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
    pub const fn fixed_address(mut self, address: AppAddress) -> Self {
        self.register.address = Some(address);
        self
    }

    /// Adds what must be met, on this node or any, before this application is ready; at most 64. Names, patterns, any of several,
    /// so many of them, with a limit to the wait or without: see [`Requirement`](crate::app::Requirement).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Registration, app::Requirement};
    ///
    /// let registration = Registration::new()
    ///     .requires(["hip.imu | knee.imu"])
    ///     .requires([Requirement::at_least(2, ["*.drive"])]);
    /// ```
    #[must_use]
    pub fn requires<N: Into<String>>(mut self, names: impl IntoIterator<Item = N>) -> Self {
        self.register.requires.extend(names.into_iter().map(Into::into));
        self
    }

    /// Subscribes to a layer's events: [`NodeEvent`](crate::events::NodeEvent), [`RequirementEvent`](crate::events::RequirementEvent).
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use sinew::{NodeApi, Payload, Registration, events::NodeEvent};
    ///
    /// let node = NodeApi::connect("/run/sinew/knee.sock")?;
    /// let mut monitor = node.register_transport_address(Registration::new().subscribe::<NodeEvent>())?;
    /// while let Some(received) = monitor.receive(Duration::from_secs(60))? {
    ///     if received.kind() == NodeEvent::KIND {
    ///         println!("{:?}", received.decode::<NodeEvent>()?);
    ///     }
    /// }
    /// # Ok::<(), sinew::client::ApiError>(())
    /// ```
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

    /// How many received messages wait in this process until no more are taken out of the socket or the rings. Default 256.
    /// While an answer is waited for it is more, see [`MessageBuilder::confirmed`].
    #[must_use]
    pub const fn inbox_capacity(mut self, messages: usize) -> Self {
        self.inbox_capacity = messages;
        self
    }

    /// How long a send waits while the node or, on a direct link, the peer takes nothing; whatever it takes begins that time
    /// anew. Default 1 s. For one send alone, and in all: [`MessageBuilder::room_within`].
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::Registration;
    ///
    /// let registration = Registration::new().stall_timeout(Duration::from_millis(50));
    /// ```
    #[must_use]
    pub const fn stall_timeout(mut self, stall_timeout: Duration) -> Self {
        self.link.stall_timeout = stall_timeout;
        self
    }

    /// Whether messages to and from other processes of the node may go directly, through rings of their own, where LNCL
    /// introduces the two and both want it; else all of them go through the node. A link is made at the first message to
    /// another process. It costs a ring of each side ([`direct_ring_bytes`](Self::direct_ring_bytes)), allocated at once, and some
    /// time in the call in which it is made.
    /// Default false; only with [`Transport::Ring`].
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Registration;
    ///
    /// // The shortest way to another process of the node, where that one registers with `direct`, too.
    /// let registration = Registration::new().name("knee.sensor").direct(true);
    /// ```
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
    pub const fn without_reconnect(mut self) -> Self {
        self.returning = ReconnectPolicy::Never;
        self
    }

    /// What carries the messages between this process and the node. Default [`Transport::Ring`].
    #[must_use]
    pub const fn transport(mut self, transport: Transport) -> Self {
        self.link.transport = transport;
        self
    }

    /// What the thread does before it sleeps at a ring: looks for a while, or sleeps at once. Looking keeps a CPU busy and
    /// saves the wake, which is most of a short message's way. A task ([`AsyncEndpoint`]) looks for 10 us at once, and between two
    /// such looks others of its runtime have their turn; so its runtime does not sleep meanwhile. Over plain sockets, and while
    /// the node is away, it does nothing. Default [`Spin::Off`].
    #[must_use]
    pub const fn spin(mut self, spin: Spin) -> Self {
        self.link.spin = spin;
        self
    }

    /// Registers, and blocks meanwhile. Each `look` it is looked whether that is still wanted.
    fn greet(&self, path: &Path, look: Duration, is_wanted: impl Fn() -> bool) -> Result<Link, ApiError> {
        let deadline = Time::now() + self.deadline;
        let mut greeting = Greeting::begin(path, &self.register, self.link.clone(), deadline)?;
        while is_wanted() {
            match greeting.wait(deadline.min(Time::now() + look)) {
                Ok(Some(link)) => return Ok(link),
                Ok(None) if Time::now() >= deadline => break,
                Ok(None) => {}
                // The node had waited for this side for its 2 s: that is the pace of it.
                Err(_) if greeting.may_begin_anew() && Time::now() < deadline => {
                    greeting = Greeting::begin(path, &self.register, self.link.clone(), deadline)?;
                }
                Err(why) => return Err(why),
            }
        }
        Err(match greeting.missing() {
            None => ApiError::NoAnswer(self.deadline),
            // The deadline was over before the node had looked.
            Some(missing) if missing.is_empty() => {
                ApiError::Waiting { missing: self.register.requires.clone(), waited: self.deadline }
            }
            Some(missing) => ApiError::Waiting { missing, waited: self.deadline },
        })
    }

    fn subscribe_kind(mut self, kind: Kind) -> Self {
        self.register.events.push(kind);
        self
    }
}
