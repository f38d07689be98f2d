//! Applications in virtual time: exact times, identical runs, and the errors of a replay.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod answers;
mod compared;
mod endings;
mod guarded;
mod parameters;
mod timers;
mod wall;

use sinew::{
    prelude::*,
    replay::{Replay, TimedMessage},
};

payload!("replay.angle", Stream, expires_after = 20 ms => #[derive(Debug, Clone, Copy)] pub(crate) struct Angle { pub(crate) degrees: f64 });
payload!("replay.torque", Stream => #[derive(Debug, Clone, Copy)] pub(crate) struct Torque { pub(crate) newton_metres: f64, pub(crate) t_ns: u64 });
payload!("replay.note" => #[derive(Debug, Clone)] pub(crate) struct Note { pub(crate) text: String });

/// The begin of all replays here.
pub(crate) const START: Time = Time::from_nanos(5_000_000_000);

pub(crate) fn ms(ms: u64) -> Time {
    START + Duration::from_millis(ms)
}

pub(crate) fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(0x0a00_0001), AppAddress::new(0x1000 + app))
}

pub(crate) const HIP: u32 = 1;
pub(crate) const KNEE: u32 = 2;
pub(crate) const MOTOR: u32 = 3;
pub(crate) const LOG: u32 = 4;

/// A replay from `START` in which all these names are known.
pub(crate) fn replay() -> Replay {
    let names = [("hip", HIP), ("knee", KNEE), ("motor", MOTOR), ("log", LOG)];
    names.into_iter().fold(Replay::new().starts_at(START), |replay, (name, app)| replay.name(name, tid(app)))
}

/// Sends a note to the log, which is outside.
pub(crate) fn note<A: Actor<Context = AppContext<A>>>(ctx: &mut AppContext<A>, text: impl Into<String>) {
    ctx.send("log", &Note { text: text.into() }).unwrap();
}

/// The times since the start and the texts of all notes.
pub(crate) fn notes(outputs: &[TimedMessage]) -> Vec<(Duration, String)> {
    let notes = outputs.iter().filter(|output| output.kind == Note::KIND);
    notes.map(|output| (output.at.since(START), text(output))).collect()
}

pub(crate) fn text(output: &TimedMessage) -> String {
    rmp_serde::from_slice::<Note>(&output.payload).unwrap().text
}

/// A controller: a torque each millisecond, from the newest angle, and none without one for 20 ms.
pub(crate) struct Controller {
    pub(crate) gain: f64,
    degrees: Option<f64>,
}

impl Controller {
    pub(crate) fn spec(name: &str, gain: f64) -> AppSpec<Self> {
        AppSpec::new(name, move || Self { gain, degrees: None }).handles::<Angle>()
    }
}

impl Actor for Controller {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.watch_input::<Angle>(None, Duration::from_millis(20), |this, _, _| this.degrees = None);
        ctx.every(Duration::from_millis(1), |this, _, ctx| {
            let newton_metres = this.gain * this.degrees.unwrap_or_default();
            let torque = Torque { newton_metres, t_ns: ctx.now().as_nanos() };
            ctx.send("motor", &torque).unwrap();
        });
    }
}

impl Handler<Delivery<Angle>> for Controller {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
        self.degrees = Some(angle.degrees);
    }
}

/// Angles of the hip, one each millisecond, with a chance of a gap, from a seed.
pub(crate) fn angles(seed: u64, count: u64) -> Vec<TimedMessage> {
    let mut state = seed;
    let mut chance = move || {
        // The constants of Knuth's MMIX.
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    };
    let mut at = START;
    let mut next = || {
        let gap = if chance() % 50 == 0 { 30_000_000 } else { 1_000_000 };
        at = at + Duration::from_nanos(gap + chance() % 100_000);
        let degrees = (chance() % 12_000) as f64 / 100.0;
        TimedMessage::of(at, tid(HIP), tid(KNEE), &Angle { degrees })
    };
    (0..count).map(|_| next()).collect()
}
