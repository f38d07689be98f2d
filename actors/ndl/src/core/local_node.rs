//! The local node: its announcement, and its claim to its own address.
//!
//! Each process announces its claim to its address ([`Claim`]). A settled process precedes a settling one,
//! and then an earlier incarnation precedes a later one. Other nodes accept the first of them as soon as they
//! know that both are alive. The other process gives the address up when it receives from the first.

use std::net::SocketAddrV4;

use sinew_model::{config::NodeConfig, limits::FURTHER_MAX, progress::Progress};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Place, address_conflict::Claimant, paces::Pace};
use crate::datagram::{Announcement, Claim};

/// Another process has this node's address and precedes this node. It is accepted if it persists.
#[derive(Clone, Copy, Debug)]
struct Trial {
    since: Time,
    received: Time,
}

/// The local node.
#[derive(Debug)]
pub(super) struct LocalNode {
    pub(super) announcement: Announcement,
    /// The stalled parts of this node.
    pub(super) progress: Progress,
    /// End of the settling period. Until then, a live node with this node's address means that this node is
    /// the newcomer.
    settles: Option<Time>,
    /// Latest end to which the settling period can be postponed while another process with this node's
    /// address settles, too.
    settles_at_latest: Time,
    /// Start of a repeated settling period. Other nodes may have received the earlier claim last.
    settles_anew: Option<Time>,
    /// The node lost all its members. Other nodes may have given its address to a later incarnation.
    is_lonely: bool,
    /// Another process is about to be believed to own this node's address.
    trial: Option<Trial>,
}

/// Which process has this node's address, after another live process answered with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ownership {
    /// This node is not running.
    Unclaimed,
    /// This node.
    Local,
    /// The other process. This node goes on for now, because the other one may end.
    Contested,
    /// The other process. This node gives the address up.
    Lost,
    /// The same, before this node has settled, so that the address is not used twice.
    LostAtStart,
}

impl LocalNode {
    /// Creates the node without addresses. `boot_nonce` is random.
    pub(super) fn new(
        config: &NodeConfig,
        node: NodeAddress,
        incarnation: Incarnation,
        boot_nonce: u64,
    ) -> Self {
        let announcement = Announcement {
            project: config.project.clone(),
            node,
            name: config.name.clone(),
            incarnation,
            boot_nonce,
            gncl_ip: 0,
            gncl_port: 0,
            period_us: u32::try_from(config.ndl.period.as_micros()).unwrap_or(u32::MAX),
            gncl_further: Vec::new(),
            ndl: Vec::new(),
            ndl6: Vec::new(),
            gncl_port6: 0,
            claim: Claim::Settling,
        };
        Self {
            announcement,
            progress: Progress::default(),
            settles: None,
            settles_at_latest: Time::ZERO,
            settles_anew: None,
            is_lonely: false,
            trial: None,
        }
    }

    /// Sets the addresses at which GNCL listens, the preferred one first, and its port at IPv6 addresses.
    pub(super) fn announce_gncl(&mut self, addresses: Vec<SocketAddrV4>, port6: Option<u16>) {
        let mut all = addresses.into_iter().map(|gncl| (gncl.ip().to_bits(), gncl.port()));
        let announcement = &mut self.announcement;
        (announcement.gncl_ip, announcement.gncl_port) = all.next().unwrap_or_default();
        announcement.gncl_further = all.take(FURTHER_MAX).collect();
        announcement.gncl_port6 = port6.unwrap_or(0);
    }

    pub(super) const fn has_started(&self) -> bool {
        self.settles.is_some()
    }

    /// Starts the settling period. At its end this node owns its address, unless another process shows that
    /// it does. // spec: NDL-5.5
    pub(super) fn settle(&mut self, now: Time, pace: &Pace) {
        self.settles = Some(now + pace.bound());
        // Another settling process that was received by the regular end has settled by then.
        self.settles_at_latest = now + pace.bound() * 2 + pace.period;
        if self.announcement.claim == Claim::Held {
            self.settles_anew = Some(now);
        }
        self.announcement.claim = Claim::Settling;
    }

