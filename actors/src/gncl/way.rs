//! One session with a peer: what is sent to it on the connections of a lane, and what was taken of its messages there.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use sinew_runtime::{
    outcome::Rejection,
    router::Outlet as _,
    tid::NodeAddress,
    time::Time,
    wire::{Kind, Message},
};
use tokio::net::TcpStream;

use super::{
    core::{Decline, write},
    peer::frame,
};
use crate::{
    config::NodeConfig,
    outlet::{LinkNumber, OutletLimits, Session, StreamOutlet},
    refusals::Refusals,
    session::{Ack, Arrival, Receiving, Window},
};

/// Bytes of frames for one peer that are kept unacknowledged, from which on further messages wait.
const WINDOW_BYTES: usize = 4 << 20;
/// Messages that are kept at most: half of what their numbers' 16 bits on the wire can tell apart.
const WINDOW_MESSAGES_MAX: usize = 1 << 15;
/// Frames of this layer itself that wait for a socket at most: more than a peer's ACKs, PINGs and PONGs ever are.
const WORDS_MAX: usize = 32;

/// The two nodes of a session.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ends {
    pub(super) here: NodeAddress,
    pub(super) node: NodeAddress,
}

/// A session with a peer.
pub(crate) struct Way {
    pub(crate) outlet: StreamOutlet<Arc<TcpStream>>,
    /// What was taken of its messages. Locked for a moment, never with another lock in hand.
    receiving: Mutex<Receiving>,
    ends: Ends,
    refusals: Arc<Refusals>,
}

impl Way {
    /// `now` numbers what is remembered: a later session with the same life of the peer has a larger number.
    pub(super) fn new(now: Time, ends: Ends, config: &NodeConfig, refusals: &Arc<Refusals>) -> Self {
        let limits = OutletLimits {
            queue_capacity: config.gncl.queue_capacity,
            queue_bytes: config.gncl.queue_bytes,
            unconfirmed_max: config.gncl.queue_capacity,
            payload_max: config.payload_max,
        };
        let messages = config.gncl.queue_capacity.min(WINDOW_MESSAGES_MAX);
        let window = Window { messages, bytes: WINDOW_BYTES };
        let memory = now.as_nanos();
        let void = frame(ends.here, ends.node, Kind::GNCL_VOID, Bytes::new()).header;
        let outlet = StreamOutlet::with_session(limits, Session::new(memory, window, void));
        let receiving = Mutex::new(Receiving::new(memory));
        Self { outlet, receiving, ends, refusals: refusals.clone() }
    }

    /// Its messages come on `link` from now on, and are taken from no other.
    pub(super) fn attach(&self, link: LinkNumber) {
        self.receiving().attach(link.number());
        self.acknowledge();
    }

    /// A message came on `link`. Returns whether it is to be taken.
    ///
    /// # Errors
    /// It is not the next one.
    pub(super) fn arrive(&self, link: LinkNumber, message: &Message) -> Result<bool, Decline> {
        let number = message.header.number;
        let arrival = self.receiving().arrive(link.number(), number, message.size());
        match arrival {
            Arrival::Take { ack_is_due } => {
                if ack_is_due {
                    self.acknowledge();
                }
                Ok(true)
            }
            Arrival::Fenced => Ok(false),
            Arrival::OutOfStep { expected } => Err(Decline::Violation(format!(
                "message {number} came where {} is the next one",
                expected as u16
            ))),
        }
    }

    /// The peer says what it has taken.
    pub(super) fn heard(&self, link: LinkNumber, ack: &Ack, now: Time) {
        let counts = self.receiving().heard(link.number(), ack.epoch);
        if counts && self.outlet.heard(link, ack, now) {
            self.refusals.count(
                now,
                "session begun anew",
                &format!(
                    "node {} does not know what it took; what it was sent ends as Unknown",
                    self.ends.node
                ),
            );
            self.acknowledge();
        }
    }

    /// Tells the peer what was taken, if it does not know.
    pub(super) fn acknowledge_if_owed(&self) {
        let owes = self.receiving().owes_ack();
        if owes {
            self.acknowledge();
        }
    }

    fn acknowledge(&self) {
        let epoch = self.outlet.epoch();
        let ack = self.receiving().ack(epoch);
        self.say(frame(self.ends.here, self.ends.node, Kind::GNCL_ACK, write(&ack)));
    }

    fn receiving(&self) -> MutexGuard<'_, Receiving> {
        self.receiving.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says something on the present connection, ahead of all that waits. Without one nobody needs it.
    pub(super) fn say(&self, message: Message) {
        if let Err(refused) = self.outlet.submit_urgent(message, WORDS_MAX)
            && refused.why == Rejection::QueueFull
        {
            let detail =
                format!("a frame of kind {} for node {}", refused.message.header.kind, self.ends.node);
            self.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }

    /// Sends a frame of this layer itself.
    pub(super) fn send(&self, message: Message) {
        if let Err(refused) = self.outlet.submit(message) {
            let kind = refused.message.header.kind;
            let detail = format!("a frame of kind {kind} for node {}: {}", self.ends.node, refused.why);
            self.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }
}
