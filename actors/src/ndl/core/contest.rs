//! A newcomer with a member's address: a restart of it, or a second process?

use std::time::Duration;

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{Core, Output, Place, cycle::IN_A_ROW_MAX, lives::Proof};
use crate::ndl::datagram::Announcement;

/// Longest time that a node has to show that it lives, when another process comes with its address.
const CHALLENGE_MAX: Duration = Duration::from_millis(100);
/// How often it is asked in that time: a question or its answer may be lost.
const CHALLENGES: u32 = 3;

/// A newcomer claims a member's address in a later life. The member has a time to show that it lives; if it does not, the newcomer has as long to
/// show that it does still: who finds that a living process has its address gives that up, and is silent.
#[derive(Debug)]
pub(super) struct Contest {
    /// An answer of the member to a question of then or later says that there are two.
    since: Time,
    pub(super) tried: Party,
    tried_since: Time,
    /// When the one that is tried is asked again, or its time is over.
    pub(super) until: Time,
    /// How often it is asked again in its time.
    pub(super) again: u32,
    /// How often its time was given anew: our own timer was late, or the member gave a sign or is connected.
    pub(super) put_off: u32,
    /// The newcomer has answered in its time. What the member said meanwhile on its connection is known when that part of the time is over.
    pub(super) has_answered: bool,
    /// The member lives, too, and has not settled, as the newcomer has: if that lives still, the address is its own.
    gives_way: bool,
    pub(super) newcomer: Proof,
}

/// Who is to show that it lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Party {
    Member,
    Newcomer,
}

impl Contest {
    /// Whether this says that the newcomer lives still, now that the member has had its time.
    fn is_won_by(&self, proof: &Proof) -> bool {
        self.tried == Party::Newcomer
            && proof.asked >= self.tried_since
            && self.newcomer.is_of(&proof.announcement)
    }
}

impl Core {
    /// A newcomer with a member's address: has the member been restarted, or are there two? // spec: NDL-5.3
    pub(super) fn contest(&mut self, now: Time, newcomer: Proof) {
        let node = newcomer.announcement.node;
        if let Some(contest) = self.contests.get_mut(&node) {
            let wins = contest.is_won_by(&newcomer);
            let is_newer = contest.newcomer.is_of(&newcomer.announcement)
                && contest.newcomer.from == newcomer.from
                && newcomer.asked >= contest.newcomer.asked;
            contest.has_answered |= wins;
            if wins || is_newer {
                contest.newcomer = newcomer;
            }
            return;
        }
        let tried = Party::Member;
        let contest = Contest {
            since: now,
            tried,
            tried_since: now,
            until: now,
            again: 0,
            put_off: 0,
            has_answered: false,
            gives_way: false,
            newcomer,
        };
        self.contests.insert(node, contest);
        self.give_time(now, node, tried);
    }

    /// The member is lost while a newcomer is tried: who answered before may be gone since, and is asked.
    pub(super) fn succeed(&mut self, now: Time, newcomer: &Proof) {
        if !self.contradicts_a_proof(now, newcomer) {
            let _ = self.contact_at(now, newcomer.from);
            self.ask(now, newcomer.from);
        }
    }

    fn challenge(&self) -> Duration {
        self.rest().period.min(CHALLENGE_MAX)
    }

    fn give_time(&mut self, now: Time, node: NodeAddress, tried: Party) {
        let until = now + self.challenge() / CHALLENGES;
        let Some(contest) = self.contests.get_mut(&node) else { return };
        (contest.tried, contest.tried_since, contest.has_answered) = (tried, now, false);
        (contest.until, contest.again) = (until, CHALLENGES - 1);
        if let Some(member) = self.members.get(&node) {
            // Where it is not reached by datagrams, its connections may be at rest.
            let incarnation = member.announcement.incarnation;
            self.outputs.push_back(Output::AskForSign { node, incarnation });
        }
        self.ask_the_tried(now, node);
    }

    fn ask_the_tried(&mut self, now: Time, node: NodeAddress) {
        match self.contests.get(&node).map(|contest| (contest.tried, contest.newcomer.from)) {
            Some((Party::Member, _)) => self.challenge_member(now, node),
            Some((Party::Newcomer, from)) => {
                // Others may have taken its place among those that are asked.
                let _ = self.contact_at(now, from);
                self.ask(now, from);
            }
            None => {}
        }
    }

    pub(super) fn challenge_member(&mut self, now: Time, node: NodeAddress) {
        // An answer of the member from where the newcomer is proves nothing.
        let newcomer = self.contests.get(&node).map(|contest| contest.newcomer.from);
        let routes = self.members.get(&node).into_iter().flat_map(|member| member.routes.places());
        let asked: Vec<_> = routes.filter(|place| Some(*place) != newcomer).collect();
        asked.into_iter().for_each(|place| self.ask(now, place));
    }

