//! Connections over an address that this host has lost: they are cut at once, and dialled again over a
//! remaining address.

use std::time::Duration;

use actix::{AsyncContext, Context, StreamHandler};
use sinew_model::address::is_same_host;
use sinew_runtime::time::Time;

use super::Gncl;
use crate::{
    core::ConnectionId,
    interfaces::{self, AddressLost},
};

/// Delay before a failed subscription at the kernel is repeated.
const RESUBSCRIBE_DELAY: Duration = Duration::from_secs(10);

impl Gncl {
    /// Subscribes to the kernel's notifications of lost addresses. Without them, lost addresses are found by
    /// missing answers.
    pub(super) fn watch_interfaces(&self, ctx: &mut Context<Self>) {
        match interfaces::lost() {
            Ok(lost) => drop(ctx.add_stream(lost)),
            Err(error) => {
                self.state.store.refusals.count(Time::now(), "interfaces not watched", &error);
                // The process may have had no free descriptor.
                ctx.run_later(RESUBSCRIBE_DELAY, |actor, ctx| actor.watch_interfaces(ctx));
            }
        }
    }

    /// Returns the connections that are bound to this address.
    fn connections_at(&self, AddressLost(lost): AddressLost) -> Vec<ConnectionId> {
        let is_there = |wire: &super::Wire| {
            let local = wire.transport.as_ref().and_then(|transport| transport.socket().local_addr().ok());
            local.is_some_and(|local| is_same_host(local, lost))
        };
        self.wires.iter().filter(|(_, wire)| is_there(wire)).map(|(connection, _)| *connection).collect()
    }
}

impl StreamHandler<AddressLost> for Gncl {
    // spec: GNCL-9
    fn handle(&mut self, lost: AddressLost, ctx: &mut Context<Self>) {
        for connection in self.connections_at(lost) {
            let detail = format!(
                "{lost} is gone, or its interface is down; a connection over it has ended, and its messages go over another address, if there is one"
            );
            self.state.store.refusals.count(Time::now(), "address lost", &detail);
            self.ended(connection, ctx);
        }
    }

    /// The end of the kernel's notifications does not end this layer.
    fn finished(&mut self, _: &mut Context<Self>) {}
}
