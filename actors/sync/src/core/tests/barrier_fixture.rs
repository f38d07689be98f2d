//! The hip at barriers: its requests, and the reports of other nodes.

use sinew_model::barrier::{BarrierKind, OnPartyLoss};
use sinew_runtime::app::Requirement;

use super::*;
use crate::arrivals::{Arrival, Arrivals, BARRIERS_MAX, PublishedBarrier};

fn name(text: &str) -> Name {
    Name::try_from(text.to_owned()).unwrap()
}

/// The state of a barrier of the hip and the knee at which no application waits.
pub(super) fn idle(text: &str, generation: u64) -> PublishedBarrier {
    let parties = vec![Requirement::name("hip"), Requirement::name("knee")];
    let (members, earlier, arrivals) = (Vec::new(), Vec::new(), Vec::new());
    PublishedBarrier { name: name(text), parties, generation, members, earlier, arrivals }
}

/// The state of a barrier at which the knee waits behind this generation.
pub(super) fn awaited(text: &str, generation: u64) -> PublishedBarrier {
    let knee = Arrival { party: 1, app: app(0), name: Some(name("knee")), after: generation };
    PublishedBarrier { arrivals: vec![knee], ..idle(text, generation) }
}

pub(super) fn answered(correlation: u64, answer: BarrierAnswer) -> Output {
    Output::AnswerBarrier { app: app(0), correlation, answer }
}

impl Bench {
    /// Creates a bench in which application 0 is "hip".
    pub(super) fn of_the_hip() -> Self {
        let mut bench = Self::new();
        bench.registers(0, "hip", &[]);
        bench.ready(0);
        bench
    }

    /// Creates a bench in which the knee has reported as many barriers as a node keeps.
    pub(super) fn that_has_no_room() -> Self {
        let mut bench = Self::of_the_hip();
        bench.links(KNEE, INCARNATION);
        bench.links(ANKLE, INCARNATION);
        let barriers = (0..BARRIERS_MAX).map(|number| idle(&format!("round {number}"), 1)).collect();
        bench.receives_arrivals(KNEE, INCARNATION, 1, barriers);
        bench.passes(SPACING);
        bench
    }

    pub(super) fn receives_arrivals(
        &mut self,
        from: NodeAddress,
        incarnation: Incarnation,
        version: u64,
        barriers: Vec<PublishedBarrier>,
    ) -> Vec<Output> {
        let payload = Arrivals { incarnation, version, barriers }.encode();
        self.handle(Input::ArrivalsReceived { from, payload })
    }

    /// The hip arrives, and does not wait for the return of a lost party.
    pub(super) fn arrives(&mut self, barrier: &str, correlation: u64) -> Vec<Output> {
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: barrier.to_owned(),
            parties: ["hip", "knee"].map(str::to_owned).to_vec(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Fail,
        };
        self.handle(Input::Arrived { app: app(0), correlation, asked })
    }

    pub(super) fn leaves(&mut self, correlation: Option<u64>) {
        let barrier = "calibrated".to_owned();
        self.handle(Input::Left { app: app(0), barrier, correlation });
    }

    pub(super) fn barriers(&self) -> usize {
        self.core.barriers(self.now).len()
    }
}
