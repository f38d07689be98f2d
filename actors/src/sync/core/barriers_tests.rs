//! Run-time barriers, as one node sees them: what it keeps in mind, whom it believes, whose wait is over.

use super::*;
use crate::sync::arrivals::{Arrivals, BARRIERS_MAX, BarrierSaid};

fn name(text: &str) -> Name {
    Name::try_from(text.to_owned()).unwrap()
}

/// A barrier of the hip and the knee at which nobody waits.
fn idle(text: &str, generation: u64) -> BarrierSaid {
    let parties = vec![Requirement::name("hip"), Requirement::name("knee")];
    BarrierSaid { name: name(text), parties, generation, members: Vec::new(), arrivals: Vec::new() }
}

impl Bench {
    /// Application 0 is "hip".
    fn of_the_hip() -> Self {
        let mut bench = Self::new();
        bench.registers(0, "hip", &[]);
        bench.ready(0);
        bench
    }

    /// The knee has said of as many barriers as a node keeps in mind.
    fn that_has_no_room() -> Self {
        let mut bench = Self::of_the_hip();
        bench.links(KNEE, LIFE);
        bench.links(ANKLE, LIFE);
        let barriers = (0..BARRIERS_MAX).map(|number| idle(&format!("round {number}"), 1)).collect();
        bench.is_told(KNEE, LIFE, 1, barriers);
        bench.passes(SPACING);
        bench
    }

    fn is_told(
        &mut self,
        from: NodeAddress,
        incarnation: Incarnation,
        version: u64,
        barriers: Vec<BarrierSaid>,
    ) -> Vec<Output> {
        let payload = Arrivals { incarnation, version, barriers }.encode();
        self.hears(Input::ArrivalsReceived { from, payload })
    }
}

// spec: SYNC-10
#[test]
fn nothing_is_forgotten_for_a_barrier_that_only_others_know() {
    let mut bench = Bench::that_has_no_room();
    let outputs = bench.is_told(ANKLE, LIFE, 1, vec![idle("other", 5)]);
    assert_eq!((outputs.len(), bench.passes(SPACING).len()), (0, 0), "nor is anything said on");
}
