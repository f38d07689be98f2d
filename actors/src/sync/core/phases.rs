//! Phases: applications that come up in steps, each going on when those that it comes up with have reached the step too.
//!
//! A phase is a level, not a meeting: whoever has reached it counts until its life ends. So one that is started again goes through its
//! phases beside others that were through long ago, and nobody waits for them to come back. What an application has reached stands in
//! its node's list; each node decides for its own applications, as with requirements.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    app::{Requirement, is_phase},
    tid::AppAddress,
    time::Time,
};

use super::{
    Core, Output,
    rendezvous::{Arrived, GRACE},
    respite::Moment,
};
use crate::sync::{
    facts::Absence,
    list::{Name, PHASES_MAX},
    words::{BarrierAnswer, BarrierKind, BarrierStatus, OnPartyLoss},
};

/// The generation that an answer about a phase has: a life reaches it once.
const ONCE: u64 = 1;

/// The applications of this node that wait at phases for others.
#[derive(Debug, Default)]
pub(super) struct Phases(BTreeMap<(AppAddress, Name), Wait>);

/// An application has reached a phase and waits for the others.
#[derive(Debug)]
struct Wait {
    /// Who has to have reached it, as it was asked.
    texts: Vec<String>,
    /// The same as requirements on the phase.
    parties: Vec<Requirement>,
    since: Time,
    until: Time,
    on_loss: OnPartyLoss,
    /// Of each party, since when it is known to be lost, if that is not waited for.
    lost: Vec<Option<Time>>,
    /// Of its request.
    correlation: u64,
    /// Of each party, since when it is missing, if it is.
    absent: Vec<Option<Time>>,
}

/// How a wait stands.
struct Standing {
    /// Who has not reached the phase, of which party, and the last that is known of each.
    missing: Vec<(usize, String, &'static str)>,
    /// Of which parties one that is asked for by its name has ended.
    lost: Vec<usize>,
}

impl Phases {
    /// The life of `app` is over.
    pub(super) fn ended(&mut self, app: AppAddress) {
        self.0.retain(|(other, _), _| *other != app);
    }

    /// An application waits no more; it has reached the phase all the same.
    pub(super) fn leave(&mut self, app: AppAddress, phase: &str, correlation: Option<u64>) {
        self.0.retain(|(other, name), wait| {
            let is_meant = *other == app && &**name == phase;
            !is_meant || correlation.is_some_and(|correlation| correlation != wait.correlation)
        });
    }

    /// Who is waited for.
    pub(super) fn awaited(&self) -> impl Iterator<Item = &Requirement> {
        self.0.values().flat_map(|wait| &wait.parties)
    }

    /// When somebody's time is over.
    pub(super) fn next_wake(&self) -> Option<Time> {
        self.0.values().map(Wait::next).min()
    }
}

impl Wait {
    /// When its time is over, or that of the return of the party that was lost first.
    fn next(&self) -> Time {
        let lost = self.lost.iter().copied().flatten().min();
        lost.map_or(self.until, |lost| self.until.min(lost + GRACE))
    }

