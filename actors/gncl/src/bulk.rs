//! The thread that reads and writes the connections of Bulk. The thread for Control then sleeps while it has
//! no messages.
//!
//! If all CPUs are busy, a busy thread waits for its time slice like all others. A sleeping thread gets a CPU
//! soon after its wake.

use std::{io, net, os::fd::AsFd as _, sync::Arc, thread};

use sinew_model::thread_priority::lower_priority;
use tokio::{
    net::TcpStream,
    runtime::{Builder, Handle},
    sync::oneshot,
};

use super::{task::TaskThread, yield_policy::YieldPolicy};

/// A thread for Bulk. The thread and its tasks end when this value is dropped.
pub(super) struct BulkThread {
    runtime: Handle,
    yield_policy: Arc<YieldPolicy>,
    _is_wanted: oneshot::Sender<()>,
}

impl BulkThread {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system provides no thread, or no descriptors for its reactor.
    pub(super) fn begin(name: &str, yield_policy: YieldPolicy) -> io::Result<Self> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let handle = runtime.handle().clone();
        let (is_wanted, is_to_end) = oneshot::channel();
        thread::Builder::new().name(name.to_owned()).spawn(move || {
            lower_priority();
            // The channel carries no value; its closing ends the thread.
            let _: Result<(), _> = runtime.block_on(is_to_end);
        })?;
        Ok(Self { runtime: handle, yield_policy: Arc::new(yield_policy), _is_wanted: is_wanted })
    }

    /// Returns the runtime of its tasks.
    pub(super) const fn runtime(&self) -> &Handle {
        &self.runtime
    }

    /// Returns the number of ended turns on this thread.
    #[cfg(test)]
    pub(super) fn turns(&self) -> u64 {
        self.yield_policy.turns()
    }

    /// Returns the thread for tasks that may get further turns at once.
    pub(super) fn task_thread(&self) -> TaskThread {
        TaskThread::Other(self.runtime.clone(), self.yield_policy.clone())
    }

    /// Returns the same connection, registered with this thread's reactor.
    ///
    /// # Errors
    /// There is no free descriptor.
    pub(super) fn adopt(&self, socket: &TcpStream) -> io::Result<TcpStream> {
        let socket = socket.as_fd().try_clone_to_owned()?;
        let _entered = self.runtime.enter();
        TcpStream::from_std(net::TcpStream::from(socket))
    }
}
