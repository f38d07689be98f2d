//! The query cycle: which nodes are queried, and which missed too many answers.

use std::time::Duration;

use sinew_model::facts::LossReason;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Core, Host, Output, Place,
    contact::Contact,
    contacts::Due,
    grace_period::GracePeriod,
    paces::{Cycle, REST},
};

impl Core {
    /// Starts a shell, the first one or a later one.
    pub(super) fn begin(&mut self, now: Time) {
        self.add_seeds(now);
        self.seek_remembered(now);
        self.members.forgive(&self.paces);
        self.conflicts.clear();
        let members = &self.members;
        self.paces.start(now, |at| at == REST || members.values().any(|member| member.pace == at));
        // spec: NDL-5.5
        if !self.local_node.has_started() {
            self.local_node.settle(now, self.paces.rest());
        }
        self.time_passed(now);
    }

    pub(super) fn time_passed(&mut self, now: Time) {
        self.decide_conflicts(now);
        self.local_node.time_passed(now);
        for at in 0..self.paces.all.len() {
            if let Some(grace) = self.paces.all[at].end_grace(now) {
                self.lose_the_silent(now, at, now.since(grace.until), Some(grace));
            }
            if let Some(cycle) = self.paces.all[at].next_cycle(now) {
                self.run_cycle(now, at, cycle);
            }
        }
    }

    fn run_cycle(&mut self, now: Time, at: usize, Cycle { late, is_stall, counts }: Cycle) {
        if is_stall {
            self.introspection.stalled(now, late);
            if self.paces.reports_stall(now) {
                self.outputs.push_back(Output::Stalled { late });
            }
        }
        if counts {
            self.count_missed(now, at, late);
        }
        // Done in every cycle, so that the results of hosts and of GNCL are recent when the next cycle counts.
        let pace = (at, &self.paces.all[at]);
        self.outputs.extend(self.members.probes(now, pace, &self.local_addresses));
        if at == REST {
            self.query_all(now);
        } else {
            self.query_watch_group(now, at);
        }
    }

    fn count_missed(&mut self, now: Time, at: usize, late: Duration) {
        let pace = &self.paces.all[at];
        self.members.count_missed(now, at, pace.period);
        let dropped = self.members.drop_former_routes(at, pace.missed_max);
        dropped.into_iter().for_each(|place| self.contacts.release(now, place));
        // A renewed grace period that still runs also covers the members that are silent now.
        if !pace.has_grace() {
            self.lose_the_silent(now, at, late, None);
        }
        let unheard = self.members.unheard(at, &self.paces.all[at]);
        unheard.iter().for_each(|event| self.subscribers.publish(event));
    }

    /// Loses the members that missed too many answers, unless the local timer was late. In that case the
    /// datagrams in the socket are read first. The `former` grace period may be renewed.
    // spec: NDL-4.1, NDL-4.2
    fn lose_the_silent(&mut self, now: Time, at: usize, late: Duration, former: Option<GracePeriod>) {
        let pace = &mut self.paces.all[at];
        let silent = self.members.silent(now, (at, pace), &self.local_addresses);
        if silent.is_empty() || pace.start_grace(now, late, former) {
            return;
        }
        for node in silent {
            self.lose(now, node, self.reason_of_silence(node));
        }
    }

    /// Returns the loss reason for a silent member, from the result of its host's probe. // spec: NDL-4.6
    fn reason_of_silence(&self, node: NodeAddress) -> LossReason {
        match self.members.get(&node).and_then(|member| member.host) {
            Some(Host::Accepts) => LossReason::Hung,
            Some(Host::Refuses) => LossReason::Crashed,
            Some(Host::IsSilent) | None => LossReason::LinkDown,
        }
    }

    // spec: NDL-2.1
    fn query_all(&mut self, now: Time) {
        let (remembered, present, contacts) = self.remembered_parts();
        remembered.time_passed(now, &present, contacts);
        // An address that a member announces is queried as the member's, even if another node is remembered there.
        for place in self
            .members
            .values()
            .flat_map(|m| m.unknown_places(&self.local_addresses, &self.contacts))
            .collect::<Vec<_>>()
        {
            self.contacts.get_or_insert_with(place, || Contact::announced(now));
        }
        let (remembered, present, (contacts, _)) = self.remembered_parts();
        remembered.restore_contacts(now, &present, contacts);
        self.outputs.extend(self.members.moves(now, &self.local_addresses));
        self.members.await_all(REST);
        for place in self.contacts.keys().copied().collect::<Vec<_>>() {
            self.query_in_cycle(now, place);
        }
        self.query_group(now);
    }

    /// Queries the members of one watch group. A pace without members stops.
    fn query_watch_group(&mut self, now: Time, at: usize) {
        let Some(places) = self.members.query_all(now, at) else { return self.paces.all[at].stop() };
        places.into_iter().for_each(|place| self.query(now, place));
    }

    fn query_in_cycle(&mut self, now: Time, place: Place) {
        let is_due = match self.contacts.next_cycle(place, self.paces.rest().missed_max) {
            Due::Now => true,
            Due::Later => false,
            Due::Member(node) => self.members.get_mut(&node).is_some_and(|member| {
                // The members of a watch group are queried by that group's own cycle.
                let is_due = member.pace == REST || !member.routes.has(place);
                if is_due {
                    member.routes.queried(now, place);
                }
                is_due
            }),
        };
        if is_due {
            self.query(now, place);
        }
    }

    /// Announces that the node stops. It sends nothing afterwards. // spec: NDL-4.4
    pub(super) fn leave(&mut self) {
        self.outputs.extend(self.members.leaves());
        self.paces.stop();
        self.conflicts.clear();
    }
}
