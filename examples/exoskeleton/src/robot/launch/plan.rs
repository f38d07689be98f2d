//! The start order of the processes: shuffled by the seed, one joint two seconds late.

use std::time::Duration;

use exoskeleton_model::chance::Chance;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::part::Part;
use sinew::Time;

use crate::robot::role::Role;

/// The purpose of the random numbers here; the plant draws others.
const PURPOSE: u64 = 7;
const APART_MS: (u64, u64) = (50, 250);
const LATE: Duration = Duration::from_secs(2);

/// Remaining starts, soonest last.
pub(super) struct Plan {
    starts: Vec<(Time, Role)>,
    late: Role,
}

impl Plan {
    pub(super) fn shuffled(seed: u64, now: Time) -> Self {
        let mut chance = Chance::for_purpose(seed, PURPOSE);
        let late = Role::Node(Part::Joint(Joint::ALL[chance.next_u64() as usize % 3]));
        let mut others: Vec<Role> = Role::ALL.into_iter().filter(|role| *role != late).collect();
        for last in (1..others.len()).rev() {
            others.swap(last, chance.next_u64() as usize % (last + 1));
        }
        let mut plan = Self { starts: Vec::new(), late };
        let mut at = now;
        for role in others {
            plan.add(role, at);
            let (low, high) = APART_MS;
            at = at + Duration::from_millis(low + chance.next_u64() % (high - low));
        }
        plan.add(late, now + LATE);
        plan
    }

    pub(super) fn add(&mut self, role: Role, at: Time) {
        self.starts.push((at, role));
        self.starts.sort_by(|a, b| b.cmp(a));
    }

    pub(super) fn next_due(&self) -> Option<Time> {
        self.starts.last().map(|(at, _)| *at)
    }

    pub(super) fn take_due(&mut self, now: Time) -> Option<Role> {
        self.next_due().filter(|due| *due <= now)?;
        self.starts.pop().map(|(_, role)| role)
    }

    /// The order as text.
    pub(super) fn description(&self) -> String {
        let order: Vec<&str> = self.starts.iter().rev().map(|(_, role)| role.name()).collect();
        format!("start order: {}; {} comes {} s late", order.join(", "), self.late, LATE.as_secs())
    }
}

#[cfg(test)]
#[path = "../../../tests/unit/plan.rs"]
mod tests;
