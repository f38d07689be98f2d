//! Messages that arrive during the wait for an answer: the valid answers, and the kept messages.

use std::{thread, time::Duration};

use sinew_lncl::testing::{PlayedApp, RawClient};
use sinew_protocol::payload::Register;
use sinew_runtime::{
    outcome::Ticket,
    wire::{Header, TIME_TO_LIVE_MAX},
};

use super::{
    Class, Doubled, Flags, Message, Outcome, Rejection, TORQUE, TestNode, Time, Transport, WATCHDOG,
    forms::{self, Client, Under},
    on, register,
};

on_every_transport! {
    too_long_time_limit_is_reduced_to_maximum
    guessed_request_number_forges_no_answer
    messages_during_wait_exceed_inbox_capacity
    messages_dropped_during_wait_are_counted
}

fn guessed_request_number_forges_no_answer(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    // given: a client that received one request, and so can guess the next numbers
    let (mut hostile, its_tid) = RawClient::register(&node, &Register::default());
    let tid = endpoint.tid();
    let known = thread::scope(|scope| {
        let asked = scope.spawn(|| {
            let correlation = hostile.next().expect("the question").header.correlation;
            let ticket = Ticket { source: tid, destination: its_tid, correlation };
            hostile.send(&Message::outcome(ticket, Outcome::Failed));
            correlation
        });
        let outcome = endpoint.message(its_tid, &TORQUE).confirmed(WATCHDOG).unwrap();
        assert_eq!(outcome, Outcome::Failed);
        asked.join().unwrap()
    });
    // when: it sends answers to the next requests in advance
    for number in known + 1..known + 32 {
        let mut forged = Message::typed(its_tid, endpoint.tid(), &Doubled { newton_metres: -1.0 });
        forged.header.flags = Flags::REPLY;
        forged.header.correlation = number;
        hostile.send(&forged);
    }
    hostile.send(&Message::typed(its_tid, app.tid, &TORQUE));
    assert_eq!(app.next().header.source, its_tid, "the node has passed on all of it");
    // then: the real destination answers
    let asked = thread::scope(|scope| {
        scope.spawn(|| {
            let request = app.next();
            let mut reply = Message::typed(app.tid, request.header.source, &Doubled { newton_metres: 5.0 });
            reply.header.flags = Flags::REPLY;
            reply.header.correlation = request.header.correlation;
            node.router().send(reply).unwrap();
        });
        endpoint.message(app.tid, &TORQUE).ask::<Doubled>(WATCHDOG).unwrap()
    });
    assert_eq!(asked, Doubled { newton_metres: 5.0 });
}

fn too_long_time_limit_is_reduced_to_maximum(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    // One would be 10 us if its upper bits were cut off, and the other is C's value forever.
    for within in [TIME_TO_LIVE_MAX + Duration::from_micros(11), Duration::from_nanos(u64::MAX)] {
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut asked = app.next();
                assert_eq!(asked.header.time_to_live_us, u32::MAX);
                asked.settle(Outcome::Delivered);
                let request = app.next();
                assert_eq!(request.header.time_to_live_us, u32::MAX);
                let doubled = Doubled { newton_metres: 5.0 };
                let mut reply = Message::typed(app.tid, request.header.source, &doubled);
                reply.header.flags = Flags::REPLY;
                reply.header.correlation = request.header.correlation;
                node.router().send(reply).unwrap();
            });
            assert_eq!(endpoint.message(app.tid, &TORQUE).confirmed(within).unwrap(), Outcome::Delivered);
            endpoint.message(app.tid, &TORQUE).ask::<Doubled>(within).unwrap()
        });
    }
}

/// Sends `count` messages while `endpoint` waits for an outcome, each as soon as the node has room for it.
/// They are Bulk: the outcome must find room behind them.
fn flood(node: &TestNode, endpoint: &mut Client, app: &PlayedApp, count: usize, message: &Message) {
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut asked = app.next();
            let deadline = Time::now() + WATCHDOG * 3;
            for number in 0..count {
                let header = Header { class: Class::Bulk, ..message.header };
                let copy = || Message::new(header, message.payload.clone());
                while node.router().send(copy()).is_err() {
                    assert!(Time::now() < deadline, "waited for room for message {number}");
                    thread::yield_now();
                }
            }
            asked.settle(Outcome::Delivered);
        });
        let outcome = endpoint.message(app.tid, &TORQUE).confirmed(WATCHDOG * 3).unwrap();
        assert_eq!(outcome, Outcome::Delivered);
    });
}

/// Receives until `count` messages have arrived or were counted as refused; returns the number of refused
/// ones.
fn receive_all(endpoint: &mut Client, count: usize) -> u64 {
    let (mut received, mut refused) = (0, 0);
    let deadline = Time::now() + WATCHDOG;
    while received + refused < count as u64 {
        assert!(Time::now() < deadline, "waited for {count}; {received} arrived, {refused} were refused");
        received += u64::from(endpoint.receive(Duration::from_millis(1)).unwrap().is_some());
        while let Some(undelivered) = endpoint.take_undelivered() {
            assert_eq!((undelivered.destination, undelivered.why), (endpoint.tid(), Rejection::QueueFull));
            refused += undelivered.count;
        }
    }
    assert_eq!(received + refused, count as u64);
    refused
}

fn messages_during_wait_exceed_inbox_capacity(under: Under) {
    const COUNT: usize = 3_000;
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under).inbox_capacity(16));
    let message = Message::typed(app.tid, endpoint.tid(), &TORQUE);
    flood(&node, &mut endpoint, &app, COUNT, &message);
    assert_eq!(receive_all(&mut endpoint, COUNT), 0);
}

fn messages_dropped_during_wait_are_counted(under: Under) {
    // 19 MiB: more than a queue of the node, a ring and the inbox together hold.
    const COUNT: usize = 300;
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let mut message = Message::typed(app.tid, endpoint.tid(), &TORQUE);
    message.payload = vec![0; 64 << 10].into();
    flood(&node, &mut endpoint, &app, COUNT, &message);
    assert!(receive_all(&mut endpoint, COUNT) > 0);
}
