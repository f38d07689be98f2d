//! Reactions to successful and failed authentication of peers.

use std::{sync::Arc, time::Duration};

use actix::{AsyncContext, Context};
use rustls::pki_types::UnixTime;
use sinew_model::ports::NodeIncarnation;
use sinew_runtime::{
    lock,
    remedy::{Wanted, remedy},
    time::Time,
};
use sinew_security::{Peer, Stamp, node_security::NodeSecurity};

use super::{
    super::{
        authenticator::{AuthError, Authenticator},
        core::{Attach, ConnectionId, Input, Introduction, RefusalError},
        listener,
        transport::Transport,
    },
    Gncl,
};

/// Interval at which a node with keys checks for warnings of its certificate's validity. The interval is
/// shorter than that of the warnings, because each instance of this layer starts a new one.
const REMINDER_PERIOD: Duration = Duration::from_secs(60);

/// The refusal cause for a peer that is not accepted, or that does not accept this node.
pub(super) const NOT_AUTHENTICATED: &str = "peer not proven";

impl Gncl {
    /// Starts the thread of handshakes; a restarted layer reuses it. The start fails without the thread: a
    /// node that has keys never runs without authentication.
    ///
    /// # Errors
    /// Returns the reason and the remedy if the thread cannot be started.
    pub(super) fn start_authentication(&mut self) -> Result<(), String> {
        let Some(secured) = self.state.security.secured.get() else { return Ok(()) };
        let mut kept = lock(&self.state.store.authenticator);
        if kept.is_none() {
            let authenticator = Authenticator::begin(secured.tls.clone()).map_err(|error| {
                format!("GNCL gets no thread for handshakes: {error}; {}", remedy(Wanted::Reactor, &error))
            })?;
            *kept = Some(Arc::new(authenticator));
        }
        self.authenticator.clone_from(&kept);
        Ok(())
    }

    /// Warns regularly that the node's certificate ends soon, or has ended. The node may run for so long that
    /// its start is forgotten.
    pub(super) fn watch_certificate_times(&self, ctx: &mut Context<Self>) {
        if self.authenticator.is_none() {
            return;
        }
        ctx.run_interval(REMINDER_PERIOD, |gncl, _| {
            let secured = gncl.state.security.secured.get();
            if let Some(warning) = secured.and_then(|secured| secured.reminder(UnixTime::now(), Time::now()))
            {
                sinew_runtime::log::warn!("{warning}");
            }
        });
    }

    /// Records that the connection is established, and that `peer` is at its other end, if authentication is enabled.
    pub(super) fn authenticated(
        &mut self,
        connection: ConnectionId,
        transport: Transport,
        peer: Option<&Peer>,
    ) {
        if let Some(peer) = peer
            && let Some(warning) = peer.warning()
            && let Some(suppressed) =
                self.state.ctx.log_quotas.times.take(&peer.identity.address, Time::now())
        {
            sinew_runtime::log::warn!(suppressed, "{warning}");
        }
        if let Some(wire) = self.wires.get_mut(&connection) {
            wire.transport = Some(transport);
            wire.may_write = true;
            wire.authenticated = peer.cloned();
        }
    }

    /// Handles a peer after a failed authentication.
    pub(super) fn auth_failed(&mut self, connection: ConnectionId, why: &AuthError, ctx: &mut Context<Self>) {
        if let AuthError::NotTls = why {
            // A peer without keys can read the reason.
            self.wires.entry(connection).and_modify(|wire| wire.may_write = true);
            let decline = RefusalError::Security(why.to_string());
            return self.input(Input::Violated(connection, decline), ctx);
        }
        match why {
            AuthError::Rejected(_) => self.state.store.refusals.count(Time::now(), NOT_AUTHENTICATED, why),
            AuthError::Disconnected(error) if listener::is_starved(error) => self.input(Input::Starved, ctx),
            // Health checks open and close connections without sending anything.
            AuthError::Disconnected(_) | AuthError::NotTls => {}
        }
        self.ended(connection, ctx);
    }

