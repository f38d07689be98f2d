//! The rules of a loss: its reason, its class, the silence before it, and its bound.

use std::{net::SocketAddr, time::Duration};

use sinew_model::facts::LossReason;
use sinew_ndl::core::Host;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{DRIFT_PER_MILLE, Judge, Query};

impl Judge {
    /// Checks a loss event: the reported silence, and the bound of the loss.
    pub(crate) fn loss_notified(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        [silent, bound]: [Duration; 2],
    ) {
        let Some(other) = self.process_of(node, incarnation) else { return };
        let (period, missed_max) = self.pace(other);
        if bound != period * (missed_max + 1) {
            self.violate(now, process, other, &format!("is reported as lost with the bound {bound:?}"));
        }
        let Some(last) = self.processes[process].peers.get(&other).map(|peer| peer.last_datagram) else {
            return;
        };
        let least = now.since(last) * (1_000 - DRIFT_PER_MILLE) / 1_000;
        if silent + Duration::from_micros(2) < least {
            let words =
                format!("is reported as silent for {silent:?}, and was silent for {least:?} or longer");
            self.violate(now, process, other, &words);
        }
    }

    /// Checks a restart event: the reported silence of the previous incarnation, and the bound of its loss.
    pub(crate) fn restart_notified(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        reported: [Duration; 2],
    ) {
        let peers = self.processes[process].peers.iter().map(|(other, peer)| (&self.processes[*other], peer));
        let before = peers.filter(|(record, _)| record.node == node && record.incarnation != incarnation);
        let last = before.max_by_key(|(_, peer)| peer.last_datagram).map(|(record, _)| record.incarnation);
        if let Some(last) = last {
            self.loss_notified(now, process, (node, last), reported);
        }
    }

    pub(super) fn check_reason(&mut self, now: Time, process: usize, other: usize, why: LossReason) {
        let is_alive = self.processes[other].ended.is_none();
        match why {
            LossReason::Left | LossReason::GaveUp(_) | LossReason::Crashed | LossReason::Restarted
                if is_alive =>
            {
                self.violate(now, process, other, &format!("is alive, and is lost as {why:?}"));
            }
            LossReason::Left
            | LossReason::GaveUp(_)
            | LossReason::Crashed
            | LossReason::Restarted
            | LossReason::Duplicate => {}
            LossReason::Hung | LossReason::LinkDown => {
                let (most, least) = self.unanswered(now, process, other);
                let missed_max = self.pace(other).1 as usize;
                if is_alive && (most < missed_max || least.is_some_and(|least| least < missed_max)) {
                    let words = format!(
                        "is alive, did not answer {most} queries at one address and {least:?} at each where it has answered, and is \
                         lost as silent"
                    );
                    self.violate(now, process, other, &words);
                }
                self.check_hint(now, process, other);
            }
        }
    }

    fn check_hint(&mut self, now: Time, process: usize, other: usize) {
        let (period, missed_max) = self.pace(other);
        let counts = period * missed_max * (1_000 - DRIFT_PER_MILLE) / 1_000;
        let hint = self.processes[process].peers.get(&other).and_then(|peer| peer.hint);
        let age = hint.map(|hint| now.since(hint)).filter(|age| *age < counts);
        if let Some(age) = age {
            let words = format!("is lost as silent, and sent a query or data on its connection {age:?} ago");
            self.violate(now, process, other, &words);
        }
    }

    /// Checks the class of a loss. `host` is the classification of the other's host that has lasted long enough to be
    /// known.
    pub(crate) fn check_class(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        (why, host): (LossReason, Option<Host>),
    ) {
        let (Some(other), Some(host)) = (self.process_of(node, incarnation), host) else { return };
        let is_right = match why {
            LossReason::Left | LossReason::GaveUp(_) | LossReason::Restarted | LossReason::Duplicate => true,
            LossReason::Crashed => host == Host::Refuses,
            LossReason::Hung => host == Host::Accepts,
            LossReason::LinkDown => host == Host::IsSilent,
        };
        if !is_right {
            self.violate(
                now,
                process,
                other,
                &format!("is lost as {why:?}, and {host:?} is the response of its host"),
            );
        }
    }

    /// Returns two counts of queries since the last answer, each with half a period for the answer. The first is the
    /// highest count of any address. The second is the lowest count of the addresses that have answered before.
    fn unanswered(&self, now: Time, process: usize, other: usize) -> (usize, Option<usize>) {
        let record = &self.processes[process];
        let Some(peer) = record.peers.get(&other) else { return (0, None) };
        let least = self.pace(other).0 * 49 / 100;
        let is_missed = |query: &&Query| {
            query.sent >= peer.last_answer && now.since(query.sent) >= least && !query.is_answered_in_time
        };
        let count = |address: &SocketAddr| {
            record.queries.get(address).map_or(0, |queries| queries.iter().filter(is_missed).count())
        };
        let most = self.processes[other].addresses.iter().map(count).max();
        (most.unwrap_or(0), peer.places.iter().map(count).min())
    }

    /// Checks that a member gave a sign of life within the bound.
    pub(super) fn check_in_time(&mut self, now: Time, process: usize, other: usize) {
        let (record, (period, missed_max)) = (&self.processes[process], self.pace(other));
        let Some(peer) = record.peers.get(&other) else { return };
        let own: Duration = record
            .stalls
            .iter()
            .filter(|(began, lasted)| *began + *lasted >= peer.last_sign)
            .map(|(_, lasted)| *lasted + period)
            .sum();
        let shells = record.shells.iter().filter(|at| **at >= peer.last_sign).count();
        let shells = period * u32::try_from(shells).expect("few restarts");
        let periods = self.plan.silence_max(period, missed_max);
        let bound = periods + periods * DRIFT_PER_MILLE / 1_000 + own + shells;
        let silent = now.since(peer.last_sign);
        if silent > bound {
            let words = format!("was silent for {silent:?} and is lost only now; the bound is {bound:?}");
            self.violate(now, process, other, &words);
        }
    }
}
