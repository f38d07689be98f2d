//! A connection as the shell has it.

use actix::SpawnHandle;
use sinew_runtime::time::Time;

use super::super::{
    crowd::Member,
    link::{Heard, Mode, SharedMode},
    transport::Transport,
};
use crate::{outlet::LinkNumber, security::Peer, stores::lock};

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
    /// Which of its peer's connections it is, and what writes there, as long as it is a link.
    pub(super) link: Option<(LinkNumber, Member)>,
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
