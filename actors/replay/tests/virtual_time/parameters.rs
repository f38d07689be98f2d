//! Parameters in virtual time: applied at a tick, refused in words, moved with a slope, set together.

use std::sync::Arc;

use sinew::parameters::{AskParameters, NamedValue, ParameterList, ParameterOutcome, SetParameters, Value};

use super::*;

params! {
    /// The gains of the knee.
    struct Gains {
        /// Torque.
        newton_metres: f64 = 3.0, unit "Nm", range 0.0..=60.0;
        /// Assistance, which moves by 100 in a second.
        assistance: f64 = 0.0, unit "1", range 0.0..=1.0, slope 100.0;
    }
}

/// Sends its torque and its assistance to the motor at each tick.
struct Knee {
    gains: Arc<Gains>,
    periods: &'static [Duration],
}

impl Actor for Knee {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        for period in self.periods {
            ctx.every(*period, |this, _, ctx| {
                let newton_metres = this.gains.newton_metres.get() + this.gains.assistance.get();
                ctx.send("motor", &Torque { newton_metres, t_ns: 0 }).unwrap();
            });
        }
    }
}

const TICK: Duration = Duration::from_millis(1);

fn knee(periods: &'static [Duration]) -> AppSpec<Knee> {
    let gains = Gains::new();
    let shared = gains.clone();
    AppSpec::new("knee", move || Knee { gains: shared.clone(), periods }).params(&gains)
}

fn set(values: &[(&str, f64)]) -> SetParameters {
    let named =
        |(name, value): &(&str, f64)| NamedValue { name: (*name).to_owned(), value: Value::Number(*value) };
    SetParameters::Values(values.iter().map(named).collect())
}

/// Sends sets to the knee, each at its time, and notes their outcomes.
struct Tuner {
    sets: Vec<(Duration, SetParameters)>,
}

impl Tuner {
    fn spec(sets: &[(Duration, SetParameters)]) -> AppSpec<Self> {
        let sets = sets.to_vec();
        AppSpec::new("hip", move || Self { sets: sets.clone() })
    }
}

impl Actor for Tuner {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        for (at, set) in self.sets.clone() {
            ctx.after(at, move |this, _, ctx| {
                let within = Duration::from_secs(3);
                let reply = ctx.message("knee", &set).ask::<ParameterOutcome>(within).unwrap();
                ctx.spawn(reply.into_actor(this).map(|reply, _, ctx| match reply.unwrap() {
                    ParameterOutcome::Applied { tick, at_ns, .. } => {
                        let at = Time::from_nanos(at_ns).since(START);
                        note(ctx, format!("tick {tick} after {at:?}"));
                    }
                    ParameterOutcome::Held { stated_ns, .. } => note(ctx, format!("held until {stated_ns}")),
                    ParameterOutcome::Refused { why } => note(ctx, why),
                }));
            });
        }
    }
}

/// The torques, each with its time since the start.
fn torques(outputs: &[TimedMessage]) -> Vec<(Duration, f64)> {
    let torques = outputs.iter().filter(|output| output.kind == Torque::KIND);
    let value = |payload: &[u8]| rmp_serde::from_slice::<Torque>(payload).unwrap().newton_metres;
    torques.map(|output| (output.at.since(START), value(&output.payload))).collect()
}

const fn us(us: u64) -> Duration {
    Duration::from_micros(us)
}

#[test]
fn set_is_applied_at_next_tick_and_names_it() {
    let sets = [(us(3_500), set(&[("newton_metres", 5.0)]))];
    let outputs = replay().app(knee(&[TICK])).app(Tuner::spec(&sets)).ends_at(ms(5)).run([]).unwrap();
    assert_eq!(notes(&outputs), [(us(4_000), "tick 4 after 4ms".to_owned())]);
    let values: Vec<_> = torques(&outputs).into_iter().map(|(_, value)| value).collect();
    assert_eq!(values, [3.0, 3.0, 3.0, 5.0, 5.0]);
}

#[test]
fn value_outside_its_range_is_refused_at_once() {
    let sets = [(us(3_500), set(&[("newton_metres", 90.0)]))];
    let outputs = replay().app(knee(&[TICK])).app(Tuner::spec(&sets)).ends_at(ms(5)).run([]).unwrap();
    let why = "newton_metres = 90.0 Nm is outside 0.0 to 60.0 Nm".to_owned();
    assert_eq!(notes(&outputs), [(us(3_500), why)]);
    assert!(torques(&outputs).iter().all(|(_, value)| *value == 3.0));
}

#[test]
fn slope_moves_the_value_tick_by_tick() {
    let sets = [(us(1_500), set(&[("assistance", 0.25)]))];
    let outputs = replay().app(knee(&[TICK])).app(Tuner::spec(&sets)).ends_at(ms(6)).run([]).unwrap();
    let values: Vec<_> = torques(&outputs).into_iter().map(|(_, value)| value).collect();
    for (value, expected) in values.iter().zip([3.0, 3.1, 3.2, 3.25, 3.25, 3.25]) {
        assert!((value - expected).abs() < 1e-9, "{values:?}");
    }
}

#[test]
fn ticks_follow_the_timer_with_the_shortest_period() {
    const PERIODS: &[Duration] = &[Duration::from_millis(10), TICK];
    let sets = [(us(3_500), set(&[("newton_metres", 5.0)]))];
    let outputs = replay().app(knee(PERIODS)).app(Tuner::spec(&sets)).ends_at(ms(5)).run([]).unwrap();
    assert_eq!(notes(&outputs), [(us(4_000), "tick 4 after 4ms".to_owned())]);
}

