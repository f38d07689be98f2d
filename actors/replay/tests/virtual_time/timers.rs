//! Timers, input watchdogs and expiry at exact virtual times, and how fast they pass.

use std::time::Instant;

use super::*;

/// Notes every timer that it can have.
struct Timers;

impl Actor for Timers {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        note(ctx, "started");
        ctx.every(Duration::from_millis(4), |_, tick, ctx| {
            assert_eq!((tick.lateness, tick.missed), (Duration::ZERO, 0));
            note(ctx, format!("every {}", tick.number));
        });
        ctx.after(Duration::from_micros(8_500), |_, tick, ctx| {
            assert_eq!(tick.scheduled, ctx.now());
            note(ctx, "after");
        });
        ctx.run_later(Duration::from_millis(3), |_, ctx| note(ctx, "later"));
        ctx.run_interval(Duration::from_millis(5), |_, ctx| note(ctx, "interval"));
        let slept = ctx.clock().sleep(Duration::from_millis(7));
        ctx.spawn(slept.into_actor(self).map(|(), _, ctx| note(ctx, "slept")));
    }
}

#[test]
fn every_timer_fires_at_its_exact_time() {
    let outputs = replay().app(AppSpec::new("hip", || Timers)).ends_at(ms(10)).run([]).unwrap();
    let wanted = [
        (0, "started"),
        (3_000, "later"),
        (4_000, "every 1"),
        (5_000, "interval"),
        (7_000, "slept"),
        (8_000, "every 2"),
        (8_500, "after"),
        (10_000, "interval"),
    ];
    let wanted = wanted.map(|(at, text)| (Duration::from_micros(at), text.to_owned()));
    assert_eq!(notes(&outputs), wanted);
}

/// Notes angles and the timeouts of both input watchdogs.
struct Watches;

impl Actor for Watches {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let limit = Duration::from_millis(10);
        ctx.watch_input::<Angle>(None, limit, |_, timeout, ctx| {
            assert_eq!((timeout.silent, timeout.lateness), (timeout.limit, Duration::ZERO));
            note(ctx, "silent");
        });
        ctx.watch_input_age::<Angle>(None, limit, |_, timeout, ctx| {
            assert_eq!(timeout.lateness, Duration::ZERO);
            note(ctx, "old");
        });
    }
}

impl Handler<Delivery<Angle>> for Watches {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, ctx: &mut Self::Context) {
        note(ctx, format!("angle {} of {:?}", angle.degrees, angle.age.unwrap()));
    }
}

#[test]
fn input_watchdogs_and_expiry_have_exact_times() {
    let angle = |at, degrees, age| {
        TimedMessage::of(ms(at), tid(HIP), tid(KNEE), &Angle { degrees }).sent_at(ms(at - age))
    };
    // The last one is one millisecond older than it may be: it expires.
    let inputs = [angle(4, 1.0, 2), angle(13, 2.0, 0), angle(50, 3.0, 20), angle(80, 4.0, 21)];
    let spec = AppSpec::new("knee", || Watches).handles::<Angle>();
    let outputs = replay().app(spec).run(inputs).unwrap();
    let wanted = [
        (4, "angle 1 of 2ms"),
        // The age counts from the send: 2 ms and the limit.
        (12, "old"),
        (13, "angle 2 of 0ns"),
        (23, "old"),
        (23, "silent"),
        (50, "angle 3 of 20ms"),
        (60, "silent"),
    ];
    let wanted = wanted.map(|(at, text)| (Duration::from_millis(at), text.to_owned()));
    assert_eq!(notes(&outputs), wanted);
}

/// Counts the seconds, and asserts that no millisecond is lost between them.
struct Hour {
    turns: u64,
}

impl Actor for Hour {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(100), |this, tick, _| {
            assert_eq!((tick.number, tick.lateness), (this.turns + 1, Duration::ZERO));
            this.turns = tick.number;
        });
        ctx.every(Duration::from_secs(60), |this, _, ctx| {
            let turns = this.turns;
            note(ctx, format!("{turns}"));
        });
    }
}

#[test]
fn an_hour_passes_in_the_time_of_its_turns() {
    let hour = START + Duration::from_secs(3_600);
    let begin = Instant::now();
    let outputs = replay().app(AppSpec::new("hip", || Hour { turns: 0 })).ends_at(hour).run([]).unwrap();
    let took = begin.elapsed();
    println!("36,060 turns of an hour took {took:?}");
    let notes = notes(&outputs);
    assert_eq!(notes.len(), 60);
    assert_eq!(notes[59].0, Duration::from_secs(3_600));
    // Not a limit of real time: an hour on the wall clock is an hour.
    assert!(took < Duration::from_secs(600));
}

#[test]
fn times_of_two_replays_at_once_are_independent() {
    let run = |seconds: u64| {
        move || {
            let end = START + Duration::from_secs(seconds);
            replay().app(Controller::spec("knee", 1.0)).ends_at(end).run([]).unwrap().len()
        }
    };
    let threads = [1, 3, 2].map(|seconds| std::thread::spawn(run(seconds)));
    assert_eq!(threads.map(|thread| thread.join().unwrap()), [1_000, 3_000, 2_000]);
}
