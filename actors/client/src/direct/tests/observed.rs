//! A watched endpoint reports the messages on its links.

use std::sync::Arc;

use sinew_runtime::{
    lock,
    outcome::{self, Outcome, OutcomeObserver, Ticket},
    router::tap::{Passage, Tap, TapOf, Way},
    tid::{AppAddress, Tid},
    wire::{Header, Kind},
};

use super::*;

/// What a watcher of one application sees.
struct Notes {
    app: Tid,
    seen: std::sync::Mutex<Vec<(Way, Header, Vec<u8>)>>,
}

impl Tap for Notes {
    fn watches(&self, app: Tid) -> bool {
        self.app == app
    }

    fn saw(&self, _: Tid, passage: &Passage<'_>) {
        assert_eq!(passage.length, passage.payload.len());
        lock(&self.seen).push((passage.way, *passage.header, passage.payload.to_vec()));
    }

    fn missed(&self, _: Tid, messages: u64) {
        panic!("{messages} of a few messages were not reported");
    }
}

impl Notes {
    fn numbers(&self, way: Way) -> Vec<u64> {
        let seen = lock(&self.seen);
        let of_way = seen.iter().filter(|(seen, header, _)| *seen == way && header.kind == Counted::KIND);
        of_way.map(|(_, _, payload)| rmp_serde::from_slice::<Counted>(payload).unwrap().0).collect()
    }
}

/// Sends this number there, and the same back.
fn exchange(one: &mut Endpoint, other: &mut Endpoint, number: u64) {
    one.send(other.tid(), &Counted(number)).unwrap();
    drop(other.receive(WATCHDOG).unwrap().expect("the message"));
    other.send(one.tid(), &Counted(number)).unwrap();
    drop(one.receive(WATCHDOG).unwrap().expect("the answer"));
}

#[test]
fn watched_endpoint_reports_messages_on_its_links() {
    // Given: a link, and a watcher of one end
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let notes = Arc::new(Notes { app: one.tid(), seen: std::sync::Mutex::default() });
    let links = &node.state.observed_links;
    node.router().set_tap(TapOf::Watches, Some(notes.clone()));
    links.observe(node.router());
    // When: messages flow until the first is reported
    let deadline = Time::now() + WATCHDOG;
    let mut last = 0;
    while notes.numbers(Way::In).is_empty() {
        assert!(Time::now() < deadline, "waited for a report");
        last += 1;
        exchange(&mut one, &mut other, last);
    }
    (last + 1..last + 10).for_each(|number| exchange(&mut one, &mut other, number));
    // Then: both directions are there, each message once and in order
    for way in [Way::In, Way::Out] {
        while !notes.numbers(way).contains(&(last + 9)) {
            assert!(Time::now() < deadline, "waited for the report of the last message");
            thread::yield_now();
        }
        let numbers = notes.numbers(way);
        assert!(numbers.windows(2).all(|pair| pair[0] + 1 == pair[1]), "{numbers:?}");
    }
    // When: the watcher has gone, and the endpoint has learned it
    node.router().set_tap(TapOf::Watches, None);
    links.observe(node.router());
    let seen = lock(&notes.seen).len();
    while one.direct.is_observed() {
        assert!(Time::now() < deadline, "waited for the end of the reports");
        exchange(&mut one, &mut other, 0);
    }
    // Then: nothing more is shown
    assert_eq!(lock(&notes.seen).len(), seen);
}

/// The outcomes of the messages of one application.
struct Outcomes {
    source: Tid,
    seen: std::sync::Mutex<Vec<(Tid, Outcome)>>,
}

impl OutcomeObserver for Outcomes {
    fn settled(&self, ticket: Ticket, outcome: Outcome) {
        if ticket.source == self.source {
            lock(&self.seen).push((ticket.destination, outcome));
        }
    }
}

