//! Transactions of tuners, alone and in a simulated robot: see `world`.

mod world;

use std::{sync::Arc, time::Duration};

use self::world::{Plan, World};
use super::OwnPart;
use crate::{
    Cell, Descriptor, Domain, LEAD_MAX, NamedValue, PARTICIPANTS_MAX, Param, ParameterError,
    ParameterOutcome, ParameterTransaction, ParameterVote, Parameters, Participant, SetParameters, Stance,
    TICK_WITHIN, TransactionId, TransactionVerdict, Tuner, Value, kept_values,
};

const ID: TransactionId = TransactionId { coordinator: 99, began_ns: 1 };
/// The value before a transaction, which is the default, and after it.
const OLD: i64 = 4;
const NEW: i64 = 9;
const PERIOD: Duration = ms(10);

struct Steps(Param<i64>, &'static [Descriptor]);

static DESCRIPTORS: [Descriptor; 1] = [descriptor(false)];
static KEPT: [Descriptor; 1] = [descriptor(true)];

const fn descriptor(keep: bool) -> Descriptor {
    let domain = Domain::Integer { default: OLD, min: 1, max: 16 };
    Descriptor { name: "steps", description: "", unit: "1", domain, keep }
}

impl Parameters for Steps {
    fn descriptors(&self) -> &'static [Descriptor] {
        self.1
    }

    fn cell(&self, index: usize) -> Option<&Cell> {
        (index == 0).then_some(self.0.cell())
    }
}

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn steps() -> Arc<Steps> {
    Arc::new(Steps(Param::new(OLD), &DESCRIPTORS))
}

fn values(steps: i64) -> Vec<NamedValue> {
    vec![NamedValue { name: "steps".to_owned(), value: Value::Integer(steps) }]
}

/// A transaction of the participants 1 to `count` that was sent at 0, and applies at 100 ms.
fn transaction(count: u64) -> ParameterTransaction {
    ParameterTransaction {
        id: ID,
        participants: (1..=count).map(|tid| Participant { tid, app: format!("app-{tid}") }).collect(),
        values: values(NEW),
        lead_ns: 100_000_000,
        applies_after_ns: 100_000_000,
    }
}

/// Takes part at `now` as participant 1, on the clock of the coordinator.
fn prepare(
    tuner: &mut Tuner<u32>,
    transaction: &ParameterTransaction,
    now: Duration,
) -> Result<ParameterOutcome, ParameterError> {
    tuner.prepare(transaction, OwnPart { tid: 1, has_ticks: true }, Some((ms(0), ms(0))), now)
}

fn stances(tuner: &mut Tuner<u32>) -> Vec<(u64, Stance)> {
    std::iter::from_fn(|| tuner.take_vote()).map(|(to, vote)| (to, vote.stance)).collect()
}

fn vote(tuner: &mut Tuner<u32>, now: Duration, from: u64, stance: Stance) {
    tuner.on_vote(now, from, ParameterVote { transaction: ID, stance });
}

fn tick(tuner: &mut Tuner<u32>, number: u64, now: Duration) {
    tuner.tick((number, PERIOD), now, |_, _| {});
}

fn is_agreed(tuner: &mut Tuner<u32>, now: Duration) -> bool {
    matches!(tuner.outcome_of(ID, now), ParameterOutcome::Held { is_agreed: true, .. })
}

