//! One confirmed message to many: a copy with a receipt for each member on this node, and one for each other node that has members.
//!
//! Each receipt holds the [`GroupSend`]. Its last one that is settled, or dropped, ends it: then the message's own receipt is settled. So a
//! group send ends however its members, nodes and links end, and nothing of it is left. Other nodes report their members meanwhile, by
//! messages that name the send; those that are open are in [`OpenSends`] for that, and the table has no further hold of them.
//!
//! | rule | |
//! | --- | --- |
//! | FRAME-7 | A message with CONFIRM to many is answered by MEMBERS frames, then by one OUTCOME. |
//! | FRAME-7.1 | The first reports name every member that has a copy, and every node; the last of them says that these are all. |
//! | FRAME-7.2 | Each member's outcome is reported once, when it is known. The sender itself is no member. |
//! | FRAME-7.3 | A node takes reports about members on the reporting node alone, and of nodes that have a copy. |
//! | FRAME-7.4 | A message reaches at most 256 members of a node, and 256 other nodes; an application has 64 of them open to other nodes, each until its time to live is over. What is beyond is rejected as a whole: too many. |

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, Weak},
};

use super::{Judge, Outlet, Refused, Router, Snapshot, copy_of, for_each_here, guard, tap};
use crate::{
    outcome::{MemberReport, MemberState, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    post::lock,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Header, Message},
};

/// Members of this node that one confirmed message reaches at most. spec: FRAME-7.4
const MEMBERS_HERE_MAX: usize = 256;
/// Other nodes that one confirmed message reaches at most. spec: FRAME-7.4
const NODES_MAX: usize = 256;
/// Confirmed messages to many on other nodes that one application has open at most, each until its time to live is over. spec: FRAME-7.4
const OPEN_OF_ONE_MAX: usize = 64;

impl Router {
    /// What the node at `from` reports of the members of the confirmed message to many that `ticket` names. spec: FRAME-7.3
    pub fn members_reported(&self, from: NodeAddress, ticket: Ticket, reports: &[MemberReport]) {
        self.group_sends.reported(from, ticket, reports);
    }

    /// Confirmed messages to many that are open at other nodes.
    #[cfg(test)]
    fn open_group_sends(&self) -> usize {
        self.group_sends.len()
    }

    /// One confirmed copy for each node that has a member, and one for each member here. spec: FRAME-7
    pub(super) fn send_to_each(&self, snapshot: &Snapshot, message: Message) -> Result<(), Refused> {
        let Tid { node, app } = message.header.destination;
        let Snapshot { table, members } = snapshot;
        let peers: Vec<(NodeAddress, &Arc<dyn Outlet>)> = if node == NodeAddress::ALL && app.is_group() {
            let nodes = members.elsewhere.members(app).iter();
            nodes.filter_map(|node| Some((*node, table.peers.get(node)?))).collect()
        } else if node == NodeAddress::ALL {
            table.peers.iter().map(|(node, peer)| (*node, peer)).collect()
        } else {
            table.peers.get(&node).map(|peer| (node, peer)).into_iter().collect()
        };
        if node != self.node && node != NodeAddress::ALL && peers.is_empty() {
            return Err(Refused::new(message, Rejection::NoSuchNode));
        }
        let is_here = node == self.node || node == NodeAddress::ALL;
        let here = if is_here { self.members_but(snapshot, &message.header) } else { Vec::new() };
        let (message, send) =
            self.open_send(message, &here, peers.iter().map(|(node, _)| *node).collect())?;
        tap::saw_sent_to_many(table.tap.as_ref(), &message);
        if is_here {
            self.submit_to_each(snapshot, table.guard.as_ref(), &message, &send);
        }
        for (node, peer) in peers {
            self.submit_copy(&message, &send, Tid::new(node, app), |copy| peer.submit(copy));
        }
        Ok(())
    }

    /// A confirmed copy of what came from another node for each member here. spec: FRAME-7
    pub(super) fn deliver_to_each(
        &self,
        snapshot: &Snapshot,
        guard: Judge<'_>,
        message: Message,
    ) -> Result<(), Refused> {
        let here = self.members_but(snapshot, &message.header);
        let (message, send) = self.open_send(message, &here, Vec::new())?;
        self.submit_to_each(snapshot, guard, &message, &send);
        Ok(())
    }

