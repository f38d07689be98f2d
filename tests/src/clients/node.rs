//! The role of the node: opens its client socket, reports it, and answers the scenario's questions.

use sinew::{fault::Fault, prelude::*};

use super::{commands, entry::Poster, poster, print_line, resident};
use sinew_testkit::{DEADLINE, scripted::echo};

/// The name of the node's own application, which answers every [`Order`] with the same.
pub(super) const WITNESS: &str = "witness";

/// `CONFIGURATION [FIRST_POSTER POSTERS_IN_ALL SEED]`: the posters from the first one on run in this process.
pub(super) fn run(arguments: &[String]) {
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
        .with_writer(std::io::stderr)
        .init();
    let config = NodeConfig::from_file(&arguments[0]).expect("the fixture's configuration");
    let mut builder = Node::builder(config.name.clone()).config(config).app(echo(WITNESS));
    let numbers: Vec<u64> = arguments[1..].iter().map(|word| word.parse().expect("a number")).collect();
    if let &[first, all, seed] = &numbers[..] {
        for me in first..all {
            builder = builder.app(resident::app(me as Poster, all as Poster, seed));
        }
    }
    let node = builder.start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    print_line(&"open");
    for question in commands() {
        match &*question {
            "quiet" => poster::be_quiet(),
            "panic" => node.handle().inject("LNCL", Fault::panic()).expect("every node has it"),
            "audit" => {
                let audit = node.handle().audit(DEADLINE).expect("it runs, and nobody else asks");
                let line = serde_json::to_string(&audit).expect("every field can be written");
                print_line(&format!("audit {line}"));
            }
            "refused" => print_line(&format!("refused {}", node.handle().refused())),
            _ => panic!("{question:?} is no command of the node"),
        }
    }
    node.stop();
}
