//! Connections to peers at which long packets do not arrive: made again with shorter segments.

use std::sync::Arc;

use actix::{AsyncContext, Context, StreamHandler};
use futures_util::stream;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::Gncl;
use crate::{
    gncl::{core::ConnectionId, segments},
    stores::lock,
    takeover::take_over,
};

/// There is a limit that was not there.
pub(super) struct LimitMade;

impl Gncl {
    /// Follows what datagrams measure.
    pub(super) fn watch_limits(&self, ctx: &mut Context<Self>) {
        let made = self.stores.gncl.segments.made.clone();
        take_over(&made);
        ctx.add_stream(stream::unfold(made, |made: Arc<tokio::sync::Notify>| async move {
            made.notified().await;
            Some((LimitMade, made))
        }));
    }

    /// Connections whose segments may be longer than what arrives at their peers.
    fn connections_too_long(&self) -> Vec<ConnectionId> {
        let is_too_long = |wire: &super::Wire| {
            let node = wire.link.as_ref().and_then(super::wire::Linked::node);
            let limit = node.and_then(|node| self.stores.gncl.segments.limit(node));
            let ends = limit.zip(wire.transport.as_ref());
            ends.is_some_and(|(limit, transport)| segments::is_longer(transport.socket(), limit))
        };
        self.wires.iter().filter(|(_, wire)| is_too_long(wire)).map(|(connection, _)| *connection).collect()
    }

    /// A connection to this node answers nothing. If the node answers NDL, what is long vanishes on the way, perhaps. spec: GNCL-19
    pub(super) fn is_silent(&self, node: NodeAddress) {
        let answers = {
            let core = lock(&self.stores.ndl);
            core.has_member(node) && core.in_doubt().iter().all(|(other, _)| *other != node)
        };
        let store = &self.stores.gncl;
        if answers && store.segments.guess(node) {
            store.segments.apply(&lock(&store.listeners));
            crate::log::warn!(
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
        self.stores.gncl.segments.apply(&lock(&self.stores.gncl.listeners));
        for connection in self.connections_too_long() {
            let detail = "long packets do not arrive; the next connection uses shorter segments";
            self.stores.gncl.refusals.count(Time::now(), "segments too long", &detail);
            self.ended(connection, ctx);
        }
    }

    /// A later instance follows them now.
    fn finished(&mut self, _: &mut Context<Self>) {}
}
