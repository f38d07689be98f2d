//! The rules that must hold in any scenario. The judge knows the truth and the network, and of a core only its
//! datagrams and outputs.
//!
//! 1. No false loss: a node lost by silence did not answer `missed_max` queries in a row. Each query had half
//!    a period, at each address where the node has answered since it was found. An answer counts from its
//!    arrival in the receiver's socket: a late read is the receiver's own stall.
//! 2. A loss is detected within `missed_max` plus one periods of the last sign of life, plus the receiver's own
//!    stalls. With a timer that is always late the limit is [`Plan::silence_max`].
//! 3. A leave counts when it is received, and is sent to every known node.
//! 4. An ended incarnation never returns after its loss or its leave, nor a former one after a later one.
//! 5. Found and lost alternate. Refused, left and restarted are reported only for incarnations that ended.
//! 6. A clock's offset is as reported, within the reported bound.
//! 7. A node reports its own stalls.
//! 8. A loss by silence has the class that has been true for long: hung, crashed, or unreachable with its host.
//! 9. There is no loss by silence while the connection delivers. This also holds after that, or after a query of the
//!    other node, for as long as answers may be missed.
//! 10. When the network is healed, each node knows exactly the present nodes, with a route to each in each network.

mod losses;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    net::SocketAddr,
    time::Duration,
};

use sinew_model::{clocks::ClockOffset, facts::LossReason};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::plan::Plan;

/// Queries to one address with a known time, at most.
const QUERIES_KEPT: usize = 64;
/// Allowance for clocks and rounding, per period: drifts are below 100 ppm.
const DRIFT_PER_MILLE: u32 = 1;

/// A query, and whether its answer has been in the sender's socket.
struct Query {
    correlation: u64,
    sent: Time,
    is_answered: bool,
    /// Within a period; a core that has sent many queries since ignores a later answer.
    is_answered_in_time: bool,
}

/// The state that one process has of another one.
struct PeerState {
    is_member: bool,
    /// It ended before its loss, or its leave was received: it cannot return.
    is_over: bool,
    /// The last answer within a period of its query, by its arrival in the socket.
    last_answer: Time,
    /// The addresses of such answers since it was found.
    places: BTreeSet<SocketAddr>,
    /// The last sign of life that was read.
    last_sign: Time,
    /// The last time that any datagram of it was read, including a query to the group.
    last_datagram: Time,
    /// The last liveness hint: data on a connection, or a query to this process.
    hint: Option<Time>,
}

/// The true state of a process, and its view of the others.
struct Record {
    node: NodeAddress,
    incarnation: Incarnation,
    /// One address in each network.
    addresses: Vec<SocketAddr>,
    ended: Option<Time>,
    peers: BTreeMap<usize, PeerState>,
    queries: BTreeMap<SocketAddr, VecDeque<Query>>,
    newest: BTreeMap<NodeAddress, Incarnation>,
    /// Times and durations without CPU time.
    stalls: Vec<(Time, Duration)>,
    shells: Vec<Time>,
    has_reported_a_stall: bool,
}

pub(super) struct Judge {
    period: Duration,
    missed_max: u32,
    /// The node that is watched at another pace.
    watched: Option<(NodeAddress, Duration, u32)>,
    plan: Plan,
    processes: Vec<Record>,
    /// The index of each incarnation.
    numbers: BTreeMap<(NodeAddress, Incarnation), usize>,
    pub(super) violations: Vec<String>,
}

impl Judge {
    pub(super) fn new(plan: &Plan) -> Self {
        Self {
            period: plan.period,
            missed_max: plan.missed_max,
            watched: plan
                .watched
                .map(|(node, period, missed)| (super::network::node_address(node), period, missed)),
            plan: plan.clone(),
            processes: Vec::new(),
            numbers: BTreeMap::new(),
            violations: Vec::new(),
        }
    }

    /// Returns the pace at which `other` is watched.
    fn pace(&self, other: usize) -> (Duration, u32) {
        match self.watched {
            Some((node, period, missed_max)) if node == self.processes[other].node => (period, missed_max),
            Some(_) | None => (self.period, self.missed_max),
        }
    }

