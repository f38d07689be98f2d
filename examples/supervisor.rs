//! A supervisor with the strategy one-for-all: when the controller panics, the motor is restarted with it.
//! The operator's second command waits in the mailbox meanwhile, and the next life of the controller handles it.
//!
//! Run it: `cargo run -p sinew-examples --example supervisor`

use std::process::ExitCode;

use sinew::{
    message::{SendError, Sender},
    prelude::*,
};

payload!("supervisor.move" => struct Move { degrees: f32 });

struct Motor;

impl Actor for Motor {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        println!("the motor starts");
    }
}

struct Controller;

impl Actor for Controller {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        println!("the controller starts");
    }
}

impl Handler<Delivery<Move>> for Controller {
    type Result = ();

    fn handle(&mut self, command: Delivery<Move>, _: &mut Self::Context) {
        assert!(command.degrees <= 120.0, "no knee bends to {} degrees", command.degrees);
        println!("the controller moves to {} degrees", command.degrees);
    }
}

struct Operator;

impl Actor for Operator {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let moves = move_twice(ctx.sender()).into_actor(self).map(|result, _, ctx| {
            if let Err(error) = result {
                eprintln!("not sent: {error}");
            }
            ctx.stop();
        });
        ctx.spawn(moves);
    }
}

async fn move_twice(sender: Sender) -> Result<(), SendError> {
    for degrees in [300.0, 30.0] {
        let outcome =
            sender.message("controller", &Move { degrees }).confirmed(Duration::from_secs(10))?.await;
        println!("move to {degrees} degrees: {outcome:?}");
    }
    Ok(())
}

// ANCHOR: main
fn main() -> ExitCode {
    // At the fourth failure within 10 s the leg gives up; that is a failure for the supervisor above it.
    let leg = SupervisorSpec::new("leg").strategy(Strategy::OneForAll).intensity(3, Duration::from_secs(10));
    let leg = leg.app(AppSpec::new("motor", || Motor));
    let leg = leg.app(AppSpec::new("controller", || Controller).handles::<Move>());
    let operator = AppSpec::new("operator", || Operator).requires(["controller"]);
    let operator = operator.restart(Restart::Transient).significant();
    let node = Node::builder("supervisor").configure(|config| config.project = "supervisor".to_owned());
    node.supervisor(leg).app(operator).auto_shutdown(AutoShutdown::AnySignificant).run()
}
// ANCHOR_END: main
