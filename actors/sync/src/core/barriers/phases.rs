//! Phases: applications start in steps, and each continues when its parties have reached the same step.
//!
//! A phase is a level, not a meeting: an application that has reached it counts until its life ends. A
//! restarted application therefore passes its phases while others passed them long ago, and no other
//! application has to return. The node's list contains the phases that its applications have reached. Each
//! node decides for its own applications, as with requirements.

use std::{collections::BTreeMap, time::Duration};

use sinew_model::{
    barrier::{BarrierAnswer, BarrierKind, BarrierStatus, OnPartyLoss},
    directory::Absence,
};
use sinew_runtime::{
    app::{Requirement, is_phase},
    tid::AppAddress,
    time::Time,
};

use super::{
    answers::Answer,
    rendezvous::{Arrived, GRACE},
};
use crate::{
    core::{Output, apps::Apps, grace_period::Moment, outputs::Outputs, readiness::Readiness},
    list::Name,
};

/// The generation in an answer about a phase: a life reaches the phase once.
const ONCE: u64 = 1;

/// The applications of this node that wait for others at phases.
#[derive(Debug, Default)]
pub(super) struct Phases(BTreeMap<(AppAddress, Name), Wait>);

/// The wait of an application that has reached a phase.
#[derive(Debug)]
struct Wait {
    /// The parties that must reach the phase, as in the request.
    texts: Vec<String>,
    /// The same parties as requirements on the phase.
    parties: Vec<Requirement>,
    since: Time,
    until: Time,
    on_loss: OnPartyLoss,
    /// For each party, since when it is known to be lost, if the application does not wait for its return.
    lost: Vec<Option<Time>>,
    /// The correlation of the request.
    correlation: u64,
    /// For each missing party, since when it is missing.
    absent: Vec<Option<Time>>,
}

/// The state of a wait.
struct WaitState {
    /// The party index and name of each missing application, and its last known state.
    missing: Vec<(usize, String, &'static str)>,
    /// The indexes of the lost parties, which are requested by one name.
    lost: Vec<usize>,
}

impl Phases {
    /// Records that an application has reached a phase, and starts its wait for the others. Returns whether it
    /// had not reached the phase before. spec: SYNC-15
    ///
    /// # Errors
    /// Returns a description if the application cannot wait.
    pub(super) fn reach(
        &mut self,
        now: Time,
        arrived: Arrived,
        apps: &mut Apps,
        outputs: &mut Outputs,
    ) -> Result<bool, String> {
        // The number of guests bounds their use of phases: each has at most 16.
        let Arrived { app, name, user: _, correlation, barrier: phase, parties, within, on_loss } = arrived;
        if !is_phase(&phase) {
            return Err(format!("the phase '{phase}': it is one word without `*`, `|` and `?`"));
        }
        let called = name.as_deref().unwrap_or_default();
        if !parties.iter().any(|party| party.counts(called)) {
            return Err(format!(
                "an application called {called:?} is no party of the phase '{phase}'; an application that only waits for others requires \
                 them, as in `*.drive at {phase}`"
            ));
        }
        let is_new = apps.reach(app, &phase)?;
        let texts = parties.iter().map(ToString::to_string).collect();
        let parties: Vec<Requirement> = parties.into_iter().map(|party| party.at(&*phase)).collect();
        let until = now + within;
        let (absent, lost) = (vec![None; parties.len()], vec![None; parties.len()]);
        let wait = Wait { texts, parties, since: now, until, on_loss, lost, correlation, absent };
        if let Some(former) = self.0.insert((app, phase), wait) {
            let why =
                "this application has arrived there again; the later request replaces this one".to_owned();
            let answer = BarrierAnswer::Refused { why };
            outputs.push(Output::AnswerBarrier { app, correlation: former.correlation, answer });
        }
        Ok(is_new)
    }

    /// Returns the answers of all waits at phases that have passed or are over. spec: SYNC-15
    pub(super) fn evaluate(&mut self, moment: Moment, readiness: Readiness<'_>) -> Vec<Answer> {
        let mut answers = Vec::new();
        self.0.retain(|(app, _), wait| {
            let state = wait.state(readiness);
            let answer = wait.judge(moment, state);
            let is_over = answer.is_some();
            answers.extend(answer.map(|answer| (*app, wait.correlation, answer)));
            !is_over
        });
        answers
    }

    /// Returns how long an application has waited at phases, and for which applications.
    pub(super) fn absences_of(
        &self,
        now: Time,
        app: AppAddress,
        readiness: Readiness<'_>,
    ) -> Option<(Duration, Vec<Absence>)> {
        let waits: Vec<&Wait> =
            self.0.iter().filter(|((other, _), _)| *other == app).map(|(_, wait)| wait).collect();
        let since = waits.iter().map(|wait| wait.since).min()?;
        let missing = waits.iter().flat_map(|wait| wait.absences(now, readiness)).collect();
        Some((now.since(since), missing))
    }

