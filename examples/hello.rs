//! Two actors on one node: the hip sends a command each 100 ms, and the knee handles it.
//!
//! Run it: `cargo run -p sinew-examples --example hello`

use std::process::ExitCode;

use sinew::prelude::*;

// ANCHOR: payload
// A type that travels between actors. Without a class it is a command, of class Control.
payload!("hello.bend" => struct Bend { degrees: u64 });
// ANCHOR_END: payload

// ANCHOR: hip
struct Hip;

impl Actor for Hip {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(100), |_, tick, ctx| {
            if let Err(error) = ctx.send("knee", &Bend { degrees: 10 * tick.number }) {
                eprintln!("not sent: {error}");
            }
        });
    }
}
// ANCHOR_END: hip

// ANCHOR: knee
struct Knee;

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Bend>> for Knee {
    type Result = ();

    fn handle(&mut self, command: Delivery<Bend>, ctx: &mut Self::Context) {
        println!("the knee bends to {} degrees", command.degrees);
        if command.degrees >= 50 {
            ctx.stop();
        }
    }
}
// ANCHOR_END: knee

// ANCHOR: main
fn main() -> ExitCode {
    // Transient: not restarted after an orderly end. Significant: with it the node ends, too.
    let knee = AppSpec::new("knee", || Knee).handles::<Bend>().restart(Restart::Transient).significant();
    let hip = AppSpec::new("hip", || Hip).requires(["knee"]);
    Node::builder("hello").app(hip).app(knee).auto_shutdown(AutoShutdown::AnySignificant).run()
}
// ANCHOR_END: main
