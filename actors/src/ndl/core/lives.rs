//! Who comes, goes, and comes again in a new life.

use std::time::Duration;

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Core, Member, Output, Place, Source,
    clock::{Exchange, Measured, PeerClock},
    contact::{Contact, Role},
    contacts::ContactMut,
    gone::Silence,
    recall::Loss,
    routes::Routes,
    troubles::Troubles,
};
use crate::{
    gncl::LinkFact,
    ndl::{LossReason, MembershipFact, NodeEvent, Progress, datagram::Announcement},
};

/// Time in which a broken connection may be made again at another address.
const LINK_GRACE: Duration = Duration::from_secs(1);

/// An answer to a question that was asked at one address: somebody is there and says this.
#[derive(Clone, Debug)]
pub(super) struct Proof {
    pub(super) from: Place,
    /// When the question was asked.
    pub(super) asked: Time,
    pub(super) announcement: Announcement,
    pub(super) exchange: Option<Exchange>,
    pub(super) progress: Progress,
}

impl Proof {
    pub(super) fn is_of(&self, other: &Announcement) -> bool {
        self.announcement.node == other.node && self.announcement.is_same_life(other)
    }
}

/// How a node that becomes a member is announced to applications.
#[derive(Clone, Copy, Debug)]
enum Arrival {
    Found,
    /// It was there before, in another life that has been silent since.
    Restarted(Silence),
}

impl Core {
    /// Somebody proved to be at an address. // spec: NDL-3.2
    pub(super) fn confirmed(&mut self, now: Time, proof: Proof) {
        let claimed = &proof.announcement;
        // A newcomer whose address turns out to be another's has none to come from.
        self.contests
            .retain(|_, contest| contest.newcomer.from != proof.from || contest.newcomer.is_of(claimed));
        self.end_loneliness(now);
        if claimed.node == self.me.node {
            self.own_address_used(now, &proof);
            return;
        }
        if self.contradicts_a_proof(now, &proof) {
            return;
        }
        self.release_address(now, proof.from, claimed.node);
        let Some(member) = self.members.get(&claimed.node) else {
            self.arrive(now, proof);
            return;
        };
        let known = &member.announcement;
        if known.is_same_life(claimed) {
            self.alive(now, proof);
        } else if claimed.incarnation <= known.incarnation && claimed.precedes(known) {
            self.elder_came(now, proof);
        } else if claimed.incarnation < known.incarnation {
            self.refuse_stale(now, &proof, known.incarnation);
        } else if claimed.incarnation == known.incarnation {
            self.collide(now, claimed.node, member.into(), (&proof).into());
        } else if member.is_followed_at(proof.from) {
            self.replace(now, proof);
        } else {
            self.contest(now, proof);
        }
    }

    /// Another node is where a member was: the member is not.
    fn release_address(&mut self, now: Time, place: Place, node: NodeAddress) {
        let role = self.contacts.get(&place).map(|contact| contact.role);
        let Some(Role::Member(other)) = role.filter(|role| *role != Role::Member(node)) else { return };
        let Some(member) = self.members.get_mut(&other) else { return };
        if member.routes.is_only(place) {
            self.lose(now, other, LossReason::Crashed);
            return;
        }
        member.routes.keep(|route| route.place != place);
        self.drop_contact(now, place);
    }

    fn alive(&mut self, now: Time, proof: Proof) {
        let node = proof.announcement.node;
        if !self.is_routed(now, node, proof.from) {
            // Anybody may answer there in its name.
            return;
        }
        if let Some(member) = self.members.get_mut(&node) {
            member.announcement.claim = proof.announcement.claim;
        }
        if let Some(newcomer) = self.settle_contest(now, &proof) {
            self.give_way_to(now, newcomer);
            return;
        }
        let Some(member) = self.members.get_mut(&node) else { return };
        member.heard = now;
        (member.missed, member.host) = (0, None);
        member.is_awaited = false;
        member.answered = member.answered.max(proof.asked);
        member.routes.answered(proof.from, proof.exchange.and_then(|exchange| exchange.round_trip()));
        self.note_addresses(now, node, proof.from, &proof.announcement);
        self.drop_unannounced_routes(now, node, proof.from);
        self.measure(now, node, proof.exchange);
        self.answers_again(node);
        self.note_progress(node, proof.progress);
    }

