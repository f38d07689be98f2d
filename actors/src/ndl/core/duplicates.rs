//! Two living processes with one node address: which of them has it, for others and for themselves.
//!
//! Each says how it stands to its address ([`Claim`]). Who has settled goes before who settles, and the elder life before the later
//! one. Others listen to that one as soon as they know that both live; the other one gives the address up when it hears of it.

use std::{collections::btree_map::Entry, fmt, net::SocketAddr, time::Duration};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{Core, Member, Output, lives::Proof};
use crate::ndl::{LossReason, datagram::Claim};

/// Time between two reports that a node address is used twice.
const COLLISION_REPORT_PERIOD: Duration = Duration::from_secs(10);
/// How often who gives its address up says so: a datagram may be lost, and who does not hear it keeps the rightful one out.
const YIELDS: usize = 3;

/// Another process has our address, and goes before us: it is believed when it stays.
#[derive(Clone, Copy, Debug)]
pub(super) struct Trial {
    since: Time,
    heard: Time,
}

/// A process that has a node address, or wants it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Claimant {
    /// The node's name.
    pub(crate) name: String,
    /// Where it answers.
    pub(crate) at: SocketAddr,
}

impl From<&Proof> for Claimant {
    fn from(proof: &Proof) -> Self {
        Self { name: proof.announcement.name.clone(), at: proof.from.there }
    }
}

impl From<&Member> for Claimant {
    fn from(member: &Member) -> Self {
        Self { name: member.announcement.name.clone(), at: member.routes.best().there }
    }
}

impl fmt::Display for Claimant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the node '{}' at {}", self.name, self.at)
    }
}

impl Core {
    /// The address is ours from then on, if nobody else shows that it is his. // spec: NDL-5.5
    pub(super) fn settle(&mut self, now: Time) {
        self.settles = Some(now + self.loss_bound());
        // One that settles and was heard by the regular end has settled itself by then.
        self.settles_at_latest = now + self.loss_bound() * 2 + self.rest().period;
        if self.me.claim == Claim::Held {
            self.settles_anew = Some(now);
        }
        self.me.claim = Claim::Settling;
    }

    pub(super) fn end_settling(&mut self, now: Time) {
        if self.settles.is_some_and(|settles| settles <= now) {
            self.me.claim = Claim::Held;
        }
    }

    /// Somebody is there again after all others were lost: to them we may have been the one who was lost. // spec: NDL-5.7
    pub(super) fn end_loneliness(&mut self, now: Time) {
        if std::mem::take(&mut self.is_lonely) {
            self.settle(now);
        }
    }

    /// Who goes before a member in its address proved to be there. // spec: NDL-5.6
    pub(super) fn elder_came(&mut self, now: Time, proof: Proof) {
        let claimed = &proof.announcement;
        let node = claimed.node;
        let Some(member) = self.members.get(&node) else { return };
        if member.fence.is_some_and(|fence| claimed.incarnation <= fence) {
            let known = member.announcement.incarnation;
            self.refuse_stale(now, &proof, known);
            return;
        }
        // Asked before the member came, it may have ended since, to make way for it.
        if proof.asked < member.since {
            return;
        }
        self.give_way_to(now, proof);
    }

    /// A member lives, and so does who goes before it in its address.
    pub(super) fn give_way_to(&mut self, now: Time, proof: Proof) {
        let node = proof.announcement.node;
        let Some(member) = self.members.get(&node) else { return };
        self.collide(now, node, (&proof).into(), member.into());
        self.contests.remove(&node);
        self.lose(now, node, LossReason::Duplicate);
        self.arrive(now, proof);
    }

    // spec: NDL-5.4
    pub(super) fn collide(&mut self, now: Time, node: NodeAddress, holder: Claimant, newcomer: Claimant) {
        let what = format_args!("{node} is that of {holder}; {newcomer} claims the same node address");
        self.refusals.count(now, "NDL node address used twice", &what);
        self.collisions_reported.retain(|_, last| now.since(*last) < COLLISION_REPORT_PERIOD);
        if let Entry::Vacant(report) = self.collisions_reported.entry(node) {
            report.insert(now);
            self.outputs.push_back(Output::Collision { node, holder, newcomer });
        }
    }

    /// A living process has our own node address. // spec: NDL-5.5
    pub(super) fn own_address_used(&mut self, now: Time, proof: &Proof) {
        let Some(settles) = self.settles else { return };
        let own = Claimant { name: self.me.name.clone(), at: proof.from.here };
        let other = Claimant::from(proof);
        let theirs = &proof.announcement;
        if now < settles {
            // Two that start together: the later life gives up at once, the earlier one only if the other stays.
            let is_later =
                (theirs.incarnation, theirs.boot_nonce) < (self.me.incarnation, self.me.boot_nonce);
            let period = self.rest().period;
            // It may have heard just before that we had settled, and make way for that. Were we to give up at once, nobody would be left.
            let may_make_way = theirs.claim == Claim::Settling
                && self.settles_anew.is_some_and(|since| now.since(since) < period);
            let is_over = now + period > settles;
            // It may not have heard of us yet, and gives up when it does; if it never does, it settles. Were both to give up, nobody would
            // be left.
            let may_give_up = theirs.claim == Claim::Settling && settles + period <= self.settles_at_latest;
            if is_later && !may_make_way || is_over && !may_give_up {
                return self.give_address_up(other);
            }
            if is_over {
                self.settles = Some(settles + period);
            }
        }
        if !theirs.precedes(&self.me) {
            return self.collide(now, self.me.node, own, other);
        }
        self.collide(now, self.me.node, other.clone(), own);
        // Whose connections stand, and prove something, is what it says; the other one cannot connect. spec: NDL-5.8
        if now >= settles && !self.proven.is_anybody() {
            self.try_other(now, other);
        }
    }

    /// Both have settled, apart from each other: who goes before us is given the time that a newcomer has. // spec: NDL-5.7
    fn try_other(&mut self, now: Time, other: Claimant) {
        let is_on = |trial: &Trial| now.since(trial.heard) <= self.loss_bound();
        let since = self.trial.filter(is_on).map_or(now, |trial| trial.since);
        if now.since(since) >= self.rest().period * self.rest().missed_max {
            return self.give_address_up(other);
        }
        self.trial = Some(Trial { since, heard: now });
    }

    fn give_address_up(&mut self, holder: Claimant) {
        (self.settles, self.trial) = (None, None);
        self.me.claim = Claim::Yielded;
        for _ in 0..YIELDS {
            self.leave();
        }
        self.outputs.push_back(Output::AddressTaken { holder });
    }
}
