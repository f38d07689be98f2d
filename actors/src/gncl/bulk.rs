//! The thread that reads and writes the connections of Bulk, so that the one that carries Control sleeps when nothing comes for it.
//!
//! Where all CPUs are busy, whoever is busy himself waits for his turn like everybody else, and whoever sleeps has a CPU soon after he
//! is woken.

use std::{io, net, os::fd::AsFd as _, sync::Arc, thread};

use tokio::{
    net::TcpStream,
    runtime::{Builder, Handle},
    sync::oneshot,
};

use super::{courtesy::Courtesy, task::Place};
use crate::nicer::give_way;

/// Such a thread. It ends with this, and what it does with it.
pub(super) struct BulkThread {
    runtime: Handle,
    courtesy: Arc<Courtesy>,
    _is_wanted: oneshot::Sender<()>,
}

impl BulkThread {
    /// # Errors
    /// The system gives no thread, or no descriptors for its reactor.
    pub(super) fn begin(name: &str, courtesy: Courtesy) -> io::Result<Self> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let handle = runtime.handle().clone();
        let (is_wanted, is_to_end) = oneshot::channel();
        thread::Builder::new().name(name.to_owned()).spawn(move || {
            give_way();
            // Nothing is ever said but that nobody wants it any more.
            let _: Result<(), _> = runtime.block_on(is_to_end);
        })?;
        Ok(Self { runtime: handle, courtesy: Arc::new(courtesy), _is_wanted: is_wanted })
    }

    /// Where its tasks are.
    pub(super) const fn runtime(&self) -> &Handle {
        &self.runtime
    }

    /// Turns that have ended on it.
    #[cfg(test)]
    pub(super) fn turns(&self) -> u64 {
        self.courtesy.turns()
    }

    /// The same for those that may have a next turn at once.
    pub(super) fn place(&self) -> Place {
        Place::There(self.runtime.clone(), self.courtesy.clone())
    }

    /// The same connection, for tasks of this thread.
    ///
    /// # Errors
    /// There is no descriptor left.
    pub(super) fn adopt(&self, socket: &TcpStream) -> io::Result<TcpStream> {
        let socket = socket.as_fd().try_clone_to_owned()?;
        let _entered = self.runtime.enter();
        TcpStream::from_std(net::TcpStream::from(socket))
    }
}
