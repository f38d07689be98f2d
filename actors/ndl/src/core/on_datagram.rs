//! The meaning of a received datagram, and the trust in it.
//!
//! A datagram proves nothing, because any sender can forge its source address. An answer to a query that this
//! node sent to an address proves that a node is at that address, and at no other.

use std::net::SocketAddr;

use sinew_model::facts::LossReason;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Cast, Core, Input, Output, Place, Query, Source, clock::Exchange, contact::Role,
    incarnations::AcceptedAnswer, members::Sender, queries::SentQuery,
};
use crate::datagram::{Answer, Body, Claim, Leave, parse};

/// An unsolicited message.
#[derive(Clone, Copy, Debug)]
struct Unsolicited {
    from: Place,
    source: Source,
    /// The announced node.
    node: NodeAddress,
    sender: Sender,
    /// Send time, in the sender's clock.
    sent: Time,
}

impl Core {
    /// Processes a datagram, if its sender's budget allows it. // spec: NDL-7.2
    pub fn receive(&mut self, now: Time, from: Place, cast: Cast, bytes: &[u8]) {
        // An IPv6 group is received once for each address of an interface. A datagram from a link-local
        // address concerns the link-local path, and so on.
        if cast == Cast::Multicast && from.there.is_ipv6() && !from.is_usable() {
            return;
        }
        if !self.contacts.admit(now, from, bytes) {
            self.refusals.count(now, "NDL datagrams above the budget of their source", &from.there);
            return;
        }
        let datagram = match parse(self.local_node.announcement.node, bytes) {
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
                Input::QueryReceived(Query { from, cast, correlation, sent, announcement })
            }
            Body::Answer(answer) => Input::AnswerReceived { from, correlation, sent, answer },
            Body::Leave(leave) => Input::LeaveReceived { from, leave },
        };
        self.handle(now, input);
    }

    // spec: NDL-3
    pub(super) fn query_received(&mut self, now: Time, query: &Query) {
        let Query { from, cast, correlation, sent: query_sent, ref announcement } = *query;
        let (node, sender) = (announcement.node, self.members.sender(from, announcement));
        // A member's query to the group is not answered: it also queries this node directly.
        if cast == Cast::Unicast || sender != Sender::MemberOnRoute {
            self.outputs.push_back(Output::SendAnswer {
                to: from,
                node,
                correlation,
                query_sent,
                query_received: now,
            });
        }
        let source = match cast {
            Cast::Unicast => Source::Query,
            Cast::Multicast => Source::Multicast,
        };
        self.unsolicited_received(now, Unsolicited { from, source, node, sender, sent: query_sent });
    }

    // spec: NDL-3.1
    pub(super) fn answer_received(
        &mut self,
        now: Time,
        from: Place,
        (correlation, answer_sent): (u64, Time),
        answer: Answer,
    ) {
        if let Some(query) = self.contacts.take_query(from, correlation) {
            let exchange = self.exchange(now, query, answer_sent, &answer);
            let Answer { announcement, progress, .. } = answer;
            self.confirmed(
                now,
                AcceptedAnswer { from, queried: query.sent, announcement, exchange, progress },
            );
        } else if self.contacts.has_group_query(correlation) {
            // A node that answers the group query is queried directly: only that proves its address.
            let (node, sender) = (answer.announcement.node, self.members.sender(from, &answer.announcement));
            let source = Source::Multicast;
            self.unsolicited_received(now, Unsolicited { from, source, node, sender, sent: answer_sent });
        } else {
            let what = format_args!(
                "the answer of {} belongs to no pending query: it is a second one, or too late",
                from.there
            );
            self.refusals.count(now, "NDL answer without a question", &what);
        }
    }

    /// Returns the timestamps of a query and its answer, or `None` if the answer quotes a send time that
    /// cannot be this node's.
    fn exchange(&self, now: Time, query: SentQuery, answer_sent: Time, answer: &Answer) -> Option<Exchange> {
        let query_sent = Time::from_nanos(answer.query_sent_ns);
        let query_received = Time::from_nanos(answer.query_received_ns);
        if query_sent < query.sent || now < query_sent {
            let what =
                format_args!("{} quotes a send time that is not its query's", answer.announcement.node);
            self.refusals.count(now, "NDL answer with false times", &what);
            return None;
        }
        Some(Exchange { query_sent, query_received, answer_sent, answer_received: now })
    }

    /// Handles an unsolicited message of a possible node. // spec: NDL-2.2
    fn unsolicited_received(&mut self, now: Time, message: Unsolicited) {
        let Unsolicited { from, source, node, sender, sent } = message;
        match sender {
            Sender::MemberOnRoute => {}
            Sender::MemberAtAnnounced => self.query_named(now, from, source),
            Sender::Stranger => return self.query_named(now, from, source),
        }
        self.members.received(now, (node, sent), source, (&self.authenticated, &self.paces));
        if let Some(mut contact) = self.contacts.get_mut(&from) {
            contact.sources.entry(source).or_insert(now);
        }
    }

    // spec: NDL-2.3
    pub(super) fn address_named(&mut self, now: Time, source: Source, address: SocketAddr) {
        if self.paths().contains(&address) {
            return;
        }
        let places = self.local_addresses.places_of(address);
        let is_known = places.iter().all(|place| self.contacts.contains_key(place));
        if !is_known && !self.contacts.admit_any(now) {
            self.refusals.count(
                now,
                "more addresses named than can be asked",
                &format_args!("{address}, by {}", source.name()),
            );
            return;
        }
        places.into_iter().for_each(|place| self.query_named(now, place, source));
    }

    /// Queries `place` at once, unless it was queried just now because of a received datagram.
    fn query_named(&mut self, now: Time, place: Place, source: Source) {
        if let Some(evicted) = self.contacts.named(now, place, source) {
            self.refusals.count(now, "more addresses than can be asked", &evicted.there);
        }
        self.query_on_receipt(now, place);
    }

    // spec: NDL-4.4, NDL-4.8
    pub(super) fn leave_received(&mut self, now: Time, from: Place, leave: Leave) {
        let Leave { announcement, gave_up } = leave;
        let (announcement, node) = (&announcement, announcement.node);
        let yields = announcement.claim == Claim::Yielded;
        if yields && self.authenticated.has(&self.members, node) {
            // A node that gives its address up ends, and so do its connections. spec: NDL-5.8
            let what = format_args!("{} claims that {node} gives its address up", from.there);
            self.refusals.count(now, "NDL leave of a node that is connected", &what);
        } else if self.members.sender(from, announcement) != Sender::Stranger {
            if !yields {
                self.remembered_left(node, announcement.incarnation);
            }
            let why = if yields { LossReason::Duplicate } else { LossReason::announced(gave_up) };
            self.lose(now, node, why);
        } else if self.conflicts.is_newcomer(from, announcement) {
            // The newcomer gives way to the member, or ends. spec: NDL-5.3
            self.conflicts.remove(node);
        } else if self.departed.is_last_at(from, announcement, &self.contacts) {
            // The node was silent and has been queried since. An answer that it sent before it left is no
            // longer a sign of life. Another node may be at that address now.
            if !matches!(self.contacts.role_at(&from), Some(Role::Member(_))) {
                self.contacts.release(now, from);
            }
            self.contacts.void_queries(now, announcement);
            self.departed.left(node);
        } else {
            let what = format_args!("{} claims that {node} leaves, which is no member there", from.there);
            self.refusals.count(now, "NDL leave of a stranger", &what);
        }
    }
}
