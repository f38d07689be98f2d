//! Restarts applications and layers thousands of times and says whether memory, descriptors or threads grew.
//!
//! `cargo run --release -p sinew-tests --bin growth [--restarts N]`
//!
//! Exit code 1: something grew beyond its bound.

use std::{
    process::ExitCode,
    time::{Duration, Instant},
};

use clap::Parser;
use serde_json::json;
use sinew::{NodeHandle, fault::Fault, prelude::*};
use sinew_tests::{
    Ground, all_run,
    load::LAYERS,
    puppet::{Job, desk, outcome_of_job},
    ready_for, sees, until,
};

/// Growth of resident memory over all restarts that the allocator and the kernel may have for themselves.
const GROWTH_MAX_KIB: u64 = 4 * 1024;
/// What has not changed for so long has come to rest.
const AT_REST: Duration = Duration::from_secs(1);
/// Applications that fail at once.
const APPS: usize = 8;

/// Takes jobs and keeps nothing of them.
struct Clerk;

impl Actor for Clerk {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // A timer of the kernel's, a group, a watchdog, a future: all that an application can leave behind.
        context.every(Duration::from_millis(50), |_, _, _| {});
        context.watch_input::<Job>(None, Duration::from_secs(1), |_, _, _| {});
        context.join("clerks");
        context.spawn(async { actix::clock::sleep(Duration::from_secs(3_600)).await }.into_actor(self));
    }
}

impl Handler<Delivery<Job>> for Clerk {
    type Result = ();

    fn handle(&mut self, _: Delivery<Job>, _: &mut Self::Context) {}
}

/// What this process has of the host.
#[derive(Clone, Copy, Debug)]
struct Held {
    resident_kib: u64,
    descriptors: usize,
    threads: u64,
}

impl Held {
    fn now() -> Self {
        let status = std::fs::read_to_string("/proc/self/status").expect("Linux has it");
        let field = |name: &str| {
            let line = status.lines().find(|line| line.starts_with(name)).expect("Linux has this line");
            line.split_whitespace().nth(1).and_then(|word| word.parse().ok()).expect("a number")
        };
        let descriptors = std::fs::read_dir("/proc/self/fd").expect("Linux has it").count();
        Self { resident_kib: field("VmRSS:"), descriptors, threads: field("Threads:") }
    }
}

/// Two linked nodes whose actors fail.
struct Field {
    nodes: [Node; 2],
    names: Vec<String>,
    sender: sinew::message::Sender,
}

impl Field {
    fn new() -> Self {
        let ground = Ground::new();
        let node = |name: &str| {
            ground.node(name).configure(|config| {
                let supervision = &mut config.supervision;
                (supervision.app_restarts_max, supervision.layer_restarts_max) = (1_000_000, 1_000_000);
                (supervision.app_window, supervision.layer_window) =
                    (Duration::from_millis(1), Duration::from_millis(1));
            })
        };
        let names: Vec<_> = (0..APPS).map(|number| format!("clerk {number}")).collect();
        let (desk, key) = desk("desk");
        let mut here = node("home").app(desk);
        for (number, name) in names.iter().enumerate() {
            let app = AppSpec::new(name.as_str(), || Clerk).handles::<Job>();
            here = here.app(app.place(Place::thread(format!("thread {}", number % 4))));
        }
        let nodes = [here.start().expect("a node"), node("there").start().expect("a node")];
        all_run(&[&nodes[0], &nodes[1]]);
        sees(&nodes[0].handle(), nodes[1].address());
        Self { nodes, names, sender: key.sender() }
    }

    /// All applications of the node fail once.
    fn fail_apps(&self) -> u64 {
        let node = self.nodes[0].handle();
        let before: Vec<_> = self.names.iter().map(|name| readies(&node, name)).collect();
        for name in &self.names {
            node.inject(name, Fault::panic()).expect("it is there");
        }
        for (name, before) in self.names.iter().zip(before) {
            ready_for(&node, name, before + 1);
        }
        APPS as u64
    }

