//! Which path a message to another application takes, and from which path its messages may be read. Pure.
//!
//! At first all messages go through the node. An endpoint that wants a link with another application of the
//! node ([`DirectLinks`]) asks LNCL for an introduction, and continues through the node meanwhile. If the other
//! side agrees, both have a *direct link*: a ring in each direction that bypasses the node.
//!
//! ```text
//!   A (asks)                  LNCL                       B (is asked)
//!   Asked  ── INTRODUCE ────► │ ── INTRODUCTION ───────► Offered: its offer lies in the link's socket
//!          ◄─ INTRODUCED ──── │ ◄─ taken ───────────────
//!   Direct: its offer lies in the socket, too; from now on A writes to its ring only, and leaves B's ring unread
//!          ── SWITCH ───────► │ ── three marks ────────► Direct: B reads A's ring, and writes to its own only
//!          ◄─ three marks ─── │ ◄─ SWITCH ──────────────
//!   Direct, open: A reads B's ring
//! ```
//!
//! **Order is preserved.** The node keeps the order of each class, but not between classes: a lane that was
//! skipped gets its turn before others. So a SWITCH becomes one mark in each class, behind all messages sent
//! through the node before it. A ring is read when all three marks have arrived. The sender does not wait for
//! that: it writes into the ring at once.

mod events;
mod peer;
#[cfg(test)]
mod tests;

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::Class,
};

use crate::DirectLinks;
pub use events::{HangUpAction, MarkEffect, NodeDelivery, OutcomeEffect, Unread};
use peer::{Marks, Peer, PeerRing, Switch};

/// Maximum number of direct links per endpoint, including those being set up. Messages beyond it go through
/// the node.
pub(super) use sinew_protocol::link_counts::LINKS_MAX;
/// Maximum number of remembered destinations without a link, refused or counted. One more replaces the one
/// that expires first.
const UNLINKED_MAX: usize = 256;
/// Number of messages to one destination within [`COUNT_INTERVAL`] at which an endpoint with automatic links
/// requests one. A control loop at 1 kHz has its link after 8 ms; an occasional command costs no memory.
const FREQUENT_MESSAGES: u32 = 8;
/// Maximum number of automatic links per endpoint, and of frequent peers with which it requests any: among many
/// endpoints that all send to all others, each link carries little, and the node wakes a receiver for more messages at
/// once. See `docs/decisions/0013-two-routes.md` for the figures.
const AUTOMATIC_LINKS_MAX: usize = 16;
/// Time in which the messages to one destination are counted. Below 8 Hz the wake that a link saves is not
/// worth a ring of each side.
const COUNT_INTERVAL: Duration = Duration::from_secs(1);
/// Time until an introduction that failed temporarily is requested again.
const SHORT_RETRY: Duration = Duration::from_millis(100);
/// Time until an introduction is requested again that this destination will hardly ever allow.
const LONG_RETRY: Duration = Duration::from_secs(10);
/// Time until an unanswered introduction is abandoned: the peer answers only within its own calls.
const INTRODUCTION_TIMEOUT: Duration = Duration::from_secs(10);
/// Time until a SWITCH for which there was no room is sent again.
const SWITCH_RETRY: Duration = Duration::from_millis(10);
/// Time until a SWITCH that was refused or not answered is sent again.
const SWITCH_TIMEOUT: Duration = Duration::from_secs(1);
/// Time for which the ring of a closed peer waits for its marks. LNCL sends them even after the peer's end.
/// They are missing only if the peer ended before its SWITCH, or LNCL with it.
pub const MARKS_AFTER_END: Duration = Duration::from_secs(10);

/// The current path of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// Through the node.
    ViaNode,
    /// Through the node, and LNCL is asked for an introduction: [`Routes::asked`].
    RequestLink,
    /// Into the ring of this link.
    Direct(LinkNumber),
}

/// The number that LNCL has assigned to a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LinkNumber(pub u64);

/// The paths to all destinations of one endpoint.
#[derive(Debug)]
pub struct Routes {
    own: Tid,
    direct_links: DirectLinks,
    peers: BTreeMap<Tid, Peer>,
    /// Number of links, including those that may become one.
    links: usize,
}

