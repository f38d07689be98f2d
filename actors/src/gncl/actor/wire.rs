//! A connection as the shell has it.

use std::sync::{Arc, Weak};

use actix::SpawnHandle;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::super::{
    core::Lane,
    crowd::Member,
    link::{Heard, Mode, SharedMode},
    peer,
    transport::Transport,
};
use crate::{outlet::LinkNumber, security::Peer, stores::lock};

/// A connection that is a link.
pub(super) struct Linked {
    peer: Weak<peer::Peer>,
    lane: Lane,
    /// Which of its peer's connections it is.
    number: LinkNumber,
    /// What writes there.
    _drainer: Member,
}

impl Linked {
    pub(super) fn new(peer: &Arc<peer::Peer>, lane: Lane, number: LinkNumber, drainer: Member) -> Self {
        Self { peer: Arc::downgrade(peer), lane, number, _drainer: drainer }
    }

    /// Nothing is written there any more, unless another connection has taken its place. Returns whether what was written ends with a whole
    /// frame.
    pub(super) fn disconnect(&self) -> bool {
        let peer = self.peer.upgrade();
        let Some(way) = peer.as_ref().and_then(|peer| peer.way(self.lane)) else { return true };
        way.outlet.disconnect(self.number)
    }

    /// At the other end.
    pub(super) fn node(&self) -> Option<NodeAddress> {
        self.peer.upgrade().map(|peer| peer.node)
    }

    /// Whether words for the peer still wait there.
    pub(super) fn has_words_left(&self) -> bool {
        let peer = self.peer.upgrade();
        let way = peer.as_ref().and_then(|peer| peer.way(self.lane));
        way.is_some_and(|way| way.outlet.is_connected() && way.outlet.urgent_left() > 0)
    }
}

/// One connection and what runs for it.
pub(super) struct Wire {
    pub(super) transport: Option<Transport>,
    /// Who is at the other end, if its keys have proven it.
    pub(super) proven: Option<Peer>,
    /// When it was accepted, or dialled.
    pub(super) began: Time,
    /// Datagrams of discovery that the other end had made when it introduced itself.
    pub(super) datagrams_made: u64,
    pub(super) mode: SharedMode,
    /// As long as it is a link.
    pub(super) link: Option<Linked>,
    /// The peer has said goodbye on it, and has not been sent yet that all was taken.
    pub(super) owes_the_last: bool,
    /// Whether what was written so far ends with a whole frame, so that words can follow; where peers prove who they are, not before that.
    pub(super) may_speak: bool,
    pub(super) tasks: Vec<SpawnHandle>,
    heard: Heard,
    /// Of that, what the core was told.
    told: Time,
    _reader: Member,
}

impl Wire {
    pub(super) fn new(
        transport: Option<Transport>,
        (mode, heard): (SharedMode, Heard),
        reader: Member,
        may_speak: bool,
    ) -> Self {
        Self {
            transport,
            proven: None,
            began: Time::now(),
            datagrams_made: 0,
            mode,
            link: None,
            owes_the_last: false,
            may_speak,
            tasks: Vec::new(),
            heard,
            told: Time::ZERO,
            _reader: reader,
        }
    }

    /// When messages were read last, if that was not said before.
    pub(super) fn heard(&mut self) -> Option<Time> {
        let last = self.heard.last();
        (std::mem::replace(&mut self.told, last) < last).then_some(last)
    }

    pub(super) fn set_mode(&self, mode: Mode) {
        *lock(&self.mode) = mode;
    }
}
