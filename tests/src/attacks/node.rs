//! The role of each node of the robot: an application that answers, one that looks who is there, and one that asks.

use std::{
    collections::BTreeMap,
    io::BufRead,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

use sinew::{NodeAddress, Sender, prelude::*};

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

/// How long another answer may take when the attack is over, on a machine that is shared.
const AGAIN: Duration = Duration::from_secs(30);

/// All by the last byte of a node's address.
#[derive(Default)]
struct Counts {
    /// How often it was lost.
    lost: BTreeMap<u8, u64>,
    /// How often it was found.
    found: BTreeMap<u8, u64>,
    /// Messages that nobody asks with, which say that they are from there: nobody of the robot sends any.
    sent: BTreeMap<u8, u64>,
}

struct Echo(Arc<Mutex<Counts>>);

impl Echo {
    fn note(&self, which: impl FnOnce(&mut Counts) -> &mut BTreeMap<u8, u64>, node: NodeAddress) {
        let mut counts = lock(&self.0);
        *which(&mut counts).entry(node.bits() as u8).or_default() += 1;
    }
}

/// What was measured since the last time that somebody asked for it.
struct Measured {
    since: Instant,
    times: Times,
    failed: u64,
    /// When the question was asked that has no answer yet.
    open: Option<Instant>,
    /// Answers in all.
    answers: u64,
}

impl Measured {
    fn new() -> Self {
        Self { since: Instant::now(), times: Times::default(), failed: 0, open: None, answers: 0 }
    }

    /// `COUNT FAILED P50 P99 MAX LASTED`, times in nanoseconds. A question that waits for its answer is among the longest: else silence
    /// would look like no traffic at all.
    fn window(&mut self) -> String {
        let (times, failed) = (std::mem::take(&mut self.times), std::mem::take(&mut self.failed));
        let lasted = std::mem::replace(&mut self.since, Instant::now()).elapsed().as_nanos();
        let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| times.percentile(share).as_nanos());
        let max = self.open.map_or(max, |asked| max.max(asked.elapsed().as_nanos()));
        format!("{} {failed} {p50} {p99} {max} {lasted}", times.count())
    }
}

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Order>> for Echo {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        if context.reply(&order, &Order { number: order.number }).is_err() {
            self.note(|counts| &mut counts.sent, order.source.node);
        }
    }
}

impl Handler<Delivery<NodeEvent>> for Echo {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        match &event.payload {
            NodeEvent::NodeFound { node, .. } => self.note(|counts| &mut counts.found, *node),
            NodeEvent::NodeLost { node, .. } => self.note(|counts| &mut counts.lost, *node),
            // Neither comes nor goes.
            NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } | NodeEvent::NodeRestarted { .. } => {
            }
        }
    }
}

/// `CONFIGURATION [ASKS]`: says `up` when all runs. `window`: what was measured since the last one; `again`: whether questions are answered
/// from now on; `seen`: who was lost, who was found, and what came unasked; `refused`: what the node refused, for each cause; `tid`: that of
/// the application that answers.
pub(super) fn play(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the director's configuration");
    let asks = arguments.get(1).is_some_and(|asks| asks == "asks");
    let counts: Arc<Mutex<Counts>> = Arc::default();
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
    let measured = Arc::new(Mutex::new(Measured::new()));
    let asking = asks.then(|| {
        let (over, measured) = (over.clone(), measured.clone());
        std::thread::spawn(move || question(&sender, &over, &measured))
    });
    if asks {
        // It is up when it has an answer.
        until("the first answer", || (lock(&measured).answers > 0).then_some(()));
    }
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match &*line {
            "window" => println!("{}", lock(&measured).window()),
            "again" => println!("{}", u8::from(is_answered(&measured))),
            "seen" => {
                let counts = lock(&counts);
                let words = |kind: &str, of: &BTreeMap<u8, u64>| {
                    of.iter().map(|(node, count)| format!(" {kind} {node} {count}")).collect::<String>()
                };
                let Counts { lost, found, sent } = &*counts;
                println!("seen{}{}{}", words("lost", lost), words("found", found), words("sent", sent));
            }
            "refused" => {
                let refused = node.handle().audit_here().refused;
                let words = refused.iter().map(|(cause, count)| format!("\t{cause}\t{count}"));
                println!("refused{}", words.collect::<String>());
            }
            "tid" => println!("{}", echo.bits()),
            _ => panic!("{line:?} is nothing that a node is told"),
        }
    }
    over.store(true, Ordering::Relaxed);
    asking.into_iter().for_each(|thread| thread.join().expect("it does not fail"));
    node.stop();
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for the answer to a question that is asked from now on: the first one that comes may be to an older one.
fn is_answered(measured: &Mutex<Measured>) -> bool {
    let (before, deadline) = (lock(measured).answers, Instant::now() + AGAIN);
    while lock(measured).answers < before + 2 {
        if Instant::now() > deadline {
            return false;
        }
        std::thread::sleep(PACE);
    }
    true
}

fn question(sender: &Sender, over: &AtomicBool, measured: &Mutex<Measured>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
    let runtime = runtime.expect("a reactor with nothing but a timer");
    for number in 0.. {
        if over.load(Ordering::Relaxed) {
            return;
        }
        let asked = Instant::now();
        lock(measured).open = Some(asked);
        let answer = runtime.block_on(async {
            sender.ask::<Order, Order>(ECHO, &Order { number }, DEADLINE).ok()?.await.ok()
        });
        let took = asked.elapsed();
        let mut measured = lock(measured);
        measured.open = None;
        match answer {
            Some(answer) => {
                assert_eq!(answer.number, number, "the answer to another question");
                measured.times.note(took);
                measured.answers += 1;
            }
            None => measured.failed += 1,
        }
        drop(measured);
        std::thread::sleep(PACE.saturating_sub(asked.elapsed()));
    }
}
