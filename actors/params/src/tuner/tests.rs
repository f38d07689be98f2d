use proptest::prelude::*;

use super::*;
use crate::{Cell, Param};

/// Parameters of all three types; two have a slope, and one of these is kept.
struct Gains {
    assistance: Param<f64>,
    torque_max: Param<f64>,
    steps: Param<i64>,
    damped: Param<bool>,
}

const fn number(
    name: &'static str,
    unit: &'static str,
    (default, min, max): (f64, f64, f64),
    slope_per_s: Option<f64>,
) -> Descriptor {
    let domain = Domain::Number { default, min, max, slope_per_s };
    Descriptor { name, description: " A gain.\n Two lines.", unit, domain, keep: slope_per_s.is_some() }
}

const DESCRIPTORS: [Descriptor; 4] = [
    number("assistance", "1", (0.3, 0.0, 1.0), Some(0.5)),
    number("torque_max", "Nm", (20.0, 0.0, 60.0), None),
    Descriptor {
        name: "steps",
        description: "",
        unit: "1",
        domain: Domain::Integer { default: 4, min: 1, max: 16 },
        keep: true,
    },
    Descriptor {
        name: "damped",
        description: "",
        unit: "",
        domain: Domain::Flag { default: false },
        keep: false,
    },
];
const _: () = crate::check(&DESCRIPTORS);

impl Parameters for Gains {
    fn descriptors(&self) -> &'static [Descriptor] {
        &DESCRIPTORS
    }

    fn cell(&self, index: usize) -> Option<&Cell> {
        let cells = [self.assistance.cell(), self.torque_max.cell(), self.steps.cell(), self.damped.cell()];
        cells.get(index).copied()
    }
}

fn gains() -> Arc<Gains> {
    Arc::new(Gains {
        assistance: Param::new(0.3),
        torque_max: Param::new(20.0),
        steps: Param::new(4),
        damped: Param::new(false),
    })
}

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn set(values: &[(&str, Value)]) -> SetParameters {
    let named = |(name, value): &(&str, Value)| NamedValue { name: (*name).to_owned(), value: *value };
    SetParameters::Values(values.iter().map(named).collect())
}

/// Stages a set at `now`, which must be legal.
fn stage(tuner: &mut Tuner<u32>, ticket: u32, values: &[(&str, Value)], now: Duration) {
    tuner.stage(&set(values), (ticket, now + TICK_WITHIN), true).expect("it is legal");
}

/// The period of the timer of the tests.
const PERIOD: Duration = ms(100);

/// Returns the outcomes of a tick at `now`.
fn tick(tuner: &mut Tuner<u32>, number: u64, now: Duration) -> Vec<(u32, ParameterOutcome)> {
    let mut outcomes = Vec::new();
    tuner.tick((number, PERIOD), now, |ticket, outcome| outcomes.push((ticket, outcome)));
    outcomes
}

fn why(outcome: &ParameterOutcome) -> &str {
    match outcome {
        ParameterOutcome::Refused { why } => why,
        ParameterOutcome::Applied { .. } | ParameterOutcome::Held { .. } => panic!("{outcome:?}"),
    }
}

fn refusal(values: &[(&str, Value)]) -> String {
    let mut tuner = Tuner::new(gains(), ms(0));
    let (_, why) = tuner.stage(&set(values), (1, ms(9)), true).expect_err("it is illegal");
    assert!(tick(&mut tuner, 1, ms(1)).is_empty(), "nothing was staged");
    why.to_string()
}

#[test]
fn set_is_applied_at_the_tick_and_not_before() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    let values = [("torque_max", Value::Integer(30)), ("damped", Value::Flag(true))];
    stage(&mut tuner, 7, &values, ms(1));
    assert_eq!((gains.torque_max.get(), gains.damped.get()), (20.0, false));
    let outcomes = tick(&mut tuner, 12, ms(2));
    let SetParameters::Values(applied) =
        set(&[("torque_max", Value::Number(30.0)), ("damped", Value::Flag(true))])
    else {
        panic!("it has values")
    };
    let expected = ParameterOutcome::Applied { tick: 12, at_ns: 2_000_000, values: applied };
    assert_eq!(outcomes, [(7, expected)]);
    assert_eq!((gains.torque_max.get(), gains.damped.get()), (30.0, true));
    assert!(tuner.is_idle() && tick(&mut tuner, 13, ms(3)).is_empty());
}

