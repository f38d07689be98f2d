//! Restarts applications and layers thousands of times, and reports growth of memory, descriptors or threads.
//!
//! `cargo run --release -p sinew-tests -- growth [OPTIONS]`.
//!
//! Exit code 1: a resource grew beyond its bound.

use std::{
    process::ExitCode,
    time::{Duration, Instant},
};

use clap::Args;
use serde_json::json;
use sinew::{NodeHandle, fault::Fault, prelude::*};
use sinew_testkit::{
    Loopback, all_run, ready_for,
    scripted::{Job, outcome_of_job, sender_app},
    sees, until,
};
use sinew_tests::load::LAYERS;

/// Maximum growth of resident memory over all restarts, as a reserve of the allocator and the kernel.
const GROWTH_MAX_KIB: u64 = 4 * 1024;
/// A value that has not changed for this long is stable.
const AT_REST: Duration = Duration::from_secs(1);
/// Number of applications that fail at the same time.
const APPS: usize = 8;

/// Accepts jobs and keeps no state.
struct Clerk;

impl Actor for Clerk {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // A timer, a group membership, a watchdog, a future: everything that an application can leave behind.
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

/// Resources of this process.
#[derive(Clone, Copy, Debug)]
struct Resources {
    resident_kib: u64,
    descriptors: usize,
    threads: u64,
}

impl Resources {
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

/// Two linked nodes with failing actors.
struct Field {
    nodes: [Node; 2],
    names: Vec<String>,
    sender: sinew::message::Sender,
}

impl Field {
    fn new() -> Self {
        let loopback = Loopback::new();
        let node = |name: &str| {
            loopback.node(name).configure(|config| {
                let supervision = &mut config.supervision;
                (supervision.app_restarts_max, supervision.layer_restarts_max) = (1_000_000, 1_000_000);
                (supervision.app_window, supervision.layer_window) =
                    (Duration::from_millis(1), Duration::from_millis(1));
            })
        };
        let names: Vec<_> = (0..APPS).map(|number| format!("clerk {number}")).collect();
        let (sender_app, key) = sender_app("sender");
        let mut here = node("home").app(sender_app);
        for (number, name) in names.iter().enumerate() {
            let app = AppSpec::new(name.as_str(), || Clerk).handles::<Job>();
            here = here.app(app.place(Place::thread(format!("thread {}", number % 4))));
        }
        let nodes = [here.start().expect("a node"), node("there").start().expect("a node")];
        all_run(&[&nodes[0], &nodes[1]]);
        sees(&nodes[0].handle(), nodes[1].address());
        Self { nodes, names, sender: key.sender() }
    }

    /// Makes all applications of the node fail once.
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

    /// Makes a layer of one node fail; the layers behind it are restarted with it.
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

    /// Restarts this many actors: applications, layers, or both in turn.
    fn restart(&self, count: u64, kind: &str) {
        let (mut done, mut turn) = (0, 0);
        while done < count {
            turn += 1;
            // Longer than the restart window: otherwise the restart delay would double each time.
            std::thread::sleep(Duration::from_millis(2));
            done += match kind {
                "applications" => self.fail_apps(),
                "layers" => self.fail_layer(turn),
                _ if turn % 2 == 0 => self.fail_apps(),
                _ => self.fail_layer(turn / 2),
            };
        }
    }

    /// The resources held once they are stable and every application accepts messages.
    fn held_at_rest(&self, at_most: Option<Resources>) -> Resources {
        for name in &self.names {
            assert_eq!(outcome_of_job(&self.sender, name, 1), Outcome::Delivered, "{name}");
        }
        sees(&self.nodes[0].handle(), self.nodes[1].address());
        if let Some(before) = at_most {
            // Connections being closed, and threads about to end.
            until("descriptors and threads are given back", || {
                let now = Resources::now();
                (now.descriptors <= before.descriptors && now.threads <= before.threads).then_some(())
            });
        } else {
            // The first samples may be too small: a link may still be down, or a thread not started yet.
            let (mut last, mut since) = (Resources::now(), Instant::now());
            until("descriptors and threads stay as many for a while", || {
                let now = Resources::now();
                if (now.descriptors, now.threads) != (last.descriptors, last.threads) {
                    (last, since) = (now, Instant::now());
                }
                (since.elapsed() >= AT_REST).then_some(())
            });
        }
        Resources::now()
    }
}

fn readies(node: &NodeHandle, name: &str) -> u64 {
    node.lives(name).expect("it is there").readies
}

/// Restarts applications and layers, and reports the growth of resources.
#[derive(Args)]
pub(super) struct Arguments {
    /// Total number of restarts.
    #[arg(long, default_value_t = 10_000)]
    restarts: u64,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    // Suppresses the messages of thousands of panics.
    std::panic::set_hook(Box::new(|_| {}));
    let Arguments { restarts } = arguments;
    let field = Field::new();
    field.restart((restarts / 5).max(100), "both");
    let first = field.held_at_rest(None);
    println!("{:<14} {:>9} {:>12} {:>12} {:>9}", "", "restarts", "resident KiB", "descriptors", "threads");
    let print = |what: &str, restarts: u64, held: Resources| {
        let Resources { resident_kib, descriptors, threads } = held;
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
