//! One confirmed message to many: a copy with a receipt for each member on this node, and one for each other
//! node that has members.
//!
//! Each receipt holds a reference to the [`GroupSend`]. It ends when its last receipt is settled or dropped:
//! then the message's own receipt is settled. So a group send ends and is freed with any kind of end of its
//! members, nodes and links. Meanwhile other nodes report their members by messages that name the send.
//! [`OpenSends`] has weak references to the open sends for that.
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

use super::{Judge, MessageSink, Router, Snapshot, SubmitError, copy_of, for_each_here, retained, tap};
use crate::{
    lock,
    outcome::{MemberReport, MemberState, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Header, Message},
};

/// Maximum number of members of this node that one confirmed message reaches. spec: FRAME-7.4
const MEMBERS_HERE_MAX: usize = 256;
/// Maximum number of other nodes that one confirmed message reaches. spec: FRAME-7.4
const NODES_MAX: usize = 256;
/// Maximum number of open confirmed messages to many on other nodes, per application, each until its time to
/// live ends. spec: FRAME-7.4
const OPEN_OF_ONE_MAX: usize = 64;

impl Router {
    /// Handles the reports of the node at `from` about members of the confirmed message to many of `ticket`.
    /// spec: FRAME-7.3
    pub fn members_reported(&self, from: NodeAddress, ticket: Ticket, reports: &[MemberReport]) {
        self.group_sends.reported(from, ticket, reports);
    }

    /// Returns the number of confirmed messages to many that are open at other nodes.
    #[cfg(test)]
    fn open_group_sends(&self) -> usize {
        self.group_sends.len()
    }

    /// Sends one confirmed copy to each node that has a member, and one to each member here. spec: FRAME-7
    pub(super) fn send_to_each(
        &self,
        snapshot: &Snapshot,
        message: Message,
        behind: &mut Vec<NodeAddress>,
    ) -> Result<(), SubmitError> {
        let Tid { node, app } = message.header.destination;
        let Snapshot { table, members } = snapshot;
        let peers: Vec<(NodeAddress, &Arc<dyn MessageSink>)> = if node == NodeAddress::ALL && app.is_group() {
            let nodes = members.elsewhere.members(app).iter();
            nodes.filter_map(|node| Some((*node, table.peers.get(node)?))).collect()
        } else if node == NodeAddress::ALL {
            table.peers.iter().map(|(node, peer)| (*node, peer)).collect()
        } else {
            table.peers.get(&node).map(|peer| (node, peer)).into_iter().collect()
        };
        if node != self.node && node != NodeAddress::ALL && peers.is_empty() {
            return Err(SubmitError::new(message, Rejection::NoSuchNode));
        }
        let is_here = node == self.node || node == NodeAddress::ALL;
        let here = if is_here { self.members_but(snapshot, &message.header) } else { Vec::new() };
        let (message, send) =
            self.open_send(message, &here, peers.iter().map(|(node, _)| *node).collect())?;
        tap::saw_sent_to_many(table.tap.as_ref(), &message);
        if is_here {
            self.submit_to_each(snapshot, table.judge(), &message, &send);
        }
        for (node, peer) in peers {
            let refused = self.submit_copy(&message, &send, Tid::new(node, app), |copy| peer.submit(copy));
            if retained::is_behind(&message.header, refused) {
                behind.push(node);
            }
        }
        Ok(())
    }

    /// Delivers a confirmed copy of a message from another node to each member here. spec: FRAME-7
    pub(super) fn deliver_to_each(
        &self,
        snapshot: &Snapshot,
        judge: Judge<'_>,
        message: Message,
    ) -> Result<(), SubmitError> {
        let here = self.members_but(snapshot, &message.header);
        let (message, send) = self.open_send(message, &here, Vec::new())?;
        self.submit_to_each(snapshot, judge, &message, &send);
        Ok(())
    }

    /// Returns the members of this node, except the sender.
    fn members_but(&self, snapshot: &Snapshot, header: &Header) -> Vec<AppAddress> {
        let mut here = Vec::new();
        for_each_here(snapshot, header.destination.app, |app, _| {
            if Tid::new(self.node, app) != header.source {
                here.push(app);
            }
        });
        here
    }

