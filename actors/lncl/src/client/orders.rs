//! Execution of the orders of a client's session.

use std::ops::ControlFlow;

use sinew_model::facts::User;
use sinew_protocol::{
    observed::Observed,
    payload::{self, Resolved, TypeDeclaration},
};
use sinew_runtime::{
    lock,
    outcome::{self, Outcome, Rejection, Ticket},
    router::tap::{Passage, Way},
    tid::Tid,
    time::Time,
    wire::{Flags, Header, Kind, Message},
};

use super::{
    super::{
        core::Registry,
        link_broker::LinkRequest,
        registrar,
        session::{MembershipError, Order},
    },
    Client,
    end::ConnectionEnd,
};
use crate::{
    State,
    undelivered::{self, Entry},
};

impl Client {
    /// Executes an order. Returns the end of the connection if the order ends it.
    pub(super) fn execute(&self, order: Order) -> ControlFlow<ConnectionEnd> {
        match order {
            Order::Route(message) => self.route(message),
            Order::Settle { source, correlation, outcome } => self.settle(source, correlation, outcome),
            Order::SetMember { group, member, confirm } => self.set_member(group, member, confirm),
            Order::RefuseMembership { destination, correlation, outcome, why } => {
                self.count_membership_error(why);
                self.send_outcome(destination, correlation, outcome);
            }
            Order::Resolve { name, nearest, correlation } => self.resolve(&name, nearest, correlation),
            Order::Introduce { to, correlation } => self.broker_link(to, correlation),
            Order::Switch { to, number, correlation } => self.switch(to, number, correlation),
            Order::DeclareType(declaration) => self.declare_type(declaration),
            // Only the program of a command has a supervisor that waits for it.
            Order::Ready => self.command.iter().for_each(|port| port.ready(self.peer.id)),
            Order::Observe(observed) => self.observe(&observed),
            Order::RefuseMessage { message, why } => self.refuse_message(&message, why),
            Order::Unregister => return ControlFlow::Break(ConnectionEnd::Unregistered),
            Order::End(violation) => {
                return ControlFlow::Break(ConnectionEnd::Refused(violation.to_string()));
            }
            Order::Register(_) => {
                return ControlFlow::Break(ConnectionEnd::Refused("registered already".to_owned()));
            }
        }
        ControlFlow::Continue(())
    }

    fn route(&self, mut message: Message) {
        let router = &self.server.state.ctx.router;
        let destination = router.absolute(message.header.destination);
        // Only a node marks a value as handed over.
        message.header.flags = message.header.flags.without(Flags::RETAINED);
        let mut is_removal = false;
        if matches!(self.user, User::Guest(_)) && message.header.flags.has(Flags::KEEP) {
            // Guests take no room from the robot's own values. Without the flag a member would get the removal.
            message.header.flags = message.header.flags.without(Flags::KEEP);
            is_removal = message.payload.is_empty();
        }
        let is_confirmed = message.header.flags.has(Flags::CONFIRM);
        if is_confirmed {
            let correlation = message.header.correlation;
            let ticket = Ticket { source: self.tid, destination, correlation };
            let Some(receipt) = self.outcomes.receipt(ticket) else { return };
            message.receipt = Some(receipt);
        }
        if is_removal {
            return message.settle(Outcome::Delivered);
        }
        let header = Header { destination, ..message.header };
        let sent = self.within_share(message).and_then(|message| router.send(message));
        if let Err(why) = sent
            && !is_confirmed
            && undelivered::is_fault(destination, why)
        {
            // The sender of a confirmed message is notified by its outcome.
            let (detail, now) = (format!("from {} to {destination}: {why}", self.tid), Time::now());
            self.server.refusals.count(now, "unconfirmed message not taken", &detail);
            self.server.state.undelivered.count(now, Entry::of(&header, why, 1, now));
        }
    }

    /// Returns the message if the client belongs to the node's own user, or if the quota of guests has room for it.
    fn within_share(&self, message: Message) -> Result<Message, Rejection> {
        let User::Guest(uid) = self.user else { return Ok(message) };
        let state = &self.server.state;
        state.guest_quotas.admit(state.ctx.node, uid, message).map_err(|refused| {
            let why = refused.why;
            // Counted and reported to the receipt's owner, like a message that a full queue rejects.
            state.ctx.router.refuse(refused);
            why
        })
    }

    fn settle(&self, source: Tid, correlation: u64, outcome: Outcome) {
        let ticket = Ticket { source, destination: self.tid, correlation };
        if !self.outlet.confirm(ticket, outcome) {
            let detail = format!("{} settles a message {correlation} of {source} that it has not", self.tid);
            self.server.refusals.count(Time::now(), "outcome of nothing", &detail);
        }
    }

    // spec: LNCL-19
    fn resolve(&self, name: &str, nearest: bool, correlation: u64) {
        let tid = registrar::resolve(&self.server.state, name).map(Tid::bits);
        // Similar names cost the node's time to find, so guests do not get them.
        let gets_nearest = nearest && tid.is_none() && self.user == User::Own;
        let nearest = if gets_nearest { registrar::nearest(&self.server.state, name) } else { Vec::new() };
        let lncl = payload::lncl_of(self.tid.node);
        let mut answer = payload::frame(Kind::LNCL_RESOLVED, lncl, self.tid, &Resolved { tid, nearest });
        answer.header.correlation = correlation;
        self.outcomes.answer(answer);
    }

