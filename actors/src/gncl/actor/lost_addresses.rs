//! Connections over an address that this host has lost: cut at once, and made again at whichever address there is.

use std::time::Duration;

use actix::{AsyncContext, Context, StreamHandler};
use sinew_runtime::time::Time;

use super::Gncl;
use crate::{
    gncl::{
        core::ConnectionId,
        interfaces::{self, AddressLost},
    },
    ndl,
};

/// When the kernel is asked again that could not be.
const AGAIN: Duration = Duration::from_secs(10);

impl Gncl {
    /// Has the kernel say which addresses are lost. Where it does not, they are found out by what is not answered.
    pub(super) fn watch_interfaces(&self, ctx: &mut Context<Self>) {
        match interfaces::lost() {
            Ok(lost) => drop(ctx.add_stream(lost)),
            Err(error) => {
                self.stores.gncl.refusals.count(Time::now(), "interfaces not watched", &error);
                // There may have been no descriptor left.
                ctx.run_later(AGAIN, |actor, ctx| actor.watch_interfaces(ctx));
            }
        }
    }

    /// Connections that are bound to this address.
    fn connections_at(&self, AddressLost(lost): AddressLost) -> Vec<ConnectionId> {
        let is_there = |wire: &super::Wire| {
            let local = wire.transport.as_ref().and_then(|transport| transport.socket().local_addr().ok());
            local.is_some_and(|local| ndl::is_same_host(local, lost))
        };
        self.wires.iter().filter(|(_, wire)| is_there(wire)).map(|(connection, _)| *connection).collect()
    }
}

impl StreamHandler<AddressLost> for Gncl {
    // spec: GNCL-9
    fn handle(&mut self, lost: AddressLost, ctx: &mut Context<Self>) {
        for connection in self.connections_at(lost) {
            let detail =
                format!("{lost} is gone, or its interface is down; what went over it goes another way");
            self.stores.gncl.refusals.count(Time::now(), "address lost", &detail);
            self.ended(connection, ctx);
        }
    }

    /// The kernel's silence is not this layer's end.
    fn finished(&mut self, _: &mut Context<Self>) {}
}
