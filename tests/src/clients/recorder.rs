//! The role of a process that is stopped: reports the number of each message that it receives.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use sinew::{Endpoint, NodeApi, Payload as _};

use super::{
    commands, print_line,
    registration::{register, wishes},
};
use sinew_testkit::scripted::{Job, Order, Value};

/// `SOCKET NAME`
pub(super) fn run(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the node accepts clients");
    let endpoint = register(&api, &wishes().name(&*arguments[1]));
    let over = Arc::new(AtomicBool::new(false));
    let ends = over.clone();
    let recorder = thread::spawn(move || record(endpoint, &ends));
    print_line(&"up");
    commands().for_each(drop);
    over.store(true, Ordering::Relaxed);
    recorder.join().expect("the node outlives this process");
}

fn record(mut endpoint: Endpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let Some(received) = endpoint.receive(Duration::from_millis(100)).expect("the node is alive") else {
            continue;
        };
        let unreadable = "the test sends nothing else";
        let (class, number) = match received.kind() {
            Job::KIND => ("bulk", received.decode::<Job>().expect(unreadable).number),
            Value::KIND => ("stream", received.decode::<Value>().expect(unreadable).number),
            Order::KIND => ("control", received.decode::<Order>().expect(unreadable).number),
            // Bytes laid out by the test: a number, followed by filler.
            _ => {
                let number = received.bytes().first_chunk().copied().map(u64::from_le_bytes);
                ("load", number.expect(unreadable))
            }
        };
        print_line(&format!("{class} {number}"));
    }
}
