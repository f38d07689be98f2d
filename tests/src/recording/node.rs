//! The role of the recorded node: applications that send to one sink, each at a rate.

use std::{io::BufRead, time::Instant};

use sinew::{message::Sender, prelude::*};

use super::{Load, SINK, Sent, source};
use sinew_testkit::{
    DEADLINE, numbers,
    report::Times,
    scripted::{SenderApp, sender_app},
    until,
};

/// Time between two batches.
const PACE: Duration = Duration::from_millis(1);
/// Messages that are due for longer than this are not caught up on at once.
const DEBT: Duration = Duration::from_millis(20);

/// Further time for the messages, beyond one and a half times that of their rate.
const RESERVE: Duration = Duration::from_secs(10);

payload!("recorded.load", Bulk => #[derive(Debug)] struct Value {
    number: u64,
    #[serde(with = "serde_bytes")]
    filler: Vec<u8>,
});

/// Takes all values.
struct Sink;

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Value>> for Sink {
    type Result = ();

    fn handle(&mut self, _: Delivery<Value>, _: &mut Self::Context) {}
}

/// `CONFIGURATION CHANNELS`
pub(super) fn run(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the scenario's configuration");
    let channels: u64 = arguments[1].parse().expect("a number");
    let (sources, keys): (Vec<_>, Vec<_>) = (0..channels).map(|at| sender_app(&source(at))).unzip();
    let sink = AppSpec::new(SINK, || Sink).handles::<Value>().own_thread();
    let builder = Node::builder(config.name.clone()).config(config).app(sink);
    let builder = sources.into_iter().fold(builder, |builder, source| builder.app(source));
    let node = builder.start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    let senders: Vec<_> = keys.into_iter().map(SenderApp::sender).collect();
    until("the sink is there", || {
        senders.first().is_none_or(|sender| sender.resolve(SINK).is_some()).then_some(())
    });
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let [rate, length, count] = numbers(&line)[..] else { panic!("{line:?} is no load") };
        println!("{}", send(&senders, Load { rate, length, count }).line());
    }
    node.stop();
}

/// Sends from all applications in turns, on one thread: `load.count` values each.
fn send(senders: &[Sender], load: Load) -> Sent {
    let rate = load.rate as f64;
    let mut times = Times::default();
    let mut channels = vec![[0, 0]; senders.len()];
    let mut value = Value { number: 0, filler: vec![7; load.length as usize] };
    let began = Instant::now();
    let (mut due, mut looked) = (0.0, began);
    // A node that cannot keep the rate ends all the same.
    let needed = Duration::from_secs_f64(load.count as f64 / rate.max(1.0));
    let lasts = needed.mul_f64(1.5) + RESERVE;
    while value.number < load.count && began.elapsed() < lasts {
        let now = Instant::now();
        let most = (rate * DEBT.as_secs_f64()).max(1.0);
        due = (due + rate * now.duration_since(looked).as_secs_f64()).min(most);
        looked = now;
        while due >= 1.0 && value.number < load.count {
            due -= 1.0;
            value.number += 1;
            for (sender, counts) in senders.iter().zip(&mut channels) {
                let begun = Instant::now();
                let sent = sender.send(SINK, &value);
                times.note(begun.elapsed());
                counts[usize::from(sent.is_err())] += 1;
            }
        }
        std::thread::sleep(PACE);
    }
    let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| times.percentile(share));
    Sent { p50, p99, max, took: began.elapsed(), channels }
}
