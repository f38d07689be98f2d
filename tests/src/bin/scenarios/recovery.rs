//! Recovery time of a whole node: from a panic of an application and of each layer, a hang, and a killed
//! process.
//!
//! `cargo run --release -p sinew-tests -- recovery [OPTIONS]`.
//!
//! Prints one JSON line per kind of fault, then a table. Exit code 3: a limit is exceeded.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;
use sinew::{NodeHandle, fault::Fault, message::Sender, prelude::*};
use sinew_testkit::report::Times;
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run, ready_for,
    scripted::{Job, Script, Seen, sender_app, wait},
};
use sinew_tests::{
    load::LAYERS,
    orders::{Me, Who},
};

/// Time budget of the hung application; the printed time is the excess.
const BUDGET: Duration = Duration::from_millis(20);

/// One kind of fault.
struct Row {
    what: String,
    times: Times,
    limit: Duration,
}

/// Measures how fast a node recovers from a panic, a hang and a kill.
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of trials per fault.
    #[arg(long, default_value_t = 200)]
    trials: usize,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    // Suppresses the messages of hundreds of panics.
    std::panic::set_hook(Box::new(|_| {}));
    let Arguments { trials } = arguments;
    // First, because the process of the application is this program, started again, and it does not get past
    // this point.
    let mut rows = vec![killed_process(trials)];
    rows.extend(panics(trials));
    rows.push(hang(trials));
    print(&rows)
}

fn print(rows: &[Row]) -> ExitCode {
    for Row { what, times, limit } in rows {
        let mut json = times.json();
        (json["bench"], json["what"], json["limit_p99_ms"]) =
            (json!("recovery"), json!(what), json!(limit.as_secs_f64() * 1e3));
        println!("{json}");
    }
    println!("{:<44} {:>6} {:>9} {:>9} {:>9} {:>9}", "", "trials", "p50 ms", "p99 ms", "max ms", "limit ms");
    let mut code = ExitCode::SUCCESS;
    for Row { what, times, limit } in rows {
        let broken = times.percentile(0.99) > *limit;
        let word = if broken { "  BROKEN" } else { "" };
        println!("{what:<44} {times} {:>9.0}{word}", limit.as_secs_f64() * 1e3);
        if broken {
            code = ExitCode::from(3);
        }
    }
    code
}

/// A node with unlimited restarts and a backoff that resets after each incarnation.
fn node(name: &str) -> NodeBuilder {
    Loopback::new().node(name).configure(|config| {
        let supervision = &mut config.supervision;
        (supervision.app_restarts_max, supervision.layer_restarts_max) = (1_000_000, 1_000_000);
        (supervision.app_window, supervision.layer_window) =
            (Duration::from_millis(1), Duration::from_millis(1));
    })
}

/// Lives longer than the restart window of [`node`].
fn live() {
    std::thread::sleep(Duration::from_millis(4));
}

/// Makes an actor panic. Returns the time from its panic to its next Ready.
fn panic_to_ready(node: &NodeHandle, name: &str) -> Duration {
    let before = node.lives(name).expect("it is there").readies;
    node.inject(name, Fault::panic()).expect("it is there");
    ready_for(node, name, before + 1);
    let lives = node.lives(name).expect("it is there");
    lives.ready.expect("it is ready").since(lives.struck.expect("it was struck"))
}

