//! The shell's state of a connection.

use std::sync::{Arc, Weak};

use actix::SpawnHandle;
use sinew_runtime::{lock, tid::NodeAddress, time::Time};
use sinew_security::Peer;
use sinew_session::outlet::LinkNumber;

use super::super::{
    connection_events::EventSource,
    core::Lane,
    link::{LastReceived, Mode, SharedMode},
    peer,
    transport::Transport,
};

/// A connection that is a link.
pub(super) struct Linked {
    peer: Weak<peer::Peer>,
    lane: Lane,
    /// The connection's number among those of its peer.
    number: LinkNumber,
    /// The task that writes to the connection.
    _drainer: EventSource,
}

impl Linked {
    pub(super) fn new(peer: &Arc<peer::Peer>, lane: Lane, number: LinkNumber, drainer: EventSource) -> Self {
        Self { peer: Arc::downgrade(peer), lane, number, _drainer: drainer }
    }

    /// Stops writing to the connection, unless another one has replaced it. Returns whether the written bytes
    /// end with a whole frame.
    pub(super) fn disconnect(&self) -> bool {
        let peer = self.peer.upgrade();
        let Some(session) = peer.as_ref().and_then(|peer| peer.session(self.lane)) else { return true };
        session.outlet.disconnect(self.number)
    }

    /// Returns the node at the other end.
    pub(super) fn node(&self) -> Option<NodeAddress> {
        self.peer.upgrade().map(|peer| peer.node)
    }

    /// Whether urgent frames for the peer are still pending.
    pub(super) fn has_urgent_pending(&self) -> bool {
        let peer = self.peer.upgrade();
        let session = peer.as_ref().and_then(|peer| peer.session(self.lane));
        session.is_some_and(|session| session.outlet.is_connected() && session.outlet.urgent_left() > 0)
    }
}

/// One connection and its tasks.
pub(super) struct Wire {
    pub(super) transport: Option<Transport>,
    /// The authenticated peer at the other end.
    pub(super) authenticated: Option<Peer>,
    /// Time at which the connection was accepted or dialled.
    pub(super) started_at: Time,
    /// Discovery datagrams that the peer had created when it introduced itself.
    pub(super) datagrams_made: u64,
    pub(super) mode: SharedMode,
    /// The link, while the connection is one.
    pub(super) link: Option<Linked>,
    /// Whether the peer has sent GOODBYE on it, and the last acknowledgement is still pending.
    pub(super) last_ack_pending: bool,
    /// Whether the written bytes end with a whole frame, so that further frames can follow. If peers
    /// authenticate, it is false until then.
    pub(super) may_write: bool,
    pub(super) tasks: Vec<SpawnHandle>,
    last_received: LastReceived,
    /// The last receive time reported to the core.
    reported: Time,
    _reader: EventSource,
}

impl Wire {
    pub(super) fn new(
        transport: Option<Transport>,
        (mode, last_received): (SharedMode, LastReceived),
        reader: EventSource,
        may_write: bool,
    ) -> Self {
        Self {
            transport,
            authenticated: None,
            started_at: Time::now(),
            datagrams_made: 0,
            mode,
            link: None,
            last_ack_pending: false,
            may_write,
            tasks: Vec::new(),
            last_received,
            reported: Time::ZERO,
            _reader: reader,
        }
    }

    /// Returns when messages were last read, if that time was not returned before.
    pub(super) fn take_last_received(&mut self) -> Option<Time> {
        let last = self.last_received.last();
        (std::mem::replace(&mut self.reported, last) < last).then_some(last)
    }

    pub(super) fn set_mode(&self, mode: Mode) {
        *lock(&self.mode) = mode;
    }
}
