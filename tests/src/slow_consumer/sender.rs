//! The role of the first node: offers Bulk at a rate, and sends requests at 1 kHz.

use std::{
    io::BufRead,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Instant,
};

use sinew::{message::Sender, prelude::*};
use sinew_runtime::lock;

use super::receiver::{CONSUMER, ECHO, Load};
use sinew_testkit::report::Times;
use sinew_testkit::scripted::reactor;
use sinew_testkit::{
    DEADLINE,
    scripted::{Order, sender_app},
    until,
};

/// Time between two requests, and between two batches of Bulk.
const PACE: Duration = Duration::from_millis(1);
/// Messages that could not be offered for longer than this are not caught up on.
const DEBT: Duration = Duration::from_millis(20);

#[derive(Default)]
struct Shared {
    floods: AtomicBool,
    over: AtomicBool,
    offered: AtomicU64,
    refused: AtomicU64,
    measured: Mutex<(Times, u64)>,
}

impl Shared {
    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }
}

/// `CONFIGURATION RATE LENGTH`
pub(super) fn run(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the scenario's configuration");
    let number = |at: usize| arguments[at].parse::<u64>().expect("a number");
    let (rate, length) = (number(1), number(2) as usize);
    let ((flooder, flood_key), (requester, ask_key)) = (sender_app("flooder"), sender_app("requester"));
    let node = Node::builder(config.name.clone()).config(config).app(flooder).app(requester);
    let node = node.start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    let (flood, ask) = (flood_key.sender(), ask_key.sender());
    for name in [CONSUMER, ECHO] {
        until(&format!("{name} is there"), || flood.resolve(name));
    }
    let shared = Arc::new(Shared::default());
    let (floods, asks) = (shared.clone(), shared.clone());
    let threads = [
        std::thread::spawn(move || offer(&flood, &floods, rate, length)),
        std::thread::spawn(move || question(&ask, &asks)),
    ];
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match &*line {
            "flood" => {
                shared.floods.store(true, Ordering::Relaxed);
                println!("flood");
            }
            "window" => {
                let mut measured = lock(&shared.measured);
                let (times, failed) = std::mem::take(&mut *measured);
                drop(measured);
                let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| times.percentile(share).as_nanos());
                println!("{} {failed} {p50} {p99} {max}", times.count());
            }
            "offered" => {
                let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
                println!("{} {}", of(&shared.offered), of(&shared.refused));
            }
            _ => panic!("{line:?} is no command of the sender"),
        }
    }
    shared.over.store(true, Ordering::Relaxed);
    threads.into_iter().for_each(|thread| thread.join().expect("it does not fail"));
    node.stop();
}

fn offer(sender: &Sender, shared: &Shared, rate: u64, length: usize) {
    let load = Load { bytes: vec![0x55; length] };
    let (mut due, mut looked) = (0.0, Instant::now());
    while !shared.is_over() {
        let rate = if shared.floods.load(Ordering::Relaxed) { rate as f64 } else { 0.0 };
        due = (due + rate * looked.elapsed().as_secs_f64()).min(rate * DEBT.as_secs_f64());
        looked = Instant::now();
        while due >= 1.0 {
            due -= 1.0;
            shared.offered.fetch_add(1, Ordering::Relaxed);
            if sender.send(CONSUMER, &load).is_err() {
                // There is no room. The rest of this batch is not offered again.
                shared.refused.fetch_add(1, Ordering::Relaxed);
                due = 0.0;
            }
        }
        std::thread::sleep(PACE);
    }
}

fn question(sender: &Sender, shared: &Shared) {
    let runtime = reactor();
    for number in 0.. {
        if shared.is_over() {
            return;
        }
        let asked = Instant::now();
        let answer = runtime.block_on(async {
            sender.message(ECHO, &Order { number }).ask::<Order>(DEADLINE).ok()?.await.ok()
        });
        let took = asked.elapsed();
        let mut measured = lock(&shared.measured);
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
