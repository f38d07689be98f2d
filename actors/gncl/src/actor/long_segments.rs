//! Connections over which long packets do not arrive: they are replaced by connections with shorter segments.

use std::sync::Arc;

use actix::{AsyncContext, Context, StreamHandler};
use futures_util::stream;
use sinew_model::notifications::claim_notifications;
use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use super::Gncl;
use crate::{core::ConnectionId, segments};

/// A new limit of the segment length exists.
pub(super) struct LimitMade;

impl Gncl {
    /// Follows the limits that datagrams measure.
    pub(super) fn watch_limits(&self, ctx: &mut Context<Self>) {
        let made = self.state.store.segments.made.clone();
        claim_notifications(&made);
        ctx.add_stream(stream::unfold(made, |made: Arc<tokio::sync::Notify>| async move {
            made.notified().await;
            Some((LimitMade, made))
        }));
    }

    /// Returns the connections with segments that may be longer than the path to their peers allows.
    fn connections_too_long(&self) -> Vec<ConnectionId> {
        let is_too_long = |wire: &super::Wire| {
            let node = wire.link.as_ref().and_then(super::wire::Linked::node);
            let limit = node.and_then(|node| self.state.store.segments.limit(node));
            let ends = limit.zip(wire.transport.as_ref());
            ends.is_some_and(|(limit, transport)| segments::is_longer(transport.socket(), limit))
        };
        self.wires.iter().filter(|(_, wire)| is_too_long(wire)).map(|(connection, _)| *connection).collect()
    }

    /// Handles a connection that gets no answer. If the node answers NDL, long packets may be lost on the
    /// path. spec: GNCL-19
    pub(super) fn on_silence(&self, node: NodeAddress) {
        let answers = self.state.ctx.ports.members().is_some_and(|members| members.answers(node));
        let store = &self.state.store;
        if answers && store.segments.guess(node) {
            store.segments.apply(&lock(&store.listeners));
            sinew_runtime::log::warn!(
                %node,
                "a connection (TCP) to this node answers nothing, though the node answers NDL: long packets do not arrive, perhaps. New connections to it use \
                 short segments. Compare the MTU of the interfaces at both ends and on the way (`ip link`), and let ICMP \"packet too big\" through every \
                 firewall"
            );
        }
    }
}

impl StreamHandler<LimitMade> for Gncl {
    // spec: GNCL-19
    fn handle(&mut self, _: LimitMade, ctx: &mut Context<Self>) {
        self.state.store.segments.apply(&lock(&self.state.store.listeners));
        for connection in self.connections_too_long() {
            let detail = "long packets do not arrive; the next connection uses shorter segments";
            self.state.store.refusals.count(Time::now(), "segments too long", &detail);
            self.ended(connection, ctx);
        }
    }

    /// A later instance follows the limits now.
    fn finished(&mut self, _: &mut Context<Self>) {}
}
