//! A node with applications, for the tests of the bridge: `robot CONFIGURATION`.

use std::process::ExitCode;

use sinew::{
    prelude::*,
    protection::{Cause, Guard, Protection, State},
    serde::{Deserialize, Serialize},
};

payload!("robot.move" => struct Move { degrees: f32 });
payload!("robot.get_angle" => struct GetAngle);
payload!("robot.angle", Stream => struct Angle { joint: String, degrees: f32 });
payload!("robot.question" => struct Question { number: u32 });
payload!("robot.answer" => struct Answer { text: String });

/// Group of the receivers of angles.
const TELEMETRY: &str = "telemetry";
const PERIOD: Duration = Duration::from_millis(20);
const TORQUE_PERIOD: Duration = Duration::from_millis(100);

#[derive(Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "robot.torque";
    const CLASS: Class = Class::Stream;
    const PROTECTION: Option<Protection> = Some(Protection::of_period(TORQUE_PERIOD));
}

/// A joint that moves on command, and sends its angle.
struct Knee {
    degrees: f32,
}

impl Knee {
    fn angle(&self) -> Angle {
        Angle { joint: "knee".to_owned(), degrees: self.degrees }
    }
}

impl Actor for Knee {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(PERIOD, |knee, _, ctx| {
            // Without a member there is no receiver.
            let _ = ctx.send(Tid::group(TELEMETRY), &knee.angle());
        });
    }
}

impl Handler<Delivery<Move>> for Knee {
    type Result = ();

    fn handle(&mut self, command: Delivery<Move>, ctx: &mut Self::Context) {
        if !(0.0..=120.0).contains(&command.degrees) {
            return ctx.reject();
        }
        self.degrees = command.degrees;
        println!("moved to {}", self.degrees);
    }
}

impl Handler<Delivery<GetAngle>> for Knee {
    type Result = ();

    fn handle(&mut self, request: Delivery<GetAngle>, ctx: &mut Self::Context) {
        if let Err(error) = ctx.reply(&request, &self.angle()) {
            println!("no reply: {error}");
        }
    }
}

/// A guarded output that the bridge commands.
struct Motor {
    guard: Option<Guard<f32>>,
}

impl Actor for Motor {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let Some(bridge) = ctx.resolve("zenoh") else {
            return ctx.fail_start("there is no bridge".to_owned());
        };
        let guard = ctx.guard::<Torque, _>(bridge, 0.0, |motor, _cause| *motor = 0.0);
        self.guard = guard.map_err(|error| ctx.fail_start(error.to_string())).ok();
        ctx.every(TORQUE_PERIOD, |motor, _, _| {
            let Some(guard) = &motor.guard else { return };
            if guard.state() == State::Safe(Cause::NotArmed) && guard.arm().is_ok() {
                println!("armed");
            }
        });
        println!("guarded");
    }
}

impl Handler<Delivery<Torque>> for Motor {
    type Result = ();

    fn handle(&mut self, torque: Delivery<Torque>, _: &mut Self::Context) {
        let Some(guard) = &self.guard else { return };
        if guard.apply(|motor| *motor = torque.newton_metres).is_ok() {
            println!("torque {}", torque.newton_metres);
        }
    }
}

/// Asks a Zenoh program as soon as it is there.
struct Patient;

impl Actor for Patient {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        match ctx.message("operator", &Question { number: 7 }).ask::<Answer>(Duration::from_secs(5)) {
            Ok(reply) => drop(ctx.spawn(reply.into_actor(self).map(|reply, _, _| match reply {
                Ok(answer) => println!("answer: {}", answer.text),
                Err(error) => println!("no answer: {error}"),
            }))),
            Err(error) => println!("not asked: {error}"),
        }
    }
}

fn main() -> ExitCode {
    let Some(file) = std::env::args().nth(1) else {
        eprintln!("name the configuration of the node");
        return ExitCode::from(2);
    };
    let knee = AppSpec::new("knee.drive", || Knee { degrees: 10.0 });
    let knee = knee.handles::<Move>().handles::<GetAngle>().sends::<Angle>();
    let motor = AppSpec::new("motor", || Motor { guard: None }).handles::<Torque>().requires(["zenoh"]);
    let patient = AppSpec::new("patient", || Patient).requires(["operator"]).sends::<Question>();
    Node::from_file(file).app(knee).app(motor).app(patient).run()
}
