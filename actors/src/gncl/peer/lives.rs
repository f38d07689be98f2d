//! Which lives of peers there are: each is met, leaves or is lost, and is over from then on.

use std::{
    sync::{Arc, Weak, atomic::Ordering},
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    outcome::Rejection,
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::Kind,
};

use super::{
    super::{core::Attach, datagrams::HandedOn, owed::Owed, way::Way},
    Peer, Store, frame,
};
use crate::stores::{Stores, lock};

/// Peers at most that are gone and have left messages for applications that take nothing.
const GONE_MAX: usize = 16;
/// Forgotten lives of peers of which it is known what came by datagram: in an error of NDL they come back, and send again what was not
/// acknowledged. The one that was forgotten first makes room.
const HANDED_ON_MAX: usize = 16;
/// In place of the time at which it left: the life was given up for it.
const GIVEN_UP: u64 = u64::MAX;

impl Store {
    /// Every life of a peer that is known, or that messages still wait of.
    pub(crate) fn met(&self) -> Vec<Arc<Peer>> {
        lock(&self.met).iter().filter_map(Weak::upgrade).collect()
    }

    /// This life of `node` has said goodbye: what it still sends is taken, and then it is over.
    pub(crate) fn leaves(&self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        for peer in self.met().iter().filter(|peer| (peer.node, peer.incarnation) == (node, incarnation)) {
            // SYNC: Relaxed; who is told of the goodbye is told behind this by the same thread, or through a post's lock.
            let _ = peer.has_left.compare_exchange(0, now.as_nanos(), Ordering::Relaxed, Ordering::Relaxed);
        }
    }

    /// This life of `node` is over: nothing more is taken of it.
    pub(crate) fn fence(&self, node: NodeAddress, incarnation: Incarnation) {
        let is_it = |peer: &&Arc<Peer>| (peer.node, peer.incarnation) == (node, incarnation);
        self.met().iter().filter(is_it).for_each(|peer| peer.fence());
    }

    /// Who left so long ago, and still sends, is over. A later life of the node that leaves just now is not.
    pub(crate) fn fence_who_left(&self, node: NodeAddress, now: Time, ago: Duration) {
        self.met()
            .iter()
            .filter(|peer| peer.node == node)
            .for_each(|peer| peer.is_given_up_if_it_left(now, ago));
    }

    /// NDL has found this life of `node`: the word that it leaves was not its own. Who waits for its last message to hear that it is gone
    /// hears that when it is told that it is there, or a second later.
    pub(crate) fn stays(&self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peer(node).filter(|peer| peer.incarnation == incarnation) {
            peer.stays();
        }
    }

    /// Whether nothing is taken any more of this life of `node`, which NDL has found: it was over, or was given up as it said that it leaves.
    pub(in crate::gncl) fn has_given_up(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.peer(node).is_some_and(|peer| peer.incarnation == incarnation && peer.was_given_up())
    }

    /// To whom a message of a life of `node` that has left or is over may still come.
    pub(crate) fn owed(&self, node: NodeAddress) -> Owed {
        let met = self.met();
        let of_node = met.iter().filter(|peer| peer.node == node);
        of_node.map(|peer| peer.owed()).fold(Owed::NOBODY, Owed::and)
    }

    /// When something of that life of `node` was read last.
    pub(crate) fn sign_of(&self, node: NodeAddress, incarnation: Incarnation) -> Option<Time> {
        let peer = self.peer(node).filter(|peer| peer.incarnation == incarnation)?;
        // SYNC: see `gives_a_sign`.
        Some(peer.sign.load(Ordering::Relaxed)).filter(|sign| *sign != 0).map(Time::from_nanos)
    }

    /// Has that life of `node` give a sign on each connection that stands: a PING, ahead of all that waits there. spec: NDL-4.7
    pub(crate) fn ask_for_a_sign(&self, here: NodeAddress, node: NodeAddress, incarnation: Incarnation) {
        let Some(peer) = self.peer(node).filter(|peer| peer.incarnation == incarnation) else { return };
        for way in peer.ways.iter().filter(|way| way.outlet.is_connected()) {
            way.say(frame(here, node, Kind::GNCL_PING, Bytes::new()));
        }
    }

    /// The peer that a connection leads to, made if need be. An older life of it is closed.
    pub(in crate::gncl) fn meet(&self, now: Time, attach: &Attach, stores: &Stores) -> Arc<Peer> {
        let node = attach.node;
        match self.peer(node) {
            Some(peer)
                if peer.incarnation == attach.incarnation && (peer.ways.len() > 1) == attach.by_class =>
            {
                return peer;
            }
            Some(_) => self.forget(node),
            None => {}
        }
        if let Some(access) = stores.access.get() {
            access.meets(node, attach.incarnation);
        }
        let peer = Arc::new(Peer::new(now, attach, stores));
        {
            let mut met = lock(&self.met);
            met.retain(|former| former.strong_count() > 0);
            met.push(Arc::downgrade(&peer));
        }
        self.lock().insert(node, peer.clone());
        peer
    }

