//! The role of each node of the robot: an application that answers, one that looks who is there, and one that asks.

use std::{
    io::BufRead,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Instant,
};

use sinew::{Sender, prelude::*};

use crate::{
    DEADLINE,
    load::Times,
    puppet::{Order, desk},
    until,
};

/// The name of the application that answers.
pub(super) const ECHO: &str = "echo";
/// Time between two questions.
const PACE: Duration = Duration::from_millis(1);

#[derive(Default)]
struct Counts {
    /// Nodes that were lost.
    lost: AtomicU64,
    /// Nodes that were found.
    found: AtomicU64,
    /// Messages that nobody asks with: nobody of the robot sends any. By the last byte of the node that they say they are from.
    sent: Mutex<std::collections::BTreeMap<u8, u64>>,
}

struct Echo(Arc<Counts>);

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Order>> for Echo {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        if context.reply(&order, &Order { number: order.number }).is_err() {
            let mut sent = self.0.sent.lock().unwrap_or_else(PoisonError::into_inner);
            *sent.entry(order.source.node.bits() as u8).or_default() += 1;
        }
    }
}

impl Handler<Delivery<NodeEvent>> for Echo {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        match &event.payload {
            NodeEvent::NodeFound { .. } => self.0.found.fetch_add(1, Ordering::Relaxed),
            NodeEvent::NodeLost { .. } => self.0.lost.fetch_add(1, Ordering::Relaxed),
            NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } | NodeEvent::NodeRestarted { .. } => {
                0
            }
        };
    }
}

/// `CONFIGURATION [ASKS]`: says `up` when all runs. `window`: what was measured since the last one; `seen`: who was lost, who was found, and
/// what came unasked; `tid`: that of the application that answers.
pub(super) fn play(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the director's configuration");
    let asks = arguments.get(1).is_some_and(|asks| asks == "asks");
    let counts = Arc::new(Counts::default());
    let counted = counts.clone();
    let name = if asks { "idle" } else { ECHO };
    let echo = AppSpec::new(name, move || Echo(counted.clone()))
        .handles::<Order>()
        .handles::<NodeEvent>()
        .own_thread();
    let (asker, key) = desk("asker");
    let node =
        Node::builder(config.name.clone()).config(config).app(echo).app(asker).start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    let sender = key.sender();
    let echo = until("the echo is there", || sender.resolve(ECHO));
    let over = Arc::new(AtomicBool::new(false));
    let measured: Arc<Mutex<(Times, u64)>> = Arc::default();
    let asking = asks.then(|| {
        let (over, measured) = (over.clone(), measured.clone());
        std::thread::spawn(move || question(&sender, &over, &measured))
    });
    if asks {
        // It is up when it has an answer.
        until("the first answer", || {
            (measured.lock().unwrap_or_else(PoisonError::into_inner).0.count() > 0).then_some(())
        });
    }
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match &*line {
            "window" => {
                let (times, failed) =
                    std::mem::take(&mut *measured.lock().unwrap_or_else(PoisonError::into_inner));
                let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| times.percentile(share).as_nanos());
                println!("{} {failed} {p50} {p99} {max}", times.count());
            }
            "seen" => {
                let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
                let sent = counts.sent.lock().unwrap_or_else(PoisonError::into_inner).clone();
                let sent: String = sent.iter().map(|(node, count)| format!(" {node} {count}")).collect();
                println!("{} {}{sent}", of(&counts.lost), of(&counts.found));
            }
            "tid" => println!("{}", echo.bits()),
            _ => panic!("{line:?} is nothing that a node is told"),
        }
    }
    over.store(true, Ordering::Relaxed);
    asking.into_iter().for_each(|thread| thread.join().expect("it does not fail"));
    node.stop();
}

fn question(sender: &Sender, over: &AtomicBool, measured: &Mutex<(Times, u64)>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
    let runtime = runtime.expect("a reactor with nothing but a timer");
    for number in 0.. {
        if over.load(Ordering::Relaxed) {
            return;
        }
        let asked = Instant::now();
        let answer = runtime.block_on(async {
            sender.ask::<Order, Order>(ECHO, &Order { number }, DEADLINE).ok()?.await.ok()
        });
        let took = asked.elapsed();
        let mut measured = measured.lock().unwrap_or_else(PoisonError::into_inner);
        match answer {
            Some(answer) => {
                assert_eq!(answer.number, number, "the answer to another question");
                measured.0.note(took);
            }
            None => measured.1 += 1,
        }
        drop(measured);
        std::thread::sleep(PACE.saturating_sub(asked.elapsed()));
    }
}
