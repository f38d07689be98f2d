//! The incarnations of nodes: nodes join, leave, and return in a new incarnation.

use sinew_model::{
    facts::{LinkFact, LossReason, MembershipFact, NodeEvent},
    progress::Progress,
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Core, Member, Output, Place,
    address_conflict::Collision,
    clock::{Exchange, Measured},
    contact::Role,
    departed::{Return, Silence},
    introspection::Loss,
    routes::Routed,
};
use crate::datagram::Announcement;

/// An answer to a query sent to one address. So a node is there, and announces this.
#[derive(Clone, Debug)]
pub(super) struct AcceptedAnswer {
    pub(super) from: Place,
    /// Time at which the query was sent.
    pub(super) queried: Time,
    pub(super) announcement: Announcement,
    pub(super) exchange: Option<Exchange>,
    pub(super) progress: Progress,
}

impl AcceptedAnswer {
    pub(super) fn is_of(&self, other: &Announcement) -> bool {
        self.announcement.node == other.node && self.announcement.is_same_incarnation(other)
    }
}

/// How a new member is announced to applications.
#[derive(Clone, Copy, Debug)]
enum Arrival {
    Found,
    /// The node was present before, in another incarnation that has been silent since.
    Restarted(Silence),
}

impl Core {
    /// Handles an answer of a node at an address. // spec: NDL-3.2
    pub(super) fn confirmed(&mut self, now: Time, answer: AcceptedAnswer) {
        let claimed = &answer.announcement;
        self.conflicts.confirmed(answer.from, claimed);
        self.local_node.is_answered(now, self.paces.rest());
        if claimed.node == self.local_node.announcement.node {
            self.local_address_used(now, &answer);
            return;
        }
        if self.contradicts_connection(now, &answer) {
            return;
        }
        self.release_address(now, answer.from, claimed.node);
        let Some(member) = self.members.get(&claimed.node) else {
            self.arrive(now, answer);
            return;
        };
        let known = &member.announcement;
        if known.is_same_incarnation(claimed) {
            self.member_answers(now, answer);
        } else if claimed.incarnation <= known.incarnation && claimed.precedes(known) {
            self.preceding_answers(now, answer);
        } else if claimed.incarnation < known.incarnation {
            self.refuse_stale(now, &answer, known.incarnation);
        } else if claimed.incarnation == known.incarnation {
            let (node, holder, newcomer) = (claimed.node, member.into(), (&answer).into());
            self.collide(now, Collision { node, holder, newcomer });
        } else if member.is_followed_at(answer.from) {
            self.replace(now, answer);
        } else {
            self.conflicts.newcomer_answers(now, answer, &self.members, self.paces.rest());
            self.execute_conflict_steps(now);
        }
    }

    /// Removes the address from a member if another node answers there.
    fn release_address(&mut self, now: Time, place: Place, node: NodeAddress) {
        let role = self.contacts.role_at(&place);
        let Some(Role::Member(other)) = role.filter(|role| *role != Role::Member(node)) else { return };
        let Some(member) = self.members.get_mut(&other) else { return };
        if member.routes.is_only(place) {
            self.lose(now, other, LossReason::Crashed);
            return;
        }
        member.routes.keep(|route| route.place != place);
        self.contacts.release(now, place);
    }

    fn member_answers(&mut self, now: Time, answer: AcceptedAnswer) {
        let node = answer.announcement.node;
        if !self.route_at(now, node, answer.from) {
            // Any node may answer there in the member's name.
            return;
        }
        if let Some(member) = self.members.get_mut(&node) {
            member.announcement.claim = answer.announcement.claim;
        }
        let (authenticated, contacts, refusals) = (&self.authenticated, &self.contacts, &self.refusals);
        let members = &self.members;
        self.conflicts.member_answers(now, &answer, (members, self.paces.rest()), |newcomer| {
            authenticated.contradicts(now, newcomer, (members, contacts), refusals)
        });
        if self.execute_conflict_steps(now) {
            return;
        }
        let AcceptedAnswer { from, queried, ref announcement, exchange, .. } = answer;
        let Some(member) = self.members.get_mut(&node) else { return };
        member.answers(now, from, queried, exchange.and_then(Exchange::round_trip));
        let missed_max = self.paces.of(member).missed_max;
        if member.announces_anew(from, announcement, missed_max) {
            self.seek(now, node);
        }
        self.drop_unannounced_routes(now, node, from);
        self.measure(now, node, exchange);
        self.note_answer(node, answer.progress);
    }

