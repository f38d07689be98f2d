//! The gains of a drive are set while the leg walks: at a tick, gradually, and in the recording.

use exoskeleton_model::message::DriveTick;
use sinew::parameters::{NamedValue, ParameterOutcome, SetParameters, Value};

use super::recorded::{checked, replayed, walk_config, walks};
use super::*;

/// The drive of the knee.
const DRIVE: (usize, u32) = (1, 2);
/// The slope of the assistance in one tick.
const STEP: f64 = 0.5e-3;
/// Upper bound of the change of the knee's torque by one [`STEP`], Nm: 80 kg, and less than 1 Nm/kg. If the assistance
/// changed by 0.2 at once, the torque would change by up to 2 Nm in a tick, the limit of its rate.
const TORQUE_STEP_MAX_NM: f64 = STEP * 80.0;
/// The torque of two steps of the encoder, Nm: 0.05 degrees each, at 100 Nm/rad. The leg moves a little differently,
/// so that an angle may be rounded to the next step.
const ROUNDING_NM: f64 = 0.18;
/// The time before a tick at which its set is sent: it arrives before the tick, and after the one before it.
const BEFORE: Duration = Duration::from_micros(900);

type Outcomes = Arc<Mutex<Vec<ParameterOutcome>>>;

/// Sets the assistance of the knee at these times, and keeps the outcomes.
struct Therapist {
    sets: Vec<(Duration, f64)>,
    outcomes: Outcomes,
}

impl Actor for Therapist {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        for (at, assistance) in self.sets.clone() {
            let value = NamedValue { name: "assistance".to_owned(), value: Value::Number(assistance) };
            let set = SetParameters::Values(vec![value]);
            context.after(at, move |this, _, context| {
                let request = context.message("knee.drive", &set).ask::<ParameterOutcome>(PERIOD * 100);
                let reply = request.expect("the drive is there");
                context.spawn(reply.into_actor(this).map(|reply, this, _| {
                    let outcome = reply.expect("the drive answers");
                    this.outcomes.lock().unwrap_or_else(PoisonError::into_inner).push(outcome);
                }));
            });
        }
    }
}

/// The recorded ticks of the knee's drive.
fn ticks(messages: &[TimedMessage]) -> Vec<DriveTick> {
    let is_tick = |one: &&TimedMessage| one.source == tid(DRIVE.0, DRIVE.1) && one.kind == DriveTick::KIND;
    let decoded = |one: &TimedMessage| rmp_serde::from_slice(&one.payload).expect("a tick");
    messages.iter().filter(is_tick).map(decoded).collect()
}

/// Walks as in [`walks`], with these sets of the knee's assistance.
fn walk_with(sets: Vec<(Duration, f64)>) -> (Vec<TimedMessage>, Vec<ParameterOutcome>) {
    let outcomes = Outcomes::default();
    let kept = outcomes.clone();
    let therapist =
        AppSpec::new("therapist", move || Therapist { sets: sets.clone(), outcomes: kept.clone() });
    let more = |replay: Replay| replay.name("therapist", tid(CENTRAL, 3)).app(therapist);
    let (_, outputs) = walk_of_apps(&walk_config(), &walks().record, more);
    let outcomes = std::mem::take(&mut *outcomes.lock().unwrap_or_else(PoisonError::into_inner));
    (outputs, outcomes)
}

#[test]
fn set_gain_moves_the_torque_gradually_and_replays() {
    // given: the tick with the greatest torque at full assistance, half a second before the end at the latest
    let before = ticks(&walks().outputs);
    let torque = |tick: &DriveTick| tick.torque_nm.unwrap_or_default();
    let assists = before[..before.len() - 500].iter().enumerate().filter(|(_, tick)| tick.assist_gain == 1.0);
    let greatest = assists.max_by(|(_, a), (_, b)| torque(a).abs().total_cmp(&torque(b).abs()));
    let (at, set_at) = greatest.expect("the leg walks with full assistance");
    let sent = Duration::from_nanos(set_at.t_ns) - BEFORE;
    // when: an illegal value 50 ms earlier, then a legal one
    let (outputs, outcomes) = walk_with(vec![(sent - PERIOD * 50, 1.4), (sent, 0.2)]);
    let after = ticks(&outputs);
    // then: the one is refused, the other names its tick
    let [ParameterOutcome::Refused { why }, ParameterOutcome::Applied { tick, at_ns, .. }] = &outcomes[..]
    else {
        panic!("{outcomes:?}");
    };
    assert_eq!(why, "assistance = 1.4 is outside 0.0 to 0.6");
    assert_eq!((*tick, *at_ns), (u64::from(set_at.seq), set_at.t_ns));
    // and: nothing has changed before that tick
    assert_eq!(after.len(), before.len());
    assert_eq!(after[..at], before[..at]);
    // and: from there on the gain moves with its slope to its end
    let assistance: Vec<f64> =
        after[at..].iter().map(|tick| tick.gains.expect("it is not the standard").assistance).collect();
    let is_step = |pair: &[f64]| (0.0..STEP + 1e-9).contains(&(pair[0] - pair[1]));
    assert!((0.4 - assistance[0] - STEP).abs() < 1e-9 && assistance.windows(2).all(is_step));
    assert_eq!(assistance.last(), Some(&0.2));
    // and: so does the torque. It acts on the leg, and feedback may double the difference.
    let apart: Vec<f64> =
        after.iter().zip(&before).map(|(after, before)| (torque(after) - torque(before)).abs()).collect();
    for (apart, ticks) in apart[at..at + 20].iter().zip(1..) {
        let most = 2.0 * TORQUE_STEP_MAX_NM * f64::from(ticks) + ROUNDING_NM;
        assert!(*apart <= most, "{apart} Nm after {ticks} ticks, and not more than {most}");
    }
    let most = apart.iter().copied().fold(0.0, f64::max);
    assert!(most > 0.5, "the gain has an effect: {most} Nm");
    // and: the recording of this walk is computed again, by both ways
    let all: Vec<_> = outputs.iter().collect();
    let replayed = replayed("set", &all, 1.0);
    assert!(replayed.is_same() && replayed.left_out() == 0, "{replayed}");
    let checked = checked("check-set", &all, 1.0).expect("each tick is the same");
    assert_eq!((checked.messages, checked.misfits.len()), (after.len(), 0));
}