    pub(super) fn time_passed(&mut self, now: Time) {
        if self.settles.is_some_and(|settles| settles <= now) {
            self.announcement.claim = Claim::Held;
        }
    }

    /// Records that the last member was lost. The others may have lost this node instead.
    pub(super) const fn is_alone(&mut self) {
        self.is_lonely = true;
    }

    /// Handles an answer of any node. If all other nodes were lost, this node settles again. // spec: NDL-5.7
    pub(super) fn is_answered(&mut self, now: Time, pace: &Pace) {
        if std::mem::take(&mut self.is_lonely) {
            self.settle(now, pace);
        }
    }

    /// Handles a live process that has this node's own address. `has_peers` tells whether nodes accept this
    /// node's identity on authenticated connections. // spec: NDL-5.5
    pub(super) fn address_used(
        &mut self,
        now: Time,
        theirs: &Announcement,
        pace: &Pace,
        has_peers: impl FnOnce() -> bool,
    ) -> Ownership {
        let Some(settles) = self.settles else { return Ownership::Unclaimed };
        if now < settles && self.yields_while_settling(now, settles, theirs, pace) {
            return Ownership::LostAtStart;
        }
        if !theirs.precedes(&self.announcement) {
            return Ownership::Local;
        }
        // A node with established, authenticated connections owns its address; the other process cannot
        // connect. spec: NDL-5.8
        if now >= settles && !has_peers() && self.is_tried(now, pace) {
            return Ownership::Lost;
        }
        Ownership::Contested
    }

    /// Returns whether this node gives the address up while it settles. If both processes do, none is left.
    fn yields_while_settling(
        &mut self,
        now: Time,
        settles: Time,
        theirs: &Announcement,
        pace: &Pace,
    ) -> bool {
        // Two processes started together: the later incarnation gives up at once, the earlier one only if
        // the other persists.
        let ours = &self.announcement;
        let is_later = (theirs.incarnation, theirs.boot_nonce) < (ours.incarnation, ours.boot_nonce);
        let period = pace.period;
        // The other process may just have received that this node had settled, and give way. If this node
        // gave up at once, none would be left.
        let may_make_way = theirs.claim == Claim::Settling
            && self.settles_anew.is_some_and(|since| now.since(since) < period);
        let is_over = now + period > settles;
        // The other process may not have received from this node yet. It gives up when it does, and
        // settles if it never does. If both gave up, none would be left.
        let may_give_up = theirs.claim == Claim::Settling && settles + period <= self.settles_at_latest;
        if is_later && !may_make_way || is_over && !may_give_up {
            return true;
        }
        if is_over {
            self.settles = Some(settles + period);
        }
        false
    }

    /// Gives a process that precedes this node the same time as a newcomer. Both settled while they could not
    /// reach each other. Returns whether that time is over.
    // spec: NDL-5.7
    fn is_tried(&mut self, now: Time, pace: &Pace) -> bool {
        let is_on = |trial: &Trial| now.since(trial.received) <= pace.bound();
        let since = self.trial.filter(is_on).map_or(now, |trial| trial.since);
        if now.since(since) >= pace.period * pace.missed_max {
            return true;
        }
        self.trial = Some(Trial { since, received: now });
        false
    }

    /// Gives the address up.
    pub(super) const fn give_up(&mut self) {
        (self.settles, self.trial) = (None, None);
        self.announcement.claim = Claim::Yielded;
    }

    /// Returns this node as a claimant of its address, as seen by the process at the other end of `place`.
    pub(super) fn claimant(&self, place: Place) -> Claimant {
        Claimant { name: self.announcement.name.clone(), at: place.here }
    }

    #[cfg(test)]
    pub(super) const fn end_trial(&mut self) {
        self.trial = None;
    }
}