#[test]
fn set_without_timely_tick_is_refused_and_never_applied() {
    const SLOW: &[Duration] = &[Duration::from_secs(2)];
    let sets = [(us(3_500), set(&[("newton_metres", 5.0)]))];
    let outputs = replay().app(knee(SLOW)).app(Tuner::spec(&sets)).ends_at(ms(2_100)).run([]).unwrap();
    let [(at, why)] = &notes(&outputs)[..] else { panic!("{:?}", notes(&outputs)) };
    assert_eq!(*at, us(1_003_500));
    assert!(why.starts_with("no tick came within 1 s"), "{why}");
    assert_eq!(torques(&outputs), [(Duration::from_secs(2), 3.0)]);
}

#[test]
fn application_without_timer_applies_set_between_two_messages() {
    let sets = [
        (us(3_500), set(&[("newton_metres", 5.0)])),
        (us(3_600), set(&[("assistance", 0.5)])),
        (us(3_700), SetParameters::Undo),
    ];
    let outputs = replay().app(knee(&[])).app(Tuner::spec(&sets)).ends_at(ms(5)).run([]).unwrap();
    let notes = notes(&outputs);
    assert_eq!(notes[0], (us(3_500), "tick 0 after 3.5ms".to_owned()));
    assert!(notes[1].1.contains("assistance moves with a slope"), "{notes:?}");
    assert_eq!(notes[2], (us(3_700), "tick 0 after 3.7ms".to_owned()));
}

#[test]
fn recorded_set_is_applied_in_a_replay() {
    let sets = [TimedMessage::of(ms(2) + us(500), tid(HIP), tid(KNEE), &set(&[("newton_metres", 7.0)]))];
    let outputs = replay().app(knee(&[TICK])).ends_at(ms(4)).run(sets).unwrap();
    let values: Vec<_> = torques(&outputs).into_iter().map(|(_, value)| value).collect();
    assert_eq!(values, [3.0, 3.0, 7.0, 7.0]);
}

/// Asks the knee for its parameters, and notes the first one.
struct Reader;

impl Actor for Reader {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.after(us(500), |this, _, ctx| {
            let question = AskParameters {};
            let reply = ctx.message("knee", &question).ask::<ParameterList>(TICK * 10).unwrap();
            ctx.spawn(reply.into_actor(this).map(|reply, _, ctx| {
                let list = reply.unwrap();
                let first = &list.parameters[0];
                note(ctx, format!("{} {} {} {:?}", first.name, first.value, first.unit, list.has_ticks));
            }));
        });
    }
}

#[test]
fn parameters_are_listed_without_a_handler_of_the_application() {
    let reader = AppSpec::new("hip", || Reader);
    let outputs = replay().app(knee(&[TICK])).app(reader).ends_at(ms(2)).run([]).unwrap();
    assert_eq!(notes(&outputs), [(us(500), "newton_metres 3.0 Nm true".to_owned())]);
}

/// A loop that notes each new torque.
struct Joint {
    name: &'static str,
    gains: Arc<Gains>,
    last: f64,
}

impl Joint {
    fn spec(name: &'static str, period: Duration) -> AppSpec<JointLoop> {
        let gains = Gains::new();
        let shared = gains.clone();
        let joint = move || JointLoop { joint: Self { name, gains: shared.clone(), last: 3.0 }, period };
        AppSpec::new(name, joint).params(&gains)
    }
}

struct JointLoop {
    joint: Joint,
    period: Duration,
}

impl Actor for JointLoop {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(self.period, |this, _, ctx| {
            let Joint { name, gains, last } = &mut this.joint;
            let newton_metres = gains.newton_metres.get();
            if newton_metres != std::mem::replace(last, newton_metres) {
                note(ctx, format!("{name} has {newton_metres:?}"));
            }
        });
    }
}

/// Sets the torques of both joints as one transaction 3.5 ms after the start, and notes the report.
struct Together {
    torques: [f64; 2],
}

impl Actor for Together {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.after(us(3_500), |this, _, ctx| {
            let set = |app: &str, value: f64| {
                let torque = NamedValue { name: "newton_metres".to_owned(), value: Value::Number(value) };
                (app.to_owned(), vec![torque])
            };
            let sets = vec![set("knee", this.torques[0]), set("motor", this.torques[1])];
            let report = ctx.sender().set_together(sets, TICK * 100, TICK * 1_000);
            ctx.spawn(report.into_actor(this).map(|report, _, ctx| {
                let report = report.unwrap();
                note(ctx, format!("{:?}: {:?}", report.verdict, report.parts));
            }));
        });
    }
}

fn together(torques: [f64; 2]) -> Vec<(Duration, String)> {
    let replay = replay().app(Joint::spec("knee", TICK)).app(Joint::spec("motor", TICK * 2));
    let together = AppSpec::new("hip", move || Together { torques });
    notes(&replay.app(together).ends_at(ms(1_500)).run([]).unwrap())
}

#[test]
fn transaction_applies_at_one_stated_time_in_both_loops() {
    let notes = together([5.0, 6.0]);
    // Stated for 103.5 ms: the first tick after that is at 104 ms in both loops.
    for text in ["knee has 5.0", "motor has 6.0"] {
        assert!(notes.contains(&(us(104_000), text.to_owned())), "{notes:?}");
    }
    let report = notes.iter().find(|(_, text)| text.starts_with("All: "));
    assert!(
        report.is_some_and(|(_, text)| text.contains("tick: 104") && text.contains("tick: 52")),
        "{notes:?}"
    );
    assert_eq!(notes.len(), 3, "{notes:?}");
}

#[test]
fn transaction_with_one_illegal_value_changes_nothing() {
    let notes = together([5.0, 90.0]);
    let [(_, report)] = &notes[..] else { panic!("{notes:?}") };
    assert!(report.starts_with("None: ") && report.contains("90.0 Nm is outside 0.0 to 60.0 Nm"), "{report}");
}
