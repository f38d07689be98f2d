//! The cycle: who is asked when, and who missed too much.

use std::time::Duration;

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Core, Host, Member, Output, Place,
    contact::{Contact, Question, Role},
    pace::REST,
};
use crate::ndl::LossReason;

/// Cycles between two queries to the address of a node that is gone, at most.
const FORMER_WAIT_MAX: u32 = 16;
/// Cycles in a row in which nobody is accused, and respites of a silence, at most: a timer that is always late puts nothing off for ever.
pub(super) const IN_A_ROW_MAX: u32 = 3;
/// Time between two reports that our own timer is late.
const STALL_REPORT_PERIOD: Duration = Duration::from_secs(1);

/// Who missed too much is lost at its end: our own timer was late, and what was answered may wait in our socket.
#[derive(Clone, Copy, Debug)]
pub(super) struct Respite {
    pub(super) until: Time,
    lasts: Duration,
    /// Counts those of one silence.
    pub(super) in_a_row: u32,
}

impl Core {
    /// A shell starts, the first one or one after it: what came while there was none is its own fault, not the peers'.
    pub(super) fn begin(&mut self, now: Time) {
        self.meet_seeds(now);
        self.seek_remembered(now);
        for member in self.members.values_mut() {
            member.is_awaited = false;
            member.routes.forgive();
            member.missed = member.missed.min(self.paces[member.pace].missed_max - 1);
        }
        self.contests.clear();
        for (at, pace) in self.paces.iter_mut().enumerate() {
            let is_used = at == REST || self.members.values().any(|member| member.pace == at);
            (pace.due, pace.late_in_a_row, pace.respite) = (is_used.then_some(now), 0, None);
        }
        // spec: NDL-5.5
        if self.settles.is_none() {
            self.settle(now);
        }
        self.time_passed(now);
    }

    pub(super) fn time_passed(&mut self, now: Time) {
        self.decide_contests(now);
        self.end_settling(now);
        for at in 0..self.paces.len() {
            self.end_respite(now, at);
            self.pace_due(now, at);
        }
    }

    fn pace_due(&mut self, now: Time, at: usize) {
        let pace = &mut self.paces[at];
        let Some(due) = pace.due.filter(|due| *due <= now) else { return };
        let late = now.since(due);
        // Lifeguard's rule: who was starved himself does not accuse others. The answers that came meanwhile are still
        // in the socket. But where he always is, one cycle of four counts, or nobody would ever be lost. spec: NDL-4.2
        let is_late = late > pace.period / 2;
        pace.due = Some(if is_late { now } else { due } + pace.period);
        let is_put_off = is_late && pace.late_in_a_row < IN_A_ROW_MAX;
        pace.late_in_a_row = if is_put_off { pace.late_in_a_row + 1 } else { 0 };
        if is_late {
            self.report_stall(now, late);
        }
        if !is_put_off {
            self.count_missed(now, at);
            self.drop_former_routes(now, at);
            // A respite that lasts still, as it was renewed, ends for those who are silent now, too.
            if self.paces[at].respite.is_none() {
                self.lose_the_silent(now, at, late, None);
            }
            self.tell_who_does_not_answer(at);
        }
        // In any cycle: what their hosts and GNCL say is to be new when the next one counts.
        self.probe_the_suspected(now, at);
        if at == REST {
            self.ask_everybody(now);
        } else {
            self.ask_group(now, at);
        }
    }

    fn report_stall(&mut self, now: Time, late: Duration) {
        self.recall.stalled(now, late);
        if self.stall_reported.is_none_or(|last| now.since(last) >= STALL_REPORT_PERIOD) {
            self.stall_reported = Some(now);
            self.outputs.push_back(Output::Stalled { late });
        }
    }

    fn count_missed(&mut self, now: Time, at: usize) {
        let period = self.paces[at].period;
        for member in self.members.values_mut().filter(|member| member.pace == at) {
            member.routes.count_missed(now, period);
            member.missed += u32::from(member.is_awaited);
        }
    }

    /// Who missed too much is lost, unless our own timer was late: then what waits in our socket is read first. A respite, the `former` one,
    /// is renewed where its end came later than twice what made it, up to [`IN_A_ROW_MAX`] in a row.
    // spec: NDL-4.1, NDL-4.2
    fn lose_the_silent(&mut self, now: Time, at: usize, late: Duration, former: Option<Respite>) {
        let (allowed, in_a_row) =
            former.map_or((Duration::ZERO, 0), |former| (former.lasts * 2, former.in_a_row));
        let pace = &self.paces[at];
        let period = pace.period;
        let own = &self.own;
        let is_silent = |member: &Member| member.pace == at && member.is_silent(now, pace, own);
        let silent: Vec<NodeAddress> =
            self.members.iter().filter(|(_, member)| is_silent(member)).map(|(node, _)| *node).collect();
        if late > allowed && in_a_row < IN_A_ROW_MAX && !silent.is_empty() {
            let lasts = late.min(period / 2);
            self.paces[at].respite = Some(Respite { until: now + lasts, lasts, in_a_row: in_a_row + 1 });
            return;
        }
        for node in silent {
            self.lose(now, node, self.class_of_silence(node));
        }
    }