    /// A layer of one node fails; those behind it are restarted with it.
    fn fail_layer(&self, number: u64) -> u64 {
        let layer = usize::try_from(number % 4).expect("below four");
        let node = self.nodes[usize::from(number % 8 > 3)].handle();
        let before: Vec<_> = LAYERS.iter().map(|name| readies(&node, name)).collect();
        node.inject(LAYERS[layer], Fault::panic()).expect("every node has it");
        for index in layer..LAYERS.len() {
            ready_for(&node, LAYERS[index], before[index] + 1);
        }
        (LAYERS.len() - layer) as u64
    }

    /// Restarts so many actors: applications, layers, or both in turn.
    fn restart(&self, count: u64, kind: &str) {
        let (mut done, mut turn) = (0, 0);
        while done < count {
            turn += 1;
            // A life longer than the window: otherwise the waits before the restarts would double each time.
            std::thread::sleep(Duration::from_millis(2));
            done += match kind {
                "applications" => self.fail_apps(),
                "layers" => self.fail_layer(turn),
                _ if turn % 2 == 0 => self.fail_apps(),
                _ => self.fail_layer(turn / 2),
            };
        }
    }

    /// What is held when all has come to rest, and every application takes messages.
    fn held_at_rest(&self, at_most: Option<Held>) -> Held {
        for name in &self.names {
            assert_eq!(outcome_of_job(&self.sender, name, 1), Outcome::Delivered, "{name}");
        }
        sees(&self.nodes[0].handle(), self.nodes[1].address());
        if let Some(before) = at_most {
            // Connections that are being closed, threads that are ending.
            until("descriptors and threads are given back", || {
                let now = Held::now();
                (now.descriptors <= before.descriptors && now.threads <= before.threads).then_some(())
            });
        } else {
            // What is counted first may only be too small: a link that is not back yet, a thread that has not begun.
            let (mut last, mut since) = (Held::now(), Instant::now());
            until("descriptors and threads stay as many for a while", || {
                let now = Held::now();
                if (now.descriptors, now.threads) != (last.descriptors, last.threads) {
                    (last, since) = (now, Instant::now());
                }
                (since.elapsed() >= AT_REST).then_some(())
            });
        }
        Held::now()
    }
}

fn readies(node: &NodeHandle, name: &str) -> u64 {
    node.lives(name).expect("it is there").readies
}

/// Restarts applications and layers, and says what grew.
#[derive(Parser)]
struct Arguments {
    /// How many restarts, over all.
    #[arg(long, default_value_t = 10_000)]
    restarts: u64,
}

fn main() -> ExitCode {
    // Thousands of panics would fill the terminal.
    std::panic::set_hook(Box::new(|_| {}));
    let Arguments { restarts } = Arguments::parse();
    let field = Field::new();
    field.restart((restarts / 5).max(100), "both");
    let first = field.held_at_rest(None);
    println!("{:<14} {:>9} {:>12} {:>12} {:>9}", "", "restarts", "resident KiB", "descriptors", "threads");
    let print = |what: &str, restarts: u64, held: Held| {
        let Held { resident_kib, descriptors, threads } = held;
        println!("{what:<14} {restarts:>9} {resident_kib:>12} {descriptors:>12} {threads:>9}");
        println!(
            "{}",
            json!({ "bench": "growth", "after": what, "restarts": restarts, "resident_kib": resident_kib,
            "descriptors": descriptors, "threads": threads })
        );
    };
    print("warm", 0, first);
    let mut last = first;
    for (kind, share) in [("applications", restarts / 2), ("layers", restarts / 4), ("both", restarts / 4)] {
        field.restart(share, kind);
        last = field.held_at_rest(Some(first));
        print(kind, share, last);
    }
    let grown = last.resident_kib.saturating_sub(first.resident_kib);
    println!("grown by {grown} KiB; the bound is {GROWTH_MAX_KIB} KiB");
    if grown > GROWTH_MAX_KIB { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}
