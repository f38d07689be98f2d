//! What a node costs among 10, 100 and 1,000 that all know each other.

mod alone;

use std::time::{Duration, Instant};

use self::alone::Alone;
use super::{
    CROWD_VARIABLE,
    plan::{Clock, Finding, Happening, Plan, Quality},
    world::World,
};
use crate::seeded::number;

/// How many nodes there are in an ordinary run; `docs/TESTING.md` has the command for more.
const CROWD: usize = 10;
/// Periods that are measured, when all know each other.
const PERIODS: u32 = 4;

fn crowd(nodes: usize) -> Plan {
    let start = |node| (Duration::ZERO, Happening::Start { node, elsewhere: false });
    Plan {
        seed: 1,
        nodes,
        period: Duration::from_millis(500),
        missed_max: 3,
        watched: None,
        finding: Finding::Group,
        connections: false,
        networks: 1,
        shared: None,
        quality: Quality {
            lost_per_mille: 0,
            twice_per_mille: 0,
            delay_max: Duration::from_micros(200),
            late_per_mille: 0,
            late_max: Duration::ZERO,
        },
        lateness: Duration::from_millis(2),
        always_late: Duration::ZERO,
        clocks: vec![Clock { ahead_ns: 0, fast_ppm: 0 }; nodes],
        happenings: (0..nodes).map(start).collect(),
        end: Duration::ZERO,
    }
}

/// All start at the same moment, and know each other; then they are quiet.
#[test]
fn a_crowd_that_starts_at_once_knows_each_other_and_its_cost_is_told() {
    let most = number(CROWD_VARIABLE).map_or(CROWD, |most| usize::try_from(most).expect("a small number"));
    let mut nodes = 10;
    while nodes <= most {
        measure(nodes);
        nodes *= 10;
    }
}

fn measure(nodes: usize) {
    let plan = crowd(nodes);
    let period = plan.period;
    let mut world = World::new(plan, None).measured();
    let begin = world.now;
    let known_after = (1..=100_u32).find(|tenths| {
        world.run_until(begin + period * *tenths / 10);
        // It stands still at the first of them: what is measured then would be nothing.
        assert_eq!(world.violations(), [""; 0], "{nodes} nodes");
        (0..nodes).all(|node| world.view(node).len() == nodes - 1)
    });
    let known_after = known_after.expect("all know each other within ten periods") * period / 10;
    let (sent, began) = (world.seen().datagrams, (world.in_cores, Instant::now()));
    let measured = period * PERIODS;
    world.run_until(world.now + measured);
    assert_eq!(world.violations(), [""; 0], "{nodes} nodes");
    let seconds = measured.as_secs_f64();
    let per_node = |total: f64| total / seconds / f64::from(u32::try_from(nodes).expect("few nodes"));
    let in_cores = (world.in_cores - began.0).as_secs_f64() * 1e3;
    let datagrams = (world.seen().datagrams - sent) as f64;
    println!(
        "{nodes} nodes at {period:?}: all known after {known_after:?} at most; a node sends {:.0} datagrams/s, its core takes {:.3} \
         ms/s of a CPU; simulated in {:?}",
        per_node(datagrams),
        per_node(in_cores),
        began.1.elapsed()
    );
}

/// One core, with nothing else in its processor's caches than on a host of its own.
#[test]
fn a_core_among_many_is_told_by_its_cost() {
    const MEASURED: u32 = 20;
    let period = Duration::from_millis(500);
    let most = number(CROWD_VARIABLE).map_or(CROWD, |most| usize::try_from(most).expect("a small number"));
    let mut nodes = 10;
    while nodes <= most {
        let mut alone = Alone::among(nodes, period);
        (0..MEASURED).for_each(|_| alone.play_a_period());
        let seconds = (period * MEASURED).as_secs_f64();
        println!(
            "{nodes} nodes at {period:?}, all but one of them puppets: its core reads and writes {:.0} datagrams/s and takes {:.3} ms/s \
             of a CPU",
            alone.datagrams as f64 / seconds,
            alone.in_core.as_secs_f64() * 1e3 / seconds
        );
        nodes *= 10;
    }
}
