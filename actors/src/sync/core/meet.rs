//! Run-time barriers, with what the core knows of applications and nodes.

use std::time::Duration;

use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, NodeAddress},
    time::Time,
};

use super::{
    Core, Output,
    rendezvous::{Arrived, Key, Known, Rendezvous},
};
use crate::sync::{
    arrivals::{Arrivals, PARTIES_MAX, fault_of_parties},
    list::Name,
    words::{ArriveAtBarrier, BarrierAnswer, BarrierStatus},
};

/// Bytes that the names of one barrier's parties have together, at most.
const PARTIES_BYTES_MAX: usize = 4_096;

impl Core {
    /// An application of this node has arrived at a barrier.
    pub(super) fn arrived(&mut self, now: Time, app: AppAddress, correlation: u64, asked: ArriveAtBarrier) {
        let arrived = self.read_arrival(app, correlation, asked);
        if let Err(why) = arrived.and_then(|arrived| self.rendezvous.arrive(now, arrived)) {
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
        let ArriveAtBarrier { barrier, parties, within_ms, on_loss } = asked;
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
        let (name, within) = (registered.name.clone(), Duration::from_millis(within_ms.into()));
        Ok(Arrived { app, name, correlation, barrier, parties: read, within, on_loss })
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
    pub(super) fn meet(&mut self, now: Time) {
        // It is taken out while it asks about names.
        let mut rendezvous =
            std::mem::replace(&mut self.rendezvous, Rendezvous::new(self.node, self.incarnation));
        rendezvous.retain(|node| self.peers.knows(node));
        rendezvous.evaluate(now, |node| self.peers.current(node), |name| self.why_not(name));
        for (app, correlation, answer) in rendezvous.take_answers() {
            self.outputs.push_back(Output::AnswerBarrier { app, correlation, answer });
        }
        for to in rendezvous.take_due(now, |node| self.peers.linked(node).is_some()) {
            let said = rendezvous.encoded();
            if said.len() > self.list_bytes_max {
                let limit = self.list_bytes_max;
                self.refuse(
                    "barriers",
                    format!("what waits at barriers takes {} of {limit} bytes: other nodes do not hear of it; raise `node.payload_max`", said.len()),
                );
                break;
            }
            self.outputs.push_back(Output::PublishArrivals { to, said });
        }
        self.rendezvous = rendezvous;
    }

    /// The barriers at which somebody of this node waits, and who is missing at each.
    pub(crate) fn barriers(&self, now: Time) -> Vec<BarrierStatus> {
        let awaited = self.rendezvous.known.iter().filter(|(_, known)| !known.waiting.is_empty());
        awaited.map(|(key, known)| self.status(now, key, known)).collect()
    }

    fn status(&self, now: Time, key: &Key, known: &Known) -> BarrierStatus {
        let title =
            |app: AppAddress| self.apps.get(app).map_or_else(|| app.to_string(), |known| known.title(app));
        let waiting = known.waiting.iter().map(|(app, wait)| (title(*app), now.since(wait.since)));
        let current = |node| self.peers.current(node);
        BarrierStatus {
            barrier: key.name.to_string(),
            parties: key.parties.clone(),
            generation: known.generation,
            waiting: waiting.collect(),
            missing: self.rendezvous.missing(key, current, |name| self.why_not(name)),
        }
    }
}