    /// Records the start of a process; processes are counted from 0.
    pub(super) fn started(
        &mut self,
        node: NodeAddress,
        incarnation: Incarnation,
        addresses: Vec<SocketAddr>,
    ) {
        self.numbers.insert((node, incarnation), self.processes.len());
        self.processes.push(Record {
            node,
            incarnation,
            addresses,
            ended: None,
            peers: BTreeMap::new(),
            queries: BTreeMap::new(),
            newest: BTreeMap::new(),
            stalls: Vec::new(),
            shells: Vec::new(),
            has_reported_a_stall: false,
        });
    }

    pub(super) fn ended(&mut self, process: usize, now: Time) {
        self.processes[process].ended = Some(now);
    }

    pub(super) fn left(&mut self, now: Time, process: usize, to: &BTreeSet<SocketAddr>) {
        let peers = &self.processes[process].peers;
        let forgotten: Vec<usize> = peers
            .iter()
            .filter(|(other, peer)| {
                peer.is_member
                    && !self.processes[**other].addresses.iter().any(|address| to.contains(address))
            })
            .map(|(other, _)| *other)
            .collect();
        for other in forgotten {
            self.violate(now, process, other, "is sent no leave");
        }
    }

    pub(super) fn shell_restarted(&mut self, process: usize, now: Time) {
        self.processes[process].shells.push(now);
    }

    pub(super) fn stalled(&mut self, process: usize, now: Time, lasts: Duration) {
        self.processes[process].stalls.push((now, lasts));
    }

    pub(super) fn reported_a_stall(&mut self, process: usize) {
        self.processes[process].has_reported_a_stall = true;
    }

    pub(super) fn stall_is_over(&mut self, now: Time, process: usize, lasted: Duration) {
        if lasted > self.period * 2 + self.plan.lateness && !self.processes[process].has_reported_a_stall {
            self.violate(now, process, process, &format!("does not report its own stall of {lasted:?}"));
        }
    }

    pub(super) fn query_sent(&mut self, now: Time, process: usize, to: SocketAddr, correlation: u64) {
        let queries = self.processes[process].queries.entry(to).or_default();
        if queries.len() == QUERIES_KEPT {
            queries.pop_front();
        }
        queries.push_back(Query { correlation, sent: now, is_answered: false, is_answered_in_time: false });
    }

    /// Records an answer in the socket of the process that sent the query.
    pub(super) fn answer_arrived(
        &mut self,
        now: Time,
        process: usize,
        (by, from): (usize, SocketAddr),
        correlation: u64,
    ) {
        let (period, _) = self.pace(by);
        let record = &mut self.processes[process];
        let queries = record.queries.entry(from).or_default();
        let Some(query) =
            queries.iter_mut().rev().find(|query| query.correlation == correlation && !query.is_answered)
        else {
            return;
        };
        query.is_answered = true;
        query.is_answered_in_time = now.since(query.sent) <= period;
        if query.is_answered_in_time
            && let Some(peer) = record.peers.get_mut(&by)
        {
            peer.last_answer = now;
            peer.places.insert(from);
        }
    }

    /// Records that an answer was read.
    pub(super) fn answer_read(&mut self, now: Time, process: usize, by: usize) {
        if let Some(peer) = self.processes[process].peers.get_mut(&by) {
            peer.last_sign = now;
        }
    }

    /// Records that data was read on a connection, or a query to this process.
    pub(super) fn hint_read(&mut self, now: Time, process: usize, of: usize) {
        if let Some(peer) = self.processes[process].peers.get_mut(&of) {
            (peer.last_sign, peer.last_datagram, peer.hint) = (now, now, Some(now));
        }
    }

    /// Records that a query or an answer was read.
    pub(super) fn datagram_read(&mut self, now: Time, process: usize, of: usize) {
        if let Some(peer) = self.processes[process].peers.get_mut(&of) {
            peer.last_datagram = now;
        }
    }

    pub(super) fn leave_read(&mut self, now: Time, process: usize, from: usize) {
        let Some(peer) = self.processes[process].peers.get_mut(&from) else { return };
        peer.is_over = true;
        if peer.is_member {
            self.violate(now, process, from, "has sent a leave, which was read, and is still a member");
        }
    }