    fn measure(&mut self, now: Time, node: NodeAddress, exchange: Option<Exchange>) {
        let Some(member) = self.members.get_mut(&node) else { return };
        let Some(exchange) = exchange else { return };
        match member.clock.measure(exchange) {
            Measured::Offset => {}
            Measured::Nothing => {
                let what = format_args!("the times of {node} contradict each other");
                self.refusals.count(now, "NDL answer with false times", &what);
                return;
            }
            Measured::Leap => {
                let what = format_args!(
                    "that of {node}, or this node's: the host slept, or the clock is set or slewed by much"
                );
                self.refusals.count(now, "a monotonic clock leapt", &what);
            }
        }
        if let Some(offset) = member.clock.offset(now) {
            let incarnation = member.announcement.incarnation;
            self.outputs.push_back(Output::ClockMeasured { node, incarnation, offset });
        }
    }

    /// Nobody with this address is a member.
    pub(super) fn arrive(&mut self, now: Time, proof: Proof) {
        let claimed = &proof.announcement;
        let mut fence = None;
        let arrival = match self.gone.get(&claimed.node) {
            None => Arrival::Found,
            Some(gone) if claimed.incarnation > gone.incarnation => {
                fence = Some(gone.incarnation);
                Arrival::Restarted(gone.silence(now))
            }
            Some(gone)
                if claimed.incarnation == gone.incarnation && claimed.boot_nonce == gone.boot_nonce =>
            {
                Arrival::Found
            }
            Some(gone) if self.earlier_may_come(now, gone.since) => {
                // GNCL knows nothing of that address any more, so that the earlier life may connect.
                let (node, incarnation) = (claimed.node, gone.incarnation);
                self.outputs.push_back(Output::Forgotten { node, incarnation });
                Arrival::Restarted(gone.silence(now))
            }
            Some(gone) => {
                self.refuse_stale(now, &proof, gone.incarnation);
                return;
            }
        };
        if self.members.len() >= self.nodes_max {
            self.refusals.count(now, "more nodes than `ndl.nodes_max`", &proof.from.there);
            return;
        }
        self.join(now, proof, arrival, fence);
    }

    // spec: NDL-5.2
    pub(super) fn refuse_stale(&self, now: Time, proof: &Proof, known: Incarnation) {
        let Announcement { node, incarnation, .. } = proof.announcement;
        let what = format_args!(
            "{node} at {} is in life {incarnation}, and the later life {known} was seen; if no other process has that address, its \
             clock went back, and it is taken 15 s after the later life was lost",
            proof.from.there
        );
        self.refusals.count(now, "NDL answer of a former life", &what);
    }

