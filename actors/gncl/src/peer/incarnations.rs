//! The incarnations of peers: each is met, leaves or is lost, and has ended from then on.

use std::{
    sync::{Arc, Weak, atomic::Ordering},
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    lock,
    outcome::Rejection,
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::Kind,
};

use super::{
    super::{
        core::Attach, datagrams::ForwardedNumbers, frame::frame, outstanding::OutstandingDestinations,
        peer_session::PeerSession,
    },
    Peer, Store,
};
use crate::State;

/// Maximum number of removed peers that have left messages for applications that accept nothing.
const DEPARTED_MAX: usize = 16;
/// Maximum number of removed incarnations with kept datagram numbers. After an error of NDL they return, and
/// repeat unacknowledged values. The earliest removed one is dropped first.
const FORWARDED_NUMBERS_MAX: usize = 16;
/// Replaces the time of departure: the incarnation was given up because of its departure.
const GIVEN_UP: u64 = u64::MAX;

impl Store {
    /// Returns all incarnations of peers that are known, or have waiting messages.
    pub fn all_incarnations(&self) -> Vec<Arc<Peer>> {
        lock(&self.all_incarnations).iter().filter_map(Weak::upgrade).collect()
    }

    /// Records that this incarnation of `node` has sent GOODBYE. Its remaining messages are accepted, then it ends.
    pub fn record_departure(&self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        for peer in
            self.all_incarnations().iter().filter(|peer| (peer.node, peer.incarnation) == (node, incarnation))
        {
            // SYNC: Relaxed; receivers of the GOODBYE are notified afterwards by the same thread, or through
            // the lock of an event queue.
            let _ = peer.has_left.compare_exchange(0, now.as_nanos(), Ordering::Relaxed, Ordering::Relaxed);
        }
    }

    /// Ends this incarnation of `node`: no further message of it is accepted.
    pub fn fence(&self, node: NodeAddress, incarnation: Incarnation) {
        let is_it = |peer: &&Arc<Peer>| (peer.node, peer.incarnation) == (node, incarnation);
        self.all_incarnations().iter().filter(is_it).for_each(|peer| peer.fence());
    }

    /// Ends incarnations that left this long ago and still send. A later incarnation of the node that leaves
    /// just now is not affected.
    pub fn fence_departed(&self, node: NodeAddress, now: Time, ago: Duration) {
        self.all_incarnations()
            .iter()
            .filter(|peer| peer.node == node)
            .for_each(|peer| peer.give_up_if_departed(now, ago));
    }

    /// Revokes the departure of this incarnation of `node`, because NDL has found it: the announcement was
    /// not its own. A waiter for its end is notified when its presence is reported, or a second later.
    pub fn revoke_departure(&self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peer(node).filter(|peer| peer.incarnation == incarnation) {
            peer.revoke_departure();
        }
    }

    /// Returns whether this incarnation of `node`, which NDL has found, is no longer accepted: it had ended,
    /// or was given up because of its announced departure.
    pub(crate) fn take_given_up(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.peer(node).is_some_and(|peer| peer.incarnation == incarnation && peer.take_given_up())
    }

    /// Returns the applications that may still receive a message of an incarnation of `node` that has left or ended.
    pub fn outstanding(&self, node: NodeAddress) -> OutstandingDestinations {
        let all = self.all_incarnations();
        let of_node = all.iter().filter(|peer| peer.node == node);
        of_node
            .map(|peer| peer.outstanding())
            .fold(OutstandingDestinations::NONE, OutstandingDestinations::union)
    }

    /// Returns when something of that incarnation of `node` was last read.
    pub fn last_alive(&self, node: NodeAddress, incarnation: Incarnation) -> Option<Time> {
        let peer = self.peer(node).filter(|peer| peer.incarnation == incarnation)?;
        // SYNC: see `mark_alive`.
        Some(peer.last_alive.load(Ordering::Relaxed)).filter(|at| *at != 0).map(Time::from_nanos)
    }

    /// Requests a liveness reply of that incarnation of `node` on each established connection: a PING, ahead
    /// of all queued messages. spec: NDL-4.7
    pub fn request_liveness(&self, here: NodeAddress, node: NodeAddress, incarnation: Incarnation) {
        let Some(peer) = self.peer(node).filter(|peer| peer.incarnation == incarnation) else { return };
        for session in peer.sessions.iter().filter(|session| session.outlet.is_connected()) {
            session.send_urgent(frame(here, node, Kind::GNCL_PING, Bytes::new()));
        }
    }

    /// Returns the peer of a connection, created if needed. An older incarnation of it is closed.
    pub(crate) fn get_or_create(&self, now: Time, attach: &Attach, state: &State) -> Arc<Peer> {
        let node = attach.node;
        match self.peer(node) {
            Some(peer)
                if peer.incarnation == attach.incarnation && (peer.sessions.len() > 1) == attach.by_class =>
            {
                return peer;
            }
            Some(_) => self.forget(node),
            None => {}
        }
        if let Some(access) = state.security.access.get() {
            access.on_connected(node, attach.incarnation);
        }
        let peer = Arc::new(Peer::new(now, attach, state));
        {
            let mut all = lock(&self.all_incarnations);
            all.retain(|former| former.strong_count() > 0);
            all.push(Arc::downgrade(&peer));
        }
        self.lock().insert(node, peer.clone());
        peer
    }

