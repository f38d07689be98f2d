//! The same inputs give the same outputs; another gain gives a first difference with a name.

use sinew::{
    replay::{CheckError, Comparison, compare},
    schema::schema_of,
};

use super::*;

fn run(gain: f64, seed: u64) -> Vec<TimedMessage> {
    replay().app(Controller::spec("knee", gain)).run(angles(seed, 2_000)).unwrap()
}

#[test]
fn only_the_same_seed_gives_the_same_outputs() {
    let (first, again) = (run(0.5, 1), run(0.5, 1));
    assert!(first.len() > 2_000, "gaps are longer than a turn");
    assert_eq!(first, again);
    assert_ne!(first, run(0.5, 2));
    let torques: std::collections::BTreeSet<_> = first.iter().map(|output| output.payload.clone()).collect();
    assert!(torques.len() > 1_000);
}

#[test]
fn changed_gain_is_named_at_its_first_torque() {
    let (recorded, replayed) = (run(0.5, 1), run(0.25, 1));
    let difference = compare(&recorded, &replayed).expect_err("the gain differs");
    // The first turn after the first angle: before it both give none.
    let first = angles(1, 1)[0].at;
    assert_eq!(difference.at, ms(first.since(START).as_millis() as u64 + 1));
    let words = difference.to_string();
    assert!(words.contains("replay.torque to 10.0.0.1/"), "{words}");
    assert!(words.contains("`newton_metres` was "), "{words}");
    assert_eq!(difference.recorded.as_ref().map(|message| message.at), Some(difference.at));
}

#[test]
fn missing_and_added_messages_are_named() {
    let recorded = run(0.5, 1);
    let shorter = &recorded[..recorded.len() - 1];
    let words = compare(&recorded, shorter).expect_err("one is missing").to_string();
    assert!(words.contains(&format!("message {} of", recorded.len())), "{words}");
    assert!(words.ends_with("it was sent in the recording, and is not in the replay"), "{words}");
    let words = compare(shorter, &recorded).expect_err("one is added").to_string();
    assert!(words.ends_with("it was not sent in the recording, and is in the replay"), "{words}");
}

#[test]
fn times_and_fields_are_compared_as_wanted() {
    let recorded = run(0.5, 1);
    let late: Vec<_> = recorded
        .iter()
        .map(|message| TimedMessage { at: message.at + Duration::from_micros(30), ..message.clone() })
        .collect();
    compare(&recorded, &late).expect("times are not compared");
    let within = |micros| Comparison::default().times_within(Duration::from_micros(micros));
    within(30).compare(&recorded, &late).expect("they are 30 us apart");
    let words = within(29).compare(&recorded, &late).expect_err("they are 30 us apart").to_string();
    assert!(words.contains("its time was 5.001000000s and is 5.001030000s"), "{words}");
    let torque = |t_ns| TimedMessage::of(ms(1), tid(KNEE), tid(MOTOR), &Torque { newton_metres: 1.0, t_ns });
    let words = compare(&[torque(1)], &[torque(2)]).expect_err("a field differs").to_string();
    assert!(words.ends_with("`t_ns` was 1 and is 2"), "{words}");
    Comparison::default().ignoring("t_ns").compare(&[torque(1)], &[torque(2)]).expect("it is ignored");
}

#[test]
fn bytes_that_are_no_messagepack_differ_by_place() {
    let raw = |bytes: &'static [u8]| TimedMessage {
        payload: bytes.into(),
        ..TimedMessage::of(ms(1), tid(KNEE), tid(MOTOR), &Note { text: String::new() })
    };
    let words = compare(&[raw(b"\xc1ab")], &[raw(b"\xc1ac")]).expect_err("they differ").to_string();
    assert!(words.ends_with("byte 2 of its payload was 0x62 and is 0x63"), "{words}");
    let words = compare(&[raw(b"\xc1ab")], &[raw(b"\xc1a")]).expect_err("they differ").to_string();
    assert!(words.ends_with("its payload had 3 bytes and has 2"), "{words}");
}

#[test]
fn recording_is_checked_against_its_own_replay() {
    let inputs = angles(3, 300);
    let tested = |gain| replay().app(Controller::spec("knee", gain));
    let mut recorded = tested(0.5).run(inputs.clone()).unwrap();
    recorded.extend(inputs);
    recorded.sort_by_key(|message| message.at);
    tested(0.5).check(recorded.clone()).expect("it is its own recording");
    let error = tested(0.25).check(recorded).expect_err("the gain differs");
    assert!(matches!(error, CheckError::Differs(_)), "{error}");
}

/// Sends a note every 500 ms.
struct Beat;

impl Actor for Beat {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(500), |_, tick, ctx| note(ctx, format!("beat {}", tick.number)));
    }
}

