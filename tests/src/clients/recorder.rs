//! The role of one that is stopped: says of each message that it gets which one it was.

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
    registration::{register, wishes},
    say, told,
};
use crate::puppet::{Job, Order, Value};

/// `SOCKET NAME`
pub(super) fn play(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    let endpoint = register(&api, &wishes().name(&*arguments[1]));
    let over = Arc::new(AtomicBool::new(false));
    let ends = over.clone();
    let recorder = thread::spawn(move || record(endpoint, &ends));
    say(&"up");
    told().for_each(drop);
    over.store(true, Ordering::Relaxed);
    recorder.join().expect("the node lives as long as this");
}

fn record(mut endpoint: Endpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let Some(received) = endpoint.receive(Duration::from_millis(100)).expect("the node lives") else {
            continue;
        };
        let unreadable = "the test sends nothing else";
        let (class, number) = match received.kind() {
            Job::KIND => ("bulk", received.decode::<Job>().expect(unreadable).number),
            Value::KIND => ("stream", received.decode::<Value>().expect(unreadable).number),
            Order::KIND => ("control", received.decode::<Order>().expect(unreadable).number),
            // Bytes laid out by the test: a number, and many more.
            _ => {
                let number = received.bytes().first_chunk().copied().map(u64::from_le_bytes);
                ("load", number.expect(unreadable))
            }
        };
        say(&format!("{class} {number}"));
    }
}
