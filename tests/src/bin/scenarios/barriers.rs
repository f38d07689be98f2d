//! Starts four nodes in every order, kills them at random moments of a barrier, and measures barrier latency.
//!
//! `cargo run --release -p sinew-tests -- barriers [OPTIONS]`.
//!
//! Exit code 1: a barrier opened early, or an application did not start although its requirements were met. A
//! wait longer than 60 s ends the program with a message.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use serde_json::json;
use sinew_testkit::options::Seed;
use sinew_testkit::random::SeededRandom;
use sinew_testkit::report::Times;
use sinew_tests::barriers::{PARTIES, Scenario, Verdict, figures, permutations};

/// Tests the start order, kills and latency of barriers.
///
/// Starts four node processes in each of the 24 orders, each once the previous ones are up, and all four at
/// the same moment. Kills them at random moments of a barrier that they pass repeatedly, one in four while
/// another node stays away from it. Measures barriers of three nodes with 32 applications.
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of the 24 start orders to run, in addition to the simultaneous start.
    #[arg(long, default_value_t = 24)]
    orders: usize,
    /// Number of times that each of the four nodes is killed and restarted.
    #[arg(long, default_value_t = 100)]
    kills: usize,
    /// Number of measurements per figure.
    #[arg(long, default_value_t = 100)]
    trials: usize,
    #[command(flatten)]
    seed: Seed,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { orders, kills, trials, seed: Seed { seed } } = arguments;
    let mut early = 0;
    for order in permutations().into_iter().take(orders) {
        early += report(
            &format!("order {}", order.map(|index| PARTIES[index].0).join(" ")),
            &Scenario::one_by_one(order).judge(),
        );
    }
    if orders > 0 {
        early += report("all at once", &Scenario::at_once().judge());
    }
    if kills > 0 {
        println!("seed {seed}");
        let verdict = killed(kills, seed);
        early += report(&format!("{} kills, {kills} of each", kills * PARTIES.len()), &verdict);
        println!(
            "somebody who was killed counted for others {:.2} ms later at most",
            verdict.hearsay.percentile(1.0).as_secs_f64() * 1e3
        );
    }
    if trials > 0 {
        let start_up = figures::start_up(trials);
        figure("3 nodes, 32 applications: last Ready to the last start", &start_up.release, 10.0);
        figure("3 nodes, 32 applications: first start to the last start", &start_up.skew, 5.0);
        let run_time = figures::run_time(trials);
        figure(
            "3 nodes, 32 applications: last arrival to the last one that goes on",
            &run_time.release,
            10.0,
        );
        figure("3 nodes, 32 applications: first one that goes on to the last one", &run_time.skew, 5.0);
    }
    if early > 0 { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

fn killed(kills: usize, seed: u64) -> Verdict {
    let mut random = SeededRandom::new(seed);
    let mut scenario = Scenario::at_once();
    for kill in 0..kills * PARTIES.len() {
        let (killed, turn) = (kill % PARTIES.len(), kill / PARTIES.len());
        if turn % 4 == 0 {
            let away = (killed + 1 + turn / 4 % (PARTIES.len() - 1)) % PARTIES.len();
            scenario.kill_who_waits(killed, away);
            continue;
        }
        // A round lasts some milliseconds.
        std::thread::sleep(random.time_below(Duration::from_millis(40)));
        scenario.kill(killed);
        std::thread::sleep(random.time_below(Duration::from_millis(40)));
        let generation = scenario.generation();
        scenario.start(killed);
        scenario.wait_until_passed(generation + 1);
    }
    scenario.wait_for_one_directory();
    scenario.judge()
}

fn report(what: &str, verdict: &Verdict) -> usize {
    for violation in &verdict.violations {
        println!("EARLY {violation}");
    }
    let milliseconds = |times: &Times| times.percentile(0.99).as_secs_f64() * 1e3;
    println!(
        "{what}: {} generations, {} early; 99 of 100: all have gone on {:.2} ms after the last arrival, within {:.2} ms",
        verdict.generations,
        verdict.violations.len(),
        milliseconds(&verdict.release),
        milliseconds(&verdict.skew)
    );
    verdict.violations.len()
}

fn figure(what: &str, times: &Times, target_ms: f64) {
    let mut json = times.json();
    (json["bench"], json["what"], json["target_ms"]) = (json!("barriers"), json!(what), json!(target_ms));
    println!("{json}");
}