    /// The members of this node, but for the sender.
    fn members_but(&self, snapshot: &Snapshot, header: &Header) -> Vec<AppAddress> {
        let mut here = Vec::new();
        for_each_here(snapshot, header.destination.app, |app, _| {
            if Tid::new(self.node, app) != header.source {
                here.push(app);
            }
        });
        here
    }

    /// Takes the receipt of a message to many for its copies, and reports who has one.
    ///
    /// # Errors
    /// The message, with its receipt: there are too many. spec: FRAME-7.4
    fn open_send(
        &self,
        mut message: Message,
        here: &[AppAddress],
        nodes: Vec<NodeAddress>,
    ) -> Result<(Message, Arc<GroupSend>), Refused> {
        let is_bounded = here.len() <= MEMBERS_HERE_MAX && nodes.len() <= NODES_MAX;
        let Some(receipt) = message.receipt.take_if(|_| is_bounded) else {
            return Err(Refused::new(message, Rejection::TooManyMembers));
        };
        let times = (Time::now(), message.header.expiry());
        match self.group_sends.open((self.node, nodes), receipt, times) {
            Ok(send) => {
                send.begin(here);
                Ok((message, send))
            }
            Err(receipt) => {
                message.receipt = Some(receipt);
                Err(Refused::new(message, Rejection::TooManyMembers))
            }
        }
    }

    /// A copy for each member on this node, except the sender itself.
    fn submit_to_each(
        &self,
        snapshot: &Snapshot,
        guard: Judge<'_>,
        message: &Message,
        send: &Arc<GroupSend>,
    ) {
        for_each_here(snapshot, message.header.destination.app, |app, outlet| {
            let member = Tid::new(self.node, app);
            if member == message.header.source {
                return;
            }
            let refused = self.submit_copy(message, send, member, |copy| {
                if guard::refuses(guard, app, &message.header) {
                    return Err(Refused::new(copy, Rejection::NotAllowed));
                }
                outlet.submit(copy)
            });
            tap::saw_one_of_many(snapshot.table.tap.as_ref(), member, message, refused);
        });
    }

    /// One copy, whose receipt says what becomes of it at `of`. One that is refused is settled so.
    fn submit_copy(
        &self,
        message: &Message,
        send: &Arc<GroupSend>,
        of: Tid,
        submit: impl FnOnce(Message) -> Result<(), Refused>,
    ) -> Option<Rejection> {
        let mut copy = copy_of(message);
        copy.receipt = Some(send.receipt(of));
        self.account(submit(copy)).err()
    }
}

/// One confirmed message to many, until all of its copies have ended.
struct GroupSend {
    here: NodeAddress,
    /// Other nodes that have a copy, in the order of their addresses.
    nodes: Vec<NodeAddress>,
    /// That of the message as a whole.
    receipt: Option<Receipt>,
    /// Where its other nodes find it.
    open: Option<Arc<OpenSends>>,
}

impl GroupSend {
    /// A group send whose copies stay on this node.
    fn within(here: NodeAddress, receipt: Receipt) -> Arc<Self> {
        Arc::new(Self { here, nodes: Vec::new(), receipt: Some(receipt), open: None })
    }

    /// Reports all that have a copy: members on this node, and other nodes. spec: FRAME-7.1
    fn begin(&self, members: &[AppAddress]) {
        let members = members
            .iter()
            .map(|app| MemberReport::of_member(Tid::new(self.here, *app), MemberState::Pending));
        let nodes = self.nodes.iter().map(|node| MemberReport::of_node(*node, MemberState::Pending));
        let last = MemberReport::of_node(self.here, MemberState::Listed);
        self.report(&members.chain(nodes).chain([last]).collect::<Vec<_>>());
    }

    /// The receipt of the copy for a member on this node, or for the members of another.
    fn receipt(self: &Arc<Self>, of: Tid) -> Receipt {
        let ticket = self.ticket();
        let ticket = Ticket { source: ticket.source, destination: of, correlation: ticket.correlation };
        Receipt::new(self.clone(), ticket)
    }

