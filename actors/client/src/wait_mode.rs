//! The wait modes of an endpoint: one semantics, three ways to wait.
//!
//! The behaviour of an endpoint is implemented once, as futures (`endpoint.rs`, `outgoing.rs`, `incoming.rs`,
//! `node_link.rs`, `reconnect.rs`). The mode decides only how it waits. A thread blocks in the wait, so that
//! its futures are ready at the first poll; a task yields its thread, to tokio or to another event loop.

use std::{
    future::Future,
    pin::Pin,
    task::{Context, Poll, Waker},
};

use super::{event_loop::EventLoop, reactor::Reactor};

/// The kind of caller that waits.
pub(super) enum WaitMode {
    /// The calling thread.
    Blocking,
    /// A task, on any thread of its runtime.
    Async(Box<Reactor>),
    /// A task of an event loop that is not tokio's.
    Polled(EventLoop),
}

/// Returns the value of a future of an endpoint with [`WaitMode::Blocking`]. The caller pins the future where it is
/// made: it has some kilobytes, and to move it costs more than a send.
pub(super) fn block_ready<T>(future: Pin<&mut impl Future<Output = T>>) -> T {
    match future.poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => value,
        Poll::Pending => unreachable!("a blocking endpoint has waited when the future returns"),
    }
}
