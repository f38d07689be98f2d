//! Shutdown of a node: messages queued for its peers are sent first, and undelivered ones are reported. spec: GNCL-10

use std::time::Duration;

use actix::{ActorContext, AsyncContext, Context};
use serde::{Deserialize, Serialize};
use sinew_model::leave_reason::LeaveReason;
use sinew_runtime::{lock, tid::NodeAddress, time::Time, wire::Kind};

use super::{
    super::{
        core::{ConnectionId, Input, RefusalError, read, write},
        frame::frame,
        link::Mode,
    },
    Gncl, Linked,
};

/// The payload of a GOODBYE; empty if the node stops in order.
#[derive(Serialize, Deserialize)]
struct Goodbye {
    /// The reason why the node gave up.
    #[serde(default)]
    gave_up: Option<LeaveReason>,
}

/// Time in which peers can receive queued messages and disconnect when the node is stopped. Data that the
/// network cannot transfer in this time is lost.
pub const LINGER: Duration = Duration::from_secs(3);
/// Time for a peer that has sent GOODBYE on a connection to read the remaining frames and the last acknowledgement.
const LAST_ACK_TIMEOUT: Duration = Duration::from_secs(2);
/// Interval at which these conditions are polled.
const LINGER_POLL: Duration = Duration::from_millis(1);

impl Gncl {
    /// spec: GNCL-10
    pub(super) fn send_goodbye(&self, node: NodeAddress) {
        let peer = self.state.store.peer(node);
        // The last datagram values are sent before the GOODBYE, too.
        peer.iter().for_each(|peer| peer.retire_datagrams());
        // spec: GNCL-10
        let words =
            self.state.ctx.gave_up.get().map(|words| write(&Goodbye { gave_up: Some(words.clone()) }));
        for session in peer.iter().flat_map(|peer| peer.sessions()) {
            let words = words.clone().unwrap_or_default();
            session.outlet.finish(frame(self.state.ctx.node, node, Kind::GNCL_GOODBYE, words));
        }
    }

    /// Stops the node's links: sends GOODBYE behind all queued messages, and dials the peers that these are
    /// for. spec: GNCL-10
    pub(super) fn leave(&mut self, now: Time, ctx: &mut Context<Self>) {
        self.leave_deadline = Some(now + LINGER);
        let undelivered_to =
            self.state.store.peers().iter().filter(|peer| peer.left() > 0).map(|peer| peer.node).collect();
        self.input(Input::LeaveRequested { undelivered_to }, ctx);
        self.stop_accepting();
        ctx.run_interval(LINGER_POLL, |actor, ctx| {
            actor.stop_accepting();
            if actor.may_end(Time::now()) {
                ctx.stop();
            }
        });
    }

    /// Stops accepting connections, unless links still lack a connection.
    fn stop_accepting(&self) {
        if !self.core.expects_lane_connections() {
            self.state.store.close();
        }
    }

    /// Whether the layer may end: all peers have disconnected, or the time is over. A peer disconnects at the
    /// GOODBYE behind all queued messages.
    pub(super) fn may_end(&self, now: Time) -> bool {
        let is_through =
            || self.wires.values().all(|wire| wire.link.is_none()) && !self.core.may_still_link();
        self.leave_deadline.is_none_or(|at| at <= now) || is_through()
    }

    /// Gives up and reports the messages that have not arrived by now. spec: GNCL-10
    pub(super) fn abandon_undelivered(&self) {
        self.state.store.close();
        let lost = self.state.ctx.ports.members().map_or_else(Vec::new, |members| members.lost());
        for peer in self.state.store.peers() {
            // Messages between layers do not matter if this node or the peer stops.
            let messages = peer.left_of_applications();
            // A peer that has left or is lost accepts nothing more. That was reported, and this stop does not cause it.
            let is_gone = peer.has_left() || lost.iter().any(|lost| lost.node == peer.node);
            if messages > 0 && is_gone {
                sinew_runtime::log::debug!(node = %peer.node, messages, "the node stops, and these were for one that is gone");
            } else if messages > 0 {
                self.state.store.refusals.count(Time::now(), "not delivered", &peer.node);
                sinew_runtime::log::warn!(node = %peer.node, messages, "the node stops, and these have not arrived, as far as it knows");
            }
            peer.close();
        }
    }

    /// Keeps the reason of a linked peer that gave up, until its departure is reported.
    pub(super) fn record_leave_reason(
        &mut self,
        node: NodeAddress,
        payload: &[u8],
    ) -> Result<(), RefusalError> {
        if payload.is_empty() {
            return Ok(());
        }
        let Goodbye { gave_up } = read(payload)?;
        if let Some(words) = gave_up.filter(|_| self.core.is_known(node)) {
            self.leave_reasons.insert(node, words);
        }
        Ok(())
    }

    /// Processes a peer's GOODBYE on a connection. The connection ends when the acknowledgement of its
    /// messages is sent; the peer has [`LAST_ACK_TIMEOUT`] to read it. spec: GNCL-10
    pub(super) fn on_goodbye(&mut self, connection: ConnectionId, ctx: &mut Context<Self>) {
        if self.wires.get(&connection).is_some_and(|wire| wire.last_ack_pending) {
            // The peer repeats its GOODBYE; one wait is enough.
            return;
        }
        self.acknowledge_last(connection);
        self.leave_when_acknowledged(connection, Time::now() + LAST_ACK_TIMEOUT, ctx);
    }

    fn leave_when_acknowledged(&mut self, connection: ConnectionId, until: Time, ctx: &mut Context<Self>) {
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        let has_urgent_pending = wire.link.as_ref().is_some_and(Linked::has_urgent_pending);
        wire.last_ack_pending = has_urgent_pending && Time::now() < until;
        if wire.last_ack_pending {
            ctx.run_later(LINGER_POLL, move |actor, ctx| {
                actor.leave_when_acknowledged(connection, until, ctx)
            });
        } else {
            self.input(Input::GoodbyeReceived(connection), ctx);
        }
    }

    fn acknowledge_last(&self, connection: ConnectionId) {
        let Some(wire) = self.wires.get(&connection) else { return };
        if let Mode::Linked(inbound) | Mode::Relocate(inbound, _) = &*lock(&wire.mode) {
            inbound.acknowledge();
        }
    }
}
