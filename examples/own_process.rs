//! An actor in a process of its own, which is killed (SIGKILL) and started again behind the same address.
//!
//! Run it: `cargo run -p sinew-examples --example own_process` kills the process once, and ends.
//! `cargo run -p sinew-examples --example own_process -- --for 60` leaves `kill -9` to you, for a minute.

use std::process::{self, Command, ExitCode};

use sinew::prelude::*;

payload!("own_process.hello" => struct Hello { process: u32 });

// ANCHOR: camera
struct Camera;

impl Actor for Camera {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        if let Err(error) = ctx.send("watcher", &Hello { process: process::id() }) {
            eprintln!("not sent: {error}");
        }
    }
}
// ANCHOR_END: camera

// ANCHOR: watcher
/// Lives in the node's process.
struct Watcher {
    /// `None`: it kills the camera's process itself, once.
    watches_for: Option<Duration>,
    lives: u32,
}

impl Actor for Watcher {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        if let Some(time) = self.watches_for {
            ctx.after(time, |_, _, ctx| ctx.stop());
        }
    }
}

impl Handler<Delivery<Hello>> for Watcher {
    type Result = ();

    fn handle(&mut self, camera: Delivery<Hello>, ctx: &mut Self::Context) {
        self.lives += 1;
        println!("life {} of the camera is process {}", self.lives, camera.process);
        // A monitor is for one life of an application, and reports its end as a `Down`.
        if let Err(error) = ctx.monitor(camera.source) {
            eprintln!("not monitored: {error}");
        }
        let (is_first, process) = (self.lives == 1, camera.process.to_string());
        if self.watches_for.is_none() {
            ctx.after(Duration::from_millis(300), move |_, _, ctx| {
                let killed = is_first.then(|| Command::new("kill").args(["-KILL", &process]).status());
                if !matches!(killed, Some(Ok(_))) {
                    ctx.stop();
                }
            });
        }
    }
}

impl Handler<Delivery<Down>> for Watcher {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, _: &mut Self::Context) {
        println!("the camera ended: {}", down.why);
    }
}
// ANCHOR_END: watcher

// ANCHOR: main
fn main() -> ExitCode {
    // The camera's process runs this program from the beginning, with the same arguments, and is the camera in `run`.
    let seconds =
        std::env::args().skip_while(|word| word != "--for").nth(1).and_then(|text| text.parse().ok());
    let watches_for = seconds.map(Duration::from_secs);
    let watcher = AppSpec::new("watcher", move || Watcher { watches_for, lives: 0 });
    let watcher = watcher.handles::<Hello>().handles::<Down>().restart(Restart::Transient).significant();
    let camera = AppSpec::new("camera", || Camera).requires(["watcher"]).own_process();
    let node = Node::builder("own_process").configure(|config| {
        config.project = "own_process".to_owned();
        config.lncl.socket = Some(std::env::temp_dir().join("sinew-own_process.sock")); // for the command `sinew`
    });
    node.app(watcher).app(camera).auto_shutdown(AutoShutdown::AnySignificant).run()
}
// ANCHOR_END: main
