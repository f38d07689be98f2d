//! All scenarios in their long form: `cargo run --release -p sinew-tests -- SCENARIO [OPTIONS]`.
//!
//! The program also has the roles of the scenarios' processes: it starts itself again with `--role`.

mod attacks;
mod barriers;
mod client_kills;
mod conservation;
mod contracts;
mod faulty_network;
mod growth;
mod hostile_client;
mod layer_panics;
mod link_faults;
mod params;
mod recording;
mod recovery;
mod slow_consumer;
mod stops;

use std::process::ExitCode;

use clap::Parser;

/// Runs a scenario with whole nodes in its long form, and reports the results.
#[derive(Parser)]
#[command(rename_all = "snake_case")]
enum Scenario {
    Attacks(attacks::Arguments),
    Barriers(barriers::Arguments),
    ClientKills(client_kills::Arguments),
    Conservation(conservation::Arguments),
    Contracts(contracts::Arguments),
    FaultyNetwork(faulty_network::Arguments),
    Growth(growth::Arguments),
    HostileClient(hostile_client::Arguments),
    LayerPanics(layer_panics::Arguments),
    LinkFaults(link_faults::Arguments),
    Params(params::Arguments),
    Recording(recording::Arguments),
    Recovery(recovery::Arguments),
    SlowConsumer(slow_consumer::Arguments),
    Stops(stops::Arguments),
}

fn main() -> ExitCode {
    if let Some(code) = sinew_tests::roles::run() {
        return code;
    }
    match Scenario::parse() {
        Scenario::Attacks(arguments) => attacks::execute(arguments),
        Scenario::Barriers(arguments) => barriers::execute(arguments),
        Scenario::ClientKills(arguments) => client_kills::execute(arguments),
        Scenario::Conservation(arguments) => conservation::execute(arguments),
        Scenario::Contracts(arguments) => contracts::execute(arguments),
        Scenario::FaultyNetwork(arguments) => faulty_network::execute(arguments),
        Scenario::Growth(arguments) => growth::execute(arguments),
        Scenario::HostileClient(arguments) => hostile_client::execute(arguments),
        Scenario::LayerPanics(arguments) => layer_panics::execute(arguments),
        Scenario::LinkFaults(arguments) => link_faults::execute(arguments),
        Scenario::Params(arguments) => params::execute(arguments),
        Scenario::Recording(arguments) => recording::execute(arguments),
        Scenario::Recovery(arguments) => recovery::execute(arguments),
        Scenario::SlowConsumer(arguments) => slow_consumer::execute(arguments),
        Scenario::Stops(arguments) => stops::execute(arguments),
    }
}
