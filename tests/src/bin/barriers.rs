//! Four nodes that start in every order and are killed at random moments of a barrier; and how long a barrier takes.
//!
//! `cargo run --release -p sinew-tests --bin barriers -- [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: a barrier opened early. Whoever waits longer than 60 s ends the program with words.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use serde_json::json;
use sinew_tests::{
    dice::Dice,
    load::Times,
    meetings::{Cast, PARTIES, Verdict, figures, permutations, play},
};

/// Starts four node processes in each of the 24 orders, kills them at random moments of a barrier that they pass all the time, and
/// measures barriers of three nodes with 32 applications.
#[derive(Parser)]
struct Arguments {
    /// How many of the 24 orders of start.
    #[arg(long, default_value_t = 24)]
    orders: usize,
    /// How often each node in turn is killed and started again.
    #[arg(long, default_value_t = 100)]
    kills: usize,
    /// How often each figure is measured.
    #[arg(long, default_value_t = 100)]
    trials: usize,
    /// What all chance comes from; another one each time if it is not given.
    #[arg(long, default_value_t = u64::from(std::process::id()))]
    seed: u64,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let Arguments { orders, kills, trials, seed } = Arguments::parse();
    let mut early = 0;
    for order in permutations().into_iter().take(orders) {
        early += report(
            &format!("order {}", order.map(|index| PARTIES[index].0).join(" ")),
            &start_in(order).judge(),
        );
    }
    if kills > 0 {
        println!("seed {seed}");
        early += report(&format!("{kills} kills"), &killed(kills, seed));
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

fn start_in(order: [usize; 4]) -> Cast {
    let program = std::env::current_exe().expect("a program has a path");
    let mut cast = Cast::new();
    order.into_iter().for_each(|index| cast.start(&program, index));
    cast.wait_until_passed(0);
    cast.wait_for_one_directory();
    cast
}

fn killed(kills: usize, seed: u64) -> Verdict {
    let program = std::env::current_exe().expect("a program has a path");
    let mut dice = Dice::new(seed);
    let mut cast = start_in([0, 1, 2, 3]);
    for kill in 0..kills {
        // A round lasts some milliseconds.
        std::thread::sleep(dice.time_below(Duration::from_millis(40)));
        cast.kill(kill % PARTIES.len());
        std::thread::sleep(dice.time_below(Duration::from_millis(40)));
        let generation = cast.generation();
        cast.start(&program, kill % PARTIES.len());
        cast.wait_until_passed(generation + 1);
    }
    cast.wait_for_one_directory();
    cast.judge()
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