#[test]
fn agreed_values_apply_at_the_stated_time() {
    let steps = steps();
    let mut tuner = Tuner::new(steps.clone(), ms(0));
    let held = prepare(&mut tuner, &transaction(2), ms(1)).expect("it is legal");
    assert_eq!(held, ParameterOutcome::Held { stated_ns: 100_000_000, bound_ns: 0, is_agreed: false });
    // The second one sends its acceptance when it has the transaction.
    assert!(stances(&mut tuner).is_empty());
    vote(&mut tuner, ms(2), 2, Stance::Accepts);
    assert_eq!(stances(&mut tuner), [(2, Stance::Commits)]);
    assert!(is_agreed(&mut tuner, ms(2)));
    tick(&mut tuner, 8, ms(99));
    assert_eq!(steps.0.get(), OLD);
    tick(&mut tuner, 9, ms(103));
    assert_eq!(steps.0.get(), NEW);
    let applied = ParameterOutcome::Applied { tick: 9, at_ns: 103_000_000, values: values(NEW) };
    assert_eq!(tuner.outcome_of(ID, ms(104)), applied);
    assert!(tuner.is_idle() && tuner.take_late().is_none());
    // Its own undo takes it back, and others learn of it later, too.
    vote(&mut tuner, ms(500), 2, Stance::Doubts);
    assert_eq!(stances(&mut tuner), [(2, Stance::Commits)]);
    tuner.stage(&SetParameters::Undo, (1, ms(900)), true).expect("there is one");
    tick(&mut tuner, 50, ms(510));
    assert_eq!(steps.0.get(), OLD);
}

#[test]
fn acceptance_goes_to_earlier_ones_and_is_repeated() {
    let mut tuner = Tuner::new(steps(), ms(0));
    let sent = Some((ms(0), ms(0)));
    tuner.prepare(&transaction(4), OwnPart { tid: 3, has_ticks: true }, sent, ms(1)).expect("it is legal");
    assert_eq!(stances(&mut tuner), [(1, Stance::Accepts), (2, Stance::Accepts)]);
    // The first one of each other is answered.
    vote(&mut tuner, ms(2), 1, Stance::Accepts);
    vote(&mut tuner, ms(3), 1, Stance::Accepts);
    assert_eq!(stances(&mut tuner), [(1, Stance::Accepts)]);
    assert_eq!(tuner.next_deadline(), Some(ms(21)));
    tuner.expire(ms(21), |_, _| {});
    assert_eq!(stances(&mut tuner), [1, 2, 4].map(|to| (to, Stance::Accepts)));
    // In the second half of the lead it asks for the result.
    tuner.expire(ms(50), |_, _| {});
    assert_eq!(stances(&mut tuner), [1, 2, 4].map(|to| (to, Stance::Doubts)));
}

#[test]
fn missing_acceptance_applies_nothing_and_is_named() {
    let steps = steps();
    let mut tuner = Tuner::new(steps.clone(), ms(0));
    prepare(&mut tuner, &transaction(3), ms(1)).expect("it is legal");
    vote(&mut tuner, ms(2), 2, Stance::Accepts);
    // An acceptance in the second half of the lead does not count.
    vote(&mut tuner, ms(60), 3, Stance::Accepts);
    tick(&mut tuner, 9, ms(100));
    let ParameterOutcome::Refused { why } = tuner.outcome_of(ID, ms(100)) else {
        panic!("it is not agreed on")
    };
    assert!(why.contains("no acceptance of app-3 was known"), "{why}");
    assert_eq!(steps.0.get(), OLD);
    // Both others know of no agreement either.
    assert!(!tuner.is_idle());
    vote(&mut tuner, ms(101), 2, Stance::Doubts);
    vote(&mut tuner, ms(102), 3, Stance::Refuses);
    assert!(tuner.is_idle());
}

#[test]
fn late_result_is_applied_at_the_next_tick() {
    let steps = steps();
    let mut tuner = Tuner::new(steps.clone(), ms(0));
    prepare(&mut tuner, &transaction(2), ms(1)).expect("it is legal");
    tick(&mut tuner, 9, ms(100));
    vote(&mut tuner, ms(3_000), 2, Stance::Commits);
    tick(&mut tuner, 30, ms(3_001));
    assert_eq!((steps.0.get(), tuner.take_late(), tuner.take_late()), (NEW, Some(ID), None));
    assert!(matches!(tuner.outcome_of(ID, ms(3_001)), ParameterOutcome::Applied { tick: 30, .. }));
}