    fn broker_link(&self, to: Tid, correlation: u64) {
        // The node can neither check messages on a direct link, nor stop them when the list changes. spec: LNCL-10
        if self.server.state.security.access.get().is_some() {
            let to = self.server.state.ctx.router.absolute(to);
            return self.send_outcome(to, correlation, Outcome::Rejected(Rejection::Unsupported));
        }
        let to = self.server.state.ctx.router.absolute(to);
        // A link would carry the messages that the node refuses because of their type. spec: LNCL-10
        if self.server.state.ctx.router.refuses_types_between(self.tid, to) {
            return self.send_outcome(to, correlation, Outcome::Rejected(Rejection::Unsupported));
        }
        let number = lock(&self.server.state.registry).new_link();
        let link_broker = &self.server.link_broker;
        if let Err(why) =
            link_broker.introduce(self.tid, to, LinkRequest { number, correlation }, Time::now())
        {
            self.send_outcome(to, correlation, Outcome::Rejected(why));
        }
        // For its deadline.
        self.server.state.ctx.checks.request();
    }

    // spec: LNCL-11
    fn switch(&self, to: Tid, number: u64, correlation: u64) {
        let to = self.server.state.ctx.router.absolute(to);
        let ticket = Ticket { source: self.tid, destination: to, correlation };
        let Some(receipt) = self.outcomes.question_receipt(ticket) else { return };
        // Marks bypass the access list on their way into the peer's queues. A client without links has none to switch
        // to.
        if self.server.state.security.access.get().is_some() {
            return receipt.settle(Outcome::Rejected(Rejection::Unsupported));
        }
        if let Err((receipt, why)) = self.server.link_broker.pass_marks(self.tid, to, number, receipt) {
            receipt.settle(Outcome::Rejected(why));
        }
    }

    // spec: LNCL-21
    fn declare_type(&self, declaration: TypeDeclaration) {
        self.orders.count();
        let declare = |state: &State, _: &Registry| {
            let types = state.ctx.ports.app_types();
            types.map_or(Ok(()), |types| types.declare(self.tid.app, self.user, declaration))
        };
        if let Some(Err(why)) = self.while_registered(declare) {
            let detail = format!("of {} ({}): {why}", self.name, self.tid);
            self.server.refusals.count(Time::now(), "declaration of a type", &detail);
        }
    }

    // spec: LNCL-20: only about its own messages.
    fn observe(&self, observed: &Observed) {
        let Observed { is_sent, missed, header, length, payload } = observed;
        let (way, own) = if *is_sent { (Way::Out, header.source) } else { (Way::In, header.destination) };
        if !is_sent && own == self.tid && header.kind == Kind::OUTCOME {
            return self.observe_outcome(observed);
        }
        if own != self.tid || !header.kind.is_user() {
            let detail = format!("{} reports a message that is not its own", self.tid);
            return self.server.refusals.count(Time::now(), "report of another's message", &detail);
        }
        let length = *length as usize;
        let passage = Passage { way, header, payload, length, refused: None };
        self.server.state.ctx.router.observe(self.tid, &passage, u64::from(*missed));
    }

    /// Shows the outcome of a message that the client has sent on a direct link. A client that no tap watches was not
    /// asked to report, or has not received yet that it is not watched any more.
    fn observe_outcome(&self, observed: &Observed) {
        let Observed { missed, header, payload, .. } = observed;
        let router = &self.server.state.ctx.router;
        if !router.is_observed(self.tid) {
            return;
        }
        router.observe_missed(self.tid, u64::from(*missed));
        // A byte that is not assigned is no outcome.
        if let Some(outcome) = payload.first().and_then(|code| Outcome::from_code(*code)) {
            let Header { source: destination, correlation, .. } = *header;
            outcome::show(Ticket { source: self.tid, destination, correlation }, outcome);
        }
    }

    fn refuse_message(&self, message: &Message, why: Rejection) {
        let Header { source, destination, correlation, flags, .. } = message.header;
        let detail = format!("{} sent a message of {source} to {destination}: {why}", self.tid);
        let cause = if why == Rejection::ForgedSource { "forged source" } else { "unsupported flags" };
        let now = Time::now();
        self.server.refusals.count(now, cause, &detail);
        if flags.has(Flags::CONFIRM) {
            let ticket = Ticket { source: self.tid, destination, correlation };
            self.outcomes.send(ticket, Outcome::Rejected(why));
        } else {
            // The message may name another source, but this client sent it.
            let destination = self.server.state.ctx.router.absolute(destination);
            let header = Header { source: self.tid, destination, ..message.header };
            self.server.state.undelivered.count(now, Entry::of(&header, why, 1, now));
        }
    }

    /// Logs it like a membership that the access list refuses.
    fn count_membership_error(&self, why: MembershipError) {
        self.orders.count();
        let detail = format!("of {} ({}): {why}", self.name, self.tid);
        self.server.refusals.count(Time::now(), "membership", &detail);
    }

    /// Notifies the client of the outcome of a question that is no message: no observer gets it.
    pub(super) fn send_outcome(&self, about: Tid, correlation: u64, outcome: Outcome) {
        let ticket = Ticket { source: self.tid, destination: about, correlation };
        self.outcomes.answer(Message::outcome(ticket, outcome));
    }
}