    pub(super) fn found(&mut self, now: Time, process: usize, node: NodeAddress, incarnation: Incarnation) {
        let Some(other) = self.process_of(node, incarnation) else {
            self.violations.push(format!(
                "{now:?}: {process} found {node} in incarnation {incarnation}, which never was"
            ));
            return;
        };
        let record = &mut self.processes[process];
        let newest = record.newest.entry(node).or_insert(incarnation);
        let is_former = incarnation < *newest;
        *newest = incarnation.max(*newest);
        let peer = record.peers.entry(other).or_insert(PeerState {
            is_member: false,
            is_over: false,
            last_answer: now,
            places: BTreeSet::new(),
            last_sign: now,
            last_datagram: now,
            hint: None,
        });
        let was_member = std::mem::replace(&mut peer.is_member, true);
        let came_back = peer.is_over;
        peer.places.clear();
        (peer.last_answer, peer.last_sign, peer.last_datagram) = (now, now, now);
        if was_member {
            self.violate(now, process, other, "is found, and was a member already");
        }
        if came_back {
            self.violate(now, process, other, "has ended, which was known, and is found again");
        }
        if is_former {
            self.violate(now, process, other, "is found again in a former incarnation");
        }
    }

    pub(super) fn lost(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        why: LossReason,
    ) {
        let Some(other) = self.process_of(node, incarnation) else {
            self.violations.push(format!(
                "{now:?}: {process} lost {node} in incarnation {incarnation}, which never was"
            ));
            return;
        };
        self.check_reason(now, process, other, why);
        self.check_in_time(now, process, other);
        let has_ended = self.processes[other].ended.is_some();
        let was_member = self.processes[process].peers.get_mut(&other).is_some_and(|peer| {
            peer.is_over |= has_ended;
            std::mem::replace(&mut peer.is_member, false)
        });
        if !was_member {
            self.violate(now, process, other, "is lost, and was no member");
        }
    }

    /// Checks a measured clock. `truth` is the peer's clock minus the process's, now.
    pub(super) fn measured(
        &mut self,
        now: Time,
        process: usize,
        (node, offset): (NodeAddress, ClockOffset),
        truth: i64,
    ) {
        let error = u128::from(offset.theirs_minus_ours_ns.abs_diff(truth));
        if error > offset.bound.as_nanos() + 2 {
            self.violations.push(format!(
                "{now:?}: {process} reports that {node}'s clock is {} ns ahead, within {:?}: it is wrong by {error} ns",
                offset.theirs_minus_ours_ns, offset.bound
            ));
        }
    }

    /// Checks the state after a long time without faults. `views` are the living processes, each with the members of
    /// its core.
    pub(super) fn at_rest(&mut self, now: Time, views: &[(usize, BTreeSet<(NodeAddress, Incarnation)>)]) {
        let present: BTreeSet<_> = self
            .processes
            .iter()
            .filter(|record| record.ended.is_none())
            .map(|record| (record.node, record.incarnation))
            .collect();
        for (process, view) in views {
            let record = &self.processes[*process];
            let reported: BTreeSet<_> = record
                .peers
                .iter()
                .filter(|(_, peer)| peer.is_member)
                .map(|(other, _)| (self.processes[*other].node, self.processes[*other].incarnation))
                .collect();
            let others: BTreeSet<_> =
                present.iter().copied().filter(|(node, _)| *node != record.node).collect();
            for (whose, has) in [("its core has", view), ("it has reported", &reported)] {
                if *has != others {
                    let (missing, gone): (Vec<_>, Vec<_>) =
                        (others.difference(has).collect(), has.difference(&others).collect());
                    self.violations.push(format!(
                        "{now:?}: at rest, {process} ({}): {whose} not {missing:?}, which are present, and has {gone:?}, which are not",
                        record.node
                    ));
                }
            }
        }
    }

    /// Returns the process index of an incarnation.
    pub(super) fn process_of(&self, node: NodeAddress, incarnation: Incarnation) -> Option<usize> {
        self.numbers.get(&(node, incarnation)).copied()
    }

    fn violate(&mut self, now: Time, process: usize, other: usize, words: &str) {
        let [own, other] = [process, other].map(|index| {
            let record = &self.processes[index];
            format!("process {index} ({} in incarnation {})", record.node, record.incarnation)
        });
        self.violations.push(format!("{now:?}: to {own}, {other} {words}"));
    }
}
