//! What of LNCL outlives a life of it: the socket that listens, and the connections, whoever holds them.
//!
//! A life that hangs takes its thread along, and with that its descriptors: nothing of it is dropped until it comes back. So the
//! next one listens at the same socket, and ends the connections of the former one itself.

use std::{
    collections::BTreeMap,
    os::unix::net::UnixListener,
    path::Path,
    sync::{Arc, Mutex, Weak},
};

use rustix::net::Shutdown;
use tokio::net::UnixStream;

use super::{
    client::ClientOutlet,
    core::ClientId,
    listener::{self, ListenError, Openers, SocketFile},
};
use crate::{outlet::Left, stores::lock};

/// The door for other processes. Dropping it closes it for new ones.
#[derive(Default)]
pub(crate) struct Door {
    open: Mutex<Option<(UnixListener, SocketFile)>>,
    /// At most as many as LNCL serves, and those of a former life until the next one begins.
    connections: Mutex<BTreeMap<ClientId, Connection>>,
}

/// One connection, as far as it still is there.
struct Connection {
    stream: Weak<UnixStream>,
    outlet: Weak<ClientOutlet>,
}

impl Door {
    /// The socket that listens at `path`, for these users: the one that is open already, as it is when LNCL starts, if the path is still ours.
    ///
    /// # Errors
    /// Why not, with what to do about it.
    pub(crate) fn open(&self, path: &Path, openers: Openers) -> Result<UnixListener, ListenError> {
        let mut open = lock(&self.open);
        if open.as_ref().is_none_or(|(_, file)| !file.is_there()) {
            // A former life may have what somebody took the file of.
            open.take().iter().for_each(|(listener, _)| shut(listener));
            *open = Some(listener::listen(path, openers)?);
        }
        let (listener, _) = open.as_ref().expect("it was opened just now, if it was not");
        listener.try_clone().map_err(|cause| ListenError::System {
            doing: "share the socket at",
            path: path.to_owned(),
            cause,
        })
    }

    /// Lets descriptors come, as they do before Linux 6.16.
    #[cfg(test)]
    pub(super) fn let_descriptors_come(&self) {
        if let Some((listener, _)) = &*lock(&self.open) {
            // An error says that they come anyway.
            let _ = sinew_shm::set_descriptors(listener, sinew_shm::Descriptors::Taken);
        }
    }

    /// A connection that was taken.
    pub(super) fn admit(&self, id: ClientId, stream: &Arc<UnixStream>) {
        let mut connections = lock(&self.connections);
        // Those whose tasks did not end by themselves.
        connections.retain(|_, connection| connection.stream.strong_count() > 0);
        connections.insert(id, Connection { stream: Arc::downgrade(stream), outlet: Weak::new() });
    }

    /// What writes there, once messages may flow.
    pub(super) fn add_outlet(&self, id: ClientId, outlet: &Arc<ClientOutlet>) {
        if let Some(connection) = lock(&self.connections).get_mut(&id) {
            connection.outlet = Arc::downgrade(outlet);
        }
    }

    /// The connection has ended.
    pub(super) fn dismiss(&self, id: ClientId) {
        lock(&self.connections).remove(&id);
    }

    /// Ends the connections of a former life that does not do so itself.
    pub(super) fn hang_up(&self) {
        let connections = std::mem::take(&mut *lock(&self.connections));
        for Connection { stream, outlet } in connections.into_values() {
            // spec: LNCL-7. A peer that sleeps at a ring is woken by its end, and takes what lies in it. Before its socket hangs up: a life that
            // comes back just now would take that for the peer's end.
            if let Some(outlet) = outlet.upgrade() {
                outlet.end(Left::Somebody);
            }
            if let Some(stream) = stream.upgrade() {
                shut(&*stream);
            }
        }
    }

    /// Nobody is let in any more, and the path is free, whoever still holds the socket.
    pub(crate) fn close(&self) {
        if let Some((listener, _file)) = lock(&self.open).take() {
            shut(&listener);
        }
    }
}

fn shut(socket: impl std::os::fd::AsFd) {
    // An error says that it is closed already.
    let _ = rustix::net::shutdown(socket, Shutdown::Both);
}
