//! Two nodes in two programs, which find each other: the hip sends its angle to the knee, and reports when the knee is
//! lost.
//!
//! Run it in two terminals: `cargo run -p sinew-examples --example two_nodes -- hip`, and
//! `cargo run -p sinew-examples --example two_nodes -- knee`.
//! Each ends after a minute or `--for SECONDS`. With `--keys DIR` each has the keys that `sinew keys init` made there.

use std::{error::Error, path::Path, process::ExitCode, thread};

use sinew::prelude::*;

payload!("two_nodes.angle", Stream, expires_after = 500 ms => struct Angle { degrees: u64 });

// ANCHOR: hip
struct Hip;

impl Actor for Hip {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        println!("the hip starts: the knee is ready");
        ctx.every(Duration::from_millis(500), |_, tick, ctx| {
            // Not sent while the knee is lost. The next value follows in 500 ms.
            let _ = ctx.send("knee", &Angle { degrees: tick.number % 90 });
        });
    }
}

impl Handler<Delivery<RequirementEvent>> for Hip {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        match &event.payload {
            RequirementEvent::Met { name } => println!("the hip has the {name} again"),
            RequirementEvent::Lost { name } | RequirementEvent::Without { name } => {
                println!("the hip has lost the {name}");
            }
        }
    }
}
// ANCHOR_END: hip

// ANCHOR: knee
struct Knee;

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Angle>> for Knee {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
        println!("the hip ({}) is at {} degrees", angle.source, angle.degrees);
    }
}
// ANCHOR_END: knee

// ANCHOR: main
fn main() -> Result<ExitCode, Box<dyn Error>> {
    let node = match std::env::args().nth(1).as_deref() {
        Some("hip") => {
            let hip = AppSpec::new("hip", || Hip).requires(["knee"]).handles::<RequirementEvent>();
            node("hip", [127, 0, 0, 2]).app(hip)
        }
        Some("knee") => node("knee", [127, 0, 0, 3]).app(AppSpec::new("knee", || Knee).handles::<Angle>()),
        _ => return Err("say which of the two: hip or knee".into()),
    };
    let seconds = option("--for").map_or(Ok(60), |text| text.parse::<u64>())?;
    let node = node.heed_signals().start()?;
    let handle = node.handle();
    thread::spawn(move || {
        thread::sleep(Duration::from_secs(seconds));
        handle.stop();
    });
    Ok(node.run())
}

fn node(name: &str, address: [u8; 4]) -> NodeBuilder {
    Node::builder(name).address(address).configure(|config| {
        config.project = "two_nodes".to_owned(); // nodes of other projects are not seen
        config.lncl.socket = Some(std::env::temp_dir().join(format!("sinew-two_nodes-{name}.sock")));
        config.security.keys = option("--keys").map(|keys| Path::new(&keys).join("nodes").join(name));
    })
}
// ANCHOR_END: main

/// The word behind `name` on the command line.
fn option(name: &str) -> Option<String> {
    std::env::args().skip_while(|word| word != name).nth(1)
}
