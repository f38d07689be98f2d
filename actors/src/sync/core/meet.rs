//! Run-time barriers, with what the core knows of applications and nodes.

use std::time::Duration;

use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, NodeAddress},
    time::Time,
};

use super::{
    Core, Output,
    rendezvous::{Arrived, Key, Known, Rendezvous, WhoWaits},
    respite::Moment,
};
use crate::sync::{
    arrivals::{Arrivals, PARTIES_BYTES_MAX, PARTIES_MAX, fault_of_parties},
    list::Name,
    words::{ArriveAtBarrier, BarrierAnswer, BarrierKind, BarrierStatus},
};

/// Bytes of an answer beside who is missing, at most.
const ANSWER: usize = 32;
/// Bytes beside the two texts of each who is missing, at most.
const MISSING: usize = 8;

impl Core {
    /// An application of this node has arrived at a barrier.
    pub(super) fn arrived(&mut self, now: Time, app: AppAddress, correlation: u64, asked: ArriveAtBarrier) {
        let kind = asked.kind;
        let arrived = self.read_arrival(app, correlation, asked);
        let admitted = arrived.and_then(|arrived| match kind {
            BarrierKind::Meeting => self.rendezvous.arrive(now, arrived),
            BarrierKind::Phase => self.reach(now, arrived),
        });
        if let Err(why) = admitted {
            let answer = BarrierAnswer::Refused { why };
            self.outputs.push_back(Output::AnswerBarrier { app, correlation, answer });
        }
    }

    fn read_arrival(
        &self,
        app: AppAddress,
        correlation: u64,
        asked: ArriveAtBarrier,
    ) -> Result<Arrived, String> {
        let ArriveAtBarrier { barrier, parties, within_ms, on_loss, kind: _ } = asked;
        let barrier = Name::try_from(barrier).map_err(|why| format!("the barrier's name: {why}"))?;
        let registered = self.apps.get(app).ok_or("only an application of this node can wait here")?;
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

    /// Takes what a node says of barriers. spec: SYNC-11
    pub(super) fn arrivals_received(&mut self, now: Time, from: NodeAddress, payload: &[u8]) {
        let said = if from == self.node || !from.is_single() {
            Err("not another node".to_owned())
        } else if payload.len() > self.list_bytes_max {
            Err(format!("{} bytes", payload.len()))
        } else if !self.peers.admit(from) {
            Err("more nodes than `ndl.nodes_max`".to_owned())
        } else {
            Arrivals::parse(payload).map_err(|fault| fault.to_string())
        };
        let linked = self.peers.linked(from);
        let told = said.and_then(|said| self.rendezvous.told(now, from, said, linked).map_err(str::to_owned));
        if let Err(why) = told {
            self.refuse("barriers", format!("from {from}: {why}"));
        }
    }

    /// Opens what can be opened, answers whose wait is over, and tells the other nodes.
    pub(super) fn meet(&mut self, moment: Moment) {
        // It is taken out while it asks about names.
        let empty = Rendezvous::new(self.node, self.incarnation, self.list_bytes_max);
        let mut rendezvous = std::mem::replace(&mut self.rendezvous, empty);
        rendezvous.retain(|node| self.peers.knows(node));
        rendezvous.evaluate(moment, |node| self.peers.current(node), |name| self.why_not(name));
        let mut answers = rendezvous.take_answers();
        answers.extend(self.pass_phases(moment));
        for to in rendezvous.take_due(moment.now, |node| self.peers.linked(node).is_some()) {
            let (said, left_out) = rendezvous.encoded();
            if left_out > 0 {
                let limit = self.list_bytes_max;
                let detail = format!(
                    "{left_out} barriers have no room in the {limit} bytes that this node says of them: others do not hear of these from it; \
                     raise `node.payload_max`"
                );
                self.refuse("barriers", detail);
            }
            self.outputs.push_back(Output::PublishArrivals { to, said });
        }
        // Behind what others hear: they are farther away.
        for (app, correlation, answer) in answers {
            let answer = within(answer, self.list_bytes_max);
            self.outputs.push_back(Output::AnswerBarrier { app, correlation, answer });
        }
        self.rendezvous = rendezvous;
    }

    /// The barriers at which somebody of this node waits, and who is missing at each.
    pub(crate) fn barriers(&self, now: Time) -> Vec<BarrierStatus> {
        let awaited = self.rendezvous.known.iter().filter(|(_, known)| !known.waiting.is_empty());
        let who_waits = self.rendezvous.who_waits(|node| self.peers.current(node));
        let meetings = awaited.map(|(key, known)| self.status(now, (key, known), &who_waits));
        meetings.chain(self.awaited_phases(now)).collect()
    }

    /// An application's name, or its address where it has none.
    pub(super) fn title(&self, app: AppAddress) -> String {
        self.apps.get(app).map_or_else(|| app.to_string(), |known| known.title(app))
    }

    fn status(&self, now: Time, (key, known): (&Key, &Known), who_waits: &WhoWaits<'_>) -> BarrierStatus {
        let waiting = known.waiting.iter().map(|(app, wait)| (self.title(*app), now.since(wait.since)));
        BarrierStatus {
            barrier: key.name.to_string(),
            parties: key.parties.clone(),
            kind: BarrierKind::Meeting,
            generation: known.generation,
            waiting: waiting.collect(),
            missing: who_waits.missing(now, key, |name| self.why_not(name)),
        }
    }
}

/// The answer with as much of who is missing as `bytes_max` has room for.
fn within(answer: BarrierAnswer, bytes_max: usize) -> BarrierAnswer {
    let cut = |missing: Vec<(String, String)>| {
        let mut left = bytes_max.saturating_sub(ANSWER);
        let has_room = |(who, why): &(String, String)| {
            left.checked_sub(who.len() + why.len() + MISSING).inspect(|rest| left = *rest).is_some()
        };
        missing.into_iter().take_while(has_room).collect()
    };
    match answer {
        BarrierAnswer::TimedOut { missing } => BarrierAnswer::TimedOut { missing: cut(missing) },
        BarrierAnswer::Lost { missing } => BarrierAnswer::Lost { missing: cut(missing) },
        BarrierAnswer::Opened { .. } | BarrierAnswer::Refused { .. } => answer,
    }
}
