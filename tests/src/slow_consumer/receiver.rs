//! The role of the second node: a slow or fast consumer, and an application beside it that answers.

use std::{
    io::BufRead,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use sinew::prelude::*;

use sinew_testkit::{DEADLINE, scripted::echo};

payload!("slow.load", Bulk => #[derive(Debug)] pub(super) struct Load {
    #[serde(with = "serde_bytes")]
    pub(super) bytes: Vec<u8>,
});

/// The name of the consumer.
pub(super) const CONSUMER: &str = "consumer";
/// The name of the application that answers.
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

/// `CONFIGURATION TAKES_US`
pub(super) fn run(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the scenario's configuration");
    let takes = Duration::from_micros(arguments[1].parse().expect("a number"));
    let counts = Arc::new(Counts::default());
    let held = counts.clone();
    let consumer = AppSpec::new(CONSUMER, move || Consumer { counts: held.clone(), takes });
    let node = Node::builder(config.name.clone()).config(config);
    let node = node.app(consumer.handles::<Load>().own_thread()).app(echo(ECHO)).start().expect("a node");
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
            _ => panic!("{line:?} is no command of the receiver"),
        }
    }
    // It holds more messages than it can process in its time to stop.
    counts.slow.store(false, Ordering::Relaxed);
    node.stop();
}
