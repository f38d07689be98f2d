//! A node that was late itself hears what waits for it before it judges anybody by that.

use super::{
    barriers::{answered, awaited},
    *,
};
use crate::{
    seeded::{Seed, number},
    sync::core::{
        rendezvous::GRACE,
        respite::{IN_A_ROW_MAX, LATE, RESPITE_MAX},
    },
};

/// Seeds in an ordinary run.
const SEEDS: u64 = 300;
/// How many instead, and the one that is to be replayed; `docs/TESTING.md` has the command.
const SEEDS_VARIABLE: &str = "SINEW_STALLS_SEEDS";
const SEED_VARIABLE: &str = "SINEW_STALLS_SEED";
/// Time until one thing that waits is read.
const TURN: Duration = Duration::from_micros(100);

impl Bench {
    /// As a shell does it, behind which so many events wait.
    fn woken(&mut self, input: Input, unread: usize) -> Vec<Output> {
        self.core.woken(self.now, unread);
        self.hears(input)
    }

    fn stalls(&mut self, time: Duration) -> Vec<Output> {
        self.now = self.now + time;
        self.woken(Input::TimePassed, 0)
    }
}

fn is_about_a_loss(output: &Output) -> bool {
    matches!(output, Output::Tell { .. } | Output::AnswerBarrier { .. } | Output::Overdue(_))
}

/// What comes to a node whose neighbour's link breaks and is mended within less than the patience with that, also where the timer is late by as
/// much as is nothing to it.
fn news(chance: &mut fastrand::Rng, from: Time) -> Vec<(Time, Input)> {
    let (mut at, mut version) = (from, 3);
    let mut news = Vec::new();
    for _ in 0..20 {
        at = at + Duration::from_millis(chance.u64(1..200));
        news.push((at, Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: LIFE })));
        at = at + Duration::from_millis(chance.u64(1..25));
        news.push((at, Input::LinkChanged(LinkFact::LinkUp { node: KNEE, incarnation: LIFE })));
        at = at + Duration::from_millis(chance.u64(0..12));
        version += 1;
        let payload = list(version, &[("knee.drive", true, &[])]).encode(usize::MAX).0;
        news.push((at, Input::ListReceived { from: KNEE, payload }));
    }
    news
}

/// The node stands still again and again; what it tells of losses that are none.
fn stand_still_again_and_again(seed: u64) -> Vec<Output> {
    let mut chance = fastrand::Rng::with_seed(seed);
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    let mut news = VecDeque::from(news(&mut chance, bench.now));
    let (mut told, mut in_a_row, mut calm) = (Vec::new(), 0, bench.now);
    while let Some((next, _)) = news.front() {
        let wake = bench.core.next_wake().map_or(*next, |wake| wake.min(*next));
        bench.now = bench.now.max(wake);
        let stalls = in_a_row < IN_A_ROW_MAX && chance.u8(..4) == 0;
        if stalls {
            bench.now = bench.now + Duration::from_millis(chance.u64(1..1_000));
            (in_a_row, calm) = (in_a_row + 1, bench.now + RESPITE_MAX);
        } else if bench.now > calm {
            in_a_row = 0;
        }
        // The timer comes first: it is the worst that a reactor can do.
        let unread = |bench: &Bench, news: &VecDeque<(Time, Input)>| {
            news.iter().take_while(|(at, _)| *at <= bench.now).count()
        };
        let waits = unread(&bench, &news);
        told.extend(bench.woken(Input::TimePassed, waits));
        while let Some((_, input)) = news.pop_front_if(|(at, _)| *at <= bench.now) {
            let waits = unread(&bench, &news);
            told.extend(bench.woken(input, waits));
            bench.now = bench.now + TURN;
        }
    }
    told.retain(is_about_a_loss);
    told
}

// spec: SYNC-16
#[test]
fn whoever_stands_still_tells_nobody_of_a_loss_that_was_none() {
    let (only, seeds) = (number(SEED_VARIABLE), number(SEEDS_VARIABLE).unwrap_or(SEEDS));
    for number in only.map_or(0..seeds, |only| only..only + 1) {
        let test = "sync::core::tests::stalls::whoever_stands_still";
        let seed = Seed { number, variable: SEED_VARIABLE, package: "sinew", test };
        let told = seed.run(|| stand_still_again_and_again(number));
        assert!(told.is_empty(), "{told:?}\n{seed}");
    }
}

// spec: SYNC-16
#[test]
fn what_is_lost_is_told_when_a_stall_and_the_time_to_read_are_over() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    let told: Vec<_> = bench.stalls(SILENCE * 20).into_iter().filter(is_about_a_loss).collect();
    assert_eq!(told, []);
    let wake = bench.core.next_wake().unwrap();
    assert!(wake <= bench.now + RESPITE_MAX, "{wake:?}");
    assert_eq!(bench.stalls(RESPITE_MAX), [lost(0, "knee.drive", Reason::LinkDown)]);
}

// spec: SYNC-16
#[test]
fn a_timer_that_is_always_late_puts_nothing_off_for_ever() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    let told = (0..=IN_A_ROW_MAX).any(|_| {
        bench.now = bench.core.next_wake().unwrap() + LATE * 3;
        bench.woken(Input::TimePassed, 0).iter().any(is_about_a_loss)
    });
    assert!(told, "it is put off again and again");
}

// spec: SYNC-16
#[test]
fn nobody_is_judged_before_what_waits_is_read_and_not_for_ever() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    bench.now = bench.now + SILENCE;
    assert!(!bench.woken(Input::TimePassed, 1).iter().any(is_about_a_loss), "one event waits");
    let mut flooded = 0;
    while !bench.woken(Input::TimePassed, 1).iter().any(is_about_a_loss) {
        bench.now = bench.now + LATE / 2;
        flooded += 1;
        assert!(flooded <= 20, "a flood puts it off for ever");
    }
}

// spec: SYNC-16
#[test]
fn the_deadline_of_a_barrier_and_the_patience_with_a_lost_party_wait_for_what_came_in_a_stall() {
    let all_here = |bench: &mut Bench| {
        bench.links(KNEE, LIFE);
        bench.list(KNEE, list(1, &[("knee", true, &[])]));
        bench.arrives("calibrated", 7);
    };
    // It comes a moment before the deadline, and is read a moment after.
    let mut bench = Bench::of_the_hip();
    all_here(&mut bench);
    bench.stalls(Duration::from_secs(60) + LATE * 2);
    let opened = bench.is_told(KNEE, LIFE, 1, vec![awaited("calibrated", 0)]);
    assert!(opened.contains(&answered(7, BarrierAnswer::Opened { generation: 1 })), "{opened:?}");
    // It is back a moment before the patience ends.
    let mut bench = Bench::of_the_hip();
    all_here(&mut bench);
    bench.lost(KNEE, LossReason::Hung);
    let told: Vec<_> = bench.stalls(GRACE * 3).into_iter().filter(is_about_a_loss).collect();
    assert_eq!(told, []);
}
