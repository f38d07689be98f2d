//! Parameters: the gain of a running loop is set by a message, checked against its range, and applied at a tick.
//!
//! Run it: `cargo run -p sinew-examples --example gains`

use std::{process::ExitCode, sync::Arc};

use sinew::{
    parameters::{NamedValue, ParameterOutcome, SetParameters, Value},
    prelude::*,
};

// ANCHOR: params
params! {
    /// How the knee assists.
    struct Gains {
        /// Assistance, as a share of the model's torque.
        assistance: f64 = 0.3, unit "1", range 0.0..=1.0, slope 2.0, keep;
    }
}
// ANCHOR_END: params

struct Knee {
    gains: Arc<Gains>,
}

impl Actor for Knee {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(5), |knee, _, ctx| {
            // One load. All that one tick reads belongs together.
            if knee.gains.assistance.get() == 0.5 {
                println!("the knee assists with 0.5");
                ctx.stop();
            }
        });
    }
}

/// Sets the assistance of the knee, first to an illegal value.
struct Therapist;

impl Actor for Therapist {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        for value in [1.4, 0.5] {
            let assistance = NamedValue { name: "assistance".to_owned(), value: Value::Number(value) };
            let set = SetParameters::Values(vec![assistance]);
            match ctx.message("knee", &set).ask::<ParameterOutcome>(Duration::from_secs(1)) {
                Ok(reply) => drop(ctx.spawn(reply.into_actor(self).map(|reply, _, _| match reply {
                    Ok(reply) => println!("{}", in_words(&reply)),
                    Err(error) => eprintln!("no outcome: {error}"),
                }))),
                Err(error) => eprintln!("not sent: {error}"),
            }
        }
    }
}

fn in_words(outcome: &ParameterOutcome) -> String {
    match outcome {
        ParameterOutcome::Applied { tick, .. } => format!("applied at tick {tick}"),
        ParameterOutcome::Held { .. } => "held for a transaction".to_owned(),
        ParameterOutcome::Refused { why } => format!("refused: {why}"),
    }
}

fn main() -> ExitCode {
    let gains = Gains::new();
    let shared = gains.clone();
    let knee = AppSpec::new("knee", move || Knee { gains: shared.clone() }).params(&gains);
    let therapist = AppSpec::new("therapist", || Therapist).requires(["knee"]);
    Node::builder("gains")
        .configure(|config| config.project = "gains".to_owned())
        .app(knee.restart(Restart::Transient).significant())
        .app(therapist)
        .auto_shutdown(AutoShutdown::AnySignificant)
        .run()
}
