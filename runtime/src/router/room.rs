//! Messages that wait at their sender until a queue has room for them.

use std::{
    sync::{Arc, atomic::Ordering},
    task::Waker,
};

use super::{Router, SubmitError, offer_to, tap};
use crate::{WakerList, outcome::Rejection, tid::Tid, wire::Message};

/// Maximum number of messages of a node that wait for room at the same time. A queue keeps the wakers of all of them.
/// The thread that makes room wakes them one after the other, which delays it by as many wakes.
const ROOM_WAITS_MAX: usize = 1_024;
const _: () = assert!(ROOM_WAITS_MAX < WakerList::MAX);

/// The place of one message that waits for room. It is free again when this is dropped.
pub(crate) struct RoomWait(Arc<Router>);

impl RoomWait {
    /// Returns a place; `None` if as many messages wait as may.
    pub(crate) fn begin(router: &Arc<Router>) -> Option<Self> {
        // SYNC: Relaxed; the count protects no other data.
        let count = |waits: usize| (waits < ROOM_WAITS_MAX).then_some(waits + 1);
        let counted = router.room_waits.fetch_update(Ordering::Relaxed, Ordering::Relaxed, count);
        counted.ok().map(|_| Self(router.clone()))
    }
}

impl Drop for RoomWait {
    fn drop(&mut self) {
        // SYNC: Relaxed; see `begin`.
        self.0.room_waits.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Router {
    /// Returns whether all messages leave through one queue to the node, which is another process.
    pub(crate) const fn has_uplink(&self) -> bool {
        self.uplink.is_some()
    }

    /// Same as [`send`](Self::send), to one application and for a sender that keeps the message after a full queue.
    /// `room` is woken for that as in [`MessageSink::offer`](super::MessageSink::offer), and such a rejection is not
    /// counted. Any other one must be [reported](Self::refuse). The message is no request, of which a guard would
    /// have to know.
    ///
    /// # Errors
    /// The message, and the reason of the rejection.
    pub(crate) fn send_or_keep(&self, mut message: Message, room: &Waker) -> Result<(), SubmitError> {
        message.header.destination = self.absolute(message.header.destination);
        let Tid { node, app } = message.header.destination;
        if self.is_cut(&message.header) {
            return Err(SubmitError::new(message, Rejection::NotAllowed));
        }
        if let Some(uplink) = &self.uplink {
            return uplink.offer(message, Some(room));
        }
        let snapshot = self.snapshot.load();
        let table = &*snapshot.table;
        let (route, peer) =
            if node == self.node { (table.local.get(&app), None) } else { (None, table.peers.get(&node)) };
        let offer = |message| match (route, peer) {
            (Some(route), _) => offer_to(table, route, message, Some(room)),
            (None, Some(peer)) => peer.offer(message, Some(room)),
            (None, None) if node == self.node => Err(SubmitError::new(message, Rejection::NoSuchApplication)),
            (None, None) => Err(SubmitError::new(message, Rejection::NoSuchNode)),
        };
        match &table.tap {
            None => offer(message),
            Some(tap) => tap::hand_over(&**tap, message, true, offer),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::NodeAddress;

    #[test]
    fn waits_of_a_node_are_bounded_until_dropped() {
        let router = Arc::new(Router::new(NodeAddress::new(7)));
        let mut waits: Vec<_> = (0..ROOM_WAITS_MAX).map_while(|_| RoomWait::begin(&router)).collect();
        assert_eq!(waits.len(), ROOM_WAITS_MAX);
        assert!(RoomWait::begin(&router).is_none());
        waits.pop();
        assert!(RoomWait::begin(&router).is_some());
    }
}
