//! Run-time barriers and phases: where applications of this node wait for others while they run.

mod answers;
mod phases;
pub(super) mod rendezvous;

use std::time::Duration;

use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, BarrierStatus},
    directory::Absence,
};
use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

pub(super) use self::answers::Answer;
use self::{
    answers::RejectedAnswers,
    phases::Phases,
    rendezvous::{Arrived, BarrierKey, BarrierState, Rendezvous, Waiters},
};
use super::{Output, apps::Apps, grace_period::Moment, outputs::Outputs, peers::Peers, readiness::Readiness};
use crate::{
    arrivals::{Arrivals, PARTIES_BYTES_MAX, PARTIES_MAX, fault_of_parties},
    list::Name,
};

/// Maximum size of an answer without its missing parties, in bytes.
const ANSWER: usize = 32;
/// Maximum size of a missing party without its two texts, in bytes.
const MISSING: usize = 8;

/// The barriers of this node.
#[derive(Debug)]
pub(super) struct Barriers {
    frame_bytes_max: usize,
    rendezvous: Rendezvous,
    phases: Phases,
    rejected: RejectedAnswers,
}

/// The request of an application that has arrived.
#[derive(Debug)]
pub(super) struct Request {
    pub(super) app: AppAddress,
    pub(super) correlation: u64,
    pub(super) asked: ArriveAtBarrier,
}

impl Barriers {
    /// Returns a state without barriers. Its frame has at most `frame_bytes_max` bytes.
    pub(super) fn new(node: NodeAddress, incarnation: Incarnation, frame_bytes_max: usize) -> Self {
        Self {
            frame_bytes_max,
            rendezvous: Rendezvous::new(node, incarnation, frame_bytes_max),
            phases: Phases::default(),
            rejected: RejectedAnswers::default(),
        }
    }

    /// Returns the barriers at which applications meet.
    pub(super) const fn rendezvous(&self) -> &Rendezvous {
        &self.rendezvous
    }

    /// Returns the barriers at which applications meet, for simulations that change them.
    pub(super) const fn rendezvous_mut(&mut self) -> &mut Rendezvous {
        &mut self.rendezvous
    }

    /// Handles the arrival of a local application at a barrier or a phase. Returns whether it has reached a
    /// phase that it had not reached before.
    pub(super) fn arrived(
        &mut self,
        now: Time,
        request: Request,
        apps: &mut Apps,
        outputs: &mut Outputs,
    ) -> bool {
        let (app, correlation, kind) = (request.app, request.correlation, request.asked.kind);
        let arrived = read_arrival(request, apps);
        let admitted = arrived.and_then(|arrived| match kind {
            BarrierKind::Meeting => self.rendezvous.arrive(now, arrived).map(|()| false),
            BarrierKind::Phase => self.phases.reach(now, arrived, apps, outputs),
        });
        admitted.unwrap_or_else(|why| {
            let answer = BarrierAnswer::Refused { why };
            outputs.push(Output::AnswerBarrier { app, correlation, answer });
            false
        })
    }

    /// Removes waits of an application. With a correlation, only the wait by that request is removed.
    pub(super) fn left(&mut self, now: Time, app: AppAddress, barrier: &str, correlation: Option<u64>) {
        self.rendezvous.leave(now, app, barrier, correlation);
        self.phases.leave(app, barrier, correlation);
    }

    /// Removes all state of an application, after its life has ended.
    pub(super) fn ended(&mut self, now: Time, app: AppAddress) {
        self.rendezvous.ended(now, app);
        self.phases.ended(app);
        self.rejected.forget(app);
    }

    /// Stores an answer that the application's mailbox rejected.
    pub(super) fn answer_rejected(&mut self, now: Time, answer: Answer, outputs: &mut Outputs) {
        self.rejected.add(now, answer, outputs);
    }

    /// Sends the rejected answers again.
    pub(super) fn offer_again(&mut self, now: Time, outputs: &mut Outputs) {
        self.rejected.offer_again(now, outputs);
    }

