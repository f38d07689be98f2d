//! Protected commands move a motor through a guard, which makes the motor safe when the commands stop.
//!
//! Run it: `cargo run -p sinew-examples --example guarded_motor`

use std::process::ExitCode;

use sinew::{
    prelude::*,
    protection::{Cause, Guard, Protection, State},
    serde::{Deserialize, Serialize},
};

const PERIOD: Duration = Duration::from_millis(100);

// ANCHOR: payload
#[derive(Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "guarded_motor.torque";
    const CLASS: Class = Class::Stream;
    // One each 100 ms. After three periods without a good one the motor becomes safe.
    const PROTECTION: Option<Protection> = Some(Protection::of_period(PERIOD));
}
// ANCHOR_END: payload

/// A guard is for one sender, so the sender has an address that stays.
const CONTROL: Tid = Tid::new(NodeAddress::HERE, AppAddress::new(0x1001));

struct Control;

impl Actor for Control {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(PERIOD, |_, tick, ctx| {
            if tick.number <= 40 {
                // An error needs no answer: without commands the motor is safe.
                let _ = ctx.send("drive", &Torque { newton_metres: tick.number as f32 });
            }
        });
    }
}

// ANCHOR: drive
struct Drive {
    /// Holds the motor, which is a number here.
    guard: Option<Guard<f32>>,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        // The closure makes the motor safe. It is called now, and whenever something is wrong.
        let guard = ctx.guard::<Torque, _>(CONTROL, 0.0, |motor, _cause| *motor = 0.0);
        self.guard = guard.map_err(|error| ctx.fail_start(error.to_string())).ok();
        ctx.every(PERIOD, |drive, _, ctx| {
            let Some(guard) = &drive.guard else { return };
            match guard.state() {
                State::Live => {}
                // Refused until eight good commands have come. In a robot a person arms the motor, after a look at it.
                State::Safe(Cause::NotArmed) if guard.arm().is_ok() => println!("the motor is armed"),
                State::Safe(Cause::NotArmed) => {}
                State::Safe(cause) => {
                    println!("the motor is safe: {cause}");
                    ctx.stop();
                }
            }
        });
    }
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    // Called for good commands alone, while the motor is armed.
    fn handle(&mut self, torque: Delivery<Torque>, _: &mut Self::Context) {
        let Some(guard) = &self.guard else { return };
        if guard.apply(|motor| *motor = torque.newton_metres).is_ok() {
            println!("the motor has {} Nm", torque.newton_metres);
        }
    }
}
// ANCHOR_END: drive

fn main() -> ExitCode {
    let control = AppSpec::new("control", || Control).address(CONTROL.app).requires(["drive"]);
    let drive = AppSpec::new("drive", || Drive { guard: None }).handles::<Torque>();
    let drive = drive.restart(Restart::Transient).significant();
    let node = Node::builder("guarded_motor").configure(|config| config.project = "guarded_motor".to_owned());
    node.app(control).app(drive).auto_shutdown(AutoShutdown::AnySignificant).run()
}
