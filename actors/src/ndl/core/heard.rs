//! What a datagram means, and what it proves.
//!
//! A datagram proves nothing: anybody can write any source address on it. An answer to a question that we asked at an
//! address, and at no other, proves that somebody is at that address.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Core, Input, Output, Place, Query, Source, Way,
    clock::Exchange,
    contact::{Contact, Question, Role},
    lives::Proof,
};
use crate::ndl::{
    LossReason,
    datagram::{Announcement, Answer, Body, Claim, Leave, parse, peek_answer},
};

/// Whose word a datagram is, if it is not forged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Speaker {
    /// A member's life, where there is a route to it.
    MemberOnItsRoute,
    /// The same at another address where it says that it is.
    MemberWhereItSays,
    /// Anybody else's.
    Stranger,
}

/// What somebody said whom we did not ask.
#[derive(Clone, Copy, Debug)]
struct Word {
    from: Place,
    source: Source,
    /// Whose word it is.
    node: NodeAddress,
    speaker: Speaker,
    /// When it was sent, in that one's clock.
    sent: Time,
}

/// Time between two questions to one address because of something that was heard, so that nobody makes us flood a third.
const ASK_GAP: Duration = Duration::from_millis(10);

impl Core {
    /// Takes in a datagram, if its sender's budget allows. // spec: NDL-7.2
    pub(crate) fn receive(&mut self, now: Time, from: Place, way: Way, bytes: &[u8]) {
        // A group of IPv6 is heard once for each address of an interface: what a link-local address sent there concerns the link-local one, and so on.
        if way == Way::Multicast && from.there.is_ipv6() && !from.is_a_way() {
            return;
        }
        if !self.admits(now, from, bytes) {
            self.refusals.count(now, "NDL datagrams above the budget of their source", &from.there);
            return;
        }
        let datagram = match parse(self.me.node, bytes) {
            Ok(datagram) => datagram,
            Err(error) => {
                self.refusals.count(
                    now,
                    error.cause(),
                    &format_args!("datagram from {}: {error}", from.there),
                );
                return;
            }
        };
        let (correlation, sent) = (datagram.correlation, datagram.sent);
        let input = match datagram.body {
            Body::Query(announcement) => {
                Input::QueryReceived(Query { from, way, correlation, sent, announcement })
            }
            Body::Answer(answer) => Input::AnswerReceived { from, correlation, sent, answer },
            Body::Leave(leave) => Input::LeaveReceived { from, leave },
        };
        self.handle(now, input);
    }

    fn admits(&mut self, now: Time, from: Place, bytes: &[u8]) -> bool {
        if let Some(mut contact) = self.contacts.get_mut(&from) {
            let is_expected = peek_answer(bytes).is_some_and(|id| contact.questions.has(id));
            // What we asked for has a budget apart, so that noise with a member's address on it does not make its
            // answers unheard.
            if is_expected && contact.answers.take(now) {
                return true;
            }
            if contact.has_own_budget() {
                return contact.budget.take(now);
            }
        }
        self.strangers.admit(now, from.there.ip())
    }

    // spec: NDL-3
    pub(super) fn queried(&mut self, now: Time, query: &Query) {
        let Query { from, way, correlation, sent: query_sent, ref announcement } = *query;
        let speaker = self.speaker(from, announcement);
        // A member's question to everybody is not for us: it asks us by ourselves, too.
        if way == Way::Unicast || speaker != Speaker::MemberOnItsRoute {
            let (to, node) = (from, announcement.node);
            self.outputs.push_back(Output::SendAnswer {
                to,
                node,
                correlation,
                query_sent,
                query_received: now,
            });
        }
        let source = match way {
            Way::Unicast => Source::Query,
            Way::Multicast => Source::Multicast,
        };
        self.heard(now, Word { from, source, node: announcement.node, speaker, sent: query_sent });
    }

    // spec: NDL-3.1
    pub(super) fn answered(
        &mut self,
        now: Time,
        from: Place,
        (correlation, answer_sent): (u64, Time),
        answer: Answer,
    ) {
        let contact = self.contacts.get_mut(&from);
        let question = contact.and_then(|mut contact| contact.questions.take(correlation));
        if let Some(question) = question {
            let exchange = self.exchange(now, question, answer_sent, &answer);
            let Answer { announcement, progress, .. } = answer;
            self.confirmed(now, Proof { from, asked: question.asked, announcement, exchange, progress });
        } else if self.group_questions.has(correlation) {
            // Who answers the group's question is asked by himself: only that proves his address.
            let (node, speaker) = (answer.announcement.node, self.speaker(from, &answer.announcement));
            self.heard(now, Word { from, source: Source::Multicast, node, speaker, sent: answer_sent });
        } else {
            let what = format_args!("{} answers what it was not asked, or twice, or too late", from.there);
            self.refusals.count(now, "NDL answer without a question", &what);
        }
    }

    /// The times of a question and its answer, unless the answer quotes a send time that cannot be ours.
    fn exchange(
        &self,
        now: Time,
        question: Question,
        answer_sent: Time,
        answer: &Answer,
    ) -> Option<Exchange> {
        let query_sent = Time::from_nanos(answer.query_sent_ns);
        let query_received = Time::from_nanos(answer.query_received_ns);
        if query_sent < question.asked || now < query_sent {
            let what =
                format_args!("{} quotes a send time that is not its query's", answer.announcement.node);
            self.refusals.count(now, "NDL answer with false times", &what);
            return None;
        }
        Some(Exchange { query_sent, query_received, answer_sent, answer_received: now })
    }