impl Routes {
    /// Creates the paths of `own`: all messages go through the node at first.
    pub const fn new(own: Tid, direct_links: DirectLinks) -> Self {
        Self { own, direct_links, peers: BTreeMap::new(), links: 0 }
    }

    /// From now on no link is made automatically: a stop cuts the echoes of this endpoint's outputs at the node.
    pub const fn keep_to_node(&mut self) {
        if matches!(self.direct_links, DirectLinks::Automatic) {
            self.direct_links = DirectLinks::Never;
        }
    }

    /// Returns the path to `destination`, which is absolute.
    pub fn route(&self, destination: Tid, now: Time) -> Route {
        match self.peers.get(&destination) {
            Some(peer @ (Peer::Direct { .. } | Peer::Offered { .. })) => {
                peer.written_link().map_or(Route::ViaNode, Route::Direct)
            }
            Some(Peer::Refused { until } | Peer::Asked { until, .. }) if now < *until => Route::ViaNode,
            // The request was not answered.
            Some(Peer::Asked { .. }) => Route::RequestLink,
            Some(Peer::Counted { until, count }) if now < *until && *count + 1 >= FREQUENT_MESSAGES => {
                self.request(destination)
            }
            Some(Peer::Refused { .. }) | None if self.direct_links == DirectLinks::Always => {
                self.request(destination)
            }
            Some(Peer::Refused { .. } | Peer::Counted { .. }) | None => Route::ViaNode,
        }
    }

    /// Returns the link that messages to `destination` are written to.
    pub fn written_link(&self, destination: Tid) -> Option<LinkNumber> {
        self.peers.get(&destination).and_then(Peer::written_link)
    }

    /// Records that a message to `destination` was sent through the node. [`route`](Self::route) does not
    /// count, because a loaned message asks for its path twice. After a refusal the count starts again, so
    /// that an occasional sender does not repeat its request.
    pub fn sent_through_node(&mut self, destination: Tid, now: Time) {
        if self.direct_links != DirectLinks::Automatic || !self.may_have_link(destination) {
            return;
        }
        let (until, count) = match self.peers.get(&destination) {
            Some(Peer::Asked { .. } | Peer::Offered { .. } | Peer::Direct { .. }) => return,
            Some(Peer::Refused { until }) if now < *until => return,
            Some(Peer::Counted { until, count }) if now < *until => (*until, *count + 1),
            Some(Peer::Refused { .. } | Peer::Counted { .. }) | None => (now + COUNT_INTERVAL, 1),
        };
        self.set_unlinked(destination, Peer::Counted { until, count });
    }

    /// Records that LNCL has been asked for an introduction to `peer`.
    pub fn asked(&mut self, peer: Tid, correlation: u64, now: Time) {
        self.set(peer, Peer::Asked { correlation, until: now + INTRODUCTION_TIMEOUT });
    }

    /// Records that LNCL could not be asked.
    pub fn not_asked(&mut self, peer: Tid, now: Time) {
        self.refuse(peer, now + SHORT_RETRY);
    }

    /// Records that this process has no memory for one more link, or cannot close further unexpected
    /// descriptors of peers.
    pub fn no_room(&mut self, peer: Tid, now: Time) {
        self.refuse(peer, now + LONG_RETRY);
    }

    /// Handles LNCL's report that `peer` has agreed to a link. Returns whether the link is still wanted;
    /// otherwise its descriptor is closed.
    pub fn introduced(&self, peer: Tid, correlation: u64) -> bool {
        matches!(self.peers.get(&peer), Some(Peer::Asked { correlation: asked, .. }) if *asked == correlation)
    }

    /// Handles LNCL's report that `peer` requests a link.
    ///
    /// # Errors
    /// Returns why there is no link; the peer may ask again.
    pub fn on_introduction(&self, peer: Tid) -> Result<(), Rejection> {
        if !self.direct_links.accepts() || peer == self.own {
            return Err(Rejection::Unsupported);
        }
        match self.peers.get(&peer) {
            // Both ask at once: the link that the smaller one requested is set up.
            Some(Peer::Asked { .. }) if self.own < peer => Err(Rejection::QueueFull),
            Some(Peer::Asked { .. }) => Ok(()),
            Some(Peer::Offered { .. } | Peer::Direct { .. }) => Err(Rejection::QueueFull),
            Some(Peer::Refused { .. } | Peer::Counted { .. }) | None if self.links < self.links_max() => {
                Ok(())
            }
            Some(Peer::Refused { .. } | Peer::Counted { .. }) | None => Err(Rejection::QueueFull),
        }
    }

