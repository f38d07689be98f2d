//! The node of this host, at which endpoints register.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use sinew_runtime::time::Time;

use super::{
    ApiError, AsyncEndpoint, Endpoint, EventLoop, Registration,
    link::{self, ServerTrust},
};

/// The connection to the node of this host, at the path of its socket.
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
    pub(super) path: PathBuf,
    pub(super) server_trust: ServerTrust,
}

impl NodeApi {
    /// Checks whether a node listens at `path`: its configuration's `lncl.socket`.
    ///
    /// The listening process is trusted, regardless of its user: the path identifies the node. So the path
    /// must be in a directory to which only the node's user and root can write, such as `/run/sinew`. In
    /// `/tmp` any process can listen there while the node is down. If the node belongs to this process's own
    /// user, [`connect_trusted`](Self::connect_trusted) trusts no other user.
    ///
    /// # Errors
    /// No process listens there, or this user may not connect.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::{NodeApi, client::ApiError};
    ///
    /// match NodeApi::connect("/run/sinew/knee.sock") {
    ///     Ok(_node) => println!("the node is there"),
    ///     Err(error @ ApiError::NoNode { .. }) => eprintln!("{error}"), // with a remedy
    ///     Err(other) => return Err(other),
    /// }
    /// # Ok::<(), ApiError>(())
    /// ```
    pub fn connect(path: impl AsRef<Path>) -> Result<Self, ApiError> {
        Self::within(path.as_ref(), ServerTrust::AnyUser, link::CONNECT)
    }

    /// Like [`connect`](Self::connect), but trusts only a node of this process's own user, or of root. Use it
    /// for a path that was found by a search, for example of a socket in `/tmp`. The kernel reports the
    /// listening user for each connection, also of an endpoint that reconnects; another user that listens
    /// there receives nothing. Takes at most `within`, and at most the 2 s of [`connect`](Self::connect).
    ///
    /// # Errors
    /// No process listens there, a process of another user does, or this user may not connect; or the process
    /// accepts no connection in time.
    pub fn connect_trusted(path: impl AsRef<Path>, within: Duration) -> Result<Self, ApiError> {
        Self::within(path.as_ref(), ServerTrust::SameUserOrRoot, within)
    }

    fn within(path: &Path, server_trust: ServerTrust, within: Duration) -> Result<Self, ApiError> {
        link::connect(path, server_trust, Time::now() + within)?;
        Ok(Self { path: path.to_owned(), server_trust })
    }

    /// Returns the registration with the trust settings of this connection.
    const fn asking(&self, mut registration: Registration) -> Registration {
        registration.link.server_trust = self.server_trust;
        registration
    }

    /// Requests a transport address, and waits until all requirements of the application are ready (the
    /// paper's RegisterTransportAddress).
    ///
    /// A process may have several addresses, for example one per thread: up to 64 by default
    /// (`lncl.clients_per_process_max`).
    ///
    /// # Errors
    /// The node refused, with a reason; or the deadline passed. Nothing stays registered.
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

    /// The same for a tokio task, without blocking it. A dropped future abandons the registration within a
    /// tenth of a second.
    ///
    /// # Errors
    /// Same as [`register_transport_address`](Self::register_transport_address).
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

    /// The same for the event loop of another library, without tokio. The only threads are the short ones that make the
    /// rings of direct links. `events` is for this endpoint alone. Only the connection to the node's socket may block,
    /// up to 2 s, while its queue of new connections is full.
    ///
    /// # Errors
    /// Same as [`register_transport_address`](Self::register_transport_address).
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::pin::pin;
    ///
    /// use sinew::{NodeApi, Registration, client::EventLoop};
    ///
    /// let node = NodeApi::connect("/run/sinew/knee.sock")?;
    /// let events = EventLoop::new()?;
    /// let mut registering = pin!(node.register_transport_address_on(Registration::new(), events.clone()));
    /// // The event loop watches the descriptor of `events`, and polls again when it is readable.
    /// let _ = events.poll(registering.as_mut());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub async fn register_transport_address_on(
        &self,
        registration: Registration,
        events: EventLoop,
    ) -> Result<AsyncEndpoint, ApiError> {
        AsyncEndpoint::register_on(&self.path, self.asking(registration), events).await
    }
}