    /// Whom what was said at `from` is of. It may hear us on fewer routes than we hear it on.
    fn speaker(&self, from: Place, announcement: &Announcement) -> Speaker {
        let member = self.members.get(&announcement.node);
        match member.filter(|member| member.announcement.is_same_life(announcement)) {
            Some(member) if member.routes.has(from) => Speaker::MemberOnItsRoute,
            Some(member) if member.announces(from) => Speaker::MemberWhereItSays,
            Some(_) | None => Speaker::Stranger,
        }
    }

    fn is_said_by_member(&self, from: Place, announcement: &Announcement) -> bool {
        self.speaker(from, announcement) != Speaker::Stranger
    }

    /// Somebody spoke who may be a node. // spec: NDL-2.2
    fn heard(&mut self, now: Time, word: Word) {
        let Word { from, source, node, speaker, sent } = word;
        match speaker {
            Speaker::MemberOnItsRoute => {}
            Speaker::MemberWhereItSays => self.look_at(now, from, source),
            Speaker::Stranger => return self.look_at(now, from, source),
        }
        if self.is_a_sign(now, node, sent)
            && let Some(member) = self.members.get_mut(&node)
        {
            member.heard = now;
            if source == Source::Query {
                // Who asks us lives, whatever becomes of our questions; he asks us as long as he hears our answers. spec: NDL-4.7
                member.sign = now;
            }
        }
        if let Some(mut contact) = self.contacts.get_mut(&from) {
            contact.sources.entry(source).or_insert(now);
        }
    }

    // spec: NDL-2.3
    pub(super) fn named(&mut self, now: Time, source: Source, address: SocketAddr) {
        if self.paths.contains(&address) {
            return;
        }
        let places = self.places_of(address);
        let is_known = places.iter().all(|place| self.contacts.contains_key(place));
        if !is_known && !self.strangers.admit_any(now) {
            self.refusals.count(
                now,
                "more addresses named than can be asked",
                &format_args!("{address}, by {}", source.name()),
            );
            return;
        }
        places.into_iter().for_each(|place| self.look_at(now, place, source));
    }

    /// Asks at `place` at once, unless something that was heard had it asked just now.
    fn look_at(&mut self, now: Time, place: Place, source: Source) {
        if !self.contacts.contains_key(&place) {
            self.make_room_for_a_candidate(now);
        }
        self.contacts.get_or_insert_with(place, || Contact::new(now, source)).heard_of(now, source);
        self.ask_unless_just_asked(now, place);
    }

    pub(super) fn ask_unless_just_asked(&mut self, now: Time, place: Place) {
        let Some(mut contact) = self.contacts.get_mut(&place) else { return };
        // What the cycle asked, or who was missed, does not count: the answer may have been due from a life that is over, and this one says
        // that it has begun.
        if contact.looked_at.is_none_or(|at| now.since(at) >= ASK_GAP) {
            contact.looked_at = Some(now);
            drop(contact);
            self.ask(now, place);
        }
    }

    /// The oldest candidate makes room: one that answers does so within milliseconds. // spec: NDL-7.1
    fn make_room_for_a_candidate(&mut self, now: Time) {
        if self.contacts.candidates() < self.nodes_max {
            return;
        }
        let candidates = self.contacts.iter().filter(|(_, contact)| contact.is_candidate());
        if let Some(oldest) = candidates.min_by_key(|(_, contact)| contact.since).map(|(place, _)| *place) {
            self.refusals.count(now, "more addresses than can be asked", &oldest.there);
            self.contacts.remove(&oldest);
        }
    }

    // spec: NDL-4.4, NDL-4.8
    pub(super) fn taken_leave_of(&mut self, now: Time, from: Place, leave: Leave) {
        let Leave { announcement, gave_up } = leave;
        let announcement = &announcement;
        let yields = announcement.claim == Claim::Yielded;
        if yields && self.is_proven(announcement.node) {
            // Who gives its address up ends, and its connections with it. spec: NDL-5.8
            let what = format_args!("{} says that {} gives its address up", from.there, announcement.node);
            self.refusals.count(now, "NDL leave of a node that is connected", &what);
        } else if self.is_said_by_member(from, announcement) {
            if !yields {
                self.note_goodbye(announcement.node, announcement.incarnation);
            }
            let why = if yields { LossReason::Duplicate } else { LossReason::announced(gave_up) };
            self.lose(now, announcement.node, why);
        } else if self.is_contender(from, announcement) {
            // It makes way for the member, or ends. spec: NDL-5.3
            self.contests.remove(&announcement.node);
        } else if self.is_former_at(from, announcement) {
            // It was silent, and has been asked since: what it answered before it left is no sign of life any more.
            // Another node may be there by now.
            let is_others = |contact: &Contact| matches!(contact.role, Role::Member(_));
            if !self.contacts.get(&from).is_some_and(is_others) {
                self.drop_contact(now, from);
            }
            self.void_questions(now, announcement);
            if let Some(gone) = self.gone.get_mut(&announcement.node) {
                gone.has_left = true;
            }
        } else {
            let what = format_args!(
                "{} says that {} leaves, which is no member there",
                from.there, announcement.node
            );
            self.refusals.count(now, "NDL leave of a stranger", &what);
        }
    }
}
