//! Who may send what to whom, asked where every route to an application of this node ends.
//!
//! A [`Guard`] stands in the routing table itself, which every sender reads anyway: while there is none, a message costs one look at a
//! pointer. What comes from other nodes, from other processes and from this one is asked the same question at the same place.

use std::sync::Arc;

use crate::{
    tid::AppAddress,
    wire::{Flags, Header},
};

/// Whoever decides. It is called on the thread of whoever sends, for every message, so it neither waits nor holds a lock for long.
pub trait Guard: Send + Sync {
    /// Whether what this header says may reach the application of this node at `target`; its destination may be a group that the
    /// application is a member of, or every application. It is told of each message once for each target, and of one that found a full
    /// queue each time that it is offered again.
    fn allows(&self, header: &Header, target: AppAddress) -> bool;

    /// An application of this node sends this question to one application; said before anybody can answer it.
    fn asks(&self, header: &Header);
}

/// Whether what this header says may not reach `target`.
///
/// What layers say, and what is said to them, is their protocols' business.
#[inline]
pub(super) fn refuses(guard: Option<&Arc<dyn Guard>>, target: AppAddress, header: &Header) -> bool {
    guard.is_some_and(|guard| is_guarded(header, target) && !guard.allows(header, target))
}

/// Whether a guard is asked at all.
const fn is_guarded(header: &Header, target: AppAddress) -> bool {
    header.kind.is_user() && !target.is_layer()
}

/// Tells the guard of a question, if it is one.
#[inline]
pub(super) fn note(guard: Option<&Arc<dyn Guard>>, header: &Header) {
    if let Some(guard) = guard
        && header.flags.has(Flags::ASK)
        && header.kind.is_user()
        && header.destination.is_single()
    {
        guard.asks(header);
    }
}