    /// Nothing reaches `node` any more: what waits for it is lost, and says so.
    pub(in crate::gncl) fn forget(&self, node: NodeAddress) {
        let peer = self.lock().remove(&node);
        // Closed without the lock: whoever is told of an outcome may ask for a peer.
        let Some(peer) = peer else { return };
        peer.fence();
        peer.end(Rejection::NoSuchNode);
        if let Some(channel) = peer.channel() {
            let mut handed_on = lock(&self.handed_on);
            let surplus = (handed_on.len() + 1).saturating_sub(HANDED_ON_MAX);
            handed_on.drain(..surplus);
            handed_on.push_back((peer.node, peer.incarnation, channel.handed_on()));
        }
        if peer.owes() {
            self.keep_gone(peer);
        }
    }

    /// Keeps a peer that is gone, as messages of it may still come to applications here. What the first one left has waited longest, and
    /// is given up when they are too many.
    fn keep_gone(&self, peer: Arc<Peer>) {
        let given_up: Vec<_> = {
            let mut gone = lock(&self.gone);
            let surplus = (gone.len() + 1).saturating_sub(GONE_MAX);
            let given_up = gone.drain(..surplus).collect();
            gone.push(peer);
            self.count_gone(&gone);
            given_up
        };
        // A receipt in a line holds the peer whose line it is: nothing of that goes by itself.
        given_up.iter().flat_map(|peer| &peer.ways).for_each(Way::abandon_lines);
        self.held_up.notify_one();
    }

    /// What was handed on by datagram of that life of `node`, if it was here before.
    pub(super) fn handed_on(&self, node: NodeAddress, incarnation: Incarnation) -> Option<HandedOn> {
        let mut all = lock(&self.handed_on);
        let place = all.iter().position(|(of, life, _)| (*of, *life) == (node, incarnation))?;
        all.remove(place).map(|(.., handed_on)| handed_on)
    }

    /// Whether messages of an earlier life of this peer still wait for the application of this line: its own wait behind them.
    pub(in crate::gncl) fn waits_before(&self, peer: &Arc<Peer>, line: u64) -> bool {
        // SYNC: Relaxed; what is in there is seen under its lock, and nearly always there is nothing. A later life is met on the thread
        // that has counted the earlier one.
        if self.gone_count.load(Ordering::Relaxed) == 0 {
            return false;
        }
        let gone = lock(&self.gone);
        let before = gone.iter().take_while(|former| !Arc::ptr_eq(former, peer));
        before.filter(|former| former.node == peer.node).any(|former| former.has_line(line))
    }

    /// Those of which nothing may come any more.
    pub(super) fn drop_those_served(&self) {
        let mut gone = lock(&self.gone);
        gone.retain(|peer| peer.owes());
        self.count_gone(&gone);
    }

    fn count_gone(&self, gone: &[Arc<Peer>]) {
        self.gone_count.store(gone.len(), Ordering::Relaxed);
    }
}

#[cfg(test)]
impl Store {
    /// This life of `node`, on connections that stand for themselves.
    pub(crate) fn meet_in_test(
        &self,
        node: NodeAddress,
        incarnation: Incarnation,
        stores: &Stores,
    ) -> Arc<Peer> {
        use super::super::core::{ConnectionId, Lane};
        let attach = Attach {
            connection: ConnectionId(1),
            node,
            incarnation,
            lane: Lane::Control,
            by_class: false,
            takes_cancels: true,
            takes_outcomes: true,
            takes_reports: true,
            takes_datagrams: false,
            is_guarded: false,
            payload_max: 1 << 20,
            answers_max: 8_192,
            welcome: None,
        };
        self.meet(Time::now(), &attach, stores)
    }
}

impl Peer {
    fn is_given_up_if_it_left(&self, now: Time, ago: Duration) {
        // SYNC: Relaxed; a word by itself, which one thread alone takes out: who finds that it stays sees that it is given up, or it is not.
        let given_up = self.has_left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| {
            let is_long_gone = left != 0 && left != GIVEN_UP && now.since(Time::from_nanos(left)) >= ago;
            is_long_gone.then_some(GIVEN_UP)
        });
        if given_up.is_ok() {
            self.fence();
        }
    }

    fn stays(&self) {
        // SYNC: see above. An error says that it has said nothing, or that it is too late.
        let _ = self.has_left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| {
            (left != 0 && left != GIVEN_UP).then_some(0)
        });
    }

    /// What is known of its clock by now is of a node that is there: it does not go with what ends.
    fn was_given_up(&self) -> bool {
        // SYNC: see above.
        let is_given_up = self.has_left.compare_exchange(GIVEN_UP, 0, Ordering::Relaxed, Ordering::Relaxed);
        is_given_up.is_ok() || self.is_over.load(Ordering::Acquire)
    }

    /// Whether a message of it that was taken may still come to an application here.
    fn owes(&self) -> bool {
        self.ways.iter().any(Way::owes)
    }

    fn has_line(&self, line: u64) -> bool {
        self.ways.iter().any(|way| way.has_line(line))
    }
}