    /// Records that our offer is in the socket of the link that `peer` has requested.
    pub fn offered(&mut self, peer: Tid, number: LinkNumber) {
        self.set(peer, Peer::Offered { number, marks: Marks::default(), ended_at: None });
    }

    /// Records that the link is established and whether our SWITCH was sent, behind all messages through the
    /// node so far. Without room for it, it is sent later. The peer's ring is open if its SWITCH established
    /// the link.
    pub fn connected(&mut self, peer: Tid, number: LinkNumber, sent: Option<u64>, now: Time) {
        let (peer_ring, ended_at) = match self.peers.get(&peer) {
            Some(Peer::Offered { ended_at, .. }) => (PeerRing::Open, *ended_at),
            Some(Peer::Refused { .. } | Peer::Counted { .. } | Peer::Asked { .. } | Peer::Direct { .. })
            | None => (PeerRing::Held(Marks::default()), None),
        };
        let later = Switch::Unsent { at: now + SWITCH_RETRY };
        let switch =
            sent.map_or(later, |correlation| Switch::Sent { correlation, again: now + SWITCH_TIMEOUT });
        self.set(peer, Peer::Direct { number, switch, peer_ring, ended_at });
    }

    /// Handles a mark of `peer`'s SWITCH.
    pub fn on_mark(
        &mut self,
        peer: Tid,
        number: LinkNumber,
        class: Class,
        confirm: Option<u64>,
    ) -> MarkEffect {
        match self.peers.get_mut(&peer) {
            // It was repeated; the first one is answered when all marks have arrived.
            Some(
                Peer::Offered { number: ours, marks, .. }
                | Peer::Direct { number: ours, peer_ring: PeerRing::Held(marks), .. },
            ) if *ours == number && marks.confirm.is_some() && confirm.is_some() => MarkEffect::Known,
            // All have arrived before: the link is being connected.
            Some(Peer::Offered { number: ours, marks, .. }) if *ours == number && marks.are_all() => {
                MarkEffect::Known
            }
            Some(Peer::Offered { number: ours, marks, .. }) if *ours == number => {
                if !marks.note(class, confirm) {
                    return MarkEffect::Wait;
                }
                MarkEffect::Connect { confirm: marks.confirm }
            }
            Some(Peer::Direct { number: ours, peer_ring, .. }) if *ours == number => {
                let PeerRing::Held(marks) = peer_ring else { return MarkEffect::Known };
                if !marks.note(class, confirm) {
                    return MarkEffect::Wait;
                }
                let confirm = marks.confirm;
                *peer_ring = PeerRing::Open;
                MarkEffect::Open { confirm }
            }
            Some(
                Peer::Refused { .. }
                | Peer::Counted { .. }
                | Peer::Asked { .. }
                | Peer::Offered { .. }
                | Peer::Direct { .. },
            )
            | None => MarkEffect::Unknown,
        }
    }

    /// Handles an OUTCOME for `correlation`.
    pub fn on_outcome(&mut self, correlation: u64, outcome: Outcome, now: Time) -> OutcomeEffect {
        let ours = self.peers.iter().find(|(_, peer)| peer.correlation() == Some(correlation));
        let Some((tid, peer)) = ours.map(|(tid, peer)| (*tid, *peer)) else { return OutcomeEffect::NotOurs };
        let Peer::Direct { number, .. } = peer else {
            self.refuse(tid, now + pause(outcome));
            return OutcomeEffect::Noted;
        };
        match outcome {
            Outcome::Delivered => self.set_switch(tid, Switch::Taken),
            // The peer itself reports that it has no such link. The close of its socket may still be in
            // transit.
            Outcome::Rejected(Rejection::Unsupported | Rejection::Malformed) => {
                return OutcomeEffect::End(tid, number);
            }
            // A node or queue in between has failed or is full: the link's end would show by itself.
            Outcome::Rejected(_)
            | Outcome::Expired
            | Outcome::Failed
            | Outcome::PeerLost
            | Outcome::Unknown => self.set_switch(tid, Switch::Resend { at: now + SWITCH_TIMEOUT }),
        }
        OutcomeEffect::Noted
    }

