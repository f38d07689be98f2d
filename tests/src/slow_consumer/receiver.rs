//! The role of the second node: a consumer that keeps up or does not, and an application beside it that answers.

use std::{
    io::BufRead,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use sinew::prelude::*;

use crate::{DEADLINE, puppet::Order};

payload!("slow.load", Bulk => #[derive(Debug)] pub(super) struct Load {
    #[serde(with = "serde_bytes")]
    pub(super) bytes: Vec<u8>,
});

/// The name of the consumer.
pub(super) const CONSUMER: &str = "consumer";
/// The name of the one that answers.
pub(super) const ECHO: &str = "echo";

#[derive(Default)]
struct Counts {
    slow: AtomicBool,
    taken: AtomicU64,
}

struct Consumer {
    counts: Arc<Counts>,
    takes: Duration,
}

impl Actor for Consumer {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Load>> for Consumer {
    type Result = ();

    fn handle(&mut self, _: Delivery<Load>, _: &mut Self::Context) {
        self.counts.taken.fetch_add(1, Ordering::Relaxed);
        if self.counts.slow.load(Ordering::Relaxed) {
            std::thread::sleep(self.takes);
        }
    }
}

struct Echo;

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Order>> for Echo {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        // Whoever asked may have gone meanwhile.
        let _ = context.reply(&order, &Order { number: order.number });
    }
}

/// `CONFIGURATION TAKES_US`
pub(super) fn play(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the director's configuration");
    let takes = Duration::from_micros(arguments[1].parse().expect("a number"));
    let counts = Arc::new(Counts::default());
    let held = counts.clone();
    let consumer = AppSpec::new(CONSUMER, move || Consumer { counts: held.clone(), takes });
    let echo = AppSpec::new(ECHO, || Echo).handles::<Order>().own_thread();
    let node = Node::builder(config.name.clone()).config(config);
    let node = node.app(consumer.handles::<Load>().own_thread()).app(echo).start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match &*line {
            "slow" => {
                counts.slow.store(true, Ordering::Relaxed);
                counts.taken.store(0, Ordering::Relaxed);
                println!("slow");
            }
            "taken" => println!("{}", counts.taken.load(Ordering::Relaxed)),
            _ => panic!("{line:?} is nothing that the receiver is told"),
        }
    }
    // It has more in its hands than it can take in its time to stop.
    counts.slow.store(false, Ordering::Relaxed);
    node.stop();
}