    fn join(&mut self, now: Time, proof: Proof, arrival: Arrival, fence: Option<Incarnation>) {
        let Proof { from, announcement, exchange, progress, .. } = proof;
        let Announcement { node, incarnation, ref name, .. } = announcement;
        let name = name.clone();
        let gone = self.gone.remove(&node);
        let mut sought = gone.map_or_else(Vec::new, |gone| self.settle_gone(&gone, from, &announcement));
        self.contact_at(now, from).role = Role::Member(node);
        let pace = self.pace_for(now, &name);
        // GNCL may have linked it when nobody here knew it.
        let link_until = if self.proven.stands(node, incarnation) { Time::MAX } else { Time::ZERO };
        let mut member = Member {
            announcement,
            met: from.there,
            routes: Routes::new(from),
            gncl_told: (Vec::new(), now),
            heard: now,
            sign: now,
            pace,
            missed: 0,
            host: None,
            progress: Progress::default(),
            troubles: Troubles::default(),
            is_awaited: false,
            clock: PeerClock::default(),
            answered: Time::ZERO,
            link_broke: None,
            link_until,
            linked: now,
            since: now,
            fence,
        };
        let gncl = member.gncl_addresses(&self.own);
        member.gncl_told.0.clone_from(&gncl);
        self.members.insert(node, member);
        sought.extend(self.settle_remembered(node));
        self.recall.found(node);
        self.note_met(node, from);
        // Before the fact, so that GNCL knows the clock of a peer when it connects.
        if let Some(member) = self.members.get_mut(&node) {
            member.routes.answered(from, exchange.and_then(|exchange| exchange.round_trip()));
        }
        self.measure(now, node, exchange);
        self.outputs.push_back(Output::Fact(MembershipFact::NodeFound { node, incarnation, gncl }));
        self.publish(&match arrival {
            Arrival::Found => NodeEvent::NodeFound { node, name, incarnation },
            Arrival::Restarted(silence) => {
                let (silent_us, bound_us) = silence.micros();
                NodeEvent::NodeRestarted { node, name, incarnation, silent_us, bound_us }
            }
        });
        self.note_progress(node, progress);
        self.seek(now, node);
        sought.into_iter().for_each(|place| self.ask_unless_just_asked(now, place));
    }

    /// A member is there in a new life. // spec: NDL-5.1
    pub(super) fn replace(&mut self, now: Time, proof: Proof) {
        let node = proof.announcement.node;
        let Some(former) = self.members.remove(&node) else { return };
        let silence = self.silence(now, &former);
        self.contests.remove(&node);
        let others = former.routes.places().filter(|place| *place != proof.from);
        others.for_each(|place| self.drop_contact(now, place));
        let incarnation = former.announcement.incarnation;
        let why = LossReason::Restarted;
        self.outputs.push_back(Output::Fact(MembershipFact::NodeLost { node, incarnation, why }));
        self.join(now, proof, Arrival::Restarted(silence), Some(incarnation));
    }

    /// What GNCL's connections tell. // spec: NDL-4.3
    pub(super) fn linked(&mut self, now: Time, fact: LinkFact) {
        let (LinkFact::LinkUp { node, incarnation }
        | LinkFact::LinkBroken { node, incarnation }
        | LinkFact::DialRefused { node, incarnation }
        | LinkFact::PeerLeft { node, incarnation, .. }) = fact;
        if let LinkFact::PeerLeft { .. } = fact {
            // Before the connection is over that proves who says so.
            self.note_goodbye(node, incarnation);
        }
        self.note_proof(now, &fact);
        let Some(member) = self.members.get_mut(&node).filter(|m| m.announcement.incarnation == incarnation)
        else {
            // About a life that is over for NDL already.
            return;
        };
        match fact {
            LinkFact::LinkUp { .. } => {
                (member.link_broke, member.link_until) = (None, Time::MAX);
                // It said so just now, so that its host does not refuse what it is sent any more. spec: NDL-4.7
                (member.sign, member.heard, member.host, member.linked) = (now, now, None, now);
            }
            LinkFact::LinkBroken { .. } => {
                (member.link_broke, member.link_until) = (Some(now), now + LINK_GRACE);
                self.challenge_member(now, node);
            }
            LinkFact::DialRefused { .. } => match member.link_broke {
                Some(then) if member.answered < then => self.lose(now, node, LossReason::Crashed),
                // It lives: whoever refuses does it in its host's name, or its end is still to come.
                Some(_) => {
                    member.link_broke = Some(now);
                    self.challenge_member(now, node);
                }
                // Never connected: its GNCL may not listen yet.
                None => {}
            },
            LinkFact::PeerLeft { gave_up, .. } => self.lose(now, node, LossReason::announced(gave_up)),
        }
    }

