//! Direct links against a real LNCL: two endpoints that exchange messages, and the effects at each when the
//! other ends.

mod hostile;
mod incarnations;
mod observed;
mod room;

use std::{sync::Arc, thread, time::Duration};

use serde::{Deserialize, Serialize};
use sinew_lncl::testing::{TestNode, WATCHDOG};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    router::mismatches::{Effect, Mismatch, Mismatches, TypedPath},
    tid::Tid,
    time::Time,
    wire::{Class, Kind, Payload},
};

use crate::{ApiError, DirectLinks, Endpoint, NodeApi, Registration};

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Counted(u64);

impl Payload for Counted {
    const NAME: &'static str = "test.counted";
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Urgent(u64);

impl Payload for Urgent {
    const NAME: &'static str = "test.urgent";
    const CLASS: Class = Class::Control;
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Setpoint(u64);

impl Payload for Setpoint {
    const NAME: &'static str = "test.setpoint";
    const CLASS: Class = Class::Stream;
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Mode(u64);

impl Payload for Mode {
    const NAME: &'static str = "test.mode";
    const CLASS: Class = Class::Stream;
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Picture(String);

impl Payload for Picture {
    const NAME: &'static str = "test.picture";
    const CLASS: Class = Class::Stream;
}

fn register(node: &TestNode, registration: Registration) -> Endpoint {
    NodeApi::connect(node.path()).unwrap().register_transport_address(registration).unwrap()
}

fn with_links() -> Registration {
    Registration::new().direct(DirectLinks::Always)
}

fn endpoint(node: &TestNode) -> Endpoint {
    register(node, with_links())
}

fn has_link(from: &Endpoint, to: &Endpoint) -> bool {
    from.direct.open.iter().any(|link| link.peer == to.tid())
}

/// Sends and receives until each has an open link with the other.
fn link(one: &mut Endpoint, other: &mut Endpoint) {
    let deadline = Time::now() + WATCHDOG;
    one.send(other.tid(), &Counted(0)).unwrap();
    while !(has_link(one, other) && has_link(other, one)) {
        assert!(Time::now() < deadline, "waited for a link between {one:?} and {other:?}");
        for endpoint in [&mut *one, &mut *other] {
            drop(endpoint.receive(Duration::from_millis(1)).unwrap());
        }
    }
}

#[test]
fn mutual_senders_switch_to_direct_link() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    one.send(other.tid(), &Counted(7)).unwrap();
    let received = other.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!((received.source(), received.decode::<Counted>().unwrap()), (one.tid(), Counted(7)));
    let outcome = thread::scope(|scope| {
        let (from, to) = (&mut one, other.tid());
        let sending = scope.spawn(move || from.message(to, &Counted(8)).confirmed(WATCHDOG).unwrap());
        other.receive(WATCHDOG).unwrap().expect("a message").settle(Outcome::Failed);
        sending.join().unwrap()
    });
    assert_eq!(outcome, Outcome::Failed, "an outcome comes back on the link");
}

#[test]
fn link_carries_messages_while_node_is_idle() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    // The node has no route to either of them any more.
    for tid in [one.tid(), other.tid()] {
        node.router().remove_local(tid.app);
    }
    let to = other.tid();
    let asking = thread::spawn(move || {
        let reply: Counted = one.message(to, &Counted(2)).ask(WATCHDOG).unwrap();
        reply
    });
    let request = other.receive(WATCHDOG).unwrap().expect("a request");
    other.reply(&request, &Counted(3)).unwrap();
    drop(request);
    assert_eq!(asking.join().unwrap(), Counted(3));
}

#[test]
fn send_only_endpoint_gets_a_link() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let deadline = Time::now() + WATCHDOG;
    while !has_link(&other, &one) {
        assert!(Time::now() < deadline, "waited for the link of an endpoint that only sends");
        one.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(Duration::from_millis(1)).unwrap());
    }
}

/// Sends messages until there is a link.
fn send_until_linked(one: &mut Endpoint, other: &mut Endpoint, send: impl Fn(&mut Endpoint, Tid)) {
    let deadline = Time::now() + WATCHDOG;
    while !(has_link(one, other) && has_link(other, one)) {
        assert!(Time::now() < deadline, "waited for a link between {one:?} and {other:?}");
        send(one, other.tid());
        for endpoint in [&mut *one, &mut *other] {
            drop(endpoint.receive(Duration::from_millis(1)).unwrap());
        }
    }
}

#[test]
fn frequent_messages_get_an_automatic_link() {
    let node = TestNode::start();
    let automatic = || register(&node, Registration::new().direct(DirectLinks::Automatic));
    let (mut one, mut other) = (automatic(), automatic());
    for _ in 0..7 {
        one.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(WATCHDOG).unwrap().expect("a message"));
    }
    assert!(!one.direct.needs_checks(), "it does not request a link for seven messages");
    send_until_linked(&mut one, &mut other, |one, to| one.send(to, &Counted(1)).unwrap());
}

/// While the ring to the node is lent, it cannot carry the request.
#[test]
fn frequent_loans_get_an_automatic_link() {
    let node = TestNode::start();
    let mut one = register(&node, Registration::new().direct(DirectLinks::Automatic));
    let mut other = endpoint(&node);
    send_until_linked(&mut one, &mut other, |one, to| {
        let loan = one.create_message(to, Kind::named("test.loan"), 8).unwrap();
        one.loaned(loan).send().unwrap();
    });
}