    /// What the node at `from` reports of its members. spec: FRAME-7.3
    fn reported(&self, from: NodeAddress, reports: &[MemberReport]) {
        if self.nodes.binary_search(&from).is_err() {
            return;
        }
        let is_its_own = |report: &&MemberReport| {
            let Tid { node, app } = report.tid;
            // The outcome of a node's copy is said by its own OUTCOME, or by the loss of the node.
            let is_of_node = app == AppAddress::NONE && report.state == MemberState::Listed;
            node == from && (is_of_node || report.tid.is_single())
        };
        let reports: Vec<_> = reports.iter().filter(is_its_own).copied().collect();
        self.report(&reports);
    }

    fn report(&self, reports: &[MemberReport]) {
        if let Some(receipt) = &self.receipt {
            receipt.report(reports);
        }
    }

    fn ticket(&self) -> Ticket {
        const NONE: Ticket = Ticket { source: Tid::NONE, destination: Tid::NONE, correlation: 0 };
        self.receipt.as_ref().map_or(NONE, Receipt::ticket)
    }
}

/// The outcome of one copy. spec: FRAME-7.2
impl ReceiptSink for GroupSend {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let Tid { node, .. } = ticket.destination;
        let state = MemberState::Settled(outcome);
        self.report(&[if node == self.here {
            MemberReport::of_member(ticket.destination, state)
        } else {
            MemberReport::of_node(node, state)
        }]);
    }
}

impl Drop for GroupSend {
    fn drop(&mut self) {
        if let Some(open) = &self.open {
            open.close(self.ticket(), self);
        }
        if let Some(receipt) = self.receipt.take() {
            receipt.settle(Outcome::Delivered);
        }
    }
}

/// Group sends of this node's applications that other nodes have copies of, by source and correlation.
#[derive(Default)]
pub(super) struct OpenSends(Mutex<BTreeMap<(Tid, u64), Open>>);

struct Open {
    send: Weak<GroupSend>,
    /// When its time to live is over: then a member that hangs with its copy takes no room from later sends.
    until: Time,
}

impl OpenSends {
    /// A group send of which `nodes`, in the order of their addresses, have copies `until` then.
    ///
    /// # Errors
    /// The receipt: its application has too many of them open at `now`, or one of this number. spec: FRAME-7.4
    fn open(
        self: &Arc<Self>,
        (here, nodes): (NodeAddress, Vec<NodeAddress>),
        receipt: Receipt,
        (now, until): (Time, Time),
    ) -> Result<Arc<GroupSend>, Receipt> {
        if nodes.is_empty() {
            return Ok(GroupSend::within(here, receipt));
        }
        let Ticket { source, correlation, .. } = receipt.ticket();
        let mut open = lock(&self.0);
        let of_source = open.range((source, 0)..=(source, u64::MAX));
        let over: Vec<_> = of_source.filter(|(_, open)| open.until < now).map(|(key, _)| *key).collect();
        over.iter().for_each(|key| drop(open.remove(key)));
        let count = open.range((source, 0)..=(source, u64::MAX)).count();
        if count >= OPEN_OF_ONE_MAX || open.contains_key(&(source, correlation)) {
            return Err(receipt);
        }
        let send = Arc::new(GroupSend { here, nodes, receipt: Some(receipt), open: Some(self.clone()) });
        open.insert((source, correlation), Open { send: Arc::downgrade(&send), until });
        Ok(send)
    }

    /// What the node at `from` reports of the members of the send that `ticket` names.
    fn reported(&self, from: NodeAddress, ticket: Ticket, reports: &[MemberReport]) {
        // Not with the lock in hand: this may be the last hold of it, which closes it.
        let send =
            lock(&self.0).get(&(ticket.source, ticket.correlation)).and_then(|open| open.send.upgrade());
        if let Some(send) = send {
            send.reported(from, reports);
        }
    }

    fn close(&self, ticket: Ticket, send: &GroupSend) {
        let mut open = lock(&self.0);
        let key = (ticket.source, ticket.correlation);
        if open.get(&key).is_some_and(|open| std::ptr::eq(open.send.as_ptr(), send)) {
            open.remove(&key);
        }
    }

    #[cfg(test)]
    fn len(&self) -> usize {
        lock(&self.0).len()
    }
}

#[cfg(test)]
mod tests;