    /// Returns a peer that needs its SWITCH again by `now`: [`switched`](Self::switched), or
    /// [`not_switched`](Self::not_switched).
    pub fn switch_due(&self, now: Time) -> Option<(Tid, LinkNumber)> {
        self.peers.iter().find_map(|(tid, peer)| match peer {
            Peer::Direct { number, switch, ended_at: None, .. }
                if switch.due().is_some_and(|at| at <= now) =>
            {
                Some((*tid, *number))
            }
            Peer::Refused { .. }
            | Peer::Counted { .. }
            | Peer::Asked { .. }
            | Peer::Offered { .. }
            | Peer::Direct { .. } => None,
        })
    }

    /// Records that the SWITCH was repeated.
    pub fn switched(&mut self, peer: Tid, correlation: u64, now: Time) {
        self.set_switch(peer, Switch::Sent { correlation, again: now + SWITCH_TIMEOUT });
    }

    /// Records that the SWITCH could not be sent; it is sent later.
    pub fn not_switched(&mut self, peer: Tid, now: Time) {
        if let Some(Peer::Direct { switch, .. }) = self.peers.get_mut(&peer) {
            let at = now + SWITCH_RETRY;
            *switch = match switch {
                Switch::Unsent { .. } => Switch::Unsent { at },
                Switch::Sent { .. } | Switch::Resend { .. } | Switch::Taken => Switch::Resend { at },
            };
        }
    }

    /// Handles a message from `source` that arrived through the node for this application alone.
    pub fn on_node_message(&mut self, source: Tid, class: Class, now: Time) -> NodeDelivery {
        match self.peers.get_mut(&source) {
            Some(Peer::Direct { number, peer_ring: PeerRing::Open, ended_at, .. }) => {
                ended_at.get_or_insert(now);
                NodeDelivery::AfterLink(*number)
            }
            Some(
                Peer::Direct { number, peer_ring: PeerRing::Held(marks), ended_at, .. }
                | Peer::Offered { number, marks, ended_at },
            ) if marks.has(class) => {
                ended_at.get_or_insert(now);
                NodeDelivery::AfterLink(*number)
            }
            Some(
                Peer::Refused { .. }
                | Peer::Counted { .. }
                | Peer::Asked { .. }
                | Peer::Offered { .. }
                | Peer::Direct { .. },
            )
            | None => NodeDelivery::Take,
        }
    }

    /// Handles the close of the link by the peer, or the end of its process, with this much `unread` data.
    /// Called repeatedly while its ring is kept.
    pub fn on_hang_up(&mut self, peer: Tid, unread: Unread, now: Time) -> HangUpAction {
        match self.peers.get_mut(&peer) {
            Some(Peer::Direct { peer_ring: PeerRing::Open, ended_at, .. }) => {
                ended_at.get_or_insert(now);
                HangUpAction::Drain
            }
            // The peer sent its SWITCH before it wrote anything.
            Some(Peer::Direct { .. } | Peer::Offered { .. }) if unread == Unread::None => HangUpAction::Drop,
            Some(
                Peer::Direct { peer_ring: PeerRing::Held(_), ended_at, .. } | Peer::Offered { ended_at, .. },
            ) => {
                if now < *ended_at.get_or_insert(now) + MARKS_AFTER_END {
                    HangUpAction::Keep
                } else {
                    HangUpAction::Drop
                }
            }
            Some(Peer::Refused { .. } | Peer::Counted { .. } | Peer::Asked { .. }) | None => {
                HangUpAction::Drop
            }
        }
    }

    /// Records that the link with `peer` has ended. A later one may be requested.
    pub fn ended(&mut self, peer: Tid, now: Time) {
        self.refuse(peer, now + SHORT_RETRY);
    }

    /// Records the end of the connection to the node. Requests to the node are dropped, and each unanswered
    /// SWITCH is sent again over the next connection.
    pub fn on_node_end(&mut self, now: Time) {
        for peer in self.peers.values_mut() {
            match peer {
                Peer::Asked { .. } => {
                    *peer = Peer::Refused { until: now };
                    self.links -= 1;
                }
                Peer::Direct { switch: switch @ Switch::Sent { .. }, .. } => {
                    *switch = Switch::Resend { at: now };
                }
                Peer::Direct { .. } | Peer::Offered { .. } | Peer::Refused { .. } | Peer::Counted { .. } => {}
            }
        }
    }