#[test]
fn other_set_ends_a_doubt() {
    let steps = steps();
    let mut tuner = Tuner::new(steps.clone(), ms(0));
    prepare(&mut tuner, &transaction(2), ms(1)).expect("it is legal");
    let other = SetParameters::Values(values(5));
    let held = tuner.stage(&other, (1, ms(2) + TICK_WITHIN), true);
    assert_eq!(held, Err((1, ParameterError::Held)));
    tick(&mut tuner, 9, ms(100));
    tuner.stage(&other, (2, ms(101) + TICK_WITHIN), true).expect("nothing is held any more");
    vote(&mut tuner, ms(102), 2, Stance::Commits);
    tick(&mut tuner, 10, ms(110));
    assert_eq!(steps.0.get(), 5);
}

#[test]
fn restart_before_the_tick_begins_with_the_agreed_value() {
    let steps = Arc::new(Steps(Param::new(OLD), &KEPT));
    let mut tuner: Tuner<u32> = Tuner::new(steps.clone(), ms(0));
    // A set that waits when the transaction begins is applied before it.
    tuner.stage(&SetParameters::Values(values(5)), (1, ms(0) + TICK_WITHIN), true).expect("it is legal");
    prepare(&mut tuner, &transaction(2), ms(1)).expect("it is legal");
    assert_eq!(kept_values(&*steps), values(OLD));
    let accepts = ParameterVote { transaction: ID, stance: Stance::Accepts };
    assert!(tuner.on_vote(ms(2), 2, accepts) && !tuner.on_vote(ms(3), 2, accepts));
    assert!(tuner.tick((1, PERIOD), ms(10), |_, _| {}));
    assert_eq!((steps.0.get(), kept_values(&*steps)), (5, values(NEW)));
    drop(tuner);
    let next: Tuner<u32> = Tuner::new(steps.clone(), ms(40));
    assert_eq!((steps.0.get(), steps.0.target(), next.is_idle()), (NEW, NEW, true));
}

#[test]
fn kept_value_stays_if_nothing_is_agreed_on() {
    let steps = Arc::new(Steps(Param::new(OLD), &KEPT));
    let mut tuner: Tuner<u32> = Tuner::new(steps.clone(), ms(0));
    prepare(&mut tuner, &transaction(3), ms(1)).expect("it is legal");
    vote(&mut tuner, ms(2), 2, Stance::Accepts);
    tick(&mut tuner, 9, ms(100));
    // It learns late that all had accepted, but another set comes before its next tick.
    vote(&mut tuner, ms(101), 2, Stance::Commits);
    assert_eq!(kept_values(&*steps), values(OLD));
    tuner.stage(&SetParameters::Values(values(5)), (1, ms(101) + TICK_WITHIN), true).expect("it is legal");
    tick(&mut tuner, 10, ms(110));
    assert_eq!(kept_values(&*steps), values(5));
}

#[test]
fn doubt_ends_by_itself() {
    let mut tuner = Tuner::new(steps(), ms(0));
    prepare(&mut tuner, &transaction(2), ms(1)).expect("it is legal");
    let (mut now, mut wakes) = (ms(1), 0);
    while let Some(next) = tuner.next_deadline() {
        assert!(next > now && wakes < 300, "{next:?} after {wakes} wakes");
        (now, wakes) = (next, wakes + 1);
        tuner.expire(now, |_, _| {});
    }
    assert!(now >= ms(10_100) && tuner.is_idle());
}