#[test]
fn refusal_names_parameter_value_and_range() {
    let number = |name, value| refusal(&[(name, Value::Number(value))]);
    assert_eq!(number("assistance", 1.4), "assistance = 1.4 is outside 0.0 to 1.0");
    assert_eq!(number("assistance", f64::NAN), "assistance = NaN is outside 0.0 to 1.0");
    assert_eq!(number("torque_max", -1.0), "torque_max = -1.0 Nm is outside 0.0 to 60.0 Nm");
    assert_eq!(refusal(&[("steps", Value::Integer(17))]), "steps = 17 is outside 1 to 16");
    assert!(number("steps", 2.0).ends_with("steps takes a whole number from 1 to 16"));
    assert!(number("damped", 1.0).ends_with("damped takes true or false"));
    let unknown = number("assistence", 0.5);
    assert!(unknown.contains("no parameter 'assistence'; the nearest name is 'assistance'"), "{unknown}");
    assert!(!number("zzz", 0.5).contains("nearest"));
    assert!(refusal(&[]).contains("no values"));
    assert!(refusal(&[("steps", Value::Integer(2)); 2]).contains("steps stands twice"));
}

#[test]
fn set_with_one_illegal_value_changes_nothing() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    let values = set(&[("torque_max", Value::Number(30.0)), ("steps", Value::Integer(99))]);
    assert!(tuner.stage(&values, (1, ms(9)), true).is_err());
    assert!(tick(&mut tuner, 1, ms(1)).is_empty());
    assert_eq!((gains.torque_max.get(), gains.steps.get()), (20.0, 4));
}

#[test]
fn slope_moves_the_value_by_the_time_between_ticks() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    tick(&mut tuner, 1, ms(100));
    stage(&mut tuner, 1, &[("assistance", Value::Number(0.5))], ms(150));
    tick(&mut tuner, 2, ms(200));
    assert!((gains.assistance.get() - 0.35).abs() < 1e-9 && gains.assistance.target() == 0.5);
    let report = &tuner.list(true).parameters[0];
    assert_eq!((report.target, report.description.as_str()), (Value::Number(0.5), "A gain. Two lines."));
    tick(&mut tuner, 3, ms(400));
    assert!((gains.assistance.get() - 0.45).abs() < 1e-9, "a missed tick counts as time");
    tick(&mut tuner, 4, ms(600));
    assert_eq!(gains.assistance.get(), 0.5);
    assert!(tuner.is_idle());
}

#[test]
fn stalled_loop_makes_no_value_jump() {
    let gains = gains();
    // The loop begins late, and then hangs.
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    stage(&mut tuner, 1, &[("assistance", Value::Number(1.0))], ms(9_500));
    tick(&mut tuner, 1, ms(10_000));
    assert!((gains.assistance.get() - 0.4).abs() < 1e-9, "{}", gains.assistance.get());
    tick(&mut tuner, 2, ms(20_000));
    assert!((gains.assistance.get() - 0.5).abs() < 1e-9, "{}", gains.assistance.get());
}

#[test]
fn value_with_a_slope_does_not_move_without_ticks() {
    // Given: a value on its way, and a loop that was cancelled
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    stage(&mut tuner, 1, &[("assistance", Value::Number(1.0))], ms(0));
    tick(&mut tuner, 1, ms(100));
    let before = gains.assistance.get();
    // When: another parameter is set between two messages
    let steps = set(&[("steps", Value::Integer(5))]);
    tuner.stage(&steps, (2, ms(9_000)), false).expect("it has no slope");
    let mut outcomes = Vec::new();
    tuner.tick((0, Duration::ZERO), ms(8_000), |ticket, outcome| outcomes.push((ticket, outcome)));
    // Then
    assert!(matches!(outcomes[..], [(2, ParameterOutcome::Applied { .. })]), "{outcomes:?}");
    assert_eq!((gains.assistance.get(), gains.steps.get()), (before, 5));
    // And: the set before it cannot be undone without ticks either
    tuner.stage(&SetParameters::Undo, (3, ms(9_000)), false).expect("the last one has no slope");
    tuner.tick((0, Duration::ZERO), ms(8_001), |_, _| {});
    let (_, why) = tuner.stage(&SetParameters::Undo, (4, ms(9_000)), false).expect_err("it has a slope");
    assert_eq!(why, ParameterError::SlopeWithoutTicks("assistance"));
}

#[test]
fn pause_is_no_time_for_a_slope() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    tuner.resume(ms(10_000));
    stage(&mut tuner, 1, &[("assistance", Value::Number(1.0))], ms(10_000));
    tick(&mut tuner, 1, ms(10_100));
    assert!((gains.assistance.get() - 0.35).abs() < 1e-9, "{}", gains.assistance.get());
}

