//! A request with its reply, and commands with their outcomes: each is a future that ends within a given time.
//!
//! Run it: `cargo run -p sinew-examples --example ask`

use std::process::ExitCode;

use sinew::{
    message::{AskError, Sender},
    prelude::*,
};

payload!("ask.get_angle" => struct GetAngle);
payload!("ask.angle" => struct Angle { degrees: f32 });
payload!("ask.move" => struct Move { degrees: f32 });

const SECOND: Duration = Duration::from_secs(1);

struct Knee {
    degrees: f32,
}

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<GetAngle>> for Knee {
    type Result = ();

    fn handle(&mut self, request: Delivery<GetAngle>, ctx: &mut Self::Context) {
        if let Err(error) = ctx.reply(&request, &Angle { degrees: self.degrees }) {
            eprintln!("no reply: {error}");
        }
    }
}

impl Handler<Delivery<Move>> for Knee {
    type Result = ();

    fn handle(&mut self, command: Delivery<Move>, ctx: &mut Self::Context) {
        if !(0.0..=120.0).contains(&command.degrees) {
            return ctx.reject(); // beyond the mechanical stops
        }
        self.degrees = command.degrees;
    }
}

// ANCHOR: hip
struct Hip;

impl Actor for Hip {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let talk = talk_to_the_knee(ctx.sender()).into_actor(self).map(|result, _, ctx| {
            if let Err(error) = result {
                eprintln!("{error}");
            }
            ctx.stop();
        });
        ctx.spawn(talk);
    }
}

async fn talk_to_the_knee(sender: Sender) -> Result<(), AskError> {
    for degrees in [30.0, 300.0] {
        let outcome = sender.message("knee", &Move { degrees }).confirmed(SECOND)?.await;
        println!("move to {degrees} degrees: {outcome:?}");
    }
    let angle = sender.message("knee", &GetAngle).ask::<Angle>(SECOND)?.await?;
    println!("the knee is at {} degrees", angle.degrees);
    Ok(())
}
// ANCHOR_END: hip

fn main() -> ExitCode {
    let knee = AppSpec::new("knee", || Knee { degrees: 0.0 }).handles::<GetAngle>().handles::<Move>();
    let hip = AppSpec::new("hip", || Hip).requires(["knee"]).restart(Restart::Transient).significant();
    let node = Node::builder("ask").configure(|config| config.project = "ask".to_owned());
    node.app(hip).app(knee).auto_shutdown(AutoShutdown::AnySignificant).run()
}