    /// Publishes the events of a member that answers with this report.
    fn note_answer(&mut self, node: NodeAddress, progress: Progress) {
        let Some(member) = self.members.get_mut(&node) else { return };
        let answers = member.troubles.answers(&member.announcement);
        let reports = member.reports(progress);
        answers.iter().chain(&reports).for_each(|event| self.subscribers.publish(event));
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

    /// Handles an answer of a node that is no member.
    pub(super) fn arrive(&mut self, now: Time, answer: AcceptedAnswer) {
        let node = answer.announcement.node;
        let (arrival, fence) =
            match self.departed.returns(now, &answer.announcement, self.paces.rest().bound()) {
                Return::Same => (Arrival::Found, None),
                Return::Later(last, silence) => (Arrival::Restarted(silence), Some(last)),
                Return::Earlier(incarnation, silence) => {
                    // GNCL drops its knowledge of that address, so that the earlier incarnation may connect.
                    self.outputs.push_back(Output::Forgotten { node, incarnation });
                    (Arrival::Restarted(silence), None)
                }
                Return::Barred(last) => {
                    self.refuse_stale(now, &answer, last);
                    return;
                }
            };
        if self.members.is_full() {
            self.refusals.count(now, "more nodes than `ndl.nodes_max`", &answer.from.there);
            return;
        }
        self.join(now, answer, arrival, fence);
    }

    // spec: NDL-5.2
    pub(super) fn refuse_stale(&self, now: Time, answer: &AcceptedAnswer, known: Incarnation) {
        let Announcement { node, incarnation, .. } = answer.announcement;
        let what = format_args!(
            "{node} at {} is in incarnation {incarnation}, and the later one {known} was seen; if no other process has that address, \
             its clock went back, and it is accepted 15 s after the loss of the later incarnation",
            answer.from.there
        );
        self.refusals.count(now, "NDL answer of a former incarnation", &what);
    }

    fn join(&mut self, now: Time, answer: AcceptedAnswer, arrival: Arrival, fence: Option<Incarnation>) {
        let AcceptedAnswer { from, announcement, exchange, progress, .. } = answer;
        let Announcement { node, incarnation, ref name, .. } = announcement;
        let name = name.clone();
        let departed = self.departed.remove(node);
        let mut sought =
            departed.map_or_else(Vec::new, |former| self.contacts.returned(&former, from, &announcement));
        self.contacts.answering(now, from).role = Role::Member(node);
        let mut member = Member::new(now, announcement, from, self.paces.pace_for(now, &name));
        member.fence = fence;
        if self.authenticated.is_connected(node, incarnation) {
            // GNCL has connected the node before it was known here.
            member.link_until = Time::MAX;
        }
        let gncl = member.gncl_addresses(&self.local_addresses);
        member.gncl_reported.0.clone_from(&gncl);
        self.members.insert(node, member);
        sought.extend(self.remembered_found(node));
        self.introspection.found(node);
        self.remember_route(node, from);
        // Done before the fact is sent, so that GNCL has the clock offset of a peer when it connects.
        if let Some(member) = self.members.get_mut(&node) {
            member.routes.answered(from, exchange.and_then(Exchange::round_trip));
        }
        self.measure(now, node, exchange);
        self.outputs.push_back(Output::Fact(MembershipFact::NodeFound { node, incarnation, gncl }));
        self.subscribers.publish(&match arrival {
            Arrival::Found => NodeEvent::NodeFound { node, name, incarnation },
            Arrival::Restarted(silence) => {
                let (silent_us, bound_us) = silence.micros();
                NodeEvent::NodeRestarted { node, name, incarnation, silent_us, bound_us }
            }
        });
        self.note_answer(node, progress);
        self.seek(now, node);
        sought.into_iter().for_each(|place| self.query_on_receipt(now, place));
    }

    /// Replaces a member by its new incarnation. // spec: NDL-5.1
    pub(super) fn replace(&mut self, now: Time, answer: AcceptedAnswer) {
        let node = answer.announcement.node;
        let Some(former) = self.members.remove(&node) else { return };
        let silence = self.silence(now, &former);
        self.conflicts.remove(node);
        let others = former.routes.places().filter(|place| *place != answer.from);
        others.for_each(|place| self.contacts.release(now, place));
        let incarnation = former.announcement.incarnation;
        let why = LossReason::Restarted;
        self.outputs.push_back(Output::Fact(MembershipFact::NodeLost { node, incarnation, why }));
        self.join(now, answer, Arrival::Restarted(silence), Some(incarnation));
    }

    /// Returns how long a member has been silent.
    fn silence(&self, now: Time, member: &Member) -> Silence {
        Silence { lasts: now.since(member.last_seen), bound: self.paces.of(member).bound() }
    }

    /// Handles a report of a GNCL connection. // spec: NDL-4.3
    pub(super) fn link_changed(&mut self, now: Time, fact: LinkFact) {
        let (node, incarnation) = fact.subject();
        if let LinkFact::PeerLeft { .. } = fact {
            // Done while the connection that authenticates the sender is still known.
            self.remembered_left(node, incarnation);
        }
        self.authenticate(now, &fact);
        let Some(member) = self.members.incarnation_mut(node, incarnation) else {
            // The report concerns an incarnation that NDL has already ended.
            return;
        };
        match fact {
            LinkFact::LinkUp { .. } => member.link_made(now),
            LinkFact::LinkBroken { .. } => {
                member.link_ended(now);
                self.challenge_member(now, node);
            }
            LinkFact::DialRefused { .. } => match member.link_broke {
                Some(then) if member.answered < then => self.lose(now, node, LossReason::Crashed),
                // The member is alive. A third party refuses in the host's name, or the member is about to end.
                Some(_) => {
                    member.link_broke = Some(now);
                    self.challenge_member(now, node);
                }
                // The member was never connected: its GNCL may not listen yet.
                None => {}
            },
            LinkFact::PeerLeft { gave_up, .. } => self.lose(now, node, LossReason::announced(gave_up)),
        }
    }

    /// Handles a connection that was made or ended. An authenticated incarnation replaces a different one
    /// that answered in its name.
    fn authenticate(&mut self, now: Time, fact: &LinkFact) {
        self.authenticated.link_changed(fact);
        let LinkFact::LinkUp { node, incarnation } = *fact else { return };
        let is_other = |member: &Member| member.announcement.incarnation != incarnation;
        if self.authenticated.is_required() && self.members.get(&node).is_some_and(is_other) {
            self.lose(now, node, LossReason::Duplicate);
        }
        let (remembered, present, contacts) = self.remembered_parts();
        remembered.answered_everywhere(node, &present, contacts);
        for place in self.remembered_found(node) {
            self.query_on_receipt(now, place);
        }
    }

    /// Compares the links with those that `is_connected` reports at the start of a shell. If GNCL was restarted,
    /// too, it does not report the connections that ended with it. // spec: NDL-4.3, NDL-4.5
    pub fn check_links(&mut self, now: Time, is_connected: impl Fn(NodeAddress, Incarnation) -> bool) {
        self.authenticated.check_links(&is_connected);
        for node in self.members.check_links(now, is_connected) {
            self.challenge_member(now, node);
        }
    }

    /// Queries a member on its routes.
    fn challenge_member(&mut self, now: Time, node: NodeAddress) {
        let places = self.conflicts.challenged_places(node, &self.members);
        places.into_iter().for_each(|place| self.query(now, place));
    }

    /// Removes a member. Answers to earlier queries are void.
    pub(super) fn lose(&mut self, now: Time, node: NodeAddress, why: LossReason) {
        let Some(member) = self.members.remove(&node) else { return };
        let newcomer = self.conflicts.take_newcomer(node);
        let sources = self.sources(&member).into_keys().collect();
        // GNCL closes the connection of an ended incarnation. The connection of a leaving one ends after all
        // its data is sent. A connection stays if the leave was forged.
        if !why.is_announced() {
            self.authenticated.lost(node, member.announcement.incarnation);
        }
        let silence = self.silence(now, &member);
        self.introspection.lost(now, &member, sources, Loss { why: why.clone(), bound: silence.bound });
        let (remembered, present, contacts) = self.remembered_parts();
        remembered.lost(node, &present, contacts);
        if self.members.is_empty() && matches!(why, LossReason::Hung | LossReason::LinkDown) {
            self.local_node.is_alone();
        }
        let places = self.release_places(now, &member, &why);
        let Announcement { incarnation, name, .. } = member.announcement;
        let (silent_us, bound_us) = silence.micros();
        let is_crash = why == LossReason::Crashed;
        let fact = MembershipFact::NodeLost { node, incarnation, why: why.clone() };
        self.outputs.push_back(Output::Fact(fact));
        let event = NodeEvent::NodeLost { node, name, incarnation, why, silent_us, bound_us };
        self.subscribers.publish(&event);
        if is_crash {
            // If only the member's GNCL restarts, the member answers this query.
            places.into_iter().for_each(|place| self.query(now, place));
        }
        if let Some(newcomer) = newcomer.filter(|newcomer| !self.contradicts_connection(now, newcomer)) {
            // It answered earlier and may have ended since.
            self.query_new(now, newcomer.from);
        }
    }

    /// Changes the contacts of a lost member to those of a departed one. Returns its places.
    fn release_places(&mut self, now: Time, member: &Member, why: &LossReason) -> Vec<Place> {
        let node = member.announcement.node;
        // An earlier incarnation holds the address of a duplicate, which must not bar it. An unauthenticated
        // incarnation may never have existed.
        let is_kept = *why != LossReason::Duplicate && self.authenticated.bars_earlier(member);
        if is_kept {
            let evicted = self.departed.insert(now, member, self.paces.of(member).bound(), why);
            if let Some((node, former)) = evicted {
                self.contacts.drop_departed(node, &former);
            }
        }
        self.contacts.void_queries(now, &member.announcement);
        let places: Vec<_> = member.routes.places().collect();
        for place in places.iter().copied() {
            if why.is_announced() {
                self.contacts.release(now, place);
                continue;
            }
            let mut contact = self.contacts.answering(now, place);
            // The place of a node that is not remembered is dropped like any address that does not answer.
            contact.role = if is_kept {
                Role::Former { node, wait: 1, left: 0 }
            } else {
                Role::Candidate { queried: 0 }
            };
            contact.queries.clear();
        }
        places
    }

    /// Returns whether the member's incarnation, which answered at `place`, has a route there or gets one now.
    fn route_at(&mut self, now: Time, node: NodeAddress, place: Place) -> bool {
        let Some(member) = self.members.get_mut(&node) else { return false };
        let mut dropped = Vec::new();
        let routed = member.route_at(place, &mut dropped);
        dropped.into_iter().for_each(|place| self.contacts.release(now, place));
        if routed == Routed::Added {
            self.contacts.answering(now, place).role = Role::Member(node);
            self.remember_route(node, place);
        }
        routed != Routed::Rejected
    }

    /// Drops the routes that a member does not announce, once it answers at an announced one. They were only
    /// used because there was no better one.
    fn drop_unannounced_routes(&mut self, now: Time, node: NodeAddress, place: Place) {
        let member = self.members.get_mut(&node).filter(|member| member.announces(place));
        let dropped = member.map(Member::drop_unannounced_routes).into_iter().flatten();
        dropped.for_each(|place| self.contacts.release(now, place));
    }

    /// Returns the places where a node that is found was remembered, and that it announces.
    fn remembered_found(&mut self, node: NodeAddress) -> Vec<Place> {
        let (remembered, present, (contacts, _)) = self.remembered_parts();
        remembered.found(node, &present, contacts)
    }

    /// Records that a member answers at `place`.
    fn remember_route(&mut self, node: NodeAddress, place: Place) {
        let (remembered, present, contacts) = self.remembered_parts();
        remembered.answered(node, place, &present, contacts);
    }

    /// Records that this incarnation of a node announces its leave.
    pub(super) fn remembered_left(&mut self, node: NodeAddress, incarnation: Incarnation) {
        let (remembered, present, _) = self.remembered_parts();
        remembered.left(node, incarnation, &present);
    }
}
