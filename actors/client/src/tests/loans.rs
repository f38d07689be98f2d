//! Loaned messages: one at a time, and the effects on all other calls, the same on every path.

use std::{thread, time::Duration};

use super::{
    ApiError, Kind, Outcome, Registration, TORQUE, TestNode, Tid, Torque, Transport, WATCHDOG,
    forms::{self, Client, Under},
    on, register,
};

const RAW: Kind = Kind::named("test.raw");
/// The first fits in the ring, if there is one; the second is in ordinary memory in any case.
const LENGTHS: [usize; 2] = [100, 200_000];

on_every_transport! {
    loan_blocks_other_sends_with_a_remedy
    dropped_loan_leaves_no_trace
    loan_before_link_setup_is_sent_on_link
    ; in_rust:
    other_endpoint_without_loan_may_send_this_loan
    unregister_during_loan_fails_but_releases_address
    loan_before_node_restart_is_sent_afterwards
}

fn lent<T>(refused: Result<T, ApiError>) {
    match refused {
        Err(error @ ApiError::LoanActive) => {
            assert!(error.to_string().contains("send that message or drop it first"), "{error}");
        }
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("it was not refused"),
    }
}

fn loan_blocks_other_sends_with_a_remedy(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut client, other) = (register(under, &node, on(under)), register(under, &node, on(under)));
    for length in LENGTHS {
        // On the same path, and on another one.
        for to in [app.tid, other.tid()] {
            let outcome = node.send_confirmed(app.tid, client.tid(), &TORQUE);
            let received = client.receive(WATCHDOG).unwrap().expect("a message");
            let mut message = client.create_message(app.tid, RAW, length).unwrap();
            message.fill(7);
            lent(client.create_message(to, RAW, 1));
            lent(client.send(to, &TORQUE));
            lent(client.message(to, &TORQUE).room_within(Duration::ZERO).send());
            lent(client.message(to, &TORQUE).confirmed(WATCHDOG));
            lent(client.message(to, &TORQUE).ask::<Torque>(WATCHDOG));
            lent(client.resolve("anybody", WATCHDOG));
            lent(client.join("drives"));
            lent(client.leave("drives"));
            assert!(client.receive(Duration::ZERO).unwrap().is_none(), "it is looked, and nothing is there");
            client.loaned(message).send().unwrap();
            assert_eq!(app.next().payload[..], vec![7; length]);
            drop(received);
            assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
            assert_eq!(client.resolve("anybody", WATCHDOG).unwrap(), None);
        }
    }
}

fn dropped_loan_leaves_no_trace(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut client = register(under, &node, on(under));
    for length in LENGTHS {
        let mut message = client.create_message(app.tid, RAW, length).unwrap();
        message.fill(7);
        drop(message);
        client.send(app.tid, &TORQUE).unwrap();
        assert_eq!(app.next().decode::<Torque>().unwrap(), TORQUE);
    }
}

fn other_endpoint_without_loan_may_send_this_loan(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut one, mut other) = (register(under, &node, on(under)), register(under, &node, on(under)));
    for length in LENGTHS {
        let message = one.create_message(app.tid, RAW, length).unwrap();
        let its_own = other.create_message(app.tid, RAW, length).unwrap();
        lent(other.loaned(message).send());
        // The message of the failed send is gone, and its memory is returned.
        one.send(app.tid, &TORQUE).unwrap();
        assert_eq!(app.next().header.source, one.tid());
        one.loaned(its_own).send().unwrap();
        let arrived = app.next();
        assert_eq!((arrived.header.source, arrived.payload.len()), (one.tid(), length));
        other.send(app.tid, &TORQUE).unwrap();
        assert_eq!(app.next().header.source, other.tid());
    }
}

fn unregister_during_loan_fails_but_releases_address(under: Under) {
    let node = TestNode::start();
    for length in LENGTHS {
        let mut client = register_when_free(under, &node, on(under).name("knee"));
        let mut message = client.create_message(Tid::NONE, RAW, length).unwrap();
        lent(client.unregister());
        message.fill(7);
        let next = register_when_free(under, &node, on(under).name("knee"));
        drop((message, next));
    }
}

/// A name is free when the node has seen the connection's end.
fn register_when_free(under: Under, node: &TestNode, registration: Registration) -> Client {
    let api = forms::Api::connect(under, node);
    let deadline = super::Time::now() + WATCHDOG;
    loop {
        match api.register(registration.clone()) {
            Ok(client) => return client,
            Err(ApiError::Refused(why)) => {
                assert!(super::Time::now() < deadline, "waited for the name: {why}")
            }
            Err(other) => panic!("{other}"),
        }
    }
}

fn loan_before_node_restart_is_sent_afterwards(under: Under) {
    let mut node = TestNode::start();
    for length in LENGTHS {
        // given: a loaned message of an endpoint, after a restart of its node
        let mut client = register(under, &node, on(under));
        let to = node.local(1).tid;
        let mut message = client.create_message(to, RAW, length).unwrap();
        message.fill(7);
        node.restart();
        let app = node.local(1);
        let deadline = super::Time::now() + WATCHDOG;
        while client.registrations() == 1 {
            assert!(super::Time::now() < deadline, "waited for the endpoint to reconnect");
            if let Err(error) = client.receive(Duration::from_millis(10)) {
                assert!(matches!(error, ApiError::Disconnected(_)), "{error}");
            }
        }
        // when: other things are to go out, they are still refused
        lent(client.send(to, &TORQUE));
        lent(client.join("drives"));
        // then: it goes to the restarted node
        client.loaned(message).send().unwrap();
        let arrived = app.next();
        assert_eq!((arrived.header.source, &arrived.payload[..]), (client.tid(), &vec![7; length][..]));
        client.join("drives").unwrap();
    }
}

fn loan_before_link_setup_is_sent_on_link(under: Under) {
    let node = TestNode::start();
    let (mut one, mut other) = (register(under, &node, on(under)), register(under, &node, on(under)));
    let (to, from) = (other.tid(), one.tid());
    for length in LENGTHS {
        let mut message = one.create_message(to, RAW, length).unwrap();
        message.fill(7);
        // Either endpoint may request the link meanwhile.
        other.send(from, &TORQUE).unwrap();
        drop(one.receive(WATCHDOG).unwrap().expect("a message"));
        let other_receives = thread::spawn(move || {
            let received = other.receive(WATCHDOG).unwrap().expect("the message");
            assert_eq!((received.source(), received.bytes()), (from, &vec![7; length][..]));
            drop(received);
            other
        });
        one.loaned(message).send().unwrap();
        other = other_receives.join().unwrap();
    }
}