    /// Whoever missed an answer: why that is so is to be known by the time that it is lost. // spec: NDL-4.6
    fn probe_the_suspected(&mut self, now: Time, at: usize) {
        // What is said later than the next look at the timer may be too late.
        let within = self.paces[at].period * 3 / 4;
        let suspected = self.members.iter().filter(|(_, member)| member.pace == at && member.missed > 0);
        let probes = suspected.map(|(node, member)| Output::Probe {
            node: *node,
            incarnation: member.announcement.incarnation,
            to: member.probed_addresses(&self.own),
            within,
            asked: now,
        });
        self.outputs.extend(probes);
    }

    /// What a host said when it was asked then; before its last connection was made it says nothing of what has happened since.
    pub(super) fn probed(&mut self, node: NodeAddress, incarnation: Incarnation, host: Host, asked: Time) {
        if let Some(member) = self.members.get_mut(&node)
            && member.announcement.incarnation == incarnation
            && member.missed > 0
            && asked >= member.linked
        {
            member.host = Some(host);
        }
    }

    /// What a member that is silent is lost as, by what its host said. // spec: NDL-4.6
    fn class_of_silence(&self, node: NodeAddress) -> LossReason {
        match self.members.get(&node).and_then(|member| member.host) {
            Some(Host::Accepts) => LossReason::Hung,
            Some(Host::Refuses) => LossReason::Crashed,
            Some(Host::IsSilent) | None => LossReason::LinkDown,
        }
    }

    fn end_respite(&mut self, now: Time, at: usize) {
        if let Some(respite) = self.paces[at].respite.take_if(|respite| respite.until <= now) {
            self.lose_the_silent(now, at, now.since(respite.until), Some(respite));
        }
    }

    // spec: NDL-2.1
    fn ask_everybody(&mut self, now: Time) {
        self.count_start(now);
        // What a member announces is asked as that, whoever is remembered there.
        self.seek_all(now);
        self.meet_remembered_again(now);
        self.tell_moves(now);
        // Also who cannot be asked at all: none of our addresses leads there any more.
        let members = self.members.values_mut().filter(|member| member.pace == REST);
        members.for_each(|member| member.is_awaited = true);
        let places: Vec<Place> = self.contacts.keys().copied().collect();
        for place in places {
            self.ask_in_cycle(now, place);
        }
        self.ask_the_group(now);
    }

    /// Everybody who hears the group from any of our addresses.
    pub(super) fn ask_the_group(&mut self, now: Time) {
        if self.asks_group {
            let (correlation, from) = (self.next_correlation(), self.paths.clone());
            let most = self.rest().answerable();
            self.group_questions.push(Question { correlation, asked: now }, most);
            self.outputs.push_back(Output::SendMulticastQuery { from, correlation });
        }
    }

    /// The members of one group; a pace that has none any more rests.
    fn ask_group(&mut self, now: Time, at: usize) {
        let members = self.members.values_mut().filter(|member| member.pace == at);
        let (mut is_empty, mut places) = (true, Vec::new());
        for member in members {
            (is_empty, member.is_awaited) = (false, true);
            for place in member.routes.places().collect::<Vec<_>>() {
                member.routes.asked(now, place);
                places.push(place);
            }
        }
        if is_empty {
            self.paces[at].due = None;
        }
        for place in places {
            self.ask(now, place);
        }
    }

    /// Which pace the node called `name` is asked at, from now on.
    pub(super) fn pace_for(&mut self, now: Time, name: &str) -> usize {
        let at = self.paces.iter().position(|pace| pace.covers(name)).unwrap_or(REST);
        let pace = &mut self.paces[at];
        pace.due.get_or_insert(now + pace.period);
        at
    }

    fn ask_in_cycle(&mut self, now: Time, place: Place) {
        let missed_max = self.rest().missed_max;
        if self.contacts.get(&place).is_some_and(|contact| contact.has_missed(missed_max)) {
            self.contacts.remove(&place);
            return;
        }
        let Some(mut contact) = self.contacts.get_mut(&place) else { return };
        let Contact { role, is_seed, .. } = &mut *contact;
        match role {
            Role::Candidate { asked } => *asked = asked.saturating_add(1),
            Role::Member(node) => {
                let Some(member) = self.members.get_mut(node) else { return };
                if member.pace != REST && member.routes.has(place) {
                    // Its group is asked by itself.
                    return;
                }
                member.routes.asked(now, place);
            }
            Role::Former { left, .. } if *left > 0 && !*is_seed => {
                *left -= 1;
                return;
            }
            Role::Former { wait, left, .. } => {
                *left = *wait;
                *wait = (*wait * 2).min(FORMER_WAIT_MAX);
            }
        }
        drop(contact);
        self.ask(now, place);
    }

    /// Time within which a node is lost that is in no group.
    pub(super) fn loss_bound(&self) -> Duration {
        self.rest().bound()
    }

    /// The node stops: it says so, and is silent from now on. // spec: NDL-4.4
    pub(super) fn leave(&mut self) {
        for (node, member) in &self.members {
            let leaves = member.routes.places().map(|to| Output::SendLeave { to, node: *node });
            self.outputs.extend(leaves);
        }
        for pace in &mut self.paces {
            (pace.due, pace.respite) = (None, None);
        }
        self.contests.clear();
    }
}
