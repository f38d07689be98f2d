//! The parts of LNCL that outlive an incarnation of its actor: the listening socket, and the connections.
//!
//! An incarnation that hangs keeps its thread, and with it its descriptors: none is dropped until it continues. So the
//! next one listens on the same socket, and ends the connections of the former one itself.

use std::{
    collections::BTreeMap,
    os::unix::net::UnixListener,
    path::Path,
    sync::{Arc, Mutex, Weak},
};

use rustix::net::Shutdown;
use sinew_runtime::lock;
use sinew_session::{book::ClientId, outlet::PeerReadHalf};
use tokio::net::UnixStream;

use super::{
    client::ClientOutlet,
    listener::{self, ListenError, SocketAccess, SocketFile},
};

/// The socket for other processes. Dropping it closes it for new connections.
#[derive(Default)]
pub struct ClientSocket {
    open: Mutex<Option<(UnixListener, SocketFile)>>,
    /// At most as many as LNCL serves, and those of a former incarnation until the next one starts.
    connections: Mutex<BTreeMap<ClientId, Connection>>,
}

/// One connection, as long as it exists.
struct Connection {
    stream: Weak<UnixStream>,
    outlet: Weak<ClientOutlet>,
}

impl ClientSocket {
    /// Returns the listening socket at `path`, for these users. An open one is used again, as at LNCL's start, if it
    /// still owns the path.
    ///
    /// # Errors
    /// The cause, and its remedy.
    pub fn open(&self, path: &Path, access: SocketAccess) -> Result<UnixListener, ListenError> {
        let mut open = lock(&self.open);
        if open.as_ref().is_none_or(|(_, file)| !file.is_there()) {
            // A former incarnation may still hold the socket of the removed file.
            open.take().iter().for_each(|(listener, _)| shut(listener));
            *open = Some(listener::listen(path, access)?);
        }
        let (listener, _) = open.as_ref().expect("it was opened just now, if it was not");
        listener.try_clone().map_err(|cause| ListenError::System {
            doing: "share the socket at",
            path: path.to_owned(),
            cause,
        })
    }

    /// Accepts descriptors, as before Linux 6.16.
    #[cfg(test)]
    pub(super) fn accept_descriptors(&self) {
        if let Some((listener, _)) = &*lock(&self.open) {
            // An error means that they are accepted anyway.
            let _ = sinew_shm::set_descriptors(listener, sinew_shm::Descriptors::Taken);
        }
    }

    /// Adds an accepted connection.
    pub(super) fn admit(&self, id: ClientId, stream: &Arc<UnixStream>) {
        let mut connections = lock(&self.connections);
        // Removes entries of tasks that did not end by themselves.
        connections.retain(|_, connection| connection.stream.strong_count() > 0);
        connections.insert(id, Connection { stream: Arc::downgrade(stream), outlet: Weak::new() });
    }

    /// Adds the writer of a connection, once messages may flow.
    pub(super) fn add_outlet(&self, id: ClientId, outlet: &Arc<ClientOutlet>) {
        if let Some(connection) = lock(&self.connections).get_mut(&id) {
            connection.outlet = Arc::downgrade(outlet);
        }
    }

    /// Removes a connection that has ended.
    pub(super) fn dismiss(&self, id: ClientId) {
        lock(&self.connections).remove(&id);
    }

    /// Ends the connections of a former incarnation that does not do so itself.
    pub(super) fn hang_up(&self) {
        let connections = std::mem::take(&mut *lock(&self.connections));
        for Connection { stream, outlet } in connections.into_values() {
            // spec: LNCL-7. The end of the outlet wakes a peer that sleeps at a ring; it then reads the remaining data.
            // It precedes the shutdown of the socket: an incarnation that continues just now would take that for the
            // peer's end.
            if let Some(outlet) = outlet.upgrade() {
                outlet.end(PeerReadHalf::MayBeOpen);
            }
            if let Some(stream) = stream.upgrade() {
                shut(&*stream);
            }
        }
    }

    /// Closes the socket and frees the path, even if another incarnation still holds the socket.
    pub fn close(&self) {
        if let Some((listener, _file)) = lock(&self.open).take() {
            shut(&listener);
        }
    }
}

fn shut(socket: impl std::os::fd::AsFd) {
    // An error means that it is closed already.
    let _ = rustix::net::shutdown(socket, Shutdown::Both);
}