    /// Its answer, if its time has come.
    fn judge(&mut self, Moment { now, judged }: Moment, standing: Standing) -> Option<BarrierAnswer> {
        let Standing { missing, lost } = standing;
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

impl Core {
    /// An application has reached a phase, and waits for the others. spec: SYNC-15
    ///
    /// # Errors
    /// Why it cannot, in words.
    pub(super) fn reach(&mut self, now: Time, arrived: Arrived) -> Result<(), String> {
        // What a guest has here is bounded by how many they are: 16 phases of each.
        let Arrived { app, name, user: _, correlation, barrier: phase, parties, within, on_loss } = arrived;
        if !is_phase(&phase) {
            return Err(format!("the phase '{phase}': it is one word without `*`, `|` and `?`"));
        }
        let called = name.as_deref().unwrap_or_default();
        if !parties.iter().any(|party| party.counts(called)) {
            return Err(format!(
                "an application called {called:?} is none of those that reach the phase '{phase}'; who waits for others requires \
                 them, as in `*.drive at {phase}`"
            ));
        }
        let registered = self.apps.get_mut(app).ok_or("only an application of this node can wait here")?;
        if !registered.phases.contains(&phase) {
            if registered.phases.len() >= PHASES_MAX {
                return Err(format!("it has reached {PHASES_MAX} phases in this life, which is the limit"));
            }
            registered.phases.push(phase.clone());
            self.own_list_changed(now);
        }
        let texts = parties.iter().map(ToString::to_string).collect();
        let parties: Vec<Requirement> = parties.into_iter().map(|party| party.at(&*phase)).collect();
        let until = now + within;
        let (absent, lost) = (vec![None; parties.len()], vec![None; parties.len()]);
        let wait = Wait { texts, parties, since: now, until, on_loss, lost, correlation, absent };
        if let Some(former) = self.phases.0.insert((app, phase), wait) {
            let why = "this application has arrived there again; the later request stands".to_owned();
            let answer = BarrierAnswer::Refused { why };
            self.outputs.push_back(Output::AnswerBarrier { app, correlation: former.correlation, answer });
        }
        Ok(())
    }

    /// Answers those at phases who may go on, or whose wait is over. spec: SYNC-15
    pub(super) fn pass_phases(&mut self, moment: Moment) -> Vec<(AppAddress, u64, BarrierAnswer)> {
        let standings: Vec<Standing> =
            self.phases.0.values().map(|wait| self.standing_at_phase(wait)).collect();
        let mut answers = Vec::new();
        let mut standings = standings.into_iter();
        self.phases.0.retain(|(app, _), wait| {
            let answer = standings.next().and_then(|standing| wait.judge(moment, standing));
            let is_over = answer.is_some();
            answers.extend(answer.map(|answer| (*app, wait.correlation, answer)));
            !is_over
        });
        answers
    }

    fn standing_at_phase(&self, wait: &Wait) -> Standing {
        let (mut missing, mut lost) = (Vec::new(), Vec::new());
        for (at, party) in wait.parties.iter().enumerate() {
            let Some(why) = self.standing(AppAddress::NONE, party).why_not(party) else { continue };
            if party.one_name().is_some() && why.is_end() {
                lost.push(at);
            }
            let parts = self.missing_parts(AppAddress::NONE, party);
            missing.extend(parts.into_iter().map(|(part, why)| (at, part, why)));
        }
        Standing { missing, lost }
    }

    fn absent_at_phase(&self, now: Time, wait: &Wait) -> Vec<Absence> {
        let absence = |(party, name, why): (usize, String, &'static str)| {
            let since = wait.absent[party].map_or(Duration::ZERO, |absent| now.since(absent));
            Absence { name, why: why.into(), since }
        };
        self.standing_at_phase(wait).missing.into_iter().map(absence).collect()
    }

    /// For how long an application has waited at phases, and for whom.
    pub(super) fn lacks_at_phases(&self, now: Time, app: AppAddress) -> Option<(Duration, Vec<Absence>)> {
        let waits: Vec<&Wait> =
            self.phases.0.iter().filter(|((other, _), _)| *other == app).map(|(_, wait)| wait).collect();
        let since = waits.iter().map(|wait| wait.since).min()?;
        let missing = waits.iter().flat_map(|wait| self.absent_at_phase(now, wait)).collect();
        Some((now.since(since), missing))
    }

    /// The phases at which somebody of this node waits, each as often as with other parties.
    pub(super) fn awaited_phases(&self, now: Time) -> Vec<BarrierStatus> {
        let mut statuses: Vec<BarrierStatus> = Vec::new();
        for ((app, phase), wait) in &self.phases.0 {
            let waiting = (self.title(*app), now.since(wait.since));
            let same =
                statuses.iter_mut().find(|status| status.barrier == **phase && status.parties == wait.texts);
            if let Some(same) = same {
                same.waiting.push(waiting);
                // All of them lack the same; who came first has lacked it for longest.
                let longer = self.absent_at_phase(now, wait);
                for (absence, longer) in same.missing.iter_mut().zip(longer) {
                    absence.since = absence.since.max(longer.since);
                }
                continue;
            }
            let (barrier, parties) = (phase.to_string(), wait.texts.clone());
            let (kind, missing) = (BarrierKind::Phase, self.absent_at_phase(now, wait));
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
}
