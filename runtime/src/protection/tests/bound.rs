//! The bound by which contracts are checked: an output is safe `age_max` and `within` after the last command was sent.

use std::collections::VecDeque;

use proptest::prelude::*;

use super::*;

const NANO: Duration = Duration::from_nanos(1);

#[test]
fn oldest_good_command_reaches_the_bound() {
    // Given: a command that is as old as it may be when it arrives
    let protection = Protection { good_min: 1, ..PROTECTION };
    let mut bench = Bench::of(protection);
    let command = bench.next();
    let bound = bench.now + protection.age_max + protection.within;
    bench.now = bench.now + protection.age_max;
    assert_eq!(bench.take(&command), Verdict::Hold);
    bench.receiver.arm(bench.now).expect("one good command is enough");
    // When, then
    bench.receiver.expire(bound - NANO);
    assert_eq!(bench.receiver.state(), State::Live);
    bench.receiver.expire(bound);
    assert_eq!(bench.receiver.state(), State::Safe(Cause::Silent));
}

/// Why a contract cannot tolerate less lateness than `age_max`.
#[test]
fn commands_that_are_all_late_keep_the_output_live() {
    // Given: a link that delays each command by half of the maximum age, with an echo each quarter of it
    let protection = Protection { within: 4 * MS, age_max: 40 * MS, good_min: 1, ..PROTECTION };
    let mut bench = Bench::of(protection);
    let mut on_the_way = VecDeque::new();
    for step in 0..400 {
        // When: one is sent each millisecond
        bench.now = bench.now + MS;
        if step % 10 == 0 {
            let at = bench.receiver.echo(bench.now);
            bench.flows.record_echo(tid(DRIVE), Echo::new(Torque::KIND, at));
        }
        on_the_way.push_back((bench.now + protection.age_max / 2, bench.seal()));
        while let Some((_, command)) = on_the_way.pop_front_if(|(arrives, _)| *arrives <= bench.now) {
            let _ = bench.take(&command);
        }
        bench.receiver.expire(bench.now);
        match step {
            0..100 => {}
            100 => bench.receiver.arm(bench.now).expect("they are good"),
            // Then
            _ => assert_eq!(bench.receiver.state(), State::Live, "step {step}"),
        }
    }
}

proptest! {
    /// For any limits and delays, and an application that always arms its output, no output is live at the bound.
    #[test]
    fn output_is_safe_at_its_last_commands_bound(
        age_max in 8..40u32, within in 3..20u32, echo_takes in 0..20u32,
        delays in prop::collection::vec(0..50u32, 1..60),
    ) {
        let protection =
            Protection { within: within * MS, age_max: age_max * MS, lost_max: 100, bad_max: 63, good_min: 1 };
        let mut bench = Bench::of(protection);
        let (began, mut sent) = (bench.now, bench.now);
        let (mut echoes, mut commands) = (VecDeque::new(), VecDeque::<(Time, Bytes)>::new());
        for step in 0..delays.len() as u32 + 200 {
            bench.now = began + step * MS;
            if step % (age_max / 4) == 0 {
                echoes.push_back((bench.now + echo_takes * MS, bench.receiver.echo(bench.now)));
            }
            while let Some((_, at)) = echoes.pop_front_if(|(arrives, _)| *arrives <= bench.now) {
                bench.flows.record_echo(tid(DRIVE), Echo::new(Torque::KIND, at));
            }
            if let Some(delay) = delays.get(step as usize) {
                // In order, as a link delivers them.
                let former = commands.back().map_or(Time::ZERO, |(arrives, _)| *arrives);
                commands.push_back(((bench.now + *delay * MS).max(former), bench.seal()));
                sent = bench.now;
            }
            while let Some((_, command)) = commands.pop_front_if(|(arrives, _)| *arrives <= bench.now) {
                let _ = bench.take(&command);
            }
            let _ = bench.receiver.arm(bench.now);
            bench.receiver.expire(bench.now);
            let is_over = bench.now >= sent + protection.age_max + protection.within;
            prop_assert!(!is_over || bench.receiver.state() != State::Live, "live {step} ms after the begin");
        }
    }
}