#[test]
fn each_class_stays_in_order_across_switch() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let to = other.tid();
    let sending = thread::spawn(move || {
        let deadline = Time::now() + WATCHDOG;
        for number in 1..=2_000_u64 {
            // The first messages go through the node. The link is up before the last one, however fast they
            // are.
            while number == 1_000 && !one.direct.open.iter().any(|link| link.peer == to) {
                assert!(Time::now() < deadline, "waited for a link to {to}");
                assert!(one.receive(Duration::from_millis(1)).unwrap().is_none());
            }
            one.send(to, &Counted(number)).unwrap();
            one.send(to, &Urgent(number)).unwrap();
            // It must poll to learn that the link is up.
            assert!(one.receive(Duration::ZERO).unwrap().is_none());
        }
        one
    });
    let (mut counted, mut urgent) = (0, 0);
    let deadline = Time::now() + WATCHDOG * 3;
    while counted < 2_000 || urgent < 2_000 {
        assert!(Time::now() < deadline, "waited for 2,000 of each; {counted} and {urgent} have come");
        let Some(received) = other.receive(Duration::from_millis(10)).unwrap() else { continue };
        let (last, number) = if received.kind() == Counted::KIND {
            (&mut counted, received.decode::<Counted>().unwrap().0)
        } else {
            (&mut urgent, received.decode::<Urgent>().unwrap().0)
        };
        assert!(number > *last, "{number} came after {last}");
        *last = number;
    }
    let one = sending.join().unwrap();
    assert!(has_link(&other, &one), "they have switched");
}

/// Marks carry a number of their sender, introductions one of LNCL. A request that waits for the same number
/// must not take either for its answer.
#[test]
fn link_is_established_despite_equal_request_number() {
    for next_number in [1, 2] {
        // given: one endpoint waits for an outcome
        let node = TestNode::start();
        let (mut one, mut other) = (endpoint(&node), endpoint(&node));
        let app = node.local(1);
        one.requests.correlation = 40;
        // Its introduction request carries one number, its SWITCH the next.
        other.requests.correlation = 40 + 1 - next_number;
        let (to, asked) = (one.tid(), app.tid);
        thread::scope(|scope| {
            let waiting = scope.spawn(|| one.message(asked, &Counted(1)).confirmed(WATCHDOG).unwrap());
            let mut message = app.next();
            // when
            let deadline = Time::now() + WATCHDOG / 2;
            other.send(to, &Counted(2)).unwrap();
            while !other.direct.open.iter().any(|link| link.peer == to) {
                assert!(Time::now() < deadline, "waited for a link with {to}");
                drop(other.receive(Duration::from_millis(1)).unwrap());
            }
            // then
            message.settle(Outcome::Delivered);
            assert_eq!(waiting.join().unwrap(), Outcome::Delivered);
        });
    }
}

#[test]
fn endpoint_without_links_gets_none() {
    let node = TestNode::start();
    let mut one = endpoint(&node);
    let mut other = register(&node, Registration::new().direct(DirectLinks::Never));
    for _ in 0..20 {
        one.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(WATCHDOG).unwrap().expect("a message"));
        other.send(one.tid(), &Counted(1)).unwrap();
        drop(one.receive(WATCHDOG).unwrap().expect("a message"));
    }
    assert!(one.direct.is_empty() && other.direct.is_empty());
}

#[test]
fn endpoints_with_a_refused_type_get_no_link() {
    // given: the node refuses one type from the other one, and a link would carry it
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let path = TypedPath { source: other.tid(), target: one.tid().app, kind: Mode::KIND };
    let table = Mismatches::new([(path, Mismatch::new(Effect::Refused))], Arc::new(|| {}));
    assert!(node.router().set_mismatches(Some(table), node.router().route_changes()));
    // when: each sends messages of another type
    for _ in 0..20 {
        one.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(WATCHDOG).unwrap().expect("a message"));
        other.send(one.tid(), &Counted(1)).unwrap();
        drop(one.receive(WATCHDOG).unwrap().expect("a message"));
    }
    // then
    assert!(one.direct.is_empty() && other.direct.is_empty());
}

/// The kind and the number of the next message that has arrived.
fn next_number(endpoint: &mut Endpoint) -> Option<(Kind, u64)> {
    let received = endpoint.receive(Duration::ZERO).unwrap()?;
    let number = match received.kind() {
        Urgent::KIND => received.decode::<Urgent>().unwrap().0,
        Setpoint::KIND => received.decode::<Setpoint>().unwrap().0,
        _ => received.decode::<Counted>().unwrap().0,
    };
    Some((received.kind(), number))
}

#[test]
fn messages_that_wait_in_a_ring_are_sorted() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    while next_number(&mut other).is_some() {}
    let to = other.tid();
    // One message alone is received past the inbox.
    one.send(to, &Counted(1)).unwrap();
    assert_eq!(next_number(&mut other), Some((Counted::KIND, 1)));
    assert_eq!(next_number(&mut other), None);
    // Several are not: a newer value supersedes, and the more urgent class is first.
    one.message(to, &Counted(2)).class(Class::Bulk).send().unwrap();
    one.send(to, &Setpoint(3)).unwrap();
    one.send(to, &Setpoint(4)).unwrap();
    one.send(to, &Urgent(5)).unwrap();
    for expected in [(Urgent::KIND, 5), (Setpoint::KIND, 4), (Counted::KIND, 2)] {
        assert_eq!(next_number(&mut other), Some(expected));
    }
    assert_eq!(next_number(&mut other), None);
}

#[test]
fn only_message_that_has_expired_is_not_received() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    while next_number(&mut other).is_some() {}
    let age = Duration::from_micros(1);
    one.message(other.tid(), &Counted(1)).expires_after(age).send().unwrap();
    let sent = Time::now();
    while Time::now().since(sent) <= age {}
    assert_eq!(next_number(&mut other), None);
    one.send(other.tid(), &Counted(2)).unwrap();
    assert_eq!(next_number(&mut other), Some((Counted::KIND, 2)));
}
