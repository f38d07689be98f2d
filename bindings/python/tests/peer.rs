//! A node with applications in Rust, for the tests of the Python package: `peer CONFIGURATION`.

use std::{process::ExitCode, sync::Arc};

use sinew::{
    prelude::*,
    serde::{Deserialize, Serialize},
};

payload!("peer.angle", Stream => struct Angle { degrees: f32 });
payload!("peer.get_report" => struct GetReport {});
payload!("peer.move" => struct Move { degrees: f64 });
payload!("peer.report" => struct Report {
    degrees: f64,
    joints: Vec<Joint>,
    gait: Gait,
    last: Step,
    note: Option<String>,
    class: u16,
});

payload!("peer.get_lateness" => struct GetLateness {});
payload!("peer.lateness" =>
    /// How late each tick of the loop was since the last request, in microseconds; at most `TICKS_MAX`.
    struct Lateness { late_us: Vec<u32> }
);

/// Group of the receivers of the loop's ticks.
const TICKS: &str = "peer.ticks";
/// Maximum number of ticks in one report: 20 s.
const TICKS_MAX: usize = 20_000;

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
struct Joint {
    name: String,
    limits: (f32, f32),
}

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
enum Gait {
    Standing,
    Walking,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
enum Step {
    None,
    Metres(f64),
    Turn { degrees: f64 },
}

params! {
    /// How the knee assists.
    struct Gains {
        /// Assistance, as a share of the model's torque.
        assistance: f64 = 0.3, unit "1", range 0.0..=1.0;
        /// Whether the knee is damped.
        damped: bool = false;
    }
}

struct Knee {
    degrees: f64,
    gait: Gait,
    last: Step,
}

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Angle>> for Knee {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
        self.degrees = angle.degrees.into();
        self.gait = Gait::Walking;
    }
}

impl Handler<Delivery<Move>> for Knee {
    type Result = ();

    fn handle(&mut self, command: Delivery<Move>, ctx: &mut Self::Context) {
        if !(0.0..=120.0).contains(&command.degrees) {
            return ctx.reject();
        }
        self.last = if command.degrees == 0.0 {
            Step::Metres(0.5)
        } else {
            Step::Turn { degrees: command.degrees - self.degrees }
        };
        self.degrees = command.degrees;
    }
}

impl Handler<Delivery<GetReport>> for Knee {
    type Result = ();

    fn handle(&mut self, request: Delivery<GetReport>, ctx: &mut Self::Context) {
        let hinge = Joint { name: "hinge".to_owned(), limits: (0.0, 120.0) };
        let report = Report {
            degrees: self.degrees,
            joints: vec![hinge],
            gait: self.gait,
            last: self.last.clone(),
            note: None,
            class: 2,
        };
        if let Err(error) = ctx.reply(&request, &report) {
            eprintln!("no reply: {error}");
        }
    }
}

/// A loop of 1 kHz, which begins at the first request for its lateness, and sends each tick to a group.
struct Loop {
    late_us: Option<Vec<u32>>,
}

impl Actor for Loop {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<GetLateness>> for Loop {
    type Result = ();

    fn handle(&mut self, request: Delivery<GetLateness>, ctx: &mut Self::Context) {
        if self.late_us.is_none() {
            ctx.every(Duration::from_millis(1), |this, tick, ctx| {
                if let Some(late_us) = this.late_us.as_mut().filter(|late_us| late_us.len() < TICKS_MAX) {
                    late_us.push(u32::try_from(tick.lateness.as_micros()).unwrap_or(u32::MAX));
                }
                // Without a member there is no receiver.
                let _ = ctx.send(Tid::group(TICKS), &Angle { degrees: tick.number as f32 });
            });
        }
        let late_us = self.late_us.replace(Vec::new()).unwrap_or_default();
        if let Err(error) = ctx.reply(&request, &Lateness { late_us }) {
            eprintln!("no reply: {error}");
        }
    }
}

fn main() -> ExitCode {
    let Some(file) = std::env::args().nth(1) else {
        eprintln!("name the configuration of the node");
        return ExitCode::from(2);
    };
    let gains: Arc<Gains> = Gains::new();
    let knee = AppSpec::new("knee", || Knee { degrees: 0.0, gait: Gait::Standing, last: Step::None });
    let knee = knee.handles::<Angle>().handles::<Move>().handles::<GetReport>().sends::<Report>();
    let ticks = AppSpec::new("loop", || Loop { late_us: None });
    let ticks = ticks.handles::<GetLateness>().sends::<Lateness>().sends::<Angle>();
    Node::from_file(file).app(knee.params(&gains)).app(ticks).run()
}
