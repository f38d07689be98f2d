//! Protected payloads of an endpoint: sealed by the sender, and checked by a guard at the receiver.

use std::{io, time::Duration};

use sinew_runtime::{
    protection::{
        Came, Cause, Guard, OVERHEAD,
        raw::{NotSafeError, Protected},
    },
    tid::Tid,
    time::Time,
    wire::{Class, Header, Kind, Message, Payload},
};

use super::{ApiError, AsyncEndpoint, Endpoint, Received, stall_timeout::Limit};

impl Endpoint {
    /// Lets protected messages of type `P` from `source` control `output`, and lets `safe` put it into its
    /// safe state otherwise; see [`Guard::new`]. From now on [`receive`](Self::receive) returns only valid
    /// messages of that type from this sender, and only while the output is live; others are refused.
    ///
    /// The sender receives four echoes per maximum age of a message, while this endpoint is in `receive`, or
    /// calls it that often. A sender of protected payloads also receives echoes in `receive`. An echo that
    /// arrives before its first protected message is returned as a message of kind `sinew.echo`: ignore it.
    /// Without echoes each message counts as too old. An endpoint that reconnects with another address
    /// creates its guards anew: messages sealed for the former address are refused.
    ///
    /// From now on the endpoint makes no automatic direct link: the stop of the whole system reaches its outputs
    /// through the node. With [`DirectLinks::Always`](crate::DirectLinks::Always) it does not reach them.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use serde::{Deserialize, Serialize};
    /// use sinew::{NodeApi, Payload, Registration, protection::Protection, client::ApiError};
    ///
    /// #[derive(Serialize, Deserialize)]
    /// struct Torque { newton_metres: f32 }
    ///
    /// impl Payload for Torque {
    ///     const NAME: &'static str = "demo.torque";
    ///     // One each 100 ms or so.
    ///     const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(100)));
    /// }
    ///
    /// # let path = std::env::temp_dir().join(format!("sinew-doc-guard-{}.sock", std::process::id()));
    /// # let mut builder = sinew::Node::builder("knee");
    /// # builder = builder.configure(|config| {
    /// #     (config.lncl.socket, config.ndl.multicast, config.ndl.mdns_port) = (Some(path.clone()), None, None);
    /// # });
    /// # let _node = builder.start().expect("a node for this example");
    /// # let path = path.to_str().expect("a short path");
    /// let node = NodeApi::connect(path)?; // the `lncl.socket` of the node
    /// let mut control = node.register_transport_address(Registration::new().name("knee.control"))?;
    /// let mut drive = node.register_transport_address(Registration::new().name("knee.drive"))?;
    ///
    /// // The output here is a number. It is safe at first, and after every fault.
    /// let motor = 0.0_f32;
    /// let guard = drive.guard::<Torque, _>(control.tid(), motor, |motor, _why| *motor = 0.0).expect("a thread");
    ///
    /// let (mut moved, soon) = (false, Duration::from_millis(5));
    /// while !moved {
    ///     // The sender: sends a command, and receives the echoes.
    ///     control.send(drive.tid(), &Torque { newton_metres: 3.0 })?;
    ///     while control.receive(soon)?.is_some() {}
    ///     // The receiver: an operator has confirmed that arming is safe. Refused until enough valid commands
    ///     // have arrived.
    ///     let _ = guard.arm();
    ///     if let Some(received) = drive.receive(soon)? {
    ///         let torque = received.decode::<Torque>()?;
    ///         moved = guard.apply(|motor| *motor = torque.newton_metres).is_ok();
    ///     }
    /// }
    /// # Ok::<(), ApiError>(())
    /// ```
    ///
    /// # Errors
    /// The watchdog thread cannot be started or has no higher priority than this one, this source is guarded
    /// already, or the type defines no maximum age.
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        source: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        let ends = (self.absolute(source), self.tid);
        self.direct.keep_to_node();
        self.ends.guard::<P, O>(ends, Time::now(), output, safe)
    }

    /// The same for a type that is known at run time only.
    fn hold<O: Send + 'static>(
        &mut self,
        source: Tid,
        protected: Protected,
        output: (O, impl FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send + 'static),
    ) -> io::Result<Guard<O>> {
        let ends = (self.absolute(source), self.tid);
        self.direct.keep_to_node();
        self.ends.hold(ends, protected, Time::now(), output)
    }

    /// Sends a payload of a type that is known at run time only, in its envelope.
    async fn send_sealed(
        &mut self,
        to: Tid,
        (protected, class): (&Protected, Class),
        payload: &[u8],
    ) -> Result<(), ApiError> {
        // First: a payload that cannot be sent uses up no counter.
        self.check_length(payload.len().saturating_add(OVERHEAD))?;
        let limit = self.stall_timeout();
        self.prepare_send(limit)?;
        let sealed = self.ends.seal((self.tid, self.absolute(to)), protected, payload, Time::now())?;
        let mut header = Header::new(protected.kind, self.tid, to);
        header.class = class;
        self.dispatch(Message::new(header, sealed).into(), limit).await.map(drop)
    }

    /// Returns a message of the value, in its envelope if its type is protected.
    pub(super) fn typed<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        limit: Limit,
    ) -> Result<Message, ApiError> {
        if P::PROTECTION.is_some() {
            // The endpoint may get another address when it reconnects, and the message is sealed for the
            // current one.
            self.prepare_send(limit)?;
        }
        let ends = (self.tid, self.absolute(destination));
        Ok(self.ends.message(ends, destination, value, Time::now())?)
    }

    /// Returns the message if it is for the program.
    pub(super) fn received(&mut self, message: Message) -> Option<Received> {
        if message.header.kind == Kind::PING {
            // The echo has arrived: that is the answer.
            drop(Received::new(message));
            return None;
        }
        match self.ends.take(message) {
            Came::Plain(message) => Some(Received::new(message)),
            Came::Good(message) => Some(Received::guarded(message)),
            Came::Settled => None,
        }
    }

    /// Sends due echoes to senders of protected payloads. Returns when the next one is due.
    pub(super) async fn echo(&mut self, now: Time) -> Time {
        // Without a node no echo can be sent, which is reported elsewhere.
        while self.node.ended.is_none()
            && let Some(echo) = self.ends.echo(self.tid, now)
        {
            // An unreachable sender does not answer either: the watchdog detects that.
            let _ = self.dispatch(echo.into(), Limit::in_all(Duration::ZERO)).await;
        }
        self.ends.echo_due().filter(|_| self.node.ended.is_none()).unwrap_or(Time::MAX)
    }
}

impl AsyncEndpoint {
    /// Lets protected messages of type `P` from `source` control `output`, like [`Endpoint::guard`].
    ///
    /// # Errors
    /// The watchdog thread cannot be started or has no higher priority than this one, this source is guarded
    /// already, or the type defines no maximum age.
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        source: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        self.endpoint.guard::<P, O>(source, output, safe)
    }

    /// Same as [`guard`](Self::guard), for a binding to another language, which knows the type at run time only.
    ///
    /// # Errors
    /// The errors of [`guard`](Self::guard).
    #[doc(hidden)]
    pub fn hold<O: Send + 'static>(
        &mut self,
        source: Tid,
        protected: Protected,
        output: (O, impl FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send + 'static),
    ) -> io::Result<Guard<O>> {
        self.endpoint.hold(source, protected, output)
    }

    /// Sends a protected payload, for a binding to another language.
    ///
    /// # Errors
    /// The message was not sent.
    #[doc(hidden)]
    pub async fn send_sealed(
        &mut self,
        to: Tid,
        typed: (&Protected, Class),
        payload: &[u8],
    ) -> Result<(), ApiError> {
        self.endpoint.send_sealed(to, typed, payload).await
    }
}
