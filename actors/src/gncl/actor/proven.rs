//! What follows from who was proven to be at the other end of a connection, or was not.

use std::sync::Arc;

use actix::Context;
use sinew_runtime::time::Time;

use super::{
    super::{
        core::{ConnectionId, Decline, Input, Introduction},
        secure::{Secure, Unproven},
        transport::Transport,
    },
    Gncl,
};
use crate::security::Peer;

/// Under which it is counted that a peer is not taken, or does not take this node.
pub(super) const NOT_PROVEN: &str = "peer not proven";

impl Gncl {
    /// The start fails if it cannot: a node that has keys is never open.
    pub(super) fn begin_to_prove(&mut self) {
        let Some(tls) = self.stores.tls.get() else { return };
        let secure = Secure::begin(tls.clone()).unwrap_or_else(|error| {
            panic!("GNCL gets no thread for handshakes: {error}; raise `ulimit -n` or `ulimit -u`")
        });
        self.secure = Some(Arc::new(secure));
    }

    /// The connection is there, and `peer` at its other end, where that is asked.
    pub(super) fn proven(&mut self, connection: ConnectionId, transport: Transport, peer: Option<&Peer>) {
        if let Some(warning) = peer.and_then(Peer::warning) {
            crate::log::warn!("{warning}");
        }
        if let Some(wire) = self.wires.get_mut(&connection) {
            wire.transport = Some(transport);
            wire.proven = peer.map(|peer| peer.identity.address);
        }
    }

    /// Nobody is taken there.
    pub(super) fn unproven(&mut self, connection: ConnectionId, why: &Unproven, ctx: &mut Context<Self>) {
        if let Unproven::IsOpen = why {
            // It reads what it is told.
            let decline = Decline::Security(why.to_string());
            return self.input(Input::Violated(connection, decline), ctx);
        }
        self.stores.gncl.refusals.count(Time::now(), NOT_PROVEN, why);
        self.ended(connection, ctx);
    }

    /// A node speaks for itself alone, whatever keys of the project it has.
    pub(super) fn is_who_was_proven(
        &self,
        connection: ConnectionId,
        says: &Introduction,
    ) -> Result<(), Decline> {
        match self.wires.get(&connection).and_then(|wire| wire.proven) {
            Some(proven) if proven != says.node => Err(Decline::Security(format!(
                "you say that you are node {}, and your certificate is of node {proven}; give each node its own keys",
                says.node
            ))),
            None if self.secure.is_some() => {
                Err(Decline::Security("nothing is proven on this connection".to_owned()))
            }
            Some(_) | None => Ok(()),
        }
    }
}
