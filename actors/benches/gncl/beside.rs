//! Control beside Bulk: one application sends requests and a flood, others answer and receive.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{SyncSender, sync_channel},
    },
    thread::Thread,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use sinew::{message::Sender, prelude::*};
use sinew_figures::{
    Alone, Figures,
    process::{await_end, print_ready},
};

use crate::{nodes::At, ping::DEADLINE};

/// Period of the round trips.
const PERIOD: Duration = Duration::from_millis(1);
/// Round trips before any is counted.
const WARM_UP: u64 = 200;
/// Messages that wait for the other node at most: enough to saturate, and 64 MB of the longest.
const QUEUE: usize = 64;

#[derive(Serialize, Deserialize)]
struct Ask {
    /// Send time, in nanoseconds since the requester started. A late round trip is counted with its real age,
    /// even if later ones have started.
    sent_ns: u64,
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Ask {
    const NAME: &'static str = "gncl.ask";
}

#[derive(Serialize, Deserialize)]
struct Answer {
    /// Of the question.
    sent_ns: u64,
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Answer {
    const NAME: &'static str = "gncl.answer";
}

#[derive(Serialize, Deserialize)]
struct Load {
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Load {
    const NAME: &'static str = "gncl.load";
    const CLASS: Class = Class::Bulk;
}

/// The results.
struct Seen {
    alone: Figures,
    beside: Figures,
    /// Bytes of Bulk that were taken by the socket's outlet, a second.
    bulk_bytes_per_s: u64,
}

struct Echo;

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Ask>> for Echo {
    type Result = ();

    fn handle(&mut self, ask: Delivery<Ask>, context: &mut Self::Context) {
        let Ask { sent_ns, block } = ask.payload;
        // A refused reply is missing among the answers.
        let _ = context.send(ask.source, &Answer { sent_ns, block });
    }
}

struct Sink {
    pause: Duration,
}

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Load>> for Sink {
    type Result = ();

    fn handle(&mut self, load: Delivery<Load>, _: &mut Self::Context) {
        std::hint::black_box(load.payload.block);
        if !self.pause.is_zero() {
            std::thread::sleep(self.pause);
        }
    }
}

struct Requester {
    to: Option<Tid>,
    round: u64,
    clock: Instant,
    rounds: u64,
    figures: Figures,
    flood: Arc<Flood>,
    flooding: Option<Thread>,
    done: SyncSender<Seen>,
    alone: Option<Figures>,
    began: Instant,
}

impl Actor for Requester {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.to = context.resolve("echo");
        let (sender, flood) = (context.sender(), self.flood.clone());
        self.flooding = Some(std::thread::spawn(move || flood.run(&sender)).thread().clone());
        context
            .every(PERIOD, |requester: &mut Self, _, context: &mut AppContext<Self>| requester.ask(context));
    }
}

impl Requester {
    fn ask(&mut self, context: &AppContext<Self>) {
        let to = self.to.expect("it was found at the start");
        let sent_ns = self.now_ns();
        // A refused request is repeated one period later.
        let _ = context.send(to, &Ask { sent_ns, block: vec![7; 64] });
    }

    fn now_ns(&self) -> u64 {
        u64::try_from(self.clock.elapsed().as_nanos()).expect("a bench does not last for centuries")
    }

    /// The rounds without a flood, or those beside it, are over.
    fn next(&mut self) {
        self.round = 0;
        let figures = std::mem::take(&mut self.figures);
        match self.alone.take() {
            None => {
                self.alone = Some(figures);
                self.flood.runs.store(true, Ordering::Relaxed);
                self.flooding.iter().for_each(Thread::unpark);
                self.began = Instant::now();
            }
            Some(alone) => {
                self.flood.runs.store(false, Ordering::Relaxed);
                let bytes = self.flood.bytes.load(Ordering::Relaxed);
                let millis = u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX);
                let bulk_bytes_per_s = bytes * 1_000 / millis.max(1);
                // The measuring thread takes one result; later rounds are not needed.
                let _ = self.done.try_send(Seen { alone, beside: figures, bulk_bytes_per_s });
            }
        }
    }
}

impl Handler<Delivery<Answer>> for Requester {
    type Result = ();

    fn handle(&mut self, answer: Delivery<Answer>, _: &mut Self::Context) {
        self.round += 1;
        if self.round > WARM_UP {
            self.figures.record(Duration::from_nanos(self.now_ns() - answer.payload.sent_ns));
        }
        if self.round == WARM_UP + self.rounds {
            self.next();
        }
    }
}

/// A thread that sends Bulk as fast as it is taken, and sleeps until it is to.
struct Flood {
    runs: AtomicBool,
    bytes: AtomicU64,
    message_bytes: usize,
}

impl Flood {
    fn run(&self, sender: &Sender) {
        let load = Load { block: vec![7; self.message_bytes] };
        loop {
            if !self.runs.load(Ordering::Relaxed) {
                std::thread::park();
            } else if sender.send("sink", &load).is_ok() {
                self.bytes.fetch_add(self.message_bytes as u64, Ordering::Relaxed);
            } else {
                std::thread::sleep(Duration::from_micros(100));
            }
        }
    }
}

fn node(name: &str, at: At) -> NodeBuilder {
    at.node(name).configure(|config| config.gncl.queue_capacity = QUEUE)
}

/// Runs the answering node until its input ends. The flooded application takes `pause` for each message.
pub(crate) fn echo(at: At, pause: Duration) {
    let echo = AppSpec::new("echo", || Echo).handles::<Ask>().own_thread();
    let sink = AppSpec::new("sink", move || Sink { pause }).handles::<Load>().own_thread();
    let _node = node("there", at).app(echo).app(sink).start().expect("a node");
    print_ready();
    await_end();
}

/// Runs the asking node: `rounds` round trips alone, then the same number with the flood.
pub(crate) fn measure(case: &str, at: At, bulk_bytes: usize, rounds: u64) {
    let (done, seen) = sync_channel(1);
    let flood = Flood { runs: AtomicBool::new(false), bytes: AtomicU64::new(0), message_bytes: bulk_bytes };
    let flood = Arc::new(flood);
    let requester = move || Requester {
        to: None,
        round: 0,
        clock: Instant::now(),
        rounds,
        figures: Figures::new(),
        flood: flood.clone(),
        flooding: None,
        done: done.clone(),
        alone: None,
        began: Instant::now(),
    };
    let requester =
        AppSpec::new("requester", requester).handles::<Answer>().requires(["echo", "sink"]).own_thread();
    let node = node("home", at).app(requester).start().expect("a node");
    let seen = seen.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    seen.report(case);
}

impl Seen {
    fn report(&self, case: &str) {
        let report = |figure, seen, counts: &[(&str, u64)]| {
            Alone { bench: "gncl", case, figure, seen, counts }.report();
        };
        report("Control alone", &self.alone, &[]);
        let ratio = self.beside.p99().as_nanos() * 100 / self.alone.p99().as_nanos().max(1);
        let counts = [
            ("bulk_kib_per_s", self.bulk_bytes_per_s >> 10),
            ("p99_ratio_percent", u64::try_from(ratio).unwrap_or(u64::MAX)),
        ];
        report("Control beside the flood", &self.beside, &counts);
    }
}