    /// A shell starts, and `stands` says which connections there are: where GNCL was restarted, too, those that ended with it are told by
    /// nobody. // spec: NDL-4.3, NDL-4.5
    pub(crate) fn look_at_links(&mut self, now: Time, stands: impl Fn(NodeAddress, Incarnation) -> bool) {
        self.proven.look_at_links(&stands);
        let mut broken = Vec::new();
        for (node, member) in &mut self.members {
            if member.link_until == Time::MAX && !stands(*node, member.announcement.incarnation) {
                (member.link_broke, member.link_until) = (Some(now), now + LINK_GRACE);
                broken.push(*node);
            }
        }
        broken.into_iter().for_each(|node| self.challenge_member(now, node));
    }

    /// A member is gone. Answers to earlier questions do not count any more.
    pub(super) fn lose(&mut self, now: Time, node: NodeAddress, why: LossReason) {
        let Some(member) = self.members.remove(&node) else { return };
        let contest = self.contests.remove(&node);
        let sources = self.sources(&member).into_keys().collect();
        // GNCL ends the connection of a life that is over; that of one that leaves ends when all is said, and where the word was not its own it stays.
        if !why.is_announced() {
            self.proven.lost(node, member.announcement.incarnation);
        }
        let silence = self.silence(now, &member);
        self.recall.lost(now, &member, sources, Loss { why: why.clone(), bound: silence.bound });
        self.note_parted(node);
        self.is_lonely |= self.members.is_empty() && matches!(why, LossReason::Hung | LossReason::LinkDown);
        // An elder life has the address of a duplicate, which is no bar to that; one that nobody proves may never have been there.
        let is_remembered = why != LossReason::Duplicate && self.bars_earlier(&member);
        if is_remembered {
            self.remember(now, &member, &why);
        }
        self.void_questions(now, &member.announcement);
        let places: Vec<_> = member.routes.places().collect();
        for place in places.iter().copied() {
            if why.is_announced() {
                self.drop_contact(now, place);
                continue;
            }
            let mut contact = self.contact_at(now, place);
            // Whom nobody remembers is forgotten there as any address is that does not answer.
            contact.role = if is_remembered {
                Role::Former { node, wait: 1, left: 0 }
            } else {
                Role::Candidate { asked: 0 }
            };
            contact.questions.clear();
        }
        let Announcement { incarnation, name, .. } = member.announcement;
        let (silent_us, bound_us) = silence.micros();
        let is_crash = why == LossReason::Crashed;
        let fact = MembershipFact::NodeLost { node, incarnation, why: why.clone() };
        self.outputs.push_back(Output::Fact(fact));
        self.publish(&NodeEvent::NodeLost { node, name, incarnation, why, silent_us, bound_us });
        if is_crash {
            // Perhaps only its GNCL restarts: then it answers this.
            places.into_iter().for_each(|place| self.ask(now, place));
        }
        if let Some(contest) = contest {
            self.succeed(now, &contest.newcomer);
        }
    }

    pub(super) fn contact_at(&mut self, now: Time, place: Place) -> ContactMut<'_> {
        self.contacts.get_or_insert_with(place, || Contact::new(now, Source::Query))
    }

    /// A node is not there any more: what was asked at addresses that it announced is answered too late.
    pub(super) fn void_questions(&mut self, now: Time, of: &Announcement) {
        let is_its = |contact: &Contact| match contact.role {
            Role::Candidate { .. } => true,
            Role::Former { node, .. } => node == of.node,
            Role::Member(_) => false,
        };
        let places =
            self.contacts.iter().filter(|(place, contact)| of.has_ndl_at(place.there) && is_its(contact));
        let places: Vec<_> = places.map(|(place, _)| *place).collect();
        places.into_iter().for_each(|place| self.drop_contact(now, place));
    }

    /// Nobody that we know is at `place` any more; a seed is still asked.
    pub(super) fn drop_contact(&mut self, now: Time, place: Place) {
        let Some(contact) = self.contacts.remove(&place) else { return };
        if contact.is_seed {
            self.contacts.insert(place, Contact::seed(now));
        }
    }
}
