//! Pending outcomes of a client that does not read for a while.

use std::collections::BTreeMap;

use super::*;

/// Returns the outcomes of the messages 1 to `count`; the client reads all frames.
fn outcomes(client: &mut RawClient, count: u64) -> BTreeMap<u64, Outcome> {
    let mut outcomes = BTreeMap::new();
    while outcomes.len() < count as usize {
        let message = client.next().expect("an outcome is missing");
        if message.header.kind == Kind::OUTCOME {
            let (correlation, outcome) = outcome_of(&message);
            assert_eq!(outcomes.insert(correlation, outcome), None, "{correlation} ends once");
        }
    }
    outcomes
}

/// Fills the queue of a client that does not read with Control messages.
fn fill(node: &TestNode, source: Tid, client: Tid) {
    let filler = || {
        let mut filler = filler(source, client);
        filler.header.class = Class::Control;
        filler
    };
    while node.state.ctx.router.send(filler()).is_ok() {}
}

// spec: LNCL-16
#[test]
fn slow_client_receives_the_outcome_of_each_message() {
    // Given: a client with a queue full of Control messages.
    let node = TestNode::start_with(|config| config.mailbox_capacity = 16);
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    fill(&node, app.tid, tid);

    // When: it sends confirmed messages, to an application and to none.
    let absent = Tid::new(node.address(), AppAddress::fixed(9).unwrap());
    for correlation in 1..=8 {
        client.send(&confirmed(tid, if correlation % 2 == 0 { app.tid } else { absent }, correlation));
    }
    for _ in 0..4 {
        app.next().settle(Outcome::Delivered);
    }

    // Then: it reads the outcome of each.
    let outcomes = outcomes(&mut client, 8);
    for (correlation, outcome) in outcomes {
        let none = Outcome::Rejected(Rejection::NoSuchApplication);
        assert_eq!(outcome, if correlation % 2 == 0 { Outcome::Delivered } else { none }, "{correlation}");
    }
}

// spec: LNCL-16
#[test]
fn client_that_reads_no_outcomes_is_not_read() {
    // More than are ever read of a client that reads nothing.
    const FAR_TOO_MANY: u64 = 200_000;
    let node = TestNode::start_with(|config| config.mailbox_capacity = 4);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let absent = Tid::new(node.address(), AppAddress::fixed(9).unwrap());

    // When: a client sends as long as the node accepts it, and reads nothing.
    let sent = (1..FAR_TOO_MANY)
        .take_while(|correlation| client.takes_at_once(&confirmed(tid, absent, *correlation)))
        .count() as u64;

    // Then: the node has stopped reading, and when the client reads, each of its messages has its outcome.
    assert!(sent < FAR_TOO_MANY - 1, "the node keeps on reading");
    let outcomes = outcomes(&mut client, sent);
    let expected = Outcome::Rejected(Rejection::NoSuchApplication);
    assert!(outcomes.values().all(|outcome| *outcome == expected), "{outcomes:?}");
}

// spec: LNCL-16
#[test]
fn messages_without_outcome_are_bounded_per_client() {
    // Given: a client with the maximum number of messages at an application that does not settle them.
    const PENDING: u64 = 8 * 16;
    let node = TestNode::start_with(|config| config.mailbox_capacity = 16);
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let send = |client: &mut RawClient, correlations: std::ops::RangeInclusive<u64>| {
        correlations.for_each(|correlation| client.send(&confirmed(tid, app.tid, correlation)));
    };
    send(&mut client, 1..=PENDING);
    let held: Vec<_> = (0..PENDING).map(|_| app.next()).collect();

    // When: it sends one more, then: that one is refused.
    send(&mut client, PENDING + 1..=PENDING + 1);
    let refused = (PENDING + 1, Outcome::Rejected(Rejection::QueueFull));
    assert_eq!(outcome_of(&client.next().unwrap()), refused);

    // And: after the others are settled, the next one is accepted.
    held.into_iter().for_each(|mut message| message.settle(Outcome::Delivered));
    outcomes(&mut client, PENDING);
    send(&mut client, PENDING + 2..=PENDING + 2);
    app.next().settle(Outcome::Delivered);
    assert_eq!(outcome_of(&client.next().unwrap()), (PENDING + 2, Outcome::Delivered));
}