    /// Returns whether LNCL has been asked and has not answered.
    pub fn is_asking(&self) -> bool {
        self.peers.values().any(|peer| matches!(peer, Peer::Asked { .. }))
    }

    /// Returns whether the ring of `peer` is read.
    pub fn is_open(&self, peer: Tid) -> bool {
        matches!(self.peers.get(&peer), Some(Peer::Direct { peer_ring: PeerRing::Open, .. }))
    }

    /// Returns the link with `peer`, if it exists or is being set up.
    pub fn link(&self, peer: Tid) -> Option<LinkNumber> {
        self.peers.get(&peer).and_then(Peer::link)
    }

    /// Returns the path of a message for which a link is wanted.
    fn request(&self, destination: Tid) -> Route {
        if self.may_have_link(destination) { Route::RequestLink } else { Route::ViaNode }
    }

    /// Returns whether one more link is useful. If an endpoint with automatic links has too many frequent peers, all of
    /// them are reached through the node for a while.
    pub fn is_link_useful(&mut self, now: Time) -> bool {
        let is_frequent = |peer: &Peer| match peer {
            Peer::Counted { until, count } => now < *until && *count >= FREQUENT_MESSAGES / 2,
            Peer::Refused { .. } => false,
            Peer::Asked { .. } | Peer::Offered { .. } | Peer::Direct { .. } => true,
        };
        let is_useful = self.direct_links != DirectLinks::Automatic
            || self.peers.values().filter(|peer| is_frequent(peer)).count() <= AUTOMATIC_LINKS_MAX;
        if !is_useful {
            let counted = self.peers.values_mut().filter(|peer| matches!(peer, Peer::Counted { .. }));
            for peer in counted.filter(|peer| is_frequent(peer)) {
                *peer = Peer::Refused { until: now + LONG_RETRY };
            }
        }
        is_useful
    }

    const fn links_max(&self) -> usize {
        match self.direct_links {
            DirectLinks::Automatic => AUTOMATIC_LINKS_MAX,
            DirectLinks::Always => LINKS_MAX,
            DirectLinks::Never => 0,
        }
    }

    fn may_have_link(&self, destination: Tid) -> bool {
        self.links < self.links_max()
            && destination != self.own
            && destination.node == self.own.node
            && destination.is_single()
            && !destination.app.is_layer()
    }

    fn set_switch(&mut self, peer: Tid, to: Switch) {
        if let Some(Peer::Direct { switch, .. }) = self.peers.get_mut(&peer) {
            *switch = to;
        }
    }

    fn refuse(&mut self, peer: Tid, until: Time) {
        self.set_unlinked(peer, Peer::Refused { until });
    }

    /// Remembers a destination without a link. The newest one stays: otherwise no destination could be counted
    /// while the others are refused for longer.
    fn set_unlinked(&mut self, tid: Tid, peer: Peer) {
        self.set(tid, peer);
        if self.peers.len() - self.links > UNLINKED_MAX {
            let others = self.peers.iter().filter(|(other, _)| **other != tid);
            let expiries = others.filter_map(|(other, peer)| Some((peer.expires()?, *other)));
            if let Some((_, first)) = expiries.min() {
                self.peers.remove(&first);
            }
        }
    }

    fn set(&mut self, tid: Tid, peer: Peer) {
        let is_link = |peer: &Peer| peer.expires().is_none();
        self.links += usize::from(is_link(&peer));
        if let Some(former) = self.peers.insert(tid, peer) {
            self.links -= usize::from(is_link(&former));
        }
    }
}

/// Returns how long an introduction with this outcome is not requested again.
const fn pause(outcome: Outcome) -> Duration {
    match outcome {
        // The destination is in the node's own process, on another node, a client with a plain socket, or
        // without direct links.
        Outcome::Rejected(Rejection::Unsupported) => LONG_RETRY,
        Outcome::Delivered
        | Outcome::Rejected(_)
        | Outcome::Expired
        | Outcome::Failed
        | Outcome::PeerLost
        | Outcome::Unknown => SHORT_RETRY,
    }
}