    /// Moves the receipt of a message to many into a group send, and reports the members that have a copy.
    ///
    /// # Errors
    /// The message, with its receipt: it has too many members. spec: FRAME-7.4
    fn open_send(
        &self,
        mut message: Message,
        here: &[AppAddress],
        nodes: Vec<NodeAddress>,
    ) -> Result<(Message, Arc<GroupSend>), SubmitError> {
        let is_bounded = here.len() <= MEMBERS_HERE_MAX && nodes.len() <= NODES_MAX;
        let Some(receipt) = message.receipt.take_if(|_| is_bounded) else {
            return Err(SubmitError::new(message, Rejection::TooManyMembers));
        };
        let times = (self.clock().now(), message.header.expiry());
        match self.group_sends.open((self.node, nodes), receipt, times) {
            Ok(send) => {
                send.begin(here);
                Ok((message, send))
            }
            Err(receipt) => {
                message.receipt = Some(receipt);
                Err(SubmitError::new(message, Rejection::TooManyMembers))
            }
        }
    }

    /// Submits a copy to each member on this node, except the sender itself.
    fn submit_to_each(
        &self,
        snapshot: &Snapshot,
        judge: Judge<'_>,
        message: &Message,
        send: &Arc<GroupSend>,
    ) {
        for_each_here(snapshot, message.header.destination.app, |app, sink| {
            let member = Tid::new(self.node, app);
            if member == message.header.source {
                return;
            }
            let refused = self.submit_copy(message, send, member, |copy| {
                match judge.why_refused(app, &message.header) {
                    Some(why) => Err(SubmitError::new(copy, why)),
                    None => sink.submit(copy),
                }
            });
            tap::saw_one_of_many(snapshot.table.tap.as_ref(), member, message, refused);
        });
    }

    /// Submits one copy, with a receipt for its outcome at `of`. A rejected copy is settled as rejected.
    fn submit_copy(
        &self,
        message: &Message,
        send: &Arc<GroupSend>,
        of: Tid,
        submit: impl FnOnce(Message) -> Result<(), SubmitError>,
    ) -> Option<Rejection> {
        let mut copy = copy_of(message);
        copy.receipt = Some(send.receipt(of));
        self.account(submit(copy)).err()
    }
}

/// One confirmed message to many, until all of its copies have ended.
struct GroupSend {
    here: NodeAddress,
    /// The other nodes that have a copy, in the order of their addresses.
    nodes: Vec<NodeAddress>,
    /// The receipt of the message as a whole.
    receipt: Option<Receipt>,
    /// The table in which other nodes' reports find this send.
    open: Option<Arc<OpenSends>>,
}

impl GroupSend {
    /// Creates a group send with copies on this node only.
    fn within(here: NodeAddress, receipt: Receipt) -> Arc<Self> {
        Arc::new(Self { here, nodes: Vec::new(), receipt: Some(receipt), open: None })
    }

    /// Reports all copies: members on this node, and other nodes. spec: FRAME-7.1
    fn begin(&self, members: &[AppAddress]) {
        let members = members
            .iter()
            .map(|app| MemberReport::of_member(Tid::new(self.here, *app), MemberState::Pending));
        let nodes = self.nodes.iter().map(|node| MemberReport::of_node(*node, MemberState::Pending));
        let last = MemberReport::of_node(self.here, MemberState::Listed);
        self.report(&members.chain(nodes).chain([last]).collect::<Vec<_>>());
    }

    /// Creates the receipt of the copy for a member on this node, or for the members of another node.
    fn receipt(self: &Arc<Self>, of: Tid) -> Receipt {
        let ticket = self.ticket();
        let ticket = Ticket { source: ticket.source, destination: of, correlation: ticket.correlation };
        Receipt::new(self.clone(), ticket)
    }

    /// Handles the reports of the node at `from` about its members. spec: FRAME-7.3
    fn reported(&self, from: NodeAddress, reports: &[MemberReport]) {
        if self.nodes.binary_search(&from).is_err() {
            return;
        }
        let is_its_own = |report: &&MemberReport| {
            let Tid { node, app } = report.tid;
            // The outcome of a node's copy arrives with its own OUTCOME, or with the loss of the node.
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

/// Reports the outcome of one copy. spec: FRAME-7.2
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

/// Open group sends of this node's applications with copies at other nodes, by source and correlation.
#[derive(Default)]
pub(super) struct OpenSends(Mutex<BTreeMap<(Tid, u64), Open>>);

struct Open {
    send: Weak<GroupSend>,
    /// When its time to live ends: after that, a member that hangs with its copy takes no room from later sends.
    until: Time,
}

impl OpenSends {
    /// Opens a group send with copies at `nodes`, in the order of their addresses, `until` that time.
    ///
    /// # Errors
    /// The receipt: its application has too many open at `now`, or one with this number. spec: FRAME-7.4
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

    /// Handles the reports of the node at `from` about members of the send of `ticket`.
    fn reported(&self, from: NodeAddress, ticket: Ticket, reports: &[MemberReport]) {
        // Without the lock: this may be the last reference, and its drop closes the send.
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