    /// Removes `node`: its queued messages are lost, and settled accordingly.
    pub(crate) fn forget(&self, node: NodeAddress) {
        let peer = self.lock().remove(&node);
        // The peer is closed without the lock: code notified of an outcome may look up a peer.
        let Some(peer) = peer else { return };
        peer.fence();
        peer.end(Rejection::NoSuchNode);
        if let Some(channel) = peer.channel() {
            let mut forwarded_numbers = lock(&self.forwarded_numbers);
            let surplus = (forwarded_numbers.len() + 1).saturating_sub(FORWARDED_NUMBERS_MAX);
            forwarded_numbers.drain(..surplus);
            forwarded_numbers.push_back((peer.node, peer.incarnation, channel.forwarded_numbers()));
        }
        if peer.has_undelivered() {
            self.keep_departed(peer);
        }
    }

    /// Keeps a removed peer with messages that may still be delivered to applications here. If there are too
    /// many, the earliest one is given up, because its messages have waited longest.
    fn keep_departed(&self, peer: Arc<Peer>) {
        let given_up: Vec<_> = {
            let mut departed = lock(&self.departed);
            let surplus = (departed.len() + 1).saturating_sub(DEPARTED_MAX);
            let given_up = departed.drain(..surplus).collect();
            departed.push(peer);
            self.count_departed(&departed);
            given_up
        };
        // A receipt in a queue references the peer that owns the queue, so the peer would never be dropped.
        given_up.iter().flat_map(|peer| &peer.sessions).for_each(PeerSession::abandon_queues);
        self.queues_changed.notify_one();
    }

    /// Returns the numbers forwarded by datagram of that incarnation of `node`, if it was known before.
    pub(super) fn forwarded_numbers(
        &self,
        node: NodeAddress,
        incarnation: Incarnation,
    ) -> Option<ForwardedNumbers> {
        let mut all = lock(&self.forwarded_numbers);
        let place =
            all.iter().position(|(of, of_incarnation, _)| (*of, *of_incarnation) == (node, incarnation))?;
        all.remove(place).map(|(.., forwarded_numbers)| forwarded_numbers)
    }

    /// Whether messages of an earlier incarnation of this peer still wait for the application of this queue.
    /// Messages of the later one must wait behind them.
    pub(crate) fn has_earlier_messages(&self, peer: &Arc<Peer>, queue: u64) -> bool {
        // SYNC: Relaxed; the list is read under its lock, and is nearly always empty. A later incarnation is
        // met on the thread that has counted the earlier one.
        if self.departed_count.load(Ordering::Relaxed) == 0 {
            return false;
        }
        let departed = lock(&self.departed);
        let before = departed.iter().take_while(|former| !Arc::ptr_eq(former, peer));
        before.filter(|former| former.node == peer.node).any(|former| former.has_queue(queue))
    }

    /// Drops the removed peers that have no more messages to deliver.
    pub(super) fn drop_served(&self) {
        let mut departed = lock(&self.departed);
        departed.retain(|peer| peer.has_undelivered());
        self.count_departed(&departed);
    }

    fn count_departed(&self, departed: &[Arc<Peer>]) {
        self.departed_count.store(departed.len(), Ordering::Relaxed);
    }
}

#[cfg(test)]
impl Store {
    /// Returns this incarnation of `node`, on placeholder connections.
    pub fn create_in_test(&self, node: NodeAddress, incarnation: Incarnation, state: &State) -> Arc<Peer> {
        use super::super::core::{ConnectionId, Lane};
        let attach = Attach {
            connection: ConnectionId(1),
            node,
            incarnation,
            lane: Lane::Control,
            by_class: false,
            takes_cancels: true,
            takes_outcomes: true,
            takes_outcome_runs: true,
            takes_reports: true,
            takes_datagrams: false,
            is_guarded: false,
            payload_max: 1 << 20,
            answers_max: 8_192,
            welcome: None,
        };
        self.get_or_create(Time::now(), &attach, state)
    }
}

impl Peer {
    fn give_up_if_departed(&self, now: Time, ago: Duration) {
        // SYNC: Relaxed; an independent value that one thread alone consumes. `revoke_departure` either sees that the
        // incarnation is given up, or prevents it.
        let given_up = self.has_left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| {
            let is_long_gone = left != 0 && left != GIVEN_UP && now.since(Time::from_nanos(left)) >= ago;
            is_long_gone.then_some(GIVEN_UP)
        });
        if given_up.is_ok() {
            self.fence();
        }
    }

    fn revoke_departure(&self) {
        // SYNC: see above. An error means that it has announced nothing, or that it is too late.
        let _ = self.has_left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| {
            (left != 0 && left != GIVEN_UP).then_some(0)
        });
    }

    /// Returns whether the incarnation was given up, and consumes that mark. The measured clock belongs to a
    /// node that is present now, so it is not removed with the state that ends.
    fn take_given_up(&self) -> bool {
        // SYNC: see above.
        let is_given_up = self.has_left.compare_exchange(GIVEN_UP, 0, Ordering::Relaxed, Ordering::Relaxed);
        is_given_up.is_ok() || self.is_over.load(Ordering::Acquire)
    }

    /// Whether an accepted message of it may still be delivered to an application here.
    fn has_undelivered(&self) -> bool {
        self.sessions.iter().any(PeerSession::has_undelivered)
    }

    fn has_queue(&self, queue: u64) -> bool {
        self.sessions.iter().any(|session| session.has_queue(queue))
    }
}
