//! A node that is described by a file, with the settings of its application in the table `[app.knee]`.
//!
//! Run it: `cargo run -p sinew-examples --example settings`, or with a file of your own:
//! `cargo run -p sinew-examples --example settings -- FILE`

use std::process::ExitCode;

use sinew::{prelude::*, serde::Deserialize};

// ANCHOR: settings
#[derive(Clone, Deserialize)]
#[serde(crate = "sinew::serde")]
struct Settings {
    kp: f64,
    limit_nm: f64,
}
// ANCHOR_END: settings

struct Knee {
    settings: Settings,
}

impl Actor for Knee {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let Settings { kp, limit_nm } = self.settings;
        println!("the knee has a gain of {kp} and a limit of {limit_nm} Nm");
        ctx.stop();
    }
}

fn main() -> ExitCode {
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/settings.toml");
    let file = std::env::args().nth(1).unwrap_or_else(|| example.to_owned());
    // ANCHOR: main
    // All that is wrong with the file is reported at once, line by line, before anything starts.
    Node::from_file(file)
        .configured_app("knee", |settings: Settings| {
            let knee = AppSpec::new("knee", move || Knee { settings: settings.clone() });
            knee.restart(Restart::Transient).significant()
        })
        .auto_shutdown(AutoShutdown::AnySignificant)
        .run()
    // ANCHOR_END: main
}