#[test]
fn slope_without_ticks_is_refused() {
    let mut tuner = Tuner::new(gains(), ms(0));
    let set = set(&[("assistance", Value::Number(0.5))]);
    let (_, why) = tuner.stage(&set, (1, ms(9)), false).expect_err("it would jump");
    assert!(why.to_string().contains("no periodic timer"), "{why}");
}

#[test]
fn set_without_tick_is_refused_and_not_applied_later() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    stage(&mut tuner, 1, &[("steps", Value::Integer(5))], ms(0));
    stage(&mut tuner, 2, &[("steps", Value::Integer(6))], ms(1));
    assert_eq!(tuner.next_deadline(), Some(ms(1_000)));
    let mut outcomes = Vec::new();
    tuner.expire(ms(1_000), |ticket, outcome| outcomes.push((ticket, outcome)));
    assert_eq!(outcomes.len(), 1);
    assert!(outcomes[0].0 == 1 && why(&outcomes[0].1).starts_with("no tick came within 1 s"));
    // The other one expires at the tick itself, which is too late for it.
    let late = tick(&mut tuner, 1, ms(1_001));
    assert!(late.len() == 1 && late[0].0 == 2 && why(&late[0].1).starts_with("no tick came"));
    assert_eq!(gains.steps.get(), 4);
}

#[test]
fn undo_goes_back_set_by_set() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    for (at, steps) in [5, 6].into_iter().enumerate() {
        stage(&mut tuner, 0, &[("steps", Value::Integer(steps))], ms(0));
        tick(&mut tuner, at as u64, ms(1));
    }
    assert_eq!(tuner.list(true).undoable, 2);
    for steps in [5, 4] {
        tuner.stage(&SetParameters::Undo, (0, ms(1_000)), true).expect("there is room");
        tick(&mut tuner, 3, ms(2));
        assert_eq!(gains.steps.get(), steps);
    }
    tuner.stage(&SetParameters::Undo, (0, ms(1_000)), true).expect("there is room");
    assert!(why(&tick(&mut tuner, 4, ms(3))[0].1).contains("no set to undo"));
}

#[test]
fn staged_sets_and_former_values_are_bounded() {
    let mut tuner = Tuner::new(gains(), ms(0));
    for ticket in 0..STAGED_MAX as u32 {
        stage(&mut tuner, ticket, &[("steps", Value::Integer(5))], ms(0));
    }
    let one_more = tuner.stage(&set(&[("steps", Value::Integer(5))]), (99, ms(9)), true);
    assert_eq!(one_more, Err((99, ParameterError::Full)));
    assert_eq!(tick(&mut tuner, 1, ms(1)).len(), STAGED_MAX);
    stage(&mut tuner, 0, &[("steps", Value::Integer(6))], ms(1));
    tick(&mut tuner, 2, ms(2));
    assert_eq!(tuner.list(true).undoable as usize, UNDO_MAX);
}

#[test]
fn kept_values_survive_a_new_incarnation() {
    let gains = gains();
    let mut tuner = Tuner::new(gains.clone(), ms(0));
    let values = [
        ("assistance", Value::Number(1.0)),
        ("torque_max", Value::Number(30.0)),
        ("steps", Value::Integer(5)),
    ];
    stage(&mut tuner, 0, &values, ms(0));
    tick(&mut tuner, 1, ms(200));
    drop(tuner);
    let mut next = Tuner::new(gains.clone(), ms(5_000));
    assert_eq!((gains.torque_max.get(), gains.steps.get()), (20.0, 5));
    assert!((gains.assistance.get() - 0.4).abs() < 1e-9, "it does not jump at the restart");
    tick(&mut next, 1, ms(5_200));
    assert!((gains.assistance.get() - 0.5).abs() < 1e-9, "and it moves on to its target");
}

#[test]
fn tick_reports_changes_of_kept_parameters_alone() {
    let mut tuner = Tuner::new(gains(), ms(0));
    for (name, value, is_kept) in
        [("torque_max", Value::Number(30.0), false), ("steps", Value::Integer(5), true)]
    {
        stage(&mut tuner, 0, &[(name, value)], ms(0));
        assert_eq!(tuner.tick((1, PERIOD), ms(1), |_, _| {}), is_kept, "{name}");
        assert!(!tuner.tick((2, PERIOD), ms(2), |_, _| {}));
    }
}