    /// Returns the number of discovery datagrams that this node has created, for its handshakes.
    pub(super) fn datagrams_made(&self) -> u64 {
        self.state.security.secured.get().map_or(0, NodeSecurity::made)
    }

    /// Records that an authenticated incarnation is linked: each of its datagrams counts once from now on.
    pub(super) fn confirm(&self, attach: &Attach) {
        let Attach { connection, node, incarnation, .. } = *attach;
        if let Some(secured) = self.state.security.secured.get()
            && let Some(wire) = self.wires.get(&connection)
        {
            if let Some(peer) = &wire.authenticated {
                let nodes_max = self.state.ctx.config.ndl.nodes_max;
                let known = |node| self.core.is_known(node);
                self.state.store.authenticated.record((node, incarnation), peer.clone(), nodes_max, known);
            }
            let (now, stamp) = (Time::now(), Stamp { node, incarnation, number: wire.datagrams_made });
            // Each side sends this number after the TLS handshake, so after this side knew the connection,
            // however long the frame was delayed.
            secured.confirm(now, now.since(wire.started_at), stamp);
        }
    }

    /// Checks that a node introduces only itself, even if it has other keys of the project.
    pub(super) fn check_introduction(
        &mut self,
        connection: ConnectionId,
        introduction: &Introduction,
    ) -> Result<(), RefusalError> {
        if let Some(wire) = self.wires.get_mut(&connection) {
            wire.datagrams_made = introduction.datagrams_made;
        }
        match self.wires.get(&connection).and_then(|wire| wire.authenticated.as_ref()) {
            Some(peer) if peer.identity.address != introduction.node => Err(RefusalError::Security(format!(
                "you say that you are node {}, and your certificate is of node {}; give each node its own keys",
                introduction.node, peer.identity.address
            ))),
            // A newer deny list may be in force since the authentication.
            Some(peer) => self.denied(peer).map_or(Ok(()), Err),
            None if self.authenticator.is_some() => {
                Err(RefusalError::Security("nothing is proven on this connection".to_owned()))
            }
            None => Ok(()),
        }
    }

    fn denied(&self, peer: &Peer) -> Option<RefusalError> {
        let why = self.state.security.secured.get()?.tls.denies(peer)?;
        Some(RefusalError::Security(why.to_string()))
    }

    /// Applies a new deny list. All connections of denied certificates are refused, in any stage, and count
    /// as never linked.
    // spec: GNCL-18
    pub(super) fn refuse_denied(&mut self, ctx: &mut Context<Self>) {
        let revoked = self.drop_wills_of_denied();
        let denied = self.wires.iter().filter_map(|(connection, wire)| {
            let decline = self.denied(wire.authenticated.as_ref()?)?;
            Some((*connection, decline))
        });
        let denied: Vec<_> = denied.collect();
        for (connection, decline) in denied {
            self.input(Input::Violated(connection, decline), ctx);
        }
        self.revoke(revoked, ctx);
    }

    /// Also removes nodes with a link that ended before their certificate was revoked, because they may still
    /// answer NDL. This includes nodes that a former instance of this layer linked. spec: GNCL-7
    pub(super) fn revoke_denied(&mut self, ctx: &mut Context<Self>) {
        let revoked = self.drop_wills_of_denied();
        self.revoke(revoked, ctx);
    }

    /// Drops the last wills of nodes with a revoked certificate, before their links are reported as broken and the
    /// nodes as lost. spec: WILL-5
    fn drop_wills_of_denied(&self) -> Vec<NodeIncarnation> {
        let denied = self.state.store.authenticated.matching(|peer| self.denied(peer).is_some());
        if let Some(app_lifecycle) = self.state.ctx.ports.app_lifecycle() {
            denied.iter().for_each(|incarnation| app_lifecycle.revoke(*incarnation));
        }
        denied
    }

    fn revoke(&mut self, revoked: Vec<NodeIncarnation>, ctx: &mut Context<Self>) {
        for (node, incarnation) in revoked {
            self.input(Input::CredentialsRevoked { node, incarnation }, ctx);
        }
    }
}
