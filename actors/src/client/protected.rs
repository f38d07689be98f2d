//! Protected payloads of an endpoint: sealed where they are sent, and let through by a guard where they are received.

use std::{io, time::Duration};

use sinew_runtime::{
    protection::{Came, Cause, Guard},
    tid::Tid,
    time::Time,
    wire::{Kind, Message, Payload},
};

use super::{ApiError, AsyncEndpoint, Endpoint, Received, stall_timeout::Limit};

impl Endpoint {
    /// Has `output` moved by what `source` sends of type `P`, which is protected, and made safe by `safe` when that is not as it has
    /// to be; see [`Guard::new`]. From now on [`receive`](Self::receive) returns of that type only messages of this sender's that are good, and
    /// that come while the output is live; others are refused.
    ///
    /// The sender hears an echo four times in the greatest age of a message, while this endpoint is in `receive`, or calls it that often;
    /// whoever sends protected payloads hears echoes there, too (one that comes before it has sent the first is received: a message of kind `sinew.echo`, to be left alone). Without them each message is too old. An endpoint that came back
    /// to another address than it had makes its guards anew: what is sealed for the former one is refused.
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
    /// // What is moved here is a number. It is safe at first, and whenever something is wrong.
    /// let motor = 0.0_f32;
    /// let guard = drive.guard::<Torque, _>(control.tid(), motor, |motor, _why| *motor = 0.0).expect("a thread");
    ///
    /// let (mut moved, soon) = (false, Duration::from_millis(5));
    /// while !moved {
    ///     // The one: sends, and hears what it has to quote.
    ///     control.send(drive.tid(), &Torque { newton_metres: 3.0 })?;
    ///     while control.receive(soon)?.is_some() {}
    ///     // The other one: somebody has seen that it is safe to. Refused until enough good ones have come.
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
    /// The thread that keeps the watchdogs cannot be started or is not more urgent than this one, this is guarded already, or the type bears no age at all.
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        source: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        let ends = (self.absolute(source), self.tid);
        self.ends.guard::<P, O>(ends, Time::now(), output, safe)
    }

    /// A message of the value, in its envelope if its type is protected.
    pub(super) fn typed<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        limit: Limit,
    ) -> Result<Message, ApiError> {
        if P::PROTECTION.is_some() {
            // It may come back to another address, and it is sealed for the one that it has.
            self.be_ready(limit)?;
        }
        let ends = (self.tid, self.absolute(destination));
        Ok(self.ends.message(ends, destination, value, Time::now())?)
    }

    /// What of a message is for the program.
    pub(super) fn received(&mut self, message: Message) -> Option<Received> {
        if message.header.kind == Kind::PING {
            // It has come to it: that is the answer.
            drop(Received::new(message));
            return None;
        }
        match self.ends.take(message) {
            Came::Plain(message) => Some(Received::new(message)),
            Came::Good(message) => Some(Received::guarded(message)),
            Came::Settled => None,
        }
    }

    /// Tells senders of protected payloads what they have to quote, where that is due; when the next one is.
    pub(super) async fn echo(&mut self, now: Time) -> Time {
        // Without a node nobody can be told, which is said elsewhere.
        while self.ended.is_none()
            && let Some(echo) = self.ends.echo(self.tid, now)
        {
            // Whoever cannot be reached does not answer either: the watchdog knows.
            let _ = self.dispatch(echo.into(), Limit::in_all(Duration::ZERO)).await;
        }
        self.ends.echo_due().filter(|_| self.ended.is_none()).unwrap_or(Time::MAX)
    }
}

impl AsyncEndpoint {
    /// Has `output` moved by what `source` sends of type `P`, as [`Endpoint::guard`].
    ///
    /// # Errors
    /// The thread that keeps the watchdogs cannot be started or is not more urgent than this one, this is guarded already, or the type bears no age at all.
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        source: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        self.endpoint.guard::<P, O>(source, output, safe)
    }
}
