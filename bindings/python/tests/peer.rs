//! A node with an application in Rust, for the tests of the Python package: `peer CONFIGURATION`.

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

fn main() -> ExitCode {
    let Some(file) = std::env::args().nth(1) else {
        eprintln!("name the configuration of the node");
        return ExitCode::from(2);
    };
    let gains: Arc<Gains> = Gains::new();
    let knee = AppSpec::new("knee", || Knee { degrees: 0.0, gait: Gait::Standing, last: Step::None });
    let knee = knee.handles::<Angle>().handles::<Move>().handles::<GetReport>().sends::<Report>();
    Node::from_file(file).app(knee.params(&gains)).run()
}
