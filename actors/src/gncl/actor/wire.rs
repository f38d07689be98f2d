//! A connection as the shell has it.

use std::{net::Shutdown, sync::Arc};

use actix::SpawnHandle;
use socket2::SockRef;
use tokio::net::TcpStream;

use super::super::link::{Mode, SharedMode};
use crate::{outlet::LinkNumber, stores::lock};

/// One connection and what runs for it.
pub(super) struct Wire {
    pub(super) socket: Option<Arc<TcpStream>>,
    pub(super) mode: SharedMode,
    /// Which of its peer's connections it is, and what writes there, as long as it is a link.
    pub(super) link: Option<(LinkNumber, SpawnHandle)>,
    /// Whether what was written so far ends with a whole frame, so that words can follow.
    pub(super) may_speak: bool,
    pub(super) tasks: Vec<SpawnHandle>,
}

impl Wire {
    pub(super) fn new(socket: Option<Arc<TcpStream>>, mode: SharedMode, reader: SpawnHandle) -> Self {
        Self { socket, mode, link: None, may_speak: true, tasks: vec![reader] }
    }

    pub(super) fn set_mode(&self, mode: Mode) {
        *lock(&self.mode) = mode;
    }
}

/// Shuts a socket that others may still hold.
pub(super) fn shut(socket: &TcpStream, how: Shutdown) {
    // It fails if the peer was faster, and then there is nothing left to shut.
    let _ = SockRef::from(socket).shutdown(how);
}