    /// Handles a link to `node` that is up.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress) {
        self.rendezvous.link_up(now, node);
    }

    /// Invalidates the state of `node` until it is published again. The node is unreachable or lost.
    pub(super) fn invalidate(&mut self, node: NodeAddress) {
        self.rendezvous.invalidate(node);
    }

    /// Handles the barrier state that another node published. spec: SYNC-11
    pub(super) fn frame_received(
        &mut self,
        now: Time,
        (from, payload): (NodeAddress, &[u8]),
        peers: &mut Peers,
        outputs: &mut Outputs,
    ) {
        let frame = if from == peers.here() || !from.is_single() {
            Err("not another node".to_owned())
        } else if payload.len() > self.frame_bytes_max {
            Err(format!("{} bytes", payload.len()))
        } else if !peers.admit(from) {
            Err("more nodes than `ndl.nodes_max`".to_owned())
        } else {
            Arrivals::parse(payload).map_err(|fault| fault.to_string())
        };
        let linked = peers.linked(from);
        let applied = frame.and_then(|frame| {
            self.rendezvous.frame_received(now, from, frame, linked).map_err(str::to_owned)
        });
        if let Err(why) = applied {
            outputs.refuse("barriers", format!("from {from}: {why}"));
        }
    }

    /// Schedules the rejected frame to `node` again.
    pub(super) fn frame_rejected(&mut self, now: Time, node: NodeAddress) {
        self.rendezvous.frame_rejected(now, node);
    }

    /// Opens barriers, answers waits that are over, and publishes the barrier state to other nodes.
    pub(super) fn evaluate(&mut self, moment: Moment, readiness: Readiness<'_>, outputs: &mut Outputs) {
        let peers = readiness.directory.peers;
        self.rendezvous.retain(|node| peers.contains(node));
        self.rendezvous.evaluate(moment, |node| peers.current(node), |name| readiness.why_not(name));
        let mut answers = self.rendezvous.take_answers();
        answers.extend(self.phases.evaluate(moment, readiness));
        for to in self.rendezvous.take_due(moment.now, |node| peers.linked(node).is_some()) {
            let (frame, left_out) = self.rendezvous.encoded();
            if left_out > 0 {
                let limit = self.frame_bytes_max;
                let detail = format!(
                    "{left_out} barriers have no room in this node's barrier frame, which has at most {limit} bytes: other nodes do not receive them from it; \
                     raise `node.payload_max`"
                );
                outputs.refuse("barriers", detail);
            }
            outputs.push(Output::PublishArrivals { to, frame });
        }
        // Local answers follow the frames to other nodes, as applications there are farther away.
        for (app, correlation, answer) in answers {
            let answer = within(answer, self.frame_bytes_max);
            outputs.push(Output::AnswerBarrier { app, correlation, answer });
        }
    }

    /// Returns all parties for which local applications wait.
    pub(super) fn awaited(&self) -> impl Iterator<Item = &Requirement> {
        self.rendezvous.awaited().chain(self.phases.awaited())
    }

    /// Returns the time of the next deadline that [`Barriers::evaluate`] judges.
    pub(super) fn next_deadline(&self) -> Option<Time> {
        [self.rendezvous.next_over(), self.phases.next_wake()].into_iter().flatten().min()
    }

    /// Returns the time at which a frame or an answer is sent next.
    pub(super) fn next_due(&self) -> Option<Time> {
        [self.rendezvous.next_due(), self.rejected.next_wake()].into_iter().flatten().min()
    }

    /// Returns how long an application has waited at phases, and for which applications.
    pub(super) fn absences_at_phases(
        &self,
        now: Time,
        app: AppAddress,
        readiness: Readiness<'_>,
    ) -> Option<(Duration, Vec<Absence>)> {
        self.phases.absences_of(now, app, readiness)
    }

    /// Returns the barriers at which local applications wait, with the missing parties of each.
    pub(super) fn statuses(&self, now: Time, readiness: Readiness<'_>) -> Vec<BarrierStatus> {
        let awaited = self.rendezvous.barriers.iter().filter(|(_, known)| !known.waiting.is_empty());
        let waiters = self.rendezvous.waiters(|node| readiness.directory.peers.current(node));
        let meetings = awaited.map(|barrier| status(now, barrier, &waiters, readiness));
        meetings.chain(self.phases.statuses(now, readiness)).collect()
    }
}

fn read_arrival(request: Request, apps: &Apps) -> Result<Arrived, String> {
    let Request { app, correlation, asked } = request;
    let ArriveAtBarrier { barrier, parties, within_ms, on_loss, kind: _ } = asked;
    let barrier = Name::try_from(barrier).map_err(|why| format!("the barrier's name: {why}"))?;
    let registered = apps.get(app).ok_or("only an application of this node can wait here")?;
    if parties.len() > PARTIES_MAX || parties.iter().map(String::len).sum::<usize>() > PARTIES_BYTES_MAX {
        return Err(format!(
            "a barrier has at most {PARTIES_MAX} parties of {PARTIES_BYTES_MAX} bytes together; use patterns or counts"
        ));
    }
    let mut read: Vec<Requirement> = Vec::new();
    for text in parties {
        let party: Requirement = text.parse().map_err(|fault| format!("{fault}"))?;
        if !read.contains(&party) {
            read.push(party);
        }
    }
    read.sort_by(|a, b| a.as_str().cmp(b.as_str()));
    if let Some(why) = fault_of_parties(&read) {
        return Err(format!("the barrier '{barrier}': {why}"));
    }
    let (name, user) = (registered.name.clone(), registered.user);
    let within = Duration::from_millis(within_ms.into());
    Ok(Arrived { app, name, user, correlation, barrier, parties: read, within, on_loss })
}

fn status(
    now: Time,
    (key, known): (&BarrierKey, &BarrierState),
    waiters: &Waiters<'_>,
    readiness: Readiness<'_>,
) -> BarrierStatus {
    let title = |app: &AppAddress| readiness.directory.apps.title(*app);
    let waiting = known.waiting.iter().map(|(app, wait)| (title(app), now.since(wait.since)));
    BarrierStatus {
        barrier: key.name.to_string(),
        parties: key.parties.clone(),
        kind: BarrierKind::Meeting,
        generation: known.generation,
        waiting: waiting.collect(),
        missing: waiters.missing(now, key, |name| readiness.why_not(name)),
    }
}

/// Truncates the missing parties of an answer to `bytes_max` bytes.
fn within(answer: BarrierAnswer, bytes_max: usize) -> BarrierAnswer {
    let cut = |missing: Vec<(String, String)>| {
        let mut left = bytes_max.saturating_sub(ANSWER);
        let has_room = |(name, why): &(String, String)| {
            left.checked_sub(name.len() + why.len() + MISSING).inspect(|rest| left = *rest).is_some()
        };
        missing.into_iter().take_while(has_room).collect()
    };
    match answer {
        BarrierAnswer::TimedOut { missing } => BarrierAnswer::TimedOut { missing: cut(missing) },
        BarrierAnswer::Lost { missing } => BarrierAnswer::Lost { missing: cut(missing) },
        BarrierAnswer::Opened { .. } | BarrierAnswer::Refused { .. } => answer,
    }
}
