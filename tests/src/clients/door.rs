//! The role of the node: opens its door, says when, and answers what its director asks.

use sinew::prelude::*;

use super::{say, told};
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

pub(super) fn play(arguments: &[String]) {
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
        .with_writer(std::io::stderr)
        .init();
    let config = NodeConfig::from_file(&arguments[0]).expect("the stage's configuration");
    let witness = AppSpec::new(WITNESS, || Witness).handles::<Order>().own_thread();
    let node = Node::builder(config.name.clone()).config(config).app(witness).start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    say(&"open");
    for question in told() {
        match &*question {
            "refused" => say(&format!("refused {}", node.handle().refused())),
            _ => panic!("{question:?} is nothing that the node answers"),
        }
    }
    node.stop();
}