    pub(super) fn decide_contests(&mut self, now: Time) {
        let due = self.contests.iter().filter(|(_, contest)| contest.until <= now).map(|(node, _)| *node);
        for node in due.collect::<Vec<_>>() {
            self.decide_contest(now, node);
        }
    }

    /// A part of the time of who is tried is over: it is asked again, or that was the last one.
    fn decide_contest(&mut self, now: Time, node: NodeAddress) {
        let challenge = self.challenge();
        let Some(member) = self.members.get(&node) else {
            self.contests.remove(&node);
            return;
        };
        let Some(contest) = self.contests.get_mut(&node) else { return };
        let is_late = now.since(contest.until) > challenge / 2;
        if contest.again > 0 && !is_late && !contest.has_answered {
            contest.again -= 1;
            contest.until = now + challenge / CHALLENGES;
            self.ask_the_tried(now, node);
            return;
        }
        // What comes before a connection ends may be of a process that has ended already.
        let broke = member.link_broke.unwrap_or(Time::ZERO);
        let since = if member.is_linked() { contest.since } else { contest.tried_since.max(broke) };
        let has_given_a_sign = member.has_given_a_sign_since(since);
        // Starved ourselves, we may not have read the answer yet; a sign may have been under way when the member ended; and what is lost of a
        // connection that stands is said again, later. It is asked again, but not for ever. spec: NDL-4.2
        let is_open = match contest.tried {
            Party::Member => is_late || has_given_a_sign || member.is_linked(),
            // Its goodbye may be unread as well: who has found a living process with its address takes its answer back.
            Party::Newcomer => is_late,
        };
        if is_open && contest.put_off < IN_A_ROW_MAX {
            contest.put_off += 1;
            let tried = contest.tried;
            self.give_time(now, node, tried);
        } else if has_given_a_sign && !contest.gives_way {
            self.both_live(now, node);
        } else if contest.tried == Party::Member {
            contest.put_off = 0;
            self.give_time(now, node, Party::Newcomer);
        } else {
            // One that does not live: its next answer would begin another contest.
            let contest = self.contests.remove(&node).filter(|contest| contest.has_answered);
            let Some(Contest { newcomer, gives_way, .. }) = contest else { return };
            if self.contradicts_a_proof(now, &newcomer) {
                return;
            }
            match self.members.get(&node).filter(|_| gives_way) {
                None => self.replace(now, newcomer),
                // It may have settled since.
                Some(member) if !newcomer.announcement.precedes(&member.announcement) => {
                    self.collide(now, node, member.into(), (&newcomer).into());
                }
                Some(_) => self.give_way_to(now, newcomer),
            }
        }
    }

    /// The member gives signs on its connection, and answers no datagram. // spec: NDL-5.4
    fn both_live(&mut self, now: Time, node: NodeAddress) {
        let (Some(member), Some(contest)) = (self.members.get(&node), self.contests.remove(&node)) else {
            return;
        };
        // Where no connection stands it may have ended: what it sent before comes late as well.
        if !member.is_linked() || !member.has_given_a_sign_since(contest.tried_since) {
            return;
        }
        self.collide(now, node, member.into(), (&contest.newcomer).into());
    }

    /// Whether this is of a newcomer that is tried, from where it is or says that it is.
    pub(super) fn is_contender(&self, from: Place, announcement: &Announcement) -> bool {
        self.contests.get(&announcement.node).is_some_and(|Contest { newcomer, .. }| {
            let is_from_there = newcomer.from == from || newcomer.announcement.has_ndl_at(from.there);
            newcomer.is_of(announcement) && is_from_there
        })
    }

    /// The member lives, and was asked after the newcomer came: there are two. The newcomer, if the address is its own.
    pub(super) fn settle_contest(&mut self, now: Time, proof: &Proof) -> Option<Proof> {
        let node = proof.announcement.node;
        let fresh = self.challenge() / CHALLENGES;
        let is_later =
            |contest: &Contest| proof.asked >= contest.since && proof.from != contest.newcomer.from;
        if !self.contests.get(&node).is_some_and(is_later) {
            return None;
        }
        let mut contest = self.contests.remove(&node)?;
        // The member may have proven itself since the newcomer came.
        if !contest.newcomer.announcement.precedes(&proof.announcement)
            || self.contradicts_a_proof(now, &contest.newcomer)
        {
            self.collide(now, node, proof.into(), (&contest.newcomer).into());
            return None;
        }
        if now.since(contest.newcomer.asked) <= fresh {
            return Some(contest.newcomer);
        }
        // It may be gone since, and the member would be lost to nobody.
        let is_tried = contest.gives_way;
        contest.gives_way = true;
        if !is_tried {
            contest.put_off = 0;
        }
        self.contests.insert(node, contest);
        if !is_tried {
            self.give_time(now, node, Party::Newcomer);
        }
        None
    }
}