/// Panics of an application and of the layers of one node.
fn panics(trials: usize) -> Vec<Row> {
    let ((scripted, _log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
    let node = node("panics").app(scripted).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let (handle, sender) = (node.handle(), key.sender());
    let mut rows = vec![
        row(
            "application panic to Ready",
            5,
            (0..trials).map(|_| {
                live();
                panic_to_ready(&handle, "scripted")
            }),
        ),
        row(
            "application panic to next message handled",
            10,
            (0..trials).map(|_| {
                live();
                panic_to_delivery(&handle, &sender)
            }),
        ),
    ];
    for layer in LAYERS {
        let times = (0..trials.div_ceil(LAYERS.len())).map(|_| {
            live();
            let ndl = handle.lives("NDL").expect("every node has it").readies;
            let time = panic_to_ready(&handle, layer);
            ready_for(&handle, "NDL", ndl + 1);
            time
        });
        rows.push(row(&format!("{layer} panic to Ready"), 10, times));
    }
    rows
}

fn row(what: &str, limit_ms: u64, trials: impl Iterator<Item = Duration>) -> Row {
    let mut times = Times::default();
    trials.for_each(|time| times.note(time));
    Row { what: what.to_owned(), times, limit: Duration::from_millis(limit_ms) }
}

/// A message sent at the moment of the panic is handled by the next incarnation.
fn panic_to_delivery(node: &NodeHandle, sender: &Sender) -> Duration {
    node.inject("scripted", Fault::panic().at_event(1)).expect("it is there");
    sender.send("scripted", &Job { number: 1 }).expect("it has room");
    let sent = sender.message("scripted", &Job { number: 2 }).confirmed(DEADLINE).expect("it has room");
    assert_eq!(wait(sent), Outcome::Delivered);
    Time::now().since(node.lives("scripted").and_then(|lives| lives.struck).expect("it was struck"))
}

/// A handler that does not return is reported: its last will is sent at that moment.
fn hang(trials: usize) -> Row {
    let ((scripted, log), (heir, inherits)) = (Script::new().app("scripted"), Script::new().app("heir"));
    let scripted = scripted.progress_within(BUDGET).last_will("heir", &Job { number: 1 });
    let node = node("hangs").app(heir).app(scripted).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    let times = (1..=trials).map(|trial| {
        let before = handle.lives("scripted").expect("it is there").readies;
        handle.inject("scripted", Fault::hang(BUDGET * 3)).expect("it is there");
        let received = received_at(&inherits, trial);
        ready_for(&handle, "scripted", before + 1);
        let struck = handle.lives("scripted").and_then(|lives| lives.struck).expect("it was struck");
        // Its thread drops it when the handler returns.
        log.wait_for_many(Seen::Dropped(trial as u64), 1);
        received.since(struck).saturating_sub(BUDGET)
    });
    row("hang reported, beyond its budget of 20 ms", 10, times)
}

fn received_at(inherits: &Log<Seen>, trial: usize) -> Time {
    inherits.wait_for_many(Seen::Got(1, 1), trial);
    Time::now()
}

/// Reports its process id.
struct Clerk;

impl Actor for Clerk {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Who>> for Clerk {
    type Result = ();

    fn handle(&mut self, who: Delivery<Who>, context: &mut Self::Context) {
        // The requester may have stopped waiting.
        let _ = context.reply(&who, &Me { pid: std::process::id(), counts: Vec::new() });
    }
}

/// Kills an application in a process of its own.
fn killed_process(trials: usize) -> Row {
    let (sender_app, key) = sender_app("sender");
    let app = AppSpec::new("drive", || Clerk).handles::<Who>().own_process();
    let node = node("processes").app(app).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let (handle, sender) = (node.handle(), key.sender());
    let times = (0..trials).map(|_| {
        // An answer takes less than the restart window: without this wait the delay before the next start
        // would double, up to 16 ms.
        live();
        let asked = sender.message("drive", &Who {}).ask::<Me>(DEADLINE).expect("it is sent");
        let me = wait(asked).expect("it answers");
        let before = handle.lives("drive").expect("it is there").readies;
        let pid = i32::try_from(me.pid).ok().and_then(Pid::from_raw).expect("a process id");
        let killed = Time::now();
        kill_process(pid, Signal::KILL).expect("it is alive");
        ready_for(&handle, "drive", before + 1);
        handle.lives("drive").and_then(|lives| lives.ready).expect("it is ready").since(killed)
    });
    row("SIGKILL of an application's process to Ready", 50, times)
}
