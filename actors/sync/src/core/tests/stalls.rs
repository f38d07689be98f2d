//! A node that was late itself reads its pending input before it judges others by it.

use sinew_sim::{Seed, number};

use super::{
    barrier_fixture::{answered, awaited},
    *,
};
use crate::core::{
    barriers::rendezvous::GRACE,
    grace_period::{GRACE_PERIOD_MAX, IN_A_ROW_MAX, LATE},
};

/// Seeds in an ordinary run.
const SEEDS: u64 = 300;
/// Variables that set the number of seeds, and the one seed to replay; `docs/book/src/contributing/testing.md` has the
/// command.
const SEEDS_VARIABLE: &str = "SINEW_STALLS_SEEDS";
const SEED_VARIABLE: &str = "SINEW_STALLS_SEED";
/// Time until one pending item is read.
const TURN: Duration = Duration::from_micros(100);

impl Bench {
    /// Wakes the core as the actor does, with this many unread events behind the input.
    fn woken(&mut self, input: Input, unread: usize) -> Vec<Output> {
        self.core.woken(self.now, unread);
        self.handle(input)
    }

    fn stalls(&mut self, time: Duration) -> Vec<Output> {
        self.now = self.now + time;
        self.woken(Input::TimePassed, 0)
    }
}

fn is_about_a_loss(output: &Output) -> bool {
    matches!(output, Output::Notify { .. } | Output::AnswerBarrier { .. } | Output::Overdue(_))
}

/// The input of a node while a neighbour's link breaks and is restored within the tolerated time, also where the timer
/// is late by no more than its tolerance.
fn inputs(chance: &mut fastrand::Rng, from: Time) -> Vec<(Time, Input)> {
    let (mut at, mut version) = (from, 3);
    let mut inputs = Vec::new();
    for _ in 0..20 {
        at = at + Duration::from_millis(chance.u64(1..200));
        inputs.push((at, Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: INCARNATION })));
        at = at + Duration::from_millis(chance.u64(1..25));
        inputs.push((at, Input::LinkChanged(LinkFact::LinkUp { node: KNEE, incarnation: INCARNATION })));
        at = at + Duration::from_millis(chance.u64(0..12));
        version += 1;
        let payload = list(version, &[("knee.drive", true, &[])]).encode(usize::MAX).0;
        inputs.push((at, Input::ListReceived { from: KNEE, payload }));
    }
    inputs
}

/// Stalls the node again and again. Returns the false losses that it reports.
fn stall_repeatedly(seed: u64) -> Vec<Output> {
    let mut chance = fastrand::Rng::with_seed(seed);
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    let mut inputs = VecDeque::from(inputs(&mut chance, bench.now));
    let (mut losses, mut in_a_row, mut calm) = (Vec::new(), 0, bench.now);
    while let Some((next, _)) = inputs.front() {
        let wake = bench.core.next_wake().map_or(*next, |wake| wake.min(*next));
        bench.now = bench.now.max(wake);
        let stalls = in_a_row < IN_A_ROW_MAX && chance.u8(..4) == 0;
        if stalls {
            bench.now = bench.now + Duration::from_millis(chance.u64(1..1_000));
            (in_a_row, calm) = (in_a_row + 1, bench.now + GRACE_PERIOD_MAX);
        } else if bench.now > calm {
            in_a_row = 0;
        }
        // The timer fires first: the worst order that a reactor can choose.
        let unread = |bench: &Bench, inputs: &VecDeque<(Time, Input)>| {
            inputs.iter().take_while(|(at, _)| *at <= bench.now).count()
        };
        let waits = unread(&bench, &inputs);
        losses.extend(bench.woken(Input::TimePassed, waits));
        while let Some((_, input)) = inputs.pop_front_if(|(at, _)| *at <= bench.now) {
            let waits = unread(&bench, &inputs);
            losses.extend(bench.woken(input, waits));
            bench.now = bench.now + TURN;
        }
    }
    losses.retain(is_about_a_loss);
    losses
}

// spec: SYNC-16
#[test]
fn stalled_node_reports_no_false_loss() {
    let (only, seeds) = (number(SEED_VARIABLE), number(SEEDS_VARIABLE).unwrap_or(SEEDS));
    for number in only.map_or(0..seeds, |only| only..only + 1) {
        let test = "core::tests::stalls::stalled_node";
        let seed = Seed { number, variable: SEED_VARIABLE, package: "sinew-sync", target: "--lib", test };
        let losses = seed.run(|| stall_repeatedly(number));
        assert!(losses.is_empty(), "{losses:?}\n{seed}");
    }
}

// spec: SYNC-16
#[test]
fn true_loss_is_reported_after_the_stall() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    let losses: Vec<_> = bench.stalls(UNREACHABLE_MAX * 20).into_iter().filter(is_about_a_loss).collect();
    assert_eq!(losses, []);
    let wake = bench.core.next_wake().unwrap();
    assert!(wake <= bench.now + GRACE_PERIOD_MAX, "{wake:?}");
    assert_eq!(bench.stalls(GRACE_PERIOD_MAX), [lost(0, "knee.drive", Reason::LinkDown)]);
}

// spec: SYNC-16
#[test]
fn always_late_timer_postpones_nothing_for_ever() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    let is_reported = (0..=IN_A_ROW_MAX).any(|_| {
        bench.now = bench.core.next_wake().unwrap() + LATE * 3;
        bench.woken(Input::TimePassed, 0).iter().any(is_about_a_loss)
    });
    assert!(is_reported, "it is put off again and again");
}

// spec: SYNC-16
#[test]
fn pending_input_delays_judgement_but_not_for_ever() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    bench.now = bench.now + UNREACHABLE_MAX;
    assert!(!bench.woken(Input::TimePassed, 1).iter().any(is_about_a_loss), "one event waits");
    let mut flooded = 0;
    while !bench.woken(Input::TimePassed, 1).iter().any(is_about_a_loss) {
        bench.now = bench.now + LATE / 2;
        flooded += 1;
        assert!(flooded <= 20, "a flood delays it forever");
    }
}

// spec: SYNC-16
#[test]
fn deadline_and_loss_tolerance_wait_for_stalled_input() {
    let all_here = |bench: &mut Bench| {
        bench.links(KNEE, INCARNATION);
        bench.list(KNEE, list(1, &[("knee", true, &[])]));
        bench.arrives("calibrated", 7);
    };
    // The event arrives shortly before the deadline, and is read shortly after it.
    let mut bench = Bench::of_the_hip();
    all_here(&mut bench);
    bench.stalls(Duration::from_secs(60) + LATE * 2);
    let opened = bench.receives_arrivals(KNEE, INCARNATION, 1, vec![awaited("calibrated", 0)]);
    assert!(opened.contains(&answered(7, BarrierAnswer::Opened { generation: 1 })), "{opened:?}");
    // The node is back shortly before the tolerance ends.
    let mut bench = Bench::of_the_hip();
    all_here(&mut bench);
    bench.lost(KNEE, LossReason::Hung);
    let losses: Vec<_> = bench.stalls(GRACE * 3).into_iter().filter(is_about_a_loss).collect();
    assert_eq!(losses, []);
}
