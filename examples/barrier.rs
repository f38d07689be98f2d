//! A barrier: three joints calibrate, each in its own time, and then go on together.
//!
//! Run it: `cargo run -p sinew-examples --example barrier`

use std::process::ExitCode;

use sinew::{
    barrier::{Barrier, Meet},
    prelude::*,
};

const JOINTS: [(&str, Duration); 3] = [
    ("hip", Duration::from_millis(100)),
    ("knee", Duration::from_millis(400)),
    ("ankle", Duration::from_millis(700)),
];

struct Joint {
    name: &'static str,
    calibration: Duration,
}

impl Actor for Joint {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.after(self.calibration, |joint, _, ctx| joint.meet_the_others(ctx));
    }
}

impl Joint {
    fn meet_the_others(&self, ctx: &mut AppContext<Self>) {
        println!("the {} is calibrated", self.name);
        // All parties name the same barrier and the same parties. No party waits for longer than 10 s.
        let parties = JOINTS.map(|(name, _)| name);
        let meeting = ctx.meet(&Barrier::new("calibrated", parties).within(Duration::from_secs(10)));
        ctx.spawn(meeting.into_actor(self).map(|met, joint, ctx| {
            match met {
                Ok(_generation) => println!("the {} walks", joint.name),
                Err(error) => eprintln!("the {} does not walk: {error}", joint.name),
            }
            ctx.stop();
        }));
    }
}

fn main() -> ExitCode {
    let node = Node::builder("barrier").configure(|config| config.project = "barrier".to_owned());
    let node = JOINTS.into_iter().fold(node, |node, (name, calibration)| {
        let joint = AppSpec::new(name, move || Joint { name, calibration });
        node.app(joint.restart(Restart::Transient).significant())
    });
    node.auto_shutdown(AutoShutdown::AllSignificant).run()
}
