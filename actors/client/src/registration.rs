//! The settings with which an application registers, and the registration itself.

use std::{path::Path, time::Duration};

use sinew_protocol::payload::Register;
use sinew_runtime::{
    tid::AppAddress,
    time::Time,
    wire::{Kind, Payload, PayloadType},
};
use sinew_schema::Schema;
use sinew_shm::{BellKind, Spin};

use super::{
    ApiError, DirectLinks, Transport, direct,
    link::{Link, LinkOptions, RegistrationHandshake, ServerTrust, TypeOf, Use, UsedTypes},
    reconnect::ReconnectPolicy,
};

#[cfg(doc)]
use super::{AsyncEndpoint, MessageBuilder};

/// The settings with which an application registers.
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
    pub(super) register: Register,
    pub(super) deadline: Duration,
    pub(super) inbox_capacity: usize,
    pub(super) link: LinkOptions,
    pub(super) returning: ReconnectPolicy,
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
                direct_links: DirectLinks::default(),
                direct_ring_bytes: direct::RING_BYTES,
                server_trust: ServerTrust::AnyUser,
                types: UsedTypes::default(),
            },
            returning: ReconnectPolicy::Always,
        }
    }
}

impl Registration {
    /// Requests a dynamic address without a name, and requires nothing.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Requests a name: 1 to 63 bytes without control characters, unique on the node.
    #[must_use]
    pub fn name(mut self, name: impl Into<String>) -> Self {
        self.register.name = Some(name.into());
        self
    }

    /// Requests this address of the fixed range (`0x1000..=0x7fff_ffff`) instead of a dynamic one.
    #[must_use]
    pub const fn fixed_address(mut self, address: AppAddress) -> Self {
        self.register.address = Some(address);
        self
    }

    /// Adds a requirement that must be met, on this node or any, before this application is ready; at most
    /// 64. Names, patterns, any of several, counts, with or without a limit on the wait: see
    /// [`Requirement`](sinew_runtime::app::Requirement).
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

    /// Subscribes to a layer's events: `NodeEvent`,
    /// [`RequirementEvent`](sinew_runtime::app::RequirementEvent).
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

    /// Declares a payload type that the application handles; at most 64 types, together with those that it
    /// [sends](Self::sends).
    ///
    /// A collision of its id with another type's is found at registration. The node gets the structure of the
    /// type, and compares it with that of each sender: see [`Payload::MISMATCH`]. The structure is found once in
    /// a process, by a thread of low priority; until the node has it, messages are not compared.
    #[must_use]
    pub fn handles<P: Payload>(self) -> Self {
        self.uses::<P>(Use::Handled)
    }

    /// Declares a payload type that the application sends, in the same way. The nodes of its receivers compare
    /// it with theirs, and a recording has the structure. At most 64 types, together with those that it
    /// [handles](Self::handles).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Registration, payload};
    ///
    /// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
    ///
    /// let sensor = Registration::new().name("knee.sensor").sends::<Angle>();
    /// ```
    #[must_use]
    pub fn sends<P: Payload>(self) -> Self {
        self.uses::<P>(Use::Sent)
    }

    fn uses<P: Payload>(mut self, as_what: Use) -> Self {
        if !self.register.kinds.iter().any(|name| name == P::NAME) {
            self.register.kinds.push(P::NAME.to_owned());
        }
        // Without an entry the structure is not declared, and messages of the type are not compared.
        if let Some(of) = PayloadType::of::<P>() {
            self.link.types.add(TypeOf::Rust(of), as_what);
        }
        self
    }

    /// Names a type without a Rust definition that the application sends or handles, so that a collision of its id
    /// with another type's is found at registration. Its structure is not known, so its messages are not compared.
    #[must_use]
    pub fn handles_named(mut self, name: impl Into<String>) -> Self {
        self.register.kinds.push(name.into());
        self
    }

    /// Declares a type without a Rust definition that the application handles, with its structure. Like
    /// [`handles`](Self::handles), but for messages of another version of the type: they are logged, and the program
    /// decides on each.
    #[must_use]
    pub fn handles_structure(self, name: &str, structure: &Schema) -> Self {
        self.given(name, structure, Use::Handled)
    }

    /// Declares a type without a Rust definition that the application sends, with its structure. Like
    /// [`sends`](Self::sends).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Registration;
    /// use sinew_schema::{Field, Schema, Shape};
    ///
    /// let degrees = Field { name: "degrees".to_owned(), shape: Shape::F64, optional: false };
    /// let angle = Schema { root: Shape::Struct(vec![degrees]), types: Default::default() };
    /// let sensor = Registration::new().name("knee.sensor").sends_structure("demo.angle", &angle);
    /// ```
    #[must_use]
    pub fn sends_structure(self, name: &str, structure: &Schema) -> Self {
        self.given(name, structure, Use::Sent)
    }

    fn given(mut self, name: &str, structure: &Schema, as_what: Use) -> Self {
        if !self.register.kinds.iter().any(|known| known == name) {
            self.register.kinds.push(name.to_owned());
        }
        let given = TypeOf::Given { name: name.to_owned(), schema: structure.encode() };
        self.link.types.add(given, as_what);
        self
    }

