//! The cycle: who is asked when, and who missed too much.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Core, Output, Source,
    contact::{Contact, Question, Role},
};
use crate::ndl::LossReason;

/// Cycles between two queries to the address of a node that is gone, at most.
const FORMER_WAIT_MAX: u32 = 16;
/// Time between two reports that our own timer is late.
const STALL_REPORT_PERIOD: Duration = Duration::from_secs(1);

impl Core {
    /// A shell starts, the first one or one after it: what came while there was none is its own fault, not the peers'.
    pub(super) fn begin(&mut self, now: Time) {
        let udp = self.udp;
        for seed in self.seeds.iter().copied().filter(|seed| Some(*seed) != udp) {
            self.contacts.entry(seed).or_insert_with(|| Contact::new(now, Source::Seed));
        }
        for member in self.members.values_mut() {
            member.is_awaited = false;
        }
        self.contests.clear();
        // spec: NDL-5.5
        self.settles.get_or_insert(now + self.period * (self.missed_max + 1));
        self.cycle_due = Some(now);
        self.time_passed(now);
    }

    pub(super) fn time_passed(&mut self, now: Time) {
        self.decide_contests(now);
        let Some(due) = self.cycle_due.filter(|due| *due <= now) else { return };
        let late = now.since(due);
        // Lifeguard's rule: who was starved himself does not accuse others. The answers that came meanwhile are still
        // in the socket. spec: NDL-4.2
        if late > self.period / 2 {
            self.report_stall(now, late);
            self.cycle_due = Some(now + self.period);
        } else {
            self.count_missed(now);
            self.cycle_due = Some(due + self.period);
        }
        self.ask_everybody(now);
    }

    fn report_stall(&mut self, now: Time, late: Duration) {
        if self.stall_reported.is_none_or(|last| now.since(last) >= STALL_REPORT_PERIOD) {
            self.stall_reported = Some(now);
            self.outputs.push_back(Output::Stalled { late });
        }
    }

    // spec: NDL-4.1
    fn count_missed(&mut self, now: Time) {
        let mut lost: Vec<NodeAddress> = Vec::new();
        for (node, member) in self.members.iter_mut().filter(|(_, member)| member.is_awaited) {
            member.missed += 1;
            if member.missed >= self.missed_max {
                lost.push(*node);
            }
        }
        for node in lost {
            self.lose(now, node, LossReason::Silent);
        }
    }

    // spec: NDL-2.1
    fn ask_everybody(&mut self, now: Time) {
        let addresses: Vec<SocketAddr> = self.contacts.keys().copied().collect();
        for address in addresses {
            self.ask_in_cycle(now, address);
        }
        if self.asks_group {
            let correlation = self.next_correlation();
            self.group_questions.push(Question { correlation, asked: now });
            self.outputs.push_back(Output::SendMulticastQuery { correlation });
        }
    }

    fn ask_in_cycle(&mut self, now: Time, address: SocketAddr) {
        let Some(contact) = self.contacts.get_mut(&address) else { return };
        match &mut contact.role {
            Role::Candidate { asked } if *asked >= self.missed_max && !contact.is_seed => {
                self.contacts.remove(&address);
                return;
            }
            Role::Candidate { asked } => *asked = asked.saturating_add(1),
            Role::Member(node) => {
                if let Some(member) = self.members.get_mut(node) {
                    member.is_awaited = true;
                }
            }
            Role::Former { left, .. } if *left > 0 && !contact.is_seed => {
                *left -= 1;
                return;
            }
            Role::Former { wait, left, .. } => {
                *left = *wait;
                *wait = (*wait * 2).min(FORMER_WAIT_MAX);
            }
        }
        self.ask(now, address);
    }

    /// The node stops: it says so, and is silent from now on. // spec: NDL-4.4
    pub(super) fn leave(&mut self) {
        for (node, member) in &self.members {
            self.outputs.push_back(Output::SendLeave { to: member.address, node: *node });
        }
        self.cycle_due = None;
        self.contests.clear();
    }
}
