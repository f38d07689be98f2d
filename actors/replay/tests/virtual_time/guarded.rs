//! Guarded outputs in virtual time: live while commands come, safe at the exact deadline.

use sinew::{
    protection::{Cause, Guard, Protection, State},
    serde::{Deserialize, Serialize},
};

use super::*;

#[derive(Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
struct Command {
    newton_metres: f64,
}

impl Payload for Command {
    const NAME: &'static str = "replay.command";
    const CLASS: Class = Class::Stream;
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(5)));
}

/// Commands the motor each 5 ms, until it falls silent at 200 ms.
struct Central;

impl Actor for Central {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(5), |_, tick, ctx| {
            if tick.number < 40 {
                let _ = ctx.send("motor", &Command { newton_metres: 2.0 });
            }
        });
    }
}

/// The motor: it arms its output as soon as it can, and notes when it is safe.
struct Motor {
    guard: Option<Guard<()>>,
}

impl Actor for Motor {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let (sender, log) = (ctx.sender(), ctx.resolve("log").unwrap());
        let guard = ctx.guard::<Command, _>(tid(HIP), (), move |(), cause| {
            if cause != Cause::NotArmed {
                sender.send(log, &Note { text: format!("safe: {cause:?}") }).unwrap();
            }
        });
        self.guard = Some(guard.unwrap());
        ctx.every(Duration::from_millis(1), |this, tick, ctx| {
            let guard = this.guard.as_ref().unwrap();
            if tick.number < 150 && guard.state() != State::Live && guard.arm().is_ok() {
                note(ctx, "armed");
            }
        });
    }
}

impl Handler<Delivery<Command>> for Motor {
    type Result = ();

    fn handle(&mut self, _: Delivery<Command>, _: &mut Self::Context) {}
}

#[test]
fn guard_is_safe_at_its_exact_virtual_deadline() {
    let run = || {
        replay()
            .app(AppSpec::new("hip", || Central))
            .app(AppSpec::new("motor", || Motor { guard: None }).handles::<Command>())
            .ends_at(ms(400))
            .run([])
            .unwrap()
    };
    let outputs = run();
    let notes = notes(&outputs);
    assert_eq!(notes.len(), 2, "{notes:?}");
    assert_eq!(notes[0].1, "armed");
    let within = Command::PROTECTION.unwrap().within;
    assert_eq!(notes[1], (Duration::from_millis(195) + within, "safe: Silent".to_owned()));
    assert_eq!(outputs, run(), "counters and echoes are the same too");
}