    /// Sets the time limit of the registration, including the wait for requirements. Default 60 s.
    #[must_use]
    pub const fn deadline(mut self, deadline: Duration) -> Self {
        self.deadline = deadline;
        self
    }

    /// Sets how many received messages wait in this process before no more are taken out of the socket or the
    /// rings. Default 256. While an answer is awaited the limit is higher, see [`MessageBuilder::confirmed`].
    #[must_use]
    pub const fn inbox_capacity(mut self, messages: usize) -> Self {
        self.inbox_capacity = messages;
        self
    }

    /// Sets how long a send waits while the node or, on a direct link, the peer reads nothing; each read
    /// restarts that time. Default 1 s. For a limit on the total wait of one send:
    /// [`MessageBuilder::room_within`].
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

    /// Sets when this endpoint has direct links with other processes of the node. A direct link is a pair of
    /// rings that bypass the node, if LNCL introduces the two and both allow it; otherwise their messages go
    /// through the node. It costs a ring of each side ([`direct_ring_bytes`](Self::direct_ring_bytes)), which
    /// another thread of the process makes. Default [`DirectLinks::Automatic`]; only with [`Transport::Ring`].
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Registration, client::DirectLinks};
    ///
    /// // The link is there before the control loop begins, if one message is sent before that.
    /// let registration = Registration::new().name("knee.sensor").direct(DirectLinks::Always);
    /// ```
    #[must_use]
    pub const fn direct(mut self, links: DirectLinks) -> Self {
        self.link.direct_links = links;
        self
    }

    /// Sets the bytes of this side's ring of each direct link, from 4 KiB to 1 MiB, rounded up to a power of
    /// two and at most the node's `lncl.ring_bytes`. A message longer than half of it is sent in pieces. All
    /// rings for direct links of a process take at most 64 MiB: beyond that messages go through the node,
    /// which is logged once. Default 64 KiB.
    #[must_use]
    pub const fn direct_ring_bytes(mut self, bytes: usize) -> Self {
        self.link.direct_ring_bytes = if bytes > 1 << 20 { 1 << 20 } else { bytes };
        self
    }

    /// Disables the reconnection when the connection has ended: then every call returns [`ApiError::Closed`].
    /// By default the endpoint reconnects automatically, under the same name, to the same address if it is
    /// free, and to its groups.
    #[must_use]
    pub const fn without_reconnect(mut self) -> Self {
        self.returning = ReconnectPolicy::Never;
        self
    }

    /// Sets the transport between this process and the node. Default [`Transport::Ring`].
    #[must_use]
    pub const fn transport(mut self, transport: Transport) -> Self {
        self.link.transport = transport;
        self
    }

    /// Sets whether the thread spins before it sleeps at a ring. Spinning keeps a CPU busy and saves the
    /// wake-up, which is most of a short message's latency. A task ([`AsyncEndpoint`]) spins for 10 us at a
    /// time, and other tasks of its runtime run in between; so its runtime does not sleep meanwhile. Over
    /// plain sockets, and while the node is down, it has no effect. Default [`Spin::Off`].
    #[must_use]
    pub const fn spin(mut self, spin: Spin) -> Self {
        self.link.spin = spin;
        self
    }

    /// Registers, and blocks meanwhile. Every `check_interval` it checks whether the registration is still
    /// wanted.
    pub(super) fn register_at(
        &self,
        path: &Path,
        check_interval: Duration,
        is_wanted: impl Fn() -> bool,
    ) -> Result<Link, ApiError> {
        let deadline = Time::now() + self.deadline;
        let mut handshake = RegistrationHandshake::begin(path, &self.register, self.link.clone(), deadline)?;
        while is_wanted() {
            match handshake.wait(deadline.min(Time::now() + check_interval)) {
                Ok(Some(link)) => return Ok(link),
                Ok(None) if Time::now() >= deadline => break,
                Ok(None) => {}
                // The node had waited its 2 s for this side, so the retry is paced.
                Err(_) if handshake.may_restart() && Time::now() < deadline => {
                    handshake =
                        RegistrationHandshake::begin(path, &self.register, self.link.clone(), deadline)?;
                }
                Err(why) => return Err(why),
            }
        }
        Err(self.late(handshake))
    }

    /// Returns the error for a registration that is past its deadline.
    pub(super) fn late(&self, handshake: RegistrationHandshake) -> ApiError {
        match handshake.missing() {
            None => ApiError::NoAnswer(self.deadline),
            // The deadline passed before the node had checked the requirements.
            Some(missing) if missing.is_empty() => {
                ApiError::Waiting { missing: self.register.requires.clone(), waited: self.deadline }
            }
            Some(missing) => ApiError::Waiting { missing, waited: self.deadline },
        }
    }

    fn subscribe_kind(mut self, kind: Kind) -> Self {
        self.register.events.push(kind);
        self
    }
}
