//! What follows from who was proven to be at the other end of a connection, or was not.

use std::{sync::Arc, time::Duration};

use actix::{AsyncContext, Context};
use rustls::pki_types::UnixTime;
use sinew_runtime::{
    remedy::{Wanted, remedy},
    time::Time,
};

use super::{
    super::{
        core::{Attach, ConnectionId, Decline, Input, Introduction},
        listener,
        secure::{Secure, Unproven},
        transport::Transport,
    },
    Gncl,
};
use crate::{
    secured::Secured,
    security::{Peer, Stamp},
    stores::lock,
    wills,
};

/// How often a node that has keys looks whether there is something to be said of how long they count: more often than that is said, as each life
/// of this layer begins anew.
const MINDED: Duration = Duration::from_secs(60);

/// Under which it is counted that a peer is not taken, or does not take this node.
pub(super) const NOT_PROVEN: &str = "peer not proven";

impl Gncl {
    /// With the thread of handshakes that there is, if this layer was restarted. The start fails if there is none: a node that has keys is never
    /// open.
    pub(super) fn begin_to_prove(&mut self) {
        let Some(secured) = self.stores.secured.get() else { return };
        let mut kept = lock(&self.stores.gncl.secure);
        let secure = kept.get_or_insert_with(|| {
            let secure = Secure::begin(secured.tls.clone()).unwrap_or_else(|error| {
                panic!("GNCL gets no thread for handshakes: {error}; {}", remedy(Wanted::Reactor, &error))
            });
            Arc::new(secure)
        });
        self.secure = Some(secure.clone());
    }

    /// Says now and then that the node's certificate ends soon, or has ended: it runs for longer than anybody remembers its start.
    pub(super) fn mind_the_times(&self, ctx: &mut Context<Self>) {
        if self.secure.is_none() {
            return;
        }
        ctx.run_interval(MINDED, |gncl, _| {
            let secured = gncl.stores.secured.get();
            if let Some(warning) = secured.and_then(|secured| secured.reminder(UnixTime::now(), Time::now()))
            {
                crate::log::warn!("{warning}");
            }
        });
    }

    /// The connection is there, and `peer` at its other end, where that is asked.
    pub(super) fn proven(&mut self, connection: ConnectionId, transport: Transport, peer: Option<&Peer>) {
        if let Some(peer) = peer
            && let Some(warning) = peer.warning()
            && let Some(suppressed) = self.stores.log_quotas.times.take(&peer.identity.address, Time::now())
        {
            crate::log::warn!(suppressed, "{warning}");
        }
        if let Some(wire) = self.wires.get_mut(&connection) {
            wire.transport = Some(transport);
            wire.may_speak = true;
            wire.proven = peer.cloned();
        }
    }

    /// Nobody is taken there.
    pub(super) fn unproven(&mut self, connection: ConnectionId, why: &Unproven, ctx: &mut Context<Self>) {
        if let Unproven::IsOpen = why {
            // It reads what it is told.
            self.wires.entry(connection).and_modify(|wire| wire.may_speak = true);
            let decline = Decline::Security(why.to_string());
            return self.input(Input::Violated(connection, decline), ctx);
        }
        match why {
            Unproven::NotTaken(_) => self.stores.gncl.refusals.count(Time::now(), NOT_PROVEN, why),
            Unproven::Ended(error) if listener::is_starved(error) => self.input(Input::Starved, ctx),
            // Whoever looks whether this host lives comes and goes without a word.
            Unproven::Ended(_) | Unproven::IsOpen => {}
        }
        self.ended(connection, ctx);
    }

    /// What a node says in its handshakes of the datagrams of discovery that it has made.
    pub(super) fn datagrams_made(&self) -> u64 {
        self.stores.secured.get().map_or(0, Secured::made)
    }

    /// A life that has proven itself is at the other end of a link: its datagrams count once from now on.
    pub(super) fn confirm(&self, attach: &Attach) {
        let Attach { connection, node, incarnation, .. } = *attach;
        if let Some(secured) = self.stores.secured.get()
            && let Some(wire) = self.wires.get(&connection)
        {
            if let Some(peer) = &wire.proven {
                let nodes_max = self.stores.config.ndl.nodes_max;
                let known = |node| self.core.knows(node);
                self.stores.gncl.proofs.note((node, incarnation), peer.clone(), nodes_max, known);
            }
            let (now, said) = (Time::now(), Stamp { node, incarnation, number: wire.datagrams_made });
            // Each end says so after the handshake of TLS, and so after this one knew the connection: however long its word was held up.
            secured.confirm(now, now.since(wire.began), said);
        }
    }

    /// A node speaks for itself alone, whatever keys of the project it has.
    pub(super) fn introduces_itself(
        &mut self,
        connection: ConnectionId,
        says: &Introduction,
    ) -> Result<(), Decline> {
        if let Some(wire) = self.wires.get_mut(&connection) {
            wire.datagrams_made = says.datagrams_made;
        }
        match self.wires.get(&connection).and_then(|wire| wire.proven.as_ref()) {
            Some(peer) if peer.identity.address != says.node => Err(Decline::Security(format!(
                "you say that you are node {}, and your certificate is of node {}; give each node its own keys",
                says.node, peer.identity.address
            ))),
            // Another list may have come in force since it proved who it is.
            Some(peer) => self.denied(peer).map_or(Ok(()), Err),
            None if self.secure.is_some() => {
                Err(Decline::Security("nothing is proven on this connection".to_owned()))
            }
            None => Ok(()),
        }
    }

    fn denied(&self, peer: &Peer) -> Option<Decline> {
        let why = self.stores.secured.get()?.tls.denies(peer)?;
        Some(Decline::Security(why.to_string()))
    }

    /// Another deny list is in force: whose certificate is on it is refused on each connection that it has, in whatever stage that is, and
    /// was not linked.
    // spec: GNCL-18
    pub(super) fn end_the_denied(&mut self, ctx: &mut Context<Self>) {
        let denied = self.wires.iter().filter_map(|(connection, wire)| {
            let decline = self.denied(wire.proven.as_ref()?)?;
            Some((*connection, decline))
        });
        let denied: Vec<_> = denied.collect();
        for (connection, decline) in denied {
            self.input(Input::Violated(connection, decline), ctx);
        }
        self.disprove_the_denied(ctx);
    }

    /// Whose link ended before its certificate was revoked is asked for as well: it may go on to answer NDL. So are those that a former
    /// instance of this layer linked. spec: GNCL-7
    pub(super) fn disprove_the_denied(&mut self, ctx: &mut Context<Self>) {
        let denied = self.stores.gncl.proofs.of_those(|peer| self.denied(peer).is_some());
        for (node, incarnation) in denied {
            // Before anybody hears that it is lost.
            wills::revoke(&self.stores, node, incarnation);
            self.input(Input::Disproven { node, incarnation }, ctx);
        }
    }
}
