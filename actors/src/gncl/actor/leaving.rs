//! A node that is stopped: what waits for its peers goes out first, and what does not is told. spec: GNCL-10

use std::time::Duration;

use actix::{ActorContext, AsyncContext, Context};
use serde::{Deserialize, Serialize};
use sinew_runtime::{tid::NodeAddress, time::Time, wire::Kind};

use super::{
    super::{
        core::{ConnectionId, Decline, Input, read, write},
        link::Mode,
        peer::frame,
    },
    Gncl, Linked,
};
use crate::{last_words::LastWords, stores::lock};

/// The payload of a GOODBYE; of a node that stops in order there is none.
#[derive(Serialize, Deserialize)]
struct Goodbye {
    /// Why the node gave up.
    #[serde(default)]
    gave_up: Option<LastWords>,
}

/// Time that peers have, when the node is stopped, to take what waits for them and hang up. Whoever has more to send
/// than goes over its network in this time loses it.
pub(crate) const LINGER: Duration = Duration::from_secs(3);
/// Time that a peer that has said goodbye on a connection has to read what is written there, and behind it that all was taken.
const LAST_WITHIN: Duration = Duration::from_secs(2);
/// How often it is looked whether they have.
const LINGER_LOOK: Duration = Duration::from_millis(1);

impl Gncl {
    /// spec: GNCL-10
    pub(super) fn say_goodbye(&self, node: NodeAddress) {
        let peer = self.stores.gncl.peer(node);
        // Behind the last values, too.
        peer.iter().for_each(|peer| peer.retire_datagrams());
        // spec: GNCL-10
        let words = self.stores.gave_up.get().map(|words| write(&Goodbye { gave_up: Some(words.clone()) }));
        for way in peer.iter().flat_map(|peer| peer.ways()) {
            let words = words.clone().unwrap_or_default();
            way.outlet.finish(frame(self.stores.node, node, Kind::GNCL_GOODBYE, words));
        }
    }

    /// The node is being stopped: says goodbye behind all that waits, and dials whom it is for. spec: GNCL-10
    pub(super) fn leave(&mut self, now: Time, ctx: &mut Context<Self>) {
        self.goes_at = Some(now + LINGER);
        let owed =
            self.stores.gncl.peers().iter().filter(|peer| peer.left() > 0).map(|peer| peer.node).collect();
        self.input(Input::LeaveRequested { owed }, ctx);
        self.close_door();
        ctx.run_interval(LINGER_LOOK, |actor, ctx| {
            actor.close_door();
            if actor.may_go(Time::now()) {
                ctx.stop();
            }
        });
    }

    /// Nobody connects any more, but for the connections that links still lack.
    fn close_door(&self) {
        if !self.core.expects_sides() {
            self.stores.gncl.close();
        }
    }

    /// Whether everybody has hung up, which a peer does at our GOODBYE, behind all that waited; or the time is over.
    pub(super) fn may_go(&self, now: Time) -> bool {
        let is_through =
            || self.wires.values().all(|wire| wire.link.is_none()) && !self.core.may_still_link();
        self.goes_at.is_none_or(|at| at <= now) || is_through()
    }

    /// What has not arrived by now does not, and says so. spec: GNCL-10
    pub(super) fn give_up(&self) {
        self.stores.gncl.close();
        for peer in self.stores.gncl.peers() {
            // What layers tell each other is of no use to a node that stops, too, or of this one.
            let messages = peer.left_of_applications();
            // One that has left, or is lost, takes nothing more: that was told, and it is no fault of this stop.
            let is_gone = peer.has_left()
                || lock(&self.stores.ndl).lost_nodes().iter().any(|(lost, _)| *lost == peer.node);
            if messages > 0 && is_gone {
                crate::log::debug!(node = %peer.node, messages, "the node stops, and these were for one that is gone");
            } else if messages > 0 {
                self.stores.gncl.refusals.count(Time::now(), "not delivered", &peer.node);
                crate::log::warn!(node = %peer.node, messages, "the node stops, and these have not arrived, as far as it knows");
            }
            peer.close();
        }
    }

    /// Keeps why a linked peer gave up, until it is told that it has left.
    pub(super) fn note_last_words(&mut self, node: NodeAddress, payload: &[u8]) -> Result<(), Decline> {
        if payload.is_empty() {
            return Ok(());
        }
        let Goodbye { gave_up } = read(payload)?;
        if let Some(words) = gave_up.filter(|_| self.core.knows(node)) {
            self.last_words.insert(node, words);
        }
        Ok(())
    }

    /// The peer has said all on a connection: it is left there when it has been sent what of that was taken, for which it has
    /// [`LAST_WITHIN`] to read. spec: GNCL-10
    pub(super) fn goodbye_came(&mut self, connection: ConnectionId, ctx: &mut Context<Self>) {
        if self.wires.get(&connection).is_some_and(|wire| wire.owes_the_last) {
            // It says so again and again, and is waited for once.
            return;
        }
        self.acknowledge_the_last(connection);
        self.leave_when_said(connection, Time::now() + LAST_WITHIN, ctx);
    }

    fn leave_when_said(&mut self, connection: ConnectionId, until: Time, ctx: &mut Context<Self>) {
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        let has_words_left = wire.link.as_ref().is_some_and(Linked::has_words_left);
        wire.owes_the_last = has_words_left && Time::now() < until;
        if wire.owes_the_last {
            ctx.run_later(LINGER_LOOK, move |actor, ctx| actor.leave_when_said(connection, until, ctx));
        } else {
            self.input(Input::GoodbyeReceived(connection), ctx);
        }
    }

    fn acknowledge_the_last(&self, connection: ConnectionId) {
        let Some(wire) = self.wires.get(&connection) else { return };
        if let Mode::Linked(inbound) | Mode::Moves(inbound, _) = &*lock(&wire.mode) {
            inbound.acknowledge();
        }
    }
}
