//! The forms of an endpoint: one semantics, two ways to wait.
//!
//! What an endpoint does is written once, as futures (`endpoint.rs`, `outgoing.rs`, `incoming.rs`, `returning.rs`). Where it
//! waits, and nowhere else, the form decides: a thread blocks there, so that its futures are ready when they are first
//! looked at; a task gives its thread back.

use std::{
    future::Future,
    pin::pin,
    task::{Context, Poll, Waker},
};

use super::reactor::Reactor;

/// Who waits.
pub(super) enum Form {
    /// The calling thread.
    Thread,
    /// A task, on whatever thread its runtime has it.
    Reactor(Box<Reactor>),
}

/// The value of a future of an endpoint whose form is [`Form::Thread`].
pub(super) fn at_once<T>(future: impl Future<Output = T>) -> T {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => value,
        Poll::Pending => unreachable!("who blocks has waited when the future returns"),
    }
}
