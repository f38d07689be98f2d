//! What a client's connection does with the orders of its session.

use std::ops::ControlFlow;

use sinew_runtime::{
    outcome::{Outcome, Rejection, Ticket},
    tid::Tid,
    time::Time,
    wire::{Flags, Header, Kind, Message},
};

use super::{
    super::{
        core::User,
        introductions::Question,
        payload::{self, Resolved},
        registrar,
        session::{NoMembership, Order},
    },
    Client,
    end::End,
};
use crate::{
    stores::lock,
    undelivered::{self, Entry},
};

impl Client {
    /// Carries an order out; the end of the connection, if that is what it asks for.
    pub(super) fn obey(&self, order: Order) -> ControlFlow<End> {
        match order {
            Order::Route(message) => self.route(message),
            Order::Settle { source, correlation, outcome } => self.settle(source, correlation, outcome),
            Order::SetMember { group, member, confirm } => self.set_member(group, member, confirm),
            Order::Tell { destination, correlation, outcome, why } => {
                self.count_no_membership(why);
                self.tell(destination, correlation, outcome);
            }
            Order::Resolve { name, nearest, correlation } => self.resolve(&name, nearest, correlation),
            Order::Introduce { to, correlation } => self.introduce(to, correlation),
            Order::Switch { to, number, correlation } => self.switch(to, number, correlation),
            Order::RefuseMessage { message, why } => self.refuse_message(&message, why),
            Order::Unregister => return ControlFlow::Break(End::Unregistered),
            Order::End(violation) => return ControlFlow::Break(End::Refused(violation.to_string())),
            Order::Register(_) => {
                return ControlFlow::Break(End::Refused("registered already".to_owned()));
            }
        }
        ControlFlow::Continue(())
    }

    fn route(&self, mut message: Message) {
        let router = &self.server.stores.router;
        let destination = router.absolute(message.header.destination);
        let is_confirmed = message.header.flags.has(Flags::CONFIRM);
        if is_confirmed {
            let correlation = message.header.correlation;
            let ticket = Ticket { source: self.tid, destination, correlation };
            let Some(receipt) = self.outcomes.receipt(ticket) else { return };
            message.receipt = Some(receipt);
        }
        let header = Header { destination, ..message.header };
        let sent = self.within_share(message).and_then(|message| router.send(message));
        if let Err(why) = sent
            && !is_confirmed
            && undelivered::is_fault(destination, why)
        {
            // The source of a confirmed message knows.
            let (detail, now) = (format!("from {} to {destination}: {why}", self.tid), Time::now());
            self.server.refusals.count(now, "unconfirmed message not taken", &detail);
            self.server.stores.undelivered.count(now, Entry::of(&header, why, 1, now));
        }
    }

    /// The message, if it is one of the robot's own, or guests leave enough to these with it.
    fn within_share(&self, message: Message) -> Result<Message, Rejection> {
        let User::Guest(uid) = self.user else { return Ok(message) };
        let stores = &self.server.stores;
        stores.shares_of_guests.admit(stores.node, uid, message).map_err(|refused| {
            let why = refused.why;
            // Counted, and told to whom its receipt belongs, as what a full queue does not take.
            stores.router.refuse(refused);
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
        let tid = registrar::resolve(&self.server.stores, name).map(Tid::bits);
        // To compare names takes the node's time, which guests do not get.
        let is_told = nearest && tid.is_none() && self.user == User::Own;
        let nearest = if is_told { registrar::nearest(&self.server.stores, name) } else { Vec::new() };
        let lncl = payload::lncl_of(self.tid.node);
        let mut answer = payload::frame(Kind::LNCL_RESOLVED, lncl, self.tid, &Resolved { tid, nearest });
        answer.header.correlation = correlation;
        self.outcomes.answer(answer);
    }

    fn introduce(&self, to: Tid, correlation: u64) {
        // What goes over a direct link nobody can check, nor stop when the list changes. spec: LNCL-10
        if self.server.stores.access.get().is_some() {
            let to = self.server.stores.router.absolute(to);
            return self.tell(to, correlation, Outcome::Rejected(Rejection::Unsupported));
        }
        let number = lock(&self.server.stores.registry).new_link();
        let to = self.server.stores.router.absolute(to);
        let introductions = &self.server.introductions;
        if let Err(why) = introductions.introduce(self.tid, to, Question { number, correlation }, Time::now())
        {
            self.tell(to, correlation, Outcome::Rejected(why));
        }
    }

    // spec: LNCL-11
    fn switch(&self, to: Tid, number: u64, correlation: u64) {
        let to = self.server.stores.router.absolute(to);
        let ticket = Ticket { source: self.tid, destination: to, correlation };
        let Some(receipt) = self.outcomes.receipt(ticket) else { return };
        // Marks are put into the queues of the other side, past the list. Who was never introduced has no link to turn to.
        if self.server.stores.access.get().is_some() {
            return receipt.settle(Outcome::Rejected(Rejection::Unsupported));
        }
        if let Err((receipt, why)) = self.server.introductions.pass_marks(self.tid, to, number, receipt) {
            receipt.settle(Outcome::Rejected(why));
        }
    }

    fn refuse_message(&self, message: &Message, why: Rejection) {
        let Header { source, destination, correlation, flags, .. } = message.header;
        let detail = format!("{} said that {source} sends to {destination}: {why}", self.tid);
        let cause = if why == Rejection::ForgedSource { "forged source" } else { "unsupported flags" };
        let now = Time::now();
        self.server.refusals.count(now, cause, &detail);
        if flags.has(Flags::CONFIRM) {
            self.tell(destination, correlation, Outcome::Rejected(why));
        } else {
            // Whatever source it names: this client has sent it.
            let destination = self.server.stores.router.absolute(destination);
            let header = Header { source: self.tid, destination, ..message.header };
            self.server.stores.undelivered.count(now, Entry::of(&header, why, 1, now));
        }
    }

    /// In words in the log, as a membership that the access list refuses.
    fn count_no_membership(&self, why: NoMembership) {
        self.orders.count();
        let detail = format!("of {} ({}): {why}", self.name, self.tid);
        self.server.refusals.count(Time::now(), "membership", &detail);
    }

    pub(super) fn tell(&self, about: Tid, correlation: u64, outcome: Outcome) {
        let ticket = Ticket { source: self.tid, destination: about, correlation };
        self.outcomes.tell(ticket, outcome);
    }
}