    /// Returns the phases at which local applications wait. A phase with different parties appears once for
    /// each set of parties.
    pub(super) fn statuses(&self, now: Time, readiness: Readiness<'_>) -> Vec<BarrierStatus> {
        let mut statuses: Vec<BarrierStatus> = Vec::new();
        for ((app, phase), wait) in &self.0 {
            let waiting = (readiness.directory.apps.title(*app), now.since(wait.since));
            let same =
                statuses.iter_mut().find(|status| status.barrier == **phase && status.parties == wait.texts);
            if let Some(same) = same {
                same.waiting.push(waiting);
                // All of them lack the same parties; the first to arrive has lacked them longest.
                let longer = wait.absences(now, readiness);
                for (absence, longer) in same.missing.iter_mut().zip(longer) {
                    absence.since = absence.since.max(longer.since);
                }
                continue;
            }
            let (barrier, parties) = (phase.to_string(), wait.texts.clone());
            let (kind, missing) = (BarrierKind::Phase, wait.absences(now, readiness));
            statuses.push(BarrierStatus {
                barrier,
                parties,
                kind,
                generation: 0,
                waiting: vec![waiting],
                missing,
            });
        }
        statuses
    }

    /// Removes the waits of `app`, after its life has ended.
    pub(super) fn ended(&mut self, app: AppAddress) {
        self.0.retain(|(other, _), _| *other != app);
    }

    /// Removes a wait of an application. The application has still reached the phase.
    pub(super) fn leave(&mut self, app: AppAddress, phase: &str, correlation: Option<u64>) {
        self.0.retain(|(other, name), wait| {
            let is_meant = *other == app && &**name == phase;
            !is_meant || correlation.is_some_and(|correlation| correlation != wait.correlation)
        });
    }

    /// Returns all awaited parties.
    pub(super) fn awaited(&self) -> impl Iterator<Item = &Requirement> {
        self.0.values().flat_map(|wait| &wait.parties)
    }

    /// Returns the time at which the next wait is over.
    pub(super) fn next_wake(&self) -> Option<Time> {
        self.0.values().map(Wait::next).min()
    }
}

impl Wait {
    /// Returns the earlier of the wait's timeout and the end of the first lost party's grace time.
    fn next(&self) -> Time {
        let lost = self.lost.iter().copied().flatten().min();
        lost.map_or(self.until, |lost| self.until.min(lost + GRACE))
    }

    fn state(&self, readiness: Readiness<'_>) -> WaitState {
        let (mut missing, mut lost) = (Vec::new(), Vec::new());
        for (at, party) in self.parties.iter().enumerate() {
            let state = readiness.state_of(AppAddress::NONE, party);
            let Some(why) = state.why_not(party) else { continue };
            if party.one_name().is_some() && why.is_end() {
                lost.push(at);
            }
            let parts = readiness.missing_parts(AppAddress::NONE, party);
            missing.extend(parts.into_iter().map(|(part, why)| (at, part, why)));
        }
        WaitState { missing, lost }
    }

    fn absences(&self, now: Time, readiness: Readiness<'_>) -> Vec<Absence> {
        let absence = |(party, name, why): (usize, String, &'static str)| {
            let since = self.absent[party].map_or(Duration::ZERO, |absent| now.since(absent));
            Absence { name, why: why.into(), since }
        };
        self.state(readiness).missing.into_iter().map(absence).collect()
    }

    /// Returns the answer, if the wait is over.
    fn judge(&mut self, Moment { now, judged }: Moment, state: WaitState) -> Option<BarrierAnswer> {
        let WaitState { missing, lost } = state;
        for (party, absent) in self.absent.iter_mut().enumerate() {
            let is_missing = missing.iter().any(|(other, ..)| *other == party);
            *absent = is_missing.then(|| absent.unwrap_or(now));
        }
        let missing: Vec<_> = missing.into_iter().map(|(_, part, why)| (part, why.to_owned())).collect();
        if missing.is_empty() {
            return Some(BarrierAnswer::Opened { generation: ONCE });
        }
        let asks = self.on_loss == OnPartyLoss::Fail;
        for (party, since) in self.lost.iter_mut().enumerate() {
            let is_lost = asks && lost.contains(&party);
            *since = is_lost.then(|| since.unwrap_or(now));
        }
        if self.until <= judged {
            Some(BarrierAnswer::TimedOut { missing })
        } else {
            (self.next() <= judged).then_some(BarrierAnswer::Lost { missing })
        }
    }
}
