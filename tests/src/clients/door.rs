//! The role of the node: opens its door, says when, and answers what its director asks.

use sinew::{fault::Fault, prelude::*};

use super::{entry::Poster, poster, resident, say, told};
use crate::{DEADLINE, puppet::Order};

/// The name of the node's own application, which answers every [`Order`] with the same.
pub(super) const WITNESS: &str = "witness";

struct Witness;

impl Actor for Witness {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Order>> for Witness {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        if order.reply_to().is_some() {
            // Whoever asked may have gone meanwhile.
            let _ = context.reply(&order, &Order { number: order.number });
        }
    }
}

/// `CONFIGURATION [FIRST_POSTER POSTERS_IN_ALL SEED]`: posters from the first one on live in this process.
pub(super) fn play(arguments: &[String]) {
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
        .with_writer(std::io::stderr)
        .init();
    let config = NodeConfig::from_file(&arguments[0]).expect("the stage's configuration");
    let witness = AppSpec::new(WITNESS, || Witness).handles::<Order>().own_thread();
    let mut builder = Node::builder(config.name.clone()).config(config).app(witness);
    let numbers: Vec<u64> = arguments[1..].iter().map(|word| word.parse().expect("a number")).collect();
    if let &[first, all, seed] = &numbers[..] {
        for me in first..all {
            builder = builder.app(resident::app(me as Poster, all as Poster, seed));
        }
    }
    let node = builder.start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    say(&"open");
    for question in told() {
        match &*question {
            "quiet" => poster::be_quiet(),
            "panic" => node.handle().inject("LNCL", Fault::panic()).expect("every node has it"),
            "audit" => {
                let audit = node.handle().audit(DEADLINE).expect("it runs, and nobody else asks");
                let line = serde_json::to_string(&audit).expect("every field can be written");
                say(&format!("audit {line}"));
            }
            "refused" => say(&format!("refused {}", node.handle().refused())),
            _ => panic!("{question:?} is nothing that the node answers"),
        }
    }
    node.stop();
}