#[test]
fn drift_of_recorded_timers_is_no_difference() {
    let tested = || replay().app(AppSpec::new("hip", || Beat)).app(AppSpec::new("knee", || Beat));
    let exact = tested().ends_at(ms(10_000)).run([]).unwrap();
    assert_eq!(exact.len(), 40);
    let drifted = |by: fn(Time, Duration) -> Time| -> Vec<_> {
        let at = |message: &TimedMessage| {
            let beats = (message.at.since(START).as_millis() / 500) as u32;
            by(message.at, Duration::from_micros(100) * beats)
        };
        exact.iter().map(|message| TimedMessage { at: at(message), ..message.clone() }).collect()
    };
    let early = drifted(|at, drift| Time::from_nanos(at.as_nanos() - drift.as_nanos() as u64));
    tested().check(early.clone()).expect("only the times differ");
    tested().check(drifted(|at, drift| at + drift)).expect("only the times differ");
    // And: an end that is set is exact
    let error = tested().ends_at(early[39].at).check(early.clone()).expect_err("the last beats are later");
    assert!(matches!(error, CheckError::Differs(_)), "{error}");
    // And: a message that never comes is a difference
    let more = TimedMessage { at: early[39].at, ..early[0].clone() };
    let error = tested().check([early, vec![more]].concat()).expect_err("no beat has these bytes");
    assert!(matches!(error, CheckError::Differs(_)), "{error}");
}

payload!("replay.later", Stream => struct Later { degrees: f64, velocity: f64 });

/// Handles a version of the angles that has one more field.
struct Follower;

impl Actor for Follower {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Later>> for Follower {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Later>, ctx: &mut Self::Context) {
        let newton_metres = angle.degrees + angle.velocity;
        ctx.send("motor", &Torque { newton_metres, t_ns: 0 }).unwrap();
    }
}

#[test]
fn recorded_type_explains_a_message_that_is_refused() {
    let older = TimedMessage {
        kind: Later::KIND,
        ..TimedMessage::of(ms(1), tid(HIP), tid(KNEE), &Angle { degrees: 1.0 })
    };
    let torque = TimedMessage::of(ms(1), tid(KNEE), tid(MOTOR), &Torque { newton_metres: 1.0, t_ns: 0 });
    let tested = || replay().app(AppSpec::new("knee", || Follower).handles::<Later>());
    let error = tested().check(vec![older.clone(), torque.clone()]).expect_err("it is not decoded");
    let CheckError::Misfit(misfit, difference) = &error else { panic!("{error}") };
    assert_eq!((misfit.count, misfit.sender, misfit.receiver), (1, tid(HIP), tid(KNEE)));
    assert!(misfit.differences.is_empty() && difference.number == 1, "{error}");
    // And: the recorded structure of the type names the field
    let angle = schema_of::<Angle>().unwrap().unwrap().schema().clone();
    let error =
        tested().recorded_type(Later::KIND, angle).check(vec![older, torque]).expect_err("it is not decoded");
    assert!(error.to_string().contains("velocity"), "{error}");
}

payload!("replay.turn", Stream => #[derive(Clone, Copy)] struct Turn { degrees: f64, newton_metres: f64 });

/// Computes recorded turns again, each from the newest angle.
struct Again {
    gain: f64,
    degrees: f64,
}

impl Actor for Again {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Angle>> for Again {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, ctx: &mut Self::Context) {
        self.degrees = angle.degrees;
        note(ctx, "an angle");
    }
}

impl Handler<Delivery<Turn>> for Again {
    type Result = ();

    fn handle(&mut self, turn: Delivery<Turn>, ctx: &mut Self::Context) {
        assert_eq!((turn.source, turn.degrees), (ctx.tid(), self.degrees));
        ctx.send("motor", &Turn { newton_metres: self.gain * self.degrees, ..turn.payload }).unwrap();
    }
}

#[test]
fn recorded_turns_are_inputs_and_alone_are_compared() {
    let turn = |at, degrees| {
        let turn = Turn { degrees, newton_metres: 0.5 * degrees };
        TimedMessage::of(ms(at), tid(KNEE), tid(MOTOR), &turn)
    };
    let angle = |at, degrees| TimedMessage::of(ms(at), tid(HIP), tid(KNEE), &Angle { degrees });
    // The status is of the shell around the recorded controller. The second angle has the time of its turn.
    let status = TimedMessage::of(ms(1), tid(KNEE), tid(LOG), &Note { text: "ready".to_owned() });
    let recorded = vec![status, turn(2, 0.0), angle(3, 10.0), turn(4, 10.0), turn(6, 20.0), angle(6, 20.0)];
    let tested = |gain| {
        let again = move || Again { gain, degrees: 0.0 };
        let spec = AppSpec::new("knee", again).handles::<Angle>().handles::<Turn>();
        replay().app(spec).turns(Turn::KIND)
    };
    let checked = tested(0.5).check_by(&Comparison::default(), recorded.clone()).expect("it is the same");
    assert_eq!((checked.messages, checked.sources), (3, 1));
    let error = tested(0.25).check(recorded).expect_err("the gain differs");
    let CheckError::Differs(difference) = &error else { panic!("{error}") };
    assert_eq!((difference.number, difference.at), (2, ms(4)), "without an angle the gain has no effect");
}