/// Returns an endpoint with an address that no other test of this process has, and the outcomes of its messages.
fn with_outcomes(node: &TestNode, index: u32) -> (Endpoint, Arc<Outcomes>) {
    let address = AppAddress::fixed(index).expect("it is one");
    let endpoint = register(node, with_links().fixed_address(address));
    let outcomes = Arc::new(Outcomes { source: endpoint.tid(), seen: std::sync::Mutex::default() });
    let observer: Arc<dyn OutcomeObserver> = outcomes.clone();
    assert!(outcome::observe(&observer, None));
    (endpoint, outcomes)
}

#[test]
fn observed_endpoint_reports_outcomes_on_its_links() {
    let node = TestNode::start();
    let ((mut one, outcomes), mut other) = (with_outcomes(&node, 0x770), endpoint(&node));
    link(&mut one, &mut other);
    assert!(lock(&outcomes.seen).is_empty(), "those of the link's setup are no messages'");
    let notes = Arc::new(Notes { app: one.tid(), seen: std::sync::Mutex::default() });
    node.router().set_tap(TapOf::Recording, Some(notes.clone()));
    node.state.observed_links.observe(node.router());
    let deadline = Time::now() + WATCHDOG;
    while !one.direct.is_observed() {
        assert!(Time::now() < deadline, "waited for the order to report");
        exchange(&mut one, &mut other, 1);
    }
    thread::scope(|scope| {
        let (from, to) = (&mut one, other.tid());
        let sending = scope.spawn(move || from.message(to, &Counted(2)).confirmed(WATCHDOG).unwrap());
        other.receive(WATCHDOG).unwrap().expect("a message").settle(Outcome::Failed);
        assert_eq!(sending.join().unwrap(), Outcome::Failed);
    });
    while lock(&outcomes.seen).is_empty() {
        assert!(Time::now() < deadline, "waited for the report of the outcome");
        thread::yield_now();
    }
    assert_eq!(*lock(&outcomes.seen), [(other.tid(), Outcome::Failed)]);
}

// spec: LNCL-20
#[test]
fn outcome_is_not_shown_unless_its_client_is_observed() {
    let node = TestNode::start();
    let ((mut one, outcomes), other) = (with_outcomes(&node, 0x771), endpoint(&node));
    let header = Header { correlation: 7, ..Header::new(Kind::OUTCOME, other.tid(), one.tid()) };
    let mut report = |payload: &[u8]| {
        let observed = sinew_protocol::observed::Observed::of(&header, payload, false);
        one.node.writer.write(&observed.frame(one.tid())).unwrap();
        // A round trip through the node comes behind the report.
        assert_eq!(one.resolve("nobody", WATCHDOG).unwrap(), None);
    };
    // Given: a client that reports although nothing is recorded
    report(&[Outcome::Failed.code()]);
    assert!(lock(&outcomes.seen).is_empty());
    // When
    let notes = Arc::new(Notes { app: header.destination, seen: std::sync::Mutex::default() });
    node.router().set_tap(TapOf::Recording, Some(notes));
    [&b""[..], &[15], &[Outcome::Expired.code()]].into_iter().for_each(&mut report);
    node.router().set_tap(TapOf::Recording, None);
    report(&[Outcome::Failed.code()]);
    // Then: bytes that are no outcome are none
    assert_eq!(*lock(&outcomes.seen), [(header.source, Outcome::Expired)]);
}

// spec: LNCL-20
#[test]
fn report_of_another_application_is_dropped() {
    let node = TestNode::start();
    let (mut one, other) = (endpoint(&node), endpoint(&node));
    let notes = Arc::new(Notes { app: other.tid(), seen: std::sync::Mutex::default() });
    node.router().set_tap(TapOf::Watches, Some(notes.clone()));
    let header = Header::new(Kind::named("test.forged"), one.tid(), other.tid());
    for (claimed, is_sent) in [(one.tid(), false), (other.tid(), true)] {
        let header = Header { source: claimed, ..header };
        let observed = sinew_protocol::observed::Observed::of(&header, &[1], is_sent);
        one.node.writer.write(&observed.frame(one.tid())).unwrap();
    }
    // A round trip through the node comes behind the reports.
    assert_eq!(one.resolve("nobody", WATCHDOG).unwrap(), None);
    assert_eq!(node.refused("report of another's message"), 2);
    assert!(lock(&notes.seen).is_empty());
}
