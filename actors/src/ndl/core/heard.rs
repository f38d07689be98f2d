//! What a datagram means, and what it proves.
//!
//! A datagram proves nothing: anybody can write any source address on it. An answer to a question that we asked at an
//! address, and at no other, proves that somebody is at that address.

use std::net::SocketAddr;

use sinew_runtime::time::Time;

use super::{
    Core, Input, Output, Query, Source, Way,
    clock::Exchange,
    contact::{Contact, Question},
    lives::Proof,
};
use crate::ndl::{
    LossReason,
    datagram::{Announcement, Answer, Body, Claim, parse, peek_answer},
};

/// Time between two questions to one address outside the cycle, so that nobody makes us flood a third.
const ASK_GAP_MS: u64 = 10;

impl Core {
    /// Takes in a datagram, if its sender's budget allows. // spec: NDL-7.2
    pub(crate) fn receive(&mut self, now: Time, from: SocketAddr, way: Way, bytes: &[u8]) {
        if !self.admits(now, from, bytes) {
            self.refusals.count(now, "NDL datagrams above the budget of their source", &from);
            return;
        }
        let datagram = match parse(self.me.node, bytes) {
            Ok(datagram) => datagram,
            Err(error) => {
                self.refusals.count(now, error.cause(), &format_args!("datagram from {from}: {error}"));
                return;
            }
        };
        let (correlation, sent) = (datagram.correlation, datagram.sent);
        let input = match datagram.body {
            Body::Query(announcement) => {
                Input::QueryReceived(Query { from, way, correlation, sent, announcement })
            }
            Body::Answer(answer) => Input::AnswerReceived { from, correlation, sent, answer },
            Body::Leave(announcement) => Input::LeaveReceived { from, announcement },
        };
        self.handle(now, input);
    }

    fn admits(&mut self, now: Time, from: SocketAddr, bytes: &[u8]) -> bool {
        if let Some(contact) = self.contacts.get_mut(&from) {
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
        self.strangers.admit(now, from.ip())
    }

    // spec: NDL-3
    pub(super) fn queried(&mut self, now: Time, query: &Query) {
        let Query { from, way, correlation, sent: query_sent, ref announcement } = *query;
        // A member's question to everybody is not for us: it asks us by ourselves, too.
        if way == Way::Unicast || !self.is_member_at(from, announcement) {
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
        self.heard(now, from, source, announcement);
    }

    // spec: NDL-3.1
    pub(super) fn answered(
        &mut self,
        now: Time,
        from: SocketAddr,
        (correlation, answer_sent): (u64, Time),
        answer: Answer,
    ) {
        let question = self.contacts.get_mut(&from).and_then(|contact| contact.questions.take(correlation));
        if let Some(question) = question {
            let exchange = self.exchange(now, question, answer_sent, &answer);
            let Answer { announcement, progress, .. } = answer;
            self.confirmed(now, Proof { from, asked: question.asked, announcement, exchange, progress });
        } else if self.group_questions.has(correlation) {
            // Who answers the group's question is asked by himself: only that proves his address.
            self.heard(now, from, Source::Multicast, &answer.announcement);
        } else {
            let what = format_args!("{from} answers what it was not asked, or twice, or too late");
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

    fn is_member_at(&self, from: SocketAddr, announcement: &Announcement) -> bool {
        self.members
            .get(&announcement.node)
            .is_some_and(|member| member.address == from && member.announcement.is_same_life(announcement))
    }

    /// Somebody spoke who may be a node. // spec: NDL-2.2
    fn heard(&mut self, now: Time, from: SocketAddr, source: Source, announcement: &Announcement) {
        if !self.is_member_at(from, announcement) {
            self.look_at(now, from, source);
            return;
        }
        if let Some(member) = self.members.get_mut(&announcement.node) {
            member.heard = now;
            if source == Source::Query {
                // Who asks us lives, whatever becomes of our questions; he asks us as long as he hears our answers. spec: NDL-4.7
                member.sign = now;
            }
        }
        if let Some(contact) = self.contacts.get_mut(&from) {
            contact.sources.entry(source).or_insert(now);
        }
    }

    // spec: NDL-2.3
    pub(super) fn resolved(&mut self, now: Time, address: SocketAddr) {
        if Some(address) == self.udp {
            return;
        }
        if !self.contacts.contains_key(&address) && !self.strangers.admit_any(now) {
            self.refusals.count(now, "more addresses from mDNS than can be asked", &address);
            return;
        }
        self.look_at(now, address, Source::Mdns);
    }

    /// Asks `address` at once, unless it was asked just now.
    fn look_at(&mut self, now: Time, address: SocketAddr, source: Source) {
        if !self.contacts.contains_key(&address) {
            self.make_room_for_a_candidate(now);
        }
        let contact = self.contacts.entry(address).or_insert_with(|| Contact::new(now, source));
        contact.sources.entry(source).or_insert(now);
        let asked = contact.questions.newest().map(|question| question.asked);
        if asked.is_none_or(|asked| now.since(asked).as_millis() >= u128::from(ASK_GAP_MS)) {
            self.ask(now, address);
        }
    }

    /// The oldest candidate makes room: one that answers does so within milliseconds. // spec: NDL-7.1
    fn make_room_for_a_candidate(&mut self, now: Time) {
        let candidates = || self.contacts.iter().filter(|(_, contact)| contact.is_candidate());
        if candidates().count() < self.nodes_max {
            return;
        }
        if let Some(oldest) =
            candidates().min_by_key(|(_, contact)| contact.since).map(|(address, _)| *address)
        {
            self.refusals.count(now, "more addresses than can be asked", &oldest);
            self.contacts.remove(&oldest);
        }
    }

    // spec: NDL-4.4
    pub(super) fn taken_leave_of(&mut self, now: Time, from: SocketAddr, announcement: &Announcement) {
        if self.is_member_at(from, announcement) {
            let yields = announcement.claim == Claim::Yielded;
            let why = if yields { LossReason::Duplicate } else { LossReason::Left };
            self.lose(now, announcement.node, why);
        } else if self.is_former_at(from, announcement) {
            // It was silent, and has been asked since: what it answered before it left is no sign of life any more.
            self.drop_contact(now, from);
        } else {
            let what =
                format_args!("{from} says that {} leaves, which is no member there", announcement.node);
            self.refusals.count(now, "NDL leave of a stranger", &what);
        }
    }
}
