//! The liveness of this node's layers, applications and clients, for the nodes that watch it. NDL asks, and
//! the root answers without waiting. The process of an application in a process of its own observes and
//! reports the application. For a client (`NodeApi`) the node observes whether it reads its queued messages.

mod clients;

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    supervision::{BranchView, ChildState, ChildView, SupervisorHandle, Turn},
    tid::AppAddress,
    time::Time,
};

pub(super) use self::clients::IdleClients;

use sinew_model::{
    facts::Trouble,
    progress::{Part, TroubleCode},
};

use super::layers::LAYERS;

/// A longer turn is reported. Below the watchdog's default of 1 s, after which the actor is replaced, and
/// above the delay that a loaded machine adds to a short turn.
const STALLED_AFTER: Duration = Duration::from_millis(250);
/// The layers' addresses, in the order of their names.
const ADDRESSES: [AppAddress; 4] = [AppAddress::LNCL, AppAddress::SYNC, AppAddress::GNCL, AppAddress::NDL];

/// Returns the milliseconds since `since`, at most the largest number.
pub(crate) fn millis_since(now: Time, since: Time) -> u32 {
    u32::try_from(now.since(since).as_millis()).unwrap_or(u32::MAX)
}

/// The turns in progress at the last check: the number of each, and since when at least it has lasted.
#[derive(Default)]
pub(crate) struct Stalls(BTreeMap<String, (u64, Time)>);

impl Stalls {
    /// Returns the children with turns that last too long, and since when. Turns in progress are remembered
    /// until the next check.
    pub(crate) fn check(
        &mut self,
        now: Time,
        turns: impl IntoIterator<Item = Turn>,
    ) -> BTreeMap<String, Time> {
        let before = std::mem::take(&mut self.0);
        for Turn { actor, number, begun, .. } in turns.into_iter().filter(|turn| turn.is_on) {
            let lasted = before.get(&actor).filter(|(turn, _)| *turn == number).map(|(_, since)| *since);
            self.0.insert(actor, (number, begun.or(lasted).unwrap_or(now)));
        }
        let lasts = self.0.iter().filter(|(_, (_, since))| now.since(*since) >= STALLED_AFTER);
        lasts.map(|(actor, (_, since))| (actor.clone(), *since)).collect()
    }
}

/// Adds the parts below a supervisor that are in trouble.
pub(crate) fn collect(
    now: Time,
    supervisor: &SupervisorHandle,
    view: BranchView,
    stalled: &BTreeMap<String, Time>,
    parts: &mut Vec<Part>,
) {
    for (id, child, below) in view.children {
        if let Some(below) = below {
            collect(now, supervisor, below, stalled, parts);
        }
        let Some(info) = supervisor.child_info(id) else { continue };
        let layer = LAYERS.iter().position(|layer| *layer == info.name).map(|at| ADDRESSES[at]);
        let Some(app) = info.tid.map(|tid| tid.app).or(layer) else { continue };
        if let Some((trouble, since)) = trouble(&child, stalled.get(&info.name).copied()) {
            let since_ms = millis_since(now, since);
            parts.push(Part { app, name: info.name, trouble: TroubleCode(trouble), since_ms });
        }
    }
}

/// Returns the trouble of a child: none if it has not been ready yet, or is not supposed to run.
fn trouble(child: &ChildView, stalled: Option<Time>) -> Option<(Trouble, Time)> {
    let was_there = child.restarts > 0;
    match child.state {
        ChildState::Ready | ChildState::Stopping(_) => stalled.map(|since| (Trouble::Stalled, since)),
        ChildState::BackingOff(_) => Some((Trouble::Down, child.since)),
        ChildState::Starting(_) => was_there.then_some((Trouble::Down, child.since)),
        ChildState::Down if child.wanted => was_there.then_some((Trouble::Down, child.since)),
        ChildState::Down => {
            let has_failed = child.last_reason.as_ref().is_some_and(|reason| reason.is_failure());
            has_failed.then_some((Trouble::GivenUp, child.since))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turn(number: u64, begun: Option<u64>) -> Turn {
        let begun = begun.map(|ms| Time::from_nanos(ms * 1_000_000));
        Turn { actor: "knee".to_owned(), number, is_on: number % 2 == 1, begun }
    }

    fn at(ms: u64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    #[test]
    fn long_turn_is_reported_with_its_start() {
        let mut stalls = Stalls::default();
        assert!(stalls.check(at(1_000), vec![turn(7, None)]).is_empty(), "it may have begun just now");
        assert_eq!(stalls.check(at(1_300), vec![turn(7, None)])["knee"], at(1_000));
        assert!(stalls.check(at(1_600), vec![turn(9, None)]).is_empty(), "another turn");
        assert!(stalls.check(at(1_900), vec![turn(10, None)]).is_empty(), "it rests");
        assert_eq!(stalls.check(at(2_000), vec![turn(11, Some(1_700))])["knee"], at(1_700));
        assert!(stalls.check(at(2_100), vec![]).is_empty() && stalls.0.is_empty());
    }
}
