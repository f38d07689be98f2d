//! The cost of one node among 10, 100 and 1,000 that all know each other.

mod alone;

use std::time::{Duration, Instant};

use sinew_sim::{Clock, History, Quality, number};

use self::alone::Alone;
use super::{
    CROWD_VARIABLE,
    plan::{Finding, Plan, Step},
    world::{BEGIN, World},
};

/// The number of nodes in an ordinary run; `docs/book/src/contributing/testing.md` has the command for more.
const CROWD: usize = 10;
/// Periods that are measured, after all know each other.
const PERIODS: u32 = 4;

fn crowd(nodes: usize) -> Plan {
    let start = |node| (Duration::ZERO, Step::Start { node, elsewhere: false });
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
        quality: Quality::GOOD,
        lateness: Duration::from_millis(2),
        always_late: Duration::ZERO,
        clocks: vec![Clock::new(BEGIN, 0, 0); nodes],
        steps: (0..nodes).map(start).collect(),
        end: Duration::ZERO,
    }
}

/// All nodes start at the same moment and find each other; then they are idle.
#[test]
fn crowd_that_starts_at_once_is_complete_and_measured() {
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
    let mut world = World::new(plan, None, &History::off()).measured();
    let begin = world.now();
    let known_after = (1..=100_u32).find(|tenths| {
        world.run_until(begin + period * *tenths / 10);
        // The run stops at the first violation, so no cost would be measured.
        assert_eq!(world.violations(), [""; 0], "{nodes} nodes");
        (0..nodes).all(|node| world.view(node).len() == nodes - 1)
    });
    let known_after = known_after.expect("all know each other within ten periods") * period / 10;
    let (sent, began) = (world.coverage().of("datagrams"), (world.in_cores, Instant::now()));
    let measured = period * PERIODS;
    world.run_until(world.now() + measured);
    assert_eq!(world.violations(), [""; 0], "{nodes} nodes");
    let seconds = measured.as_secs_f64();
    let per_node = |total: f64| total / seconds / f64::from(u32::try_from(nodes).expect("few nodes"));
    let in_cores = (world.in_cores - began.0).as_secs_f64() * 1e3;
    let datagrams = (world.coverage().of("datagrams") - sent) as f64;
    println!(
        "{nodes} nodes at {period:?}: all known after {known_after:?} at most; a node sends {:.0} datagrams/s, its core takes {:.3} \
         ms/s of a CPU; simulated in {:?}",
        per_node(datagrams),
        per_node(in_cores),
        began.1.elapsed()
    );
}

/// Counts the datagrams of one core, and measures its time. As on a host of its own, it has the processor's caches for
/// itself.
// spec: NDL-2.1, NDL-3
#[test]
fn core_among_many_handles_five_datagrams_per_peer() {
    const MEASURED: u32 = 20;
    /// The core's query and its answer, the peer's query and its answer, and the peer's query to the group.
    const OF_A_PEER: u64 = 5;
    let period = Duration::from_millis(500);
    let most = number(CROWD_VARIABLE).map_or(CROWD, |most| usize::try_from(most).expect("a small number"));
    let mut nodes = 10;
    while nodes <= most {
        let mut alone = Alone::among(nodes, period);
        (0..MEASURED).for_each(|_| alone.play_a_period());
        // One more is the core's own query to the group.
        let in_a_period = OF_A_PEER * (nodes as u64 - 1) + 1;
        assert_eq!(alone.datagrams, u64::from(MEASURED) * in_a_period, "{nodes} nodes");
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
