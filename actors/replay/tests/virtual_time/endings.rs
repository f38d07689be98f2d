//! Errors that end a replay before its end: a panic, an end, a block, a loop, inputs in disorder.

use sinew::replay::{ReplayError, RunError};

use super::*;

/// Fails in its second turn.
struct Fails(fn(&mut AppContext<Self>));

impl Actor for Fails {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(1), |this, tick, ctx| {
            note(ctx, "alive");
            if tick.number == 2 {
                (this.0)(ctx);
            }
        });
    }
}

impl Handler<Delivery<Note>> for Fails {
    type Result = ();

    fn handle(&mut self, _: Delivery<Note>, ctx: &mut Self::Context) {
        let own = ctx.tid();
        ctx.send(own, &Note { text: String::new() }).unwrap();
    }
}

fn failure(how: fn(&mut AppContext<Fails>)) -> ReplayError {
    let spec = AppSpec::new("hip", move || Fails(how)).handles::<Note>();
    let replay = replay().app(spec).turn_within(Duration::from_millis(200)).ends_at(ms(10));
    replay.run([]).expect_err("the application fails")
}

#[test]
fn panic_is_reported_with_time_and_earlier_outputs() {
    let error = failure(|_| panic!("the encoder is upside down"));
    assert_eq!((error.at, error.outputs.len()), (ms(2), 2));
    assert!(matches!(&error.fault, RunError::Panicked { app, .. } if app == "hip"), "{error}");
    let words = error.to_string();
    assert!(words.starts_with("at 5.002000000s of virtual time: hip panicked: "), "{words}");
    assert!(words.contains("the encoder is upside down"), "{words}");
}

#[test]
fn end_of_an_application_is_reported() {
    let error = failure(|ctx| ctx.stop());
    assert!(matches!(&error.fault, RunError::Ended { app, .. } if app == "hip"), "{error}");
    let error = failure(|ctx| ctx.fail_start("no encoder"));
    assert!(error.to_string().contains("no encoder"), "{error}");
}

#[test]
fn turn_that_does_not_end_is_reported() {
    let error = failure(|_| {
        loop {
            std::thread::park();
        }
    });
    assert_eq!(error.outputs.len(), 2);
    assert!(matches!(&error.fault, RunError::Blocked { app, .. } if app == "hip"), "{error}");
}

#[test]
fn messages_without_an_end_are_reported() {
    let error = failure(|ctx| {
        let own = ctx.tid();
        ctx.send(own, &Note { text: String::new() }).unwrap();
    });
    assert!(matches!(&error.fault, RunError::NeverIdle { app, .. } if app == "hip"), "{error}");
    assert_eq!(error.at, ms(2));
}

#[test]
fn inputs_in_disorder_are_refused() {
    let angle = |at| TimedMessage::of(ms(at), tid(HIP), tid(KNEE), &Angle { degrees: 1.0 });
    let replay = replay().app(Controller::spec("knee", 1.0));
    let error = replay.run([angle(1), angle(3), angle(2)]).expect_err("the third is too early");
    assert!(matches!(error.fault, RunError::Unordered { number: 3, .. }), "{error}");
}

#[test]
fn two_applications_of_one_name_are_refused() {
    let twice = replay().app(Controller::spec("knee", 1.0)).app(Controller::spec("knee", 2.0));
    let error = twice.run([]).expect_err("they have one address");
    assert!(matches!(&error.fault, RunError::Twice(name) if name == "knee"), "{error}");
}