#[test]
fn transaction_without_a_chance_is_refused_at_once() {
    let refusal = |change: fn(&mut ParameterTransaction), sent, now| {
        let mut one = transaction(2);
        change(&mut one);
        let mut tuner: Tuner<u32> = Tuner::new(steps(), ms(0));
        let refused =
            tuner.prepare(&one, OwnPart { tid: 1, has_ticks: true }, sent, now).expect_err("it is illegal");
        assert!(tuner.is_idle() && tuner.take_vote().is_none());
        refused
    };
    let sent = Some((ms(0), ms(0)));
    let many = |one: &mut ParameterTransaction| *one = transaction(PARTICIPANTS_MAX as u64 + 1);
    assert_eq!(refusal(many, sent, ms(1)), ParameterError::Participants);
    assert_eq!(refusal(|one| one.participants.clear(), sent, ms(1)), ParameterError::Participants);
    assert_eq!(refusal(|one| one.participants[1].tid = 1, sent, ms(1)), ParameterError::Participants);
    assert_eq!(refusal(|_| {}, None, ms(1)), ParameterError::UnknownClock);
    // An eighth of the lead of 100 ms is 12.5 ms.
    assert_eq!(refusal(|_| {}, Some((ms(0), ms(13))), ms(1)), ParameterError::UnknownClock);
    // It says that it was sent in the future.
    assert_eq!(refusal(|_| {}, Some((ms(2_000), ms(0))), ms(1)), ParameterError::Lead);
    assert_eq!(refusal(|_| {}, sent, ms(50)), ParameterError::TooLate);
    let long = |one: &mut ParameterTransaction| one.lead_ns = LEAD_MAX.as_nanos() as u64 + 1;
    assert_eq!(refusal(long, sent, ms(1)), ParameterError::Lead);
    assert_eq!(refusal(|one| one.applies_after_ns = u64::MAX, sent, ms(1)), ParameterError::Lead);
    let illegal = |one: &mut ParameterTransaction| one.values = values(99);
    assert!(refusal(illegal, sent, ms(1)).to_string().contains("outside 1 to 16"));
}

#[test]
fn outsiders_change_nothing() {
    let steps = steps();
    let mut tuner = Tuner::new(steps.clone(), ms(0));
    prepare(&mut tuner, &transaction(2), ms(1)).expect("it is legal");
    for stance in [Stance::Accepts, Stance::Commits, Stance::Doubts, Stance::Refuses] {
        vote(&mut tuner, ms(2), 7, stance);
        vote(&mut tuner, ms(2), 1, stance);
    }
    assert!(!is_agreed(&mut tuner, ms(3)) && stances(&mut tuner).is_empty());
}

/// Nodes and the coordinator are killed in any phase, also in the middle of their sending: the living ones have all
/// applied the values at their first tick after the stated time, or none of them has, at any time. With the coordinator
/// alive, all have the same values at the end, also those that were restarted.
#[test]
fn kills_leave_all_or_none() {
    let (mut refused, mut repaired) = (0, 0);
    for seed in 0..1_500 {
        let world = World::run(seed, Plan::Kills);
        world.judge_survivors();
        world.judge_end();
        world.judge_answer();
        refused += u32::from(world.verdict() == Some(TransactionVerdict::None));
        repaired += u32::from(world.verdict() == Some(TransactionVerdict::Repaired));
    }
    assert!(refused > 50 && repaired > 50, "{refused} without effect, {repaired} repaired");
}

/// A node is cut off from the others for up to 5 s, in any phase, and the coordinator may be killed: it may miss the
/// stated time, but all have the same values at the end.
#[test]
fn cut_off_node_follows_when_it_is_back() {
    let mut late = 0;
    for seed in 0..1_000 {
        let world = World::run(seed, Plan::Cut);
        world.judge_end();
        late += u32::from(world.was_mixed());
    }
    assert!(late > 5, "only {late} cuts came between the acceptances");
}

/// Without faults each transaction is applied by all, with any clocks and periods.
#[test]
fn transaction_without_faults_is_applied_by_all() {
    for seed in 0..500 {
        let world = World::run(seed, Plan::Calm);
        world.judge_survivors();
        assert_eq!(world.verdict(), Some(TransactionVerdict::All), "seed {seed}");
    }
}
