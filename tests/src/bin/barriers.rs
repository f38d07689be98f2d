//! Four nodes that start in every order and are killed at random moments of a barrier; and how long a barrier takes.
//!
//! `cargo run --release -p sinew-tests --bin barriers -- [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: a barrier opened early, or somebody did not start where all was there. Whoever waits longer than 60 s ends the program with words.

use std::{path::Path, process::ExitCode, time::Duration};

use clap::Parser;
use serde_json::json;
use sinew_tests::{
    dice::Dice,
    load::Times,
    meetings::{Cast, PARTIES, Verdict, figures, permutations, play},
};

/// Starts four node processes in each of the 24 orders, each when those before it are up, and at the same moment; kills them at random
/// moments of a barrier that they pass all the time, one in four while another one keeps away from it; and measures barriers of
/// three nodes with 32 applications.
#[derive(Parser)]
struct Arguments {
    /// How many of the 24 orders of start, and the simultaneous start.
    #[arg(long, default_value_t = 24)]
    orders: usize,
    /// How often each of the four nodes is killed and started again.
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
    let program = std::env::current_exe().expect("a program has a path");
    let mut early = 0;
    for order in permutations().into_iter().take(orders) {
        early += report(
            &format!("order {}", order.map(|index| PARTIES[index].0).join(" ")),
            &Cast::one_by_one(&program, order).judge(),
        );
    }
    if orders > 0 {
        early += report("all at once", &Cast::at_once(&program).judge());
    }
    if kills > 0 {
        println!("seed {seed}");
        let verdict = killed(&program, kills, seed);
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

fn killed(program: &Path, kills: usize, seed: u64) -> Verdict {
    let mut dice = Dice::new(seed);
    let mut cast = Cast::at_once(program);
    for kill in 0..kills * PARTIES.len() {
        let (killed, turn) = (kill % PARTIES.len(), kill / PARTIES.len());
        if turn % 4 == 0 {
            let away = (killed + 1 + turn / 4 % (PARTIES.len() - 1)) % PARTIES.len();
            cast.kill_who_waits(program, killed, away);
            continue;
        }
        // A round lasts some milliseconds.
        std::thread::sleep(dice.time_below(Duration::from_millis(40)));
        cast.kill(killed);
        std::thread::sleep(dice.time_below(Duration::from_millis(40)));
        let generation = cast.generation();
        cast.start(program, killed);
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