#[test]
fn kept_values_are_restored_and_illegal_ones_skipped() {
    let named = |name: &str, value| NamedValue { name: name.to_owned(), value };
    let former = gains();
    let values = [named("assistance", Value::Number(0.9)), named("steps", Value::Integer(7))];
    assert!(crate::restore(&*former, &values).is_empty());
    assert_eq!(crate::kept_values(&*former), values);
    let next = gains();
    let left_out = crate::restore(
        &*next,
        &[
            named("assistance", Value::Number(2.0)),
            named("torque_max", Value::Number(30.0)),
            named("steps", Value::Integer(7)),
        ],
    );
    assert_eq!(left_out.len(), 2, "one is out of its range, one is not kept: {left_out:?}");
    assert_eq!((next.assistance.get(), next.torque_max.get(), next.steps.get()), (0.3, 20.0, 7));
}

/// One step of a random history.
#[derive(Clone, Debug)]
enum Step {
    Set { assistance: f64, steps: i64 },
    Undo,
    Tick { after_ms: u64 },
    Pause { after_ms: u64 },
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (-0.5..1.5_f64, -3..20_i64).prop_map(|(assistance, steps)| Step::Set { assistance, steps }),
        Just(Step::Undo),
        (0..700_u64).prop_map(|after_ms| Step::Tick { after_ms }),
        (0..5_000_u64).prop_map(|after_ms| Step::Pause { after_ms }),
    ]
}

proptest! {
    /// For any history: values stay in their ranges, change at ticks only, move by at most slope times the time since
    /// the last tick and two periods, and each set has exactly one outcome, which says truly whether it was applied.
    #[test]
    fn history_keeps_ranges_slopes_and_outcomes(history in prop::collection::vec(step(), 1..80)) {
        let gains = gains();
        let mut tuner = Tuner::new(gains.clone(), ms(0));
        let (mut now, mut ticked, mut ticket, mut number) = (ms(0), ms(0), 0_u32, 0);
        let mut open = BTreeSet::new();
        for step in history {
            let before = (gains.assistance.get(), gains.steps.get());
            match step {
                Step::Set { assistance, steps } => {
                    ticket += 1;
                    let values = set(&[
                        ("assistance", Value::Number(assistance)),
                        ("steps", Value::Integer(steps)),
                    ]);
                    let is_legal = (0.0..=1.0).contains(&assistance) && (1..=16).contains(&steps);
                    let has_room = open.len() < STAGED_MAX;
                    let staged = tuner.stage(&values, (ticket, now + TICK_WITHIN), true);
                    prop_assert_eq!(staged.is_ok(), is_legal && has_room);
                    if staged.is_ok() {
                        open.insert(ticket);
                    }
                }
                Step::Undo => {
                    ticket += 1;
                    if tuner.stage(&SetParameters::Undo, (ticket, now + TICK_WITHIN), true).is_ok() {
                        open.insert(ticket);
                    }
                }
                Step::Pause { after_ms } => {
                    now += ms(after_ms);
                    tuner.resume(now);
                    ticked = now;
                }
                Step::Tick { after_ms } => {
                    now += ms(after_ms);
                    number += 1;
                    let outcomes = tick(&mut tuner, number, now);
                    let last = outcomes.iter().rev().find_map(|(_, outcome)| match outcome {
                        ParameterOutcome::Applied { values, tick, .. } => Some((values.clone(), *tick)),
                        ParameterOutcome::Refused { .. } | ParameterOutcome::Held { .. } => None,
                    });
                    for (ticket, _) in &outcomes {
                        prop_assert!(open.remove(ticket), "{ticket} has a second outcome");
                    }
                    prop_assert!(open.is_empty(), "a tick settles all sets");
                    if let Some((values, tick)) = last {
                        prop_assert_eq!(tick, number);
                        prop_assert_eq!(values[0].value, Value::Number(gains.assistance.target()));
                        prop_assert_eq!(values[1].value, Value::Integer(gains.steps.get()));
                    }
                    let step = 0.5 * (now - ticked).min(PERIOD * 2).as_secs_f64();
                    prop_assert!((gains.assistance.get() - before.0).abs() <= step + 1e-12);
                    ticked = now;
                    prop_assert!((0.0..=1.0).contains(&gains.assistance.get()));
                    prop_assert!((1..=16).contains(&gains.steps.get()));
                    continue;
                }
            }
            prop_assert_eq!((gains.assistance.get(), gains.steps.get()), before, "it changed between ticks");
        }
    }
}
